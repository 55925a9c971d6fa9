"""Reading triangle meshes from files, and single meshes of USD."""

import contextlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from warp_rigid.checks import number_in
from warp_rigid.files import polygons
from warp_rigid.files.polygons import Triangles

USD_SUFFIXES = (".usd", ".usda", ".usdc", ".usdz")


def load(path, scale: float = 1.0) -> Triangles:
    """All triangles of a file.

    Args:
        path: the file; the suffix selects the format.
        scale: factor on all coordinates, > 0.

    Raises:
        ValueError: The file has an unknown format, is unreadable, or has no triangles.
        FileNotFoundError: The file does not exist.
    """
    path = Path(path)
    scale = number_in("scale", scale, above=0)
    suffix = path.suffix.lower()
    if suffix not in READERS:
        raise ValueError(f"{path}: must be a mesh file ({' '.join(READERS)})")
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    try:
        found = READERS[suffix](path)
    except Exception as error:  # the exceptions of the parsers are not documented
        reason = (str(error).strip() or repr(error)).splitlines()[0]
        raise ValueError(reason if reason.startswith(f"{path}: ") else f"{path}: cannot be read: {reason}") from None
    if not len(found.faces):
        raise ValueError(f"{path}: holds no triangles")
    return found._replace(vertices=scale * found.vertices)


def states_its_unit(path) -> bool:
    """Whether coordinates of a file's format are in metres, or in a unit that the file states."""
    return Path(path).suffix.lower() in (".glb", ".gltf", *USD_SUFFIXES)


def _load_trimesh(path: Path) -> Triangles:
    import trimesh

    class RegularFiles(trimesh.resolvers.FilePathResolver):
        """The files beside a mesh; a named pipe among them would be waited for without end."""

        def absolute(self, name: str) -> Path:
            """The path of a file."""
            found = super().absolute(name)
            if found.exists() and not found.is_file():
                raise ValueError(f"{found}: must be a regular file")
            return found

    # Not as one mesh: trimesh would pack several images into one, and change the coordinates.
    scene: Any = trimesh.load_scene(path, process=False, resolver=RegularFiles(str(path)))
    parts = []
    for mesh in scene.dump():
        if hasattr(mesh, "faces"):
            vertices, faces = np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces, dtype=np.int64)
            uv = getattr(mesh.visual, "uv", None)
            uv = None if uv is None or len(uv) != len(vertices) else np.asarray(uv, np.float64)[faces]
            parts.append(Triangles(vertices, faces, uv))
    images = [image_of(mesh.visual) for mesh in scene.geometry.values() if hasattr(mesh, "faces")]
    first = next((image for image in images if image is not None), None)
    found = joined(parts)._replace(image=first)
    if path.suffix.lower() in (".glb", ".gltf"):
        found = found._replace(vertices=_turn_z_up(found.vertices))
    return found


def image_of(visual: Any) -> Any:
    """The image of the colour of a visual of trimesh, of Pillow; None without."""
    material = getattr(visual, "material", None)
    return getattr(material, "baseColorTexture", None) or getattr(material, "image", None)


def joined(parts: Sequence[Triangles]) -> Triangles:
    """Several meshes as one."""
    first = np.cumsum([0, *(len(part.vertices) for part in parts)])
    faces = [part.faces + start for part, start in zip(parts, first, strict=False)]
    uv = [np.full((len(part.faces), 3, 2), np.nan) if part.uv is None else part.uv for part in parts]
    return Triangles(
        np.concatenate([np.zeros((0, 3)), *(part.vertices for part in parts)]),
        np.concatenate([np.zeros((0, 3), dtype=np.int64), *faces]),
        np.concatenate(uv) if any(part.uv is not None for part in parts) else None,
    )


