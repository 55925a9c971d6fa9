"""Grounds, platforms and bins: the static bodies on which other bodies come to rest."""

from typing import Any

from warp_rigid.scene.camera import Camera
from warp_rigid.scene.scene import Scene, Vector
from warp_rigid.scene.shapes import Box, Plane

EARTH = (0.0, 0.0, -9.81)
SIDES = ((-1, 0), (1, 0), (0, -1), (0, 1))
"""Outward directions of the four walls of a bin, in the order in which they are added."""


def level_scene(gravity: Vector = EARTH, camera: Camera | None = None, **surface: Any) -> Scene:
    """A scene that contains level ground at z = 0, which is body 0.

    Args:
        gravity: [m/s^2].
        camera: of the scene.
        **surface: coefficients and name of the ground, as in `Scene.add_static`.
    """
    scene = Scene(gravity=gravity, camera=camera)
    scene.add_static(Plane(), **surface)
    return scene


def add_platform(
    scene: Scene, half_width: float, half_depth: float, top: float, x: float = 0.0, **surface: Any
) -> None:
    """Add a static box that reaches from z = 0 to z = `top`.

    Args:
        scene: the scene.
        half_width: half of its extent along x [m].
        half_depth: half of its extent along y [m].
        top: height of its upper face [m].
        x: of its centre [m].
        **surface: coefficients and name, as in `Scene.add_static`.
    """
    scene.add_static(Box((half_width, half_depth, 0.5 * top)), position=(x, 0, 0.5 * top), **surface)


def add_bin(
    scene: Scene,
    inner_half: float,
    height: float,
    thickness: float,
    *,
    center: tuple[float, float] = (0.0, 0.0),
    names: str | None = None,
    sides: tuple[tuple[int, int], ...] = SIDES,
    **surface: Any,
) -> None:
    """Add upright walls around a square; the bin has no floor.

    Args:
        scene: the scene.
        inner_half: half of the inner width [m].
        height: of the walls, which start at z = 0 [m].
        thickness: of the walls [m].
        center: of the square [m].
        names: prefix of the walls' names, followed by their numbers; the scene's default names if None.
        sides: outward directions (x, y) of the walls, in the order in which they are added.
        **surface: coefficients, as in `Scene.add_static`.
    """
    half_height, half_thickness = 0.5 * height, 0.5 * thickness
    away, length = inner_half + half_thickness, inner_half + thickness
    for i, (x, y) in enumerate(sides):
        half = (half_thickness, length, half_height) if x else (length, half_thickness, half_height)
        name = None if names is None else f"{names}_{i}"
        place = (center[0] + x * away, center[1] + y * away, half_height)
        scene.add_static(Box(half), position=place, name=name, **surface)


def add_plane_bin(scene: Scene, inner_half: float, **surface: Any) -> None:
    """Add four unbounded vertical planes around a square, which no body can leave.

    Args:
        scene: the scene.
        inner_half: half of the distance between opposite planes [m].
        **surface: coefficients, as in `Scene.add_static`.
    """
    for x, y in SIDES:
        scene.add_static(Plane(normal=(-x, -y, 0), offset=-inner_half), **surface)
