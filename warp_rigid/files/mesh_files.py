"""Reading triangle meshes from files."""

from pathlib import Path
from typing import Any

import numpy as np

from warp_rigid.checks import number_in
from warp_rigid.files import polygons

USD_SUFFIXES = (".usd", ".usda", ".usdc", ".usdz")
TRIMESH_SUFFIXES = (".stl", ".glb", ".gltf")


def load(path, scale: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """All triangles of a file: vertices (n, 3) float64, faces (m, 3) int64.

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
    known = (*polygons.READERS, *TRIMESH_SUFFIXES, *USD_SUFFIXES)
    if suffix not in known:
        raise ValueError(f"{path}: must be a mesh file ({' '.join(known)})")
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    try:
        vertices, faces = _load(path, suffix)
    except Exception as error:  # the exceptions of the parsers are not documented
        reason = (str(error).strip() or repr(error)).splitlines()[0]
        raise ValueError(reason if reason.startswith(f"{path}: ") else f"{path}: cannot be read: {reason}") from None
    if not len(faces):
        raise ValueError(f"{path}: holds no triangles")
    return scale * vertices, faces


def states_its_unit(path) -> bool:
    """Whether coordinates of a file's format are in metres, or in a unit that the file states."""
    return Path(path).suffix.lower() in (".glb", ".gltf", *USD_SUFFIXES)


def _load(path: Path, suffix: str) -> tuple[np.ndarray, np.ndarray]:
    if suffix in USD_SUFFIXES:
        return _load_usd(path)
    if suffix in TRIMESH_SUFFIXES:
        return _load_trimesh(path)
    points, corners, sides = polygons.READERS[suffix](path)
    return points, polygons.triangulated(points, corners, sides)


def _load_trimesh(path: Path) -> tuple[np.ndarray, np.ndarray]:
    import trimesh

    class RegularFiles(trimesh.resolvers.FilePathResolver):
        """The files beside a mesh; a named pipe among them would be waited for without end."""

        def absolute(self, name: str) -> Path:
            """The path of a file."""
            found = super().absolute(name)
            if found.exists() and not found.is_file():
                raise ValueError(f"{found}: must be a regular file")
            return found

    mesh: Any = trimesh.load(path, force="mesh", process=False, resolver=RegularFiles(str(path)))
    vertices, faces = np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces)
    if path.suffix.lower() in (".glb", ".gltf"):
        vertices = _turn_z_up(vertices)
    return vertices, faces


def _load_usd(path: Path) -> tuple[np.ndarray, np.ndarray]:
    from pxr import Usd, UsdGeom

    from warp_rigid.usd.metadata import is_y_up, meters_per_unit
    from warp_rigid.usd.opening import open_stage

    stage = open_stage(path)
    places = UsdGeom.XformCache()
    vertices, faces, count = [np.zeros((0, 3))], [np.zeros((0, 3), dtype=np.int64)], 0
    for prim in Usd.PrimRange(stage.GetPseudoRoot(), Usd.TraverseInstanceProxies()):
        if not prim.IsA(UsdGeom.Mesh):
            continue
        points, triangles = usd_triangles(UsdGeom.Mesh(prim))
        matrix = np.array(places.GetLocalToWorldTransform(prim))
        if np.linalg.det(matrix[:3, :3]) < 0.0:
            triangles = triangles[:, ::-1]
        vertices.append(points @ matrix[:3, :3] + matrix[3, :3])
        faces.append(triangles + count)
        count += len(points)
    joined = np.concatenate(vertices)
    if UsdGeom.StageHasAuthoredMetersPerUnit(stage):
        joined = joined * meters_per_unit(stage)
    if is_y_up(stage):
        joined = _turn_z_up(joined)
    return joined, np.concatenate(faces)


def usd_triangles(mesh) -> tuple[np.ndarray, np.ndarray]:
    """Points (n, 3) of one USD mesh, and the triangles of its polygons (m, 3)."""
    points, corners, triangles = usd_corners(mesh)
    return points, corners[triangles]


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


def _turn_z_up(vertices: np.ndarray) -> np.ndarray:
    """Rotate from y up to z up."""
    return vertices[:, [0, 2, 1]] * np.array([1.0, -1.0, 1.0])
