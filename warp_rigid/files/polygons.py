"""Mesh files with polygons, convex or not, and the division of polygons into triangles.

trimesh divides polygons into fans, which fill the notches of concave ones. The formats that have polygons are therefore
read here, PLY with the parser of trimesh.
"""

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np


class Triangles(NamedTuple):
    """All triangles of a file.

    Attributes:
        vertices: (n, 3) float64.
        faces: (m, 3) int64.
        uv: texture coordinates of the corners of the faces (m, 3, 2), NaN where a corner has none; None without.
        image: the image of the first material that has one: the path of its file, or an image of Pillow that is in the
            file; None without.
    """

    vertices: np.ndarray
    faces: np.ndarray
    uv: np.ndarray | None = None
    image: Any = None


FLAT = 1e-9
"""Area of a triangle up to which its corners are on a line, relative to that of its polygon."""


def triangles_of_corners(
    points: np.ndarray, corners: np.ndarray, sides: np.ndarray, names: tuple[str, str] = ("indices", "sizes of faces")
) -> np.ndarray:
    """Divide polygons into triangles of corners (m, 3): fans from their first corners, if all triangles have an area.

    Others are projected along their normal, the mean over the fan, and divided by the package manifold3d.

    Args:
        points: (n, 3).
        corners: indices of the corners of all polygons, one after another (c,).
        sides: number of corners of each polygon (p,); those with less than three have no triangles.
        names: of corners and sides in messages.

    Returns:
        Places in `corners`, so that what belongs to a corner of a polygon can follow it.

    Raises:
        ValueError: The arrays do not match each other.
    """
    if len(sides) and sides.min() < 0:
        raise ValueError(f"{names[1]} must be >= 0, got {sides.min()}")
    if sides.sum() != len(corners):
        raise ValueError(f"{names[1]} must add up to the length of {names[0]}, {len(corners)}, got {sides.sum()}")
    if len(corners) and not 0 <= corners.min() <= corners.max() < len(points):
        raise ValueError(f"{names[0]} must be >= 0 and < {len(points)}, got {corners.min()} to {corners.max()}")
    count = np.maximum(sides - 2, 0)
    start, first = np.cumsum(sides) - sides, np.cumsum(count) - count
    polygon = np.repeat(np.arange(len(sides)), count)
    second = start[polygon] + np.arange(1, len(polygon) + 1) - first[polygon]
    triangles = np.stack([start[polygon], second, second + 1], axis=1)
    a, b, c = (points[corners[triangles[:, k]]] for k in range(3))
    area = np.cross(b - a, c - a)
    normal = np.stack([np.bincount(polygon, area[:, k], minlength=len(sides)) for k in range(3)], axis=1)
    size = np.linalg.norm(normal, axis=1)
    wrong = np.einsum("ij,ij->i", area, normal[polygon]) <= FLAT * size[polygon] ** 2
    for k in np.unique(polygon[wrong & (count[polygon] > 1) & (size[polygon] > 0.0)]).tolist():
        own = corners[start[k] : start[k] + sides[k]]
        triangles[first[k] : first[k] + count[k]] = start[k] + _divided(points[own], normal[k] / size[k])
    return triangles


