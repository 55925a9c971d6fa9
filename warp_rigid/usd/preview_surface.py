"""Looks of the bodies of imported files: their UsdPreviewSurface materials and display colours."""

import io

import numpy as np
from pxr import Ar, Sdf, Usd, UsdGeom, UsdShade

from warp_rigid.render.appearance import linear_light
from warp_rigid.scene.look import Look
from warp_rigid.usd.prims import custom_data

PREVIEW = "UsdPreviewSurface"
DIFFUSE = (0.18, 0.18, 0.18)
NUMBERS = {"roughness": 0.5, "metallic": 0.0}
"""Values of its inputs where a file states none."""
LARGEST_FILE, LARGEST_IMAGE = 2**26, 2**26
"""Largest size of an image that is read [bytes], and number of its pixels."""
SAMPLED = 64
"""Width and height to which an image is reduced before its colours are averaged [pixel]."""


def read_look(body: Usd.Prim) -> Look | None:
    """The look of the first geometry of a body; None if the file states nothing about it.

    The image of a texture is read as its mean colour. Of files written by this package, only the looks that were
    imported before count, not the colours that tell bodies apart.
    """
    written = "motion" in custom_data(body)
    for prim in Usd.PrimRange(body, Usd.TraverseInstanceProxies()):
        if prim.IsA(UsdGeom.Gprim) and UsdGeom.Imageable(prim).ComputePurpose() != UsdGeom.Tokens.guide:
            material = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()[0]
            if written and not (material and "look" in custom_data(material.GetPrim())):
                return None
            shader = material.ComputeSurfaceSource()[0] if material else None
            if shader and shader.GetIdAttr().Get() == PREVIEW:
                return _of_shader(shader, prim)
            color = _primvar(prim, "displayColor")
            return None if color is None else Look(color, roughness=1.0)
    return None


def _of_shader(shader: UsdShade.Shader, prim: Usd.Prim) -> Look:
    numbers = dict(NUMBERS)
    for name in NUMBERS:
        value = shader.GetInput(name).Get() if shader.GetInput(name) else None
        if isinstance(value, float) and np.isfinite(value):
            numbers[name] = float(np.clip(value, 0.0, 1.0))
    return Look(_color(shader, prim), **numbers)


def _color(shader: UsdShade.Shader, prim: Usd.Prim) -> tuple[float, float, float] | None:
    """Diffuse colour: a constant, a primvar of the geometry, or the mean of an image."""
    entry = shader.GetInput("diffuseColor")
    if not entry:
        return DIFFUSE
    sources = entry.GetConnectedSources()[0]
    if not sources:
        return _checked(entry.Get())
    source = UsdShade.Shader(sources[0].source.GetPrim())
    kind = str(source.GetIdAttr().Get()) if source else ""
    if kind.startswith("UsdPrimvarReader") and source.GetInput("varname"):
        return _primvar(prim, str(source.GetInput("varname").Get()))
    if kind == "UsdUVTexture" and source.GetInput("file"):
        return _mean_of_image(source.GetInput("file").Get())
    return _checked(entry.Get())


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


def _mean_of_image(asset: Sdf.AssetPath) -> tuple[float, float, float] | None:
    """Mean colour of an image file, also in a .usdz package; None if it cannot be read."""
    try:
        from PIL import Image
    except ImportError:
        return None
    try:
        opened = Ar.GetResolver().OpenAsset(Ar.ResolvedPath(asset.resolvedPath)) if asset.resolvedPath else None
        if opened is None or opened.GetSize() > LARGEST_FILE:
            return None
        with Image.open(io.BytesIO(bytes(opened.GetBuffer()))) as image:
            if image.width * image.height > LARGEST_IMAGE:
                return None
            small = image.convert("RGB").resize((SAMPLED, SAMPLED), Image.Resampling.BOX)
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError):
        return None
    return _checked(linear_light(np.asarray(small, np.float64)).reshape(-1, 3).mean(axis=0))
