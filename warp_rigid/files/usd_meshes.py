"""Polygons and texture coordinates of single USD meshes."""

import numpy as np

from warp_rigid.files import polygons


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


def usd_coordinates(mesh, primvar, corners: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Texture coordinates of the corners of triangles, (m, 3, 2).

    Args:
        mesh: a USD mesh.
        primvar: of the mesh, or inherited.
        corners: points of the corners of its polygons (c,).
        triangles: corners of its triangles (m, 3).

    Raises:
        ValueError: The values are no pairs of finite numbers, or do not match the mesh.
    """
    from pxr import Usd, UsdGeom

    interpolation, tokens = str(primvar.GetInterpolation()), UsdGeom.Tokens
    values = _numbers(primvar.ComputeFlattened(Usd.TimeCode.EarliestTime()))
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


def _numbers(values) -> np.ndarray | None:
    try:
        found = np.array(values, np.float64)
    except (TypeError, ValueError):
        return None
    return found if found.ndim == 2 and found.shape[1] == 2 and np.isfinite(found).all() else None