def _divided(points: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Triangles (k - 2, 3) of one polygon (k, 3), counterclockwise about its normal."""
    import manifold3d

    across = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    across /= np.linalg.norm(across)
    plane = (points - points.mean(axis=0)) @ np.stack([across, np.cross(normal, across)], axis=1)
    return np.asarray(manifold3d.triangulate([plane], allow_convex=False))


def _corners(polygons: Iterable[Any]) -> np.ndarray:
    """The corners of all polygons, one after another (c,)."""
    return np.concatenate([np.zeros(0, dtype=np.int64), *(np.asarray(row, dtype=np.int64) for row in polygons)])


def _triangles(points: Any, polygons: Iterable[Any], uv: np.ndarray | None = None, image: Any = None) -> Triangles:
    """The triangles of polygons, given by their corners, with texture coordinates of all corners (c, 2)."""
    points = np.array(points, dtype=np.float64).reshape(-1, 3)
    corners, sides = _corners(polygons), np.array([len(row) for row in polygons], dtype=np.int64)
    triangles = triangles_of_corners(points, corners, sides)
    return Triangles(points, corners[triangles], None if uv is None else uv[triangles], image)


def _lines(path: Path) -> list[list[str]]:
    """The words of each line of a text file, without comments and empty lines; a backslash continues a line."""
    text = path.read_text(errors="replace").replace("\\\n", " ")
    return [words for line in text.splitlines() if (words := line.split("#", 1)[0].split())]


def _read_obj(path: Path) -> Triangles:
    """Points, faces, texture coordinates and the first image of an OBJ file."""
    points: list[list[float]] = []
    places: list[list[float]] = [[np.nan, np.nan]]  # the first is that of corners without one
    polygons, uv, libraries = [], [], []
    for name, *words in _lines(path):
        if name == "v":
            points.append([float(word) for word in words[:3]])
        elif name == "vt":
            places.append([float(word) for word in (*words, "0")[:2]])
        elif name == "f":
            # Numbers start at 1; negative ones count back from the latest point.
            numbers = [[int(part or 0) for part in (*word.split("/"), "")[:2]] for word in words]
            polygons.append([point - 1 if point >= 0 else len(points) + point for point, _ in numbers])
            uv += [place if place >= 0 else len(places) + place for _, place in numbers]
        elif name == "mtllib":
            libraries.append(path.parent / " ".join(words))
    if len(places) == 1:
        return _triangles(points, polygons)
    if uv and not 0 <= min(uv) <= max(uv) < len(places):
        raise ValueError(f"vt: there are {len(places) - 1}, but a face names {max(uv)}")
    return _triangles(points, polygons, np.array(places)[uv].reshape(-1, 2), _image_of_materials(libraries))


def _image_of_materials(libraries: list[Path]) -> Path | None:
    """The first image of a diffuse colour in some files of materials."""
    for library in libraries:
        if library.is_file():
            for name, *words in _lines(library):
                # Options begin with a minus; what follows the last one and its numbers is the path, spaces included.
                while words and _is_option(words[0]):
                    words = words[1:]
                if name == "map_Kd" and words:
                    return library.parent / " ".join(words).replace("\\", "/")
    return None


def _is_option(word: str) -> bool:
    """Whether a word before the path of an image is an option or its value."""
    return word.startswith("-") or word in ("on", "off") or word.replace(".", "", 1).isdigit()


def _read_off(path: Path) -> Triangles:
    """Points and faces of an OFF file, without colours and normals."""
    (title, *rest), *lines = _lines(path)
    if title.upper() not in ("OFF", "COFF", "NOFF", "CNOFF"):
        raise ValueError(f"must begin with OFF, got {title[:20]!r}")
    lines = [rest, *lines] if rest else lines
    count, faces = (int(word) for word in lines[0][:2])
    if len(lines) < 1 + count + faces:
        raise ValueError(f"must have {count} points and {faces} faces, has {len(lines) - 1} lines")
    points = [[float(word) for word in words[:3]] for words in lines[1 : 1 + count]]
    polygons = [[int(word) for word in words[1 : 1 + int(words[0])]] for words in lines[1 + count : 1 + count + faces]]
    return _triangles(points, polygons)


def _read_ply(path: Path) -> Triangles:
    """Points, faces, texture coordinates and the image of a PLY file."""
    # Not load_ply, which cannot read polygons of several sizes with texture coordinates.
    from trimesh.exchange import ply

    with path.open("rb") as stream:
        elements, is_text, image = ply._parse_header(stream)
        (ply._ply_ascii if is_text else ply._ply_binary)(elements, stream)
    points = np.column_stack([np.ravel(elements["vertex"]["data"][axis]) for axis in "xyz"])
    faces = elements.get("face", {}).get("data")
    polygons = _rows_of_ply(faces, "vertex_indices", "vertex_index")
    uv = _uv_of_ply(elements["vertex"]["data"], _rows_of_ply(faces, "texcoord"), _corners(polygons))
    return _triangles(points, polygons, uv, path.parent / image if image and uv is not None else None)


def _rows_of_ply(data: Any, *names: str) -> Any:
    """The lists of the faces with one of some names; an empty tuple without."""
    for name in names:
        if data is not None and name in (data.dtype.names or () if isinstance(data, np.ndarray) else data):
            rows = data[name]
            # The parser keeps lists of one length as fields of an array in a binary file, and as rows in a text file.
            return rows["f1"] if isinstance(rows, np.ndarray) and rows.dtype.names else rows
    return ()


def _uv_of_ply(vertices: Any, of_faces: Any, corners: np.ndarray) -> np.ndarray | None:
    """Texture coordinates of the corners (c, 2): from lists of faces, or those of their vertices; None without."""
    if len(of_faces):
        uv = np.concatenate([np.ravel(row) for row in of_faces]).astype(np.float64).reshape(-1, 2)
        if len(uv) != len(corners):
            raise ValueError(
                f"texcoord: must have {len(corners)} pairs, one for each corner of the faces, got {len(uv)}"
            )
        return uv
    known = vertices.dtype.names or () if isinstance(vertices, np.ndarray) else vertices
    for u, v in (("s", "t"), ("u", "v"), ("texture_u", "texture_v")):
        if u in known and v in known:
            return np.column_stack([np.ravel(vertices[u]), np.ravel(vertices[v])]).astype(np.float64)[corners]
    return None


READERS: dict[str, Callable[[Path], Triangles]] = {".obj": _read_obj, ".off": _read_off, ".ply": _read_ply}
"""Functions that read the triangles of a file with polygons, by its suffix."""