def _load_usd(path: Path) -> Triangles:
    from pxr import Usd, UsdGeom

    from warp_rigid.usd.conventions import is_y_up, meters_per_unit
    from warp_rigid.usd.opening import open_stage

    stage = open_stage(path)
    places = UsdGeom.XformCache()
    parts = []
    for prim in filter(UsdGeom.Mesh, Usd.PrimRange(stage.GetPseudoRoot(), Usd.TraverseInstanceProxies())):
        mesh, uv = UsdGeom.Mesh(prim), None
        points, corners, triangles = usd_corners(mesh)
        with contextlib.suppress(ValueError):
            uv = usd_coordinates(mesh, "st", corners, triangles)
        matrix = np.array(places.GetLocalToWorldTransform(prim))
        if np.linalg.det(matrix[:3, :3]) < 0.0:
            triangles = triangles[:, ::-1]
            uv = None if uv is None else uv[:, ::-1]
        parts.append(Triangles(points @ matrix[:3, :3] + matrix[3, :3], corners[triangles], uv))
    found = joined(parts)
    vertices = found.vertices
    if UsdGeom.StageHasAuthoredMetersPerUnit(stage):
        vertices = vertices * meters_per_unit(stage)
    return found._replace(vertices=_turn_z_up(vertices) if is_y_up(stage) else vertices)


def usd_corners(mesh) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points (n, 3) of one USD mesh, the point of each corner of its polygons (c,), and triangles of corners (m, 3)."""
    from pxr import UsdGeom

    points = np.array(mesh.GetPointsAttr().Get() or np.zeros((0, 3)), dtype=np.float64).reshape(-1, 3)
    corners = np.array(mesh.GetFaceVertexIndicesAttr().Get() or [], dtype=np.int64)
    sides = np.array(mesh.GetFaceVertexCountsAttr().Get() or [], dtype=np.int64)
    try:
        triangles = polygons.triangles_of_corners(points, corners, sides, ("faceVertexIndices", "faceVertexCounts"))
    except ValueError as error:
        raise ValueError(f"{mesh.GetPath()}: {error}") from None
    if mesh.GetOrientationAttr().Get() == UsdGeom.Tokens.leftHanded:
        triangles = triangles[:, ::-1]
    return points, corners, triangles


def usd_coordinates(mesh, name: str, corners: np.ndarray, triangles: np.ndarray) -> np.ndarray | None:
    """Texture coordinates of the corners of triangles, (m, 3, 2); None without.

    Args:
        mesh: a USD mesh.
        name: of the primvar, which the mesh has or inherits.
        corners: points of the corners of its polygons (c,).
        triangles: corners of its triangles (m, 3).

    Raises:
        ValueError: The values are no pairs of finite numbers, or do not match the mesh.
    """
    from pxr import Usd, UsdGeom

    primvar = UsdGeom.PrimvarsAPI(mesh).FindPrimvarWithInheritance(name)
    if not primvar or not primvar.HasValue():
        return None
    interpolation, tokens = str(primvar.GetInterpolation()), UsdGeom.Tokens
    values = _pairs(primvar.ComputeFlattened(Usd.TimeCode.EarliestTime()))
    ends = np.cumsum(np.array(mesh.GetFaceVertexCountsAttr().Get() or [], np.int64))
    index_of_value = {
        tokens.vertex: corners[triangles],
        tokens.varying: corners[triangles],
        tokens.faceVarying: triangles,
        tokens.uniform: np.searchsorted(ends, triangles, side="right"),
        tokens.constant: np.zeros_like(triangles),
    }
    places = index_of_value.get(interpolation)
    if values is None or places is None or places.max(initial=-1) >= len(values):
        found = "no pairs of finite numbers" if values is None else f"{len(values)} values"
        raise ValueError(f"{primvar.GetName()} is ignored: it has {found}, interpolated as {interpolation}")
    return values[places]


def _pairs(values) -> np.ndarray | None:
    try:
        found = np.array(values, np.float64)
    except (TypeError, ValueError):
        return None
    return found if found.ndim == 2 and found.shape[1] == 2 and np.isfinite(found).all() else None


def _turn_z_up(vertices: np.ndarray) -> np.ndarray:
    """Rotate from y up to z up."""
    return vertices[:, [0, 2, 1]] * np.array([1.0, -1.0, 1.0])


READERS = {
    **polygons.READERS,
    **dict.fromkeys((".stl", ".glb", ".gltf"), _load_trimesh),
    **dict.fromkeys(USD_SUFFIXES, _load_usd),
}
"""Functions that read a file, by its suffix."""
