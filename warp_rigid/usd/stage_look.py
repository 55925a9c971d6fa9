"""What a renderer needs besides the bodies and the camera: materials, and lights."""

import math

import numpy as np
from pxr import Gf, Sdf

from warp_rigid.render.framing import TOWARD_LIGHT
from warp_rigid.scene.camera import Camera
from warp_rigid.scene.look import Look
from warp_rigid.usd.cameras import place_prim
from warp_rigid.usd.conventions import MARK
from warp_rigid.usd.image_paths import ImagePaths
from warp_rigid.usd.specs import define, set_attribute, set_relationship

NAMES = Sdf.ValueTypeNames
LOOKS = "Looks"
MATT = 0.6
"""Roughness of bodies without a look."""
SUN, SKY = 2.5, 0.6
"""Intensities of the distant light and of the dome light."""


def define_look(layer: Sdf.Layer, world: str, glossy: bool) -> None:
    """Define the material and two lights below the world prim, and bind the material to the world.

    Args:
        layer: layer of the definitions.
        world: path of the world prim.
        glossy: whether bodies have roughness and metallic as primvars.
    """
    material = f"{world}/{LOOKS}/display_color"
    define(layer, f"{world}/{LOOKS}", "Scope")
    color = define_surface(layer, material)
    _read_primvar(color, f"{material}/reader", "displayColor", NAMES.Float3)
    if glossy:
        surface = layer.GetPrimAtPath(f"{material}/surface")
        for name, value in (("roughness", MATT), ("metallic", 0.0)):
            attribute = set_attribute(surface, f"inputs:{name}", NAMES.Float)
            reader = _read_primvar(attribute, f"{material}/{name}_reader", name, NAMES.Float)
            set_attribute(reader, "inputs:fallback", NAMES.Float, value)
    root = layer.GetPrimAtPath(world)
    root.SetInfo("apiSchemas", Sdf.TokenListOp.Create(prependedItems=["MaterialBindingAPI"]))
    set_relationship(root, "material:binding", material)
    sun = define(layer, f"{world}/Sun", "DistantLight")
    set_attribute(sun, "inputs:intensity", NAMES.Float, SUN)
    set_attribute(sun, "inputs:angle", NAMES.Float, 4.0)
    # Otherwise the intensity is that of the disc in the sky, which at this angle lights a thousandth as much.
    set_attribute(sun, "inputs:normalize", NAMES.Bool, True)
    x, y, z = TOWARD_LIGHT
    toward = Camera.orbit(math.degrees(math.atan2(y, x)), math.degrees(math.atan2(z, math.hypot(x, y))))
    place_prim(sun, np.zeros(3), toward)
    sky = define(layer, f"{world}/Sky", "DomeLight")
    set_attribute(sky, "inputs:intensity", NAMES.Float, SKY)
    set_attribute(sky, "inputs:color", NAMES.Color3f, Gf.Vec3f(1.0))


def _read_primvar(attribute: Sdf.AttributeSpec, path: str, name: str, kind: Sdf.ValueTypeName) -> Sdf.PrimSpec:
    """Connect an input of a shader to a primvar, through a reader at a path."""
    reader = define(attribute.layer, path, "Shader")
    set_attribute(reader, "info:id", NAMES.Token, f"UsdPrimvarReader_{kind}", uniform=True)
    set_attribute(reader, "inputs:varname", NAMES.String, name)
    set_attribute(reader, "outputs:result", kind)
    attribute.connectionPathList.explicitItems = [Sdf.Path(f"{path}.outputs:result")]
    return reader


def _read_image(attribute: Sdf.AttributeSpec, path: str, asset: str, color: np.ndarray | None) -> None:
    """Connect the colour of a material at a path to an image; the colour (3,) is for readers that do not find it."""
    texture = define(attribute.layer, f"{path}/image", "Shader")
    set_attribute(texture, "info:id", NAMES.Token, "UsdUVTexture", uniform=True)
    set_attribute(texture, "inputs:file", NAMES.Asset, Sdf.AssetPath(asset))
    set_attribute(texture, "inputs:sourceColorSpace", NAMES.Token, "sRGB")
    for axis in "ST":
        set_attribute(texture, f"inputs:wrap{axis}", NAMES.Token, "repeat")
    if color is not None:
        set_attribute(texture, "inputs:fallback", NAMES.Float4, Gf.Vec4f(*(float(part) for part in color), 1.0))
    set_attribute(texture, "outputs:rgb", NAMES.Float3)
    coordinates = set_attribute(texture, "inputs:st", NAMES.Float2)
    _read_primvar(coordinates, f"{path}/st_reader", "st", NAMES.Float2)
    attribute.connectionPathList.explicitItems = [Sdf.Path(f"{path}/image.outputs:rgb")]


def define_surface(
    layer: Sdf.Layer,
    path: str,
    color: np.ndarray | None = None,
    look: Look | None = None,
    images: ImagePaths | None = None,
) -> Sdf.AttributeSpec:
    """Define a material of one colour (3,) with the gloss and the image of a look; returns the attribute of the colour.

    The image is written if `images` names it.
    """
    material = define(layer, path, "Material")
    surface = define(layer, f"{path}/surface", "Shader")
    set_attribute(surface, "info:id", NAMES.Token, "UsdPreviewSurface", uniform=True)
    set_attribute(surface, "inputs:roughness", NAMES.Float, MATT if look is None else look.roughness)
    if look is not None:
        set_attribute(surface, "inputs:metallic", NAMES.Float, look.metallic)
        material.SetInfo("customData", {MARK: {"look": True}})
    diffuse = set_attribute(surface, "inputs:diffuseColor", NAMES.Color3f)
    asset = images.asset(look.image, layer) if images and look and look.image else None
    if asset is not None:
        _read_image(diffuse, path, asset, color)
    elif color is not None:
        diffuse.default = Gf.Vec3f(*(float(part) for part in color))
    set_attribute(surface, "outputs:surface", NAMES.Token)
    output = set_attribute(material, "outputs:surface", NAMES.Token)
    output.connectionPathList.explicitItems = [Sdf.Path(f"{path}/surface.outputs:surface")]
    return diffuse
