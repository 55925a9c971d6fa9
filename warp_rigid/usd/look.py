"""What a renderer needs besides the bodies: a material that shows their colours, lights and a camera."""

import math

import numpy as np
from pxr import Gf, Sdf, Vt

from warp_rigid.render.camera import FIELD_OF_VIEW, TOWARD_LIGHT
from warp_rigid.render.film import Film
from warp_rigid.usd.specs import define, set_attribute, set_relationship

__all__ = ["define_look", "place_camera"]

NAMES = Sdf.ValueTypeNames
CAMERA, LOOKS = "Camera", "Looks"
APERTURE = 20.955
"""Width of the film of a USD camera [mm]."""
SUN, SKY = 2.5, 0.6
"""Intensities of the distant light and of the dome light."""
ROOM = 1.3
"""Distance of the camera, relative to the one at which the bodies fill the picture."""


def define_look(layer: Sdf.Layer, world: str) -> None:
    """Define the material, two lights and a camera below the world prim, and bind the material to the world."""
    material = f"{world}/{LOOKS}/display_color"
    define(layer, f"{world}/{LOOKS}", "Scope")
    define(layer, material, "Material")
    reader = define(layer, f"{material}/reader", "Shader")
    set_attribute(reader, "info:id", NAMES.Token, "UsdPrimvarReader_float3", uniform=True)
    set_attribute(reader, "inputs:varname", NAMES.String, "displayColor")
    set_attribute(reader, "outputs:result", NAMES.Float3)
    surface = define(layer, f"{material}/surface", "Shader")
    set_attribute(surface, "info:id", NAMES.Token, "UsdPreviewSurface", uniform=True)
    set_attribute(surface, "inputs:roughness", NAMES.Float, 0.6)
    color = set_attribute(surface, "inputs:diffuseColor", NAMES.Color3f)
    color.connectionPathList.explicitItems = [Sdf.Path(f"{material}/reader.outputs:result")]
    set_attribute(surface, "outputs:surface", NAMES.Token)
    output = set_attribute(layer.GetPrimAtPath(material), "outputs:surface", NAMES.Token)
    output.connectionPathList.explicitItems = [Sdf.Path(f"{material}/surface.outputs:surface")]
    root = layer.GetPrimAtPath(world)
    root.SetInfo("apiSchemas", Sdf.TokenListOp.Create(prependedItems=["MaterialBindingAPI"]))
    set_relationship(root, "material:binding", material)
    sun = define(layer, f"{world}/Sun", "DistantLight")
    set_attribute(sun, "inputs:intensity", NAMES.Float, SUN)
    set_attribute(sun, "inputs:angle", NAMES.Float, 4.0)
    _place(sun, np.zeros(3), np.array(TOWARD_LIGHT))
    sky = define(layer, f"{world}/Sky", "DomeLight")
    set_attribute(sky, "inputs:intensity", NAMES.Float, SKY)
    camera = define(layer, f"{world}/{CAMERA}", "Camera")
    height = APERTURE * 9.0 / 16.0
    set_attribute(camera, "horizontalAperture", NAMES.Float, APERTURE)
    set_attribute(camera, "verticalAperture", NAMES.Float, height)
    set_attribute(camera, "focalLength", NAMES.Float, 0.5 * height / math.tan(0.5 * FIELD_OF_VIEW))


def place_camera(layer: Sdf.Layer, world: str, lower: np.ndarray, upper: np.ndarray) -> None:
    """Place the camera so that a box is in view.

    Args:
        layer: layer of the camera.
        world: path of the world prim.
        lower: lower corner of the box [m].
        upper: upper corner [m].
    """
    azimuth, elevation = np.radians(Film.view)
    flat = math.cos(elevation)
    back = np.array((flat * math.cos(azimuth), flat * math.sin(azimuth), math.sin(elevation)))
    radius = 0.5 * float(np.linalg.norm(upper - lower))
    reach = ROOM * radius / math.tan(0.5 * FIELD_OF_VIEW)
    camera = layer.GetPrimAtPath(f"{world}/{CAMERA}")
    _place(camera, 0.5 * (lower + upper) + reach * back, back)
    set_attribute(camera, "clippingRange", NAMES.Float2, Gf.Vec2f(0.01 * reach, 1000.0 * reach))


def _place(prim: Sdf.PrimSpec, position: np.ndarray, back: np.ndarray) -> None:
    """Set the transform of a prim that looks along its own -z, away from `back`, with z of the world up."""
    back = back / np.linalg.norm(back)
    right = np.cross((0.0, 0.0, 1.0), back)
    right /= np.linalg.norm(right)
    rows = np.eye(4)
    rows[0, :3], rows[1, :3], rows[2, :3], rows[3, :3] = right, np.cross(back, right), back, position
    set_attribute(prim, "xformOp:transform", NAMES.Matrix4d, Gf.Matrix4d(rows))
    set_attribute(prim, "xformOpOrder", NAMES.TokenArray, Vt.TokenArray(["xformOp:transform"]), uniform=True)
