"""What a renderer needs besides the bodies: a material that shows their colours, lights and a camera."""

import itertools
import math

import numpy as np
from pxr import Gf, Sdf, Vt

from warp_rigid.render.camera import FIELD_OF_VIEW, TOWARD_LIGHT, fit_camera
from warp_rigid.usd.specs import define, set_attribute, set_relationship

__all__ = ["define_look", "define_surface", "place_camera"]

NAMES = Sdf.ValueTypeNames
CAMERA, LOOKS = "Camera", "Looks"
APERTURE = 20.955
"""Width of the film of a USD camera [mm]."""
SUN, SKY = 2.5, 0.6
"""Intensities of the distant light and of the dome light."""
ROOM = 0.08
"""What is in view on each side of the box, relative to its diagonal: it contains the middles of most bodies."""
ASPECT, LINES = 16.0 / 9.0, 720
"""Shape and height of the picture that the camera is placed for."""


def define_look(layer: Sdf.Layer, world: str) -> None:
    """Define the material, two lights and a camera below the world prim, and bind the material to the world."""
    material = f"{world}/{LOOKS}/display_color"
    define(layer, f"{world}/{LOOKS}", "Scope")
    color = define_surface(layer, material)
    reader = define(layer, f"{material}/reader", "Shader")
    set_attribute(reader, "info:id", NAMES.Token, "UsdPrimvarReader_float3", uniform=True)
    set_attribute(reader, "inputs:varname", NAMES.String, "displayColor")
    set_attribute(reader, "outputs:result", NAMES.Float3)
    color.connectionPathList.explicitItems = [Sdf.Path(f"{material}/reader.outputs:result")]
    root = layer.GetPrimAtPath(world)
    root.SetInfo("apiSchemas", Sdf.TokenListOp.Create(prependedItems=["MaterialBindingAPI"]))
    set_relationship(root, "material:binding", material)
    sun = define(layer, f"{world}/Sun", "DistantLight")
    set_attribute(sun, "inputs:intensity", NAMES.Float, SUN)
    set_attribute(sun, "inputs:angle", NAMES.Float, 4.0)
    # Otherwise the intensity is that of the disc in the sky, which at this angle lights a thousandth as much.
    set_attribute(sun, "inputs:normalize", NAMES.Bool, True)
    _place(sun, np.zeros(3), np.array(TOWARD_LIGHT))
    sky = define(layer, f"{world}/Sky", "DomeLight")
    set_attribute(sky, "inputs:intensity", NAMES.Float, SKY)
    set_attribute(sky, "inputs:color", NAMES.Color3f, Gf.Vec3f(1.0))
    camera = define(layer, f"{world}/{CAMERA}", "Camera")
    height = APERTURE / ASPECT
    set_attribute(camera, "horizontalAperture", NAMES.Float, APERTURE)
    set_attribute(camera, "verticalAperture", NAMES.Float, height)
    set_attribute(camera, "focalLength", NAMES.Float, 0.5 * height / math.tan(0.5 * FIELD_OF_VIEW))


def define_surface(layer: Sdf.Layer, path: str, color: np.ndarray | None = None) -> Sdf.AttributeSpec:
    """Define a material of one colour (3,), and return the attribute of the colour."""
    material = define(layer, path, "Material")
    surface = define(layer, f"{path}/surface", "Shader")
    set_attribute(surface, "info:id", NAMES.Token, "UsdPreviewSurface", uniform=True)
    set_attribute(surface, "inputs:roughness", NAMES.Float, 0.6)
    diffuse = set_attribute(surface, "inputs:diffuseColor", NAMES.Color3f)
    if color is not None:
        diffuse.default = Gf.Vec3f(*(float(part) for part in color))
    set_attribute(surface, "outputs:surface", NAMES.Token)
    output = set_attribute(material, "outputs:surface", NAMES.Token)
    output.connectionPathList.explicitItems = [Sdf.Path(f"{path}/surface.outputs:surface")]
    return diffuse


def place_camera(layer: Sdf.Layer, world: str, lower: np.ndarray, upper: np.ndarray) -> None:
    """Place the camera so that a box is in view.

    Args:
        layer: layer of the camera.
        world: path of the world prim.
        lower: lower corner of the box [m].
        upper: upper corner [m].
    """
    room = ROOM * float(np.linalg.norm(upper - lower)) * np.array((1.0, 1.0, 0.0))
    sides = zip(lower - room, upper + room, strict=True)
    fitted = fit_camera(np.array(list(itertools.product(*sides))), ASPECT, LINES)
    eye, ahead = np.array(fitted.eye), np.array(fitted.forward)
    reach = float((0.5 * (lower + upper) - eye) @ ahead)
    camera = layer.GetPrimAtPath(f"{world}/{CAMERA}")
    _place(camera, eye, -ahead)
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
