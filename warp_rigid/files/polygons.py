"""Mesh files with polygons, convex or not, and the division of polygons into triangles.

trimesh divides polygons into fans, which fill the notches of concave ones. The formats that have polygons are therefore
read here, PLY with the parser of trimesh.
"""

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np

Polygons = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Points (n, 3), the corners of all polygons one after another (c,), and the number of corners of each polygon (p,)."""

FLAT = 1e-9
"""Area of a triangle up to which its corners are on a line, relative to that of its polygon."""


def triangulated(
    points: np.ndarray, corners: np.ndarray, sides: np.ndarray, names: tuple[str, str] = ("indices", "sizes of faces")
) -> np.ndarray:
    """Divide polygons into triangles (m, 3) of points; see `triangles_of_corners`."""
    return corners[triangles_of_corners(points, corners, sides, names)]


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


def _listed(points: Any, polygons: Iterable[Any]) -> Polygons:
    """Polygons from the lists of their corners."""
    rows = [np.asarray(row, dtype=np.int64) for row in polygons]
    corners = np.concatenate([np.zeros(0, dtype=np.int64), *rows])
    return (
        np.array(points, dtype=np.float64).reshape(-1, 3),
        corners,
        np.array([len(row) for row in rows], dtype=np.int64),
    )


def _lines(path: Path) -> list[list[str]]:
    """The words of each line of a text file, without comments and empty lines; a backslash continues a line."""
    text = path.read_text(errors="replace").replace("\\\n", " ")
    return [words for line in text.splitlines() if (words := line.split("#", 1)[0].split())]


def _read_obj(path: Path) -> Polygons:
    """Points and faces of an OBJ file; other lines, such as those that name files of materials, are not used."""
    points: list[list[float]] = []
    polygons = []
    for name, *words in _lines(path):
        if name == "v":
            points.append([float(word) for word in words[:3]])
        elif name == "f":
            # Numbers start at 1; negative ones count back from the latest point.
            numbers = [int(word.split("/")[0]) for word in words]
            polygons.append([number - 1 if number >= 0 else len(points) + number for number in numbers])
    return _listed(points, polygons)


def _read_off(path: Path) -> Polygons:
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
    return _listed(points, polygons)


def _read_ply(path: Path) -> Polygons:
    """Points and faces of a PLY file."""
    from trimesh.exchange.ply import load_ply

    with path.open("rb") as stream:
        elements = load_ply(stream, skip_materials=True)["metadata"]["_ply_raw"]
    points = np.column_stack([np.ravel(elements["vertex"]["data"][axis]) for axis in "xyz"])
    data = elements.get("face", {}).get("data")
    rows: Any = ()
    for name in ("vertex_indices", "vertex_index"):
        if data is not None and name in (data.dtype.names or () if isinstance(data, np.ndarray) else data):
            rows = data[name]
    # The parser keeps lists of one length as fields of an array in a binary file, and as rows in a text file.
    return _listed(points, rows["f1"] if isinstance(rows, np.ndarray) and rows.dtype.names else rows)


READERS: dict[str, Callable[[Path], Polygons]] = {".obj": _read_obj, ".off": _read_off, ".ply": _read_ply}
"""Functions that read the polygons of a file, by its suffix."""
