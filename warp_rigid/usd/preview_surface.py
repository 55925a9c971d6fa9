"""Looks of the bodies of imported files: UsdPreviewSurface materials, display colours and texture coordinates."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade

from warp_rigid.files.mesh_files import usd_coordinates, usd_corners
from warp_rigid.render.textures import mean_color
from warp_rigid.scene.look import Look
from warp_rigid.usd.conventions import custom_data

PREVIEW = "UsdPreviewSurface"
DIFFUSE = (0.18, 0.18, 0.18)
NUMBERS = {"roughness": 0.5, "metallic": 0.0}
"""Values of its inputs where a file states none."""


class Texture(NamedTuple):
    """The image of a diffuse colour.

    Attributes:
        image: path of the file, or of a file in a package.
        varname: name of the primvar of its coordinates.
        scale: (2,) of a transform of the coordinates.
        rotation: of that transform [degree].
        translation: (2,) of that transform.
    """

    image: str
    varname: str = "st"
    scale: tuple[float, float] = (1.0, 1.0)
    rotation: float = 0.0
    translation: tuple[float, float] = (0.0, 0.0)

    def transformed(self, uv: np.ndarray) -> np.ndarray:
        """Coordinates (..., 2) after the transform."""
        angle = np.radians(self.rotation)
        turn = np.array([(np.cos(angle), np.sin(angle)), (-np.sin(angle), np.cos(angle))])
        return (uv * self.scale) @ turn + self.translation


def read_look(body: Usd.Prim, has_uv: bool, note: Callable[[str], None]) -> Look | None:
    """The look of the first geometry of a body; None if the file states nothing about it.

    The colour of an image is its mean, which is shown where the image is not. Of files written by this package, only
    the looks that were imported before count, not the colours that tell bodies apart.

    Args:
        body: prim of the body.
        has_uv: whether its shape has texture coordinates, without which the image is not kept.
        note: called with the reason why an image is not shown, of which a warning tells, too.
    """
    written = "motion" in custom_data(body)
    for prim in Usd.PrimRange(body, Usd.TraverseInstanceProxies()):
        if prim.IsA(UsdGeom.Gprim) and UsdGeom.Imageable(prim).ComputePurpose() != UsdGeom.Tokens.guide:
            material, shader = _bound(prim)
            if written and not (material and "look" in custom_data(material.GetPrim())):
                return None
            if shader is not None:
                return _of_shader(shader, prim, has_uv, note)
            color = _primvar(prim, "displayColor")
            return None if color is None else Look(color, roughness=1.0)
    return None


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
    texture = _texture_of(prim) or Texture("")
    try:
        uv = usd_coordinates(UsdGeom.Mesh(prim), texture.varname, corners, triangles)
        return None if uv is None else texture.transformed(uv)
    except ValueError as error:
        notes.append(str(error))
        return None


def uv_and_image(prim: Usd.Prim) -> tuple[np.ndarray | None, str | None]:
    """Texture coordinates of the triangles of a mesh, (m, 3, 2) float32, and the path of its image; or None, None."""
    texture = _texture_of(prim) if prim.IsA(UsdGeom.Mesh) else None
    if texture is None:
        return None, None
    _, corners, triangles = usd_corners(UsdGeom.Mesh(prim))
    uv = read_uv(prim, corners, triangles, [])
    return (None, None) if uv is None else (uv.astype(np.float32), texture.image)


def _bound(prim: Usd.Prim) -> tuple[UsdShade.Material, UsdShade.Shader | None]:
    """The material of a geometry, and its UsdPreviewSurface; None if it has another surface or none."""
    material = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()[0]
    shader = material.ComputeSurfaceSource()[0] if material else None
    return material, shader if _kind(shader) == PREVIEW else None


def _texture_of(prim: Usd.Prim) -> Texture | None:
    """The texture of the material of a geometry; None without one whose file exists."""
    return _texture(_source(_bound(prim)[1], "diffuseColor"))


def _texture(source: UsdShade.Shader | None) -> Texture | None:
    """The texture that a UsdUVTexture describes."""
    asset = _value(source, "file") if _kind(source) == "UsdUVTexture" else None
    if not isinstance(asset, Sdf.AssetPath) or not asset.resolvedPath:
        return None
    transform: dict[str, Any] = {}
    reader = _source(source, "st")
    if _kind(reader) == "UsdTransform2d":
        found = {name: _value(reader, name) for name in ("scale", "rotation", "translation")}
        transform = {
            name: tuple(value) if isinstance(value, Gf.Vec2f) else float(value)
            for name, value in found.items()
            if value is not None
        }
        reader = _source(reader, "in")
    name = _value(reader, "varname") if _kind(reader).startswith("UsdPrimvarReader") else None
    return Texture(str(asset.resolvedPath), str(name or "st"), **transform)


def _named_image(source: UsdShade.Shader | None) -> str | None:
    """The path of the image of a UsdUVTexture, whether or not the file exists."""
    for attribute in _producers(source, "file"):
        asset, stack = attribute.Get(), attribute.GetPropertyStack()
        if isinstance(asset, Sdf.AssetPath) and asset.path and stack:
            return str(asset.resolvedPath or stack[0].layer.ComputeAbsolutePath(asset.path))
    return None


def _kind(shader: UsdShade.Shader | None) -> str:
    """Identifier of a shader; empty without one."""
    return str(shader.GetIdAttr().Get()) if shader else ""


def _source(shader: UsdShade.Shader | None, name: str) -> UsdShade.Shader | None:
    """The shader that an input is connected to, also through the inputs of materials and node graphs."""
    found = _producers(shader, name)
    is_output = found and UsdShade.Utils.GetType(found[0].GetName()) == UsdShade.AttributeType.Output
    return UsdShade.Shader(found[0].GetPrim()) if is_output else None


def _value(shader: UsdShade.Shader | None, name: str) -> Any:
    """The value of an input, also one of the material that it is connected to."""
    found = _producers(shader, name)
    return found[0].Get() if found else None


def _producers(shader: UsdShade.Shader | None, name: str) -> list[Usd.Attribute]:
    """The attributes that an input of a shader has its value from."""
    entry = shader.GetInput(name) if shader else None
    return entry.GetValueProducingAttributes() if entry else []


def _of_shader(shader: UsdShade.Shader, prim: Usd.Prim, has_uv: bool, note: Callable[[str], None]) -> Look:
    numbers = dict(NUMBERS)
    for name in NUMBERS:
        value = shader.GetInput(name).Get() if shader.GetInput(name) else None
        if isinstance(value, float) and np.isfinite(value):
            numbers[name] = float(np.clip(value, 0.0, 1.0))
    texture = _texture(_source(shader, "diffuseColor")) if has_uv else None
    return Look(_color(shader, prim, note), **numbers, image=None if texture is None else texture.image)


def _color(shader: UsdShade.Shader, prim: Usd.Prim, note: Callable[[str], None]) -> tuple[float, float, float] | None:
    """Diffuse colour: a constant, a primvar of the geometry, or the mean of an image."""
    entry = shader.GetInput("diffuseColor")
    if not entry:
        return DIFFUSE
    source = _source(shader, "diffuseColor")
    if _kind(source).startswith("UsdPrimvarReader"):
        return _primvar(prim, str(_value(source, "varname")))
    if _kind(source) == "UsdUVTexture":
        image, fallback = _named_image(source), _value(source, "fallback")
        mean = image and mean_color(image)
        if image and not mean:
            note(f"image {image} cannot be read; the plain colour is shown instead")
        return mean or (_checked(fallback[:3]) if fallback is not None else None)
    return _checked(_value(shader, "diffuseColor"))


def _primvar(prim: Usd.Prim, name: str) -> tuple[float, float, float] | None:
    """Mean of a colour that a prim has or inherits."""
    primvar = UsdGeom.PrimvarsAPI(prim).FindPrimvarWithInheritance(name)
    return _checked(primvar.Get()) if primvar and primvar.HasValue() else None


def _checked(value) -> tuple[float, float, float] | None:
    try:
        numbers = np.array(value, np.float64).reshape(-1, 3)
    except (TypeError, ValueError):
        return None
    if not len(numbers) or not np.isfinite(numbers).all():
        return None
    r, g, b = np.clip(numbers.mean(axis=0), 0.0, 1.0).tolist()
    return r, g, b
