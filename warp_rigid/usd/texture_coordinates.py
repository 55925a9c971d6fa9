"""Texture coordinates of the meshes of imported files."""

import numpy as np
from pxr import Usd, UsdGeom

from warp_rigid.files.usd_meshes import usd_coordinates, usd_corners
from warp_rigid.usd.geometry import custom_data
from warp_rigid.usd.preview_surface import Texture, texture_of

ST = "st"
"""Name of the primvar of texture coordinates, where no material names another."""


def read_uv(prim: Usd.Prim, corners: np.ndarray, triangles: np.ndarray, notes: list[str]) -> np.ndarray | None:
    """Texture coordinates of the corners of triangles, (m, 3, 2); None if a mesh has none.

    Of meshes written by this package, only those that had coordinates before count, not those that it projected.

    Args:
        prim: a mesh.
        corners: points of the corners of its polygons (c,).
        triangles: corners of its triangles (m, 3).
        notes: receives why coordinates are not used.
    """
    custom = custom_data(prim)
    if custom and "uv" not in custom:
        return None
    texture = texture_of(prim)
    primvar = UsdGeom.PrimvarsAPI(prim).FindPrimvarWithInheritance(ST if texture is None else texture.varname)
    if not primvar or not primvar.HasValue():
        return None
    try:
        return _transformed(usd_coordinates(UsdGeom.Mesh(prim), primvar, corners, triangles), texture)
    except ValueError as error:
        notes.append(str(error))
        return None


def uv_and_image(prim: Usd.Prim) -> tuple[np.ndarray | None, str | None]:
    """Texture coordinates of the triangles of a mesh, (m, 3, 2) float32, and the path of its image; or None, None."""
    texture = texture_of(prim) if prim.IsA(UsdGeom.Mesh) else None
    if texture is None:
        return None, None
    _, corners, triangles = usd_corners(UsdGeom.Mesh(prim))
    uv = read_uv(prim, corners, triangles, [])
    return (None, None) if uv is None else (uv.astype(np.float32), texture.image)


def _transformed(uv: np.ndarray, texture: Texture | None) -> np.ndarray:
    """With the UsdTransform2d between the coordinates and the image, if there is one."""
    if texture is None:
        return uv
    angle = np.radians(texture.rotation)
    turn = np.array([(np.cos(angle), np.sin(angle)), (-np.sin(angle), np.cos(angle))])
    return (uv * texture.scale) @ turn + texture.translation
