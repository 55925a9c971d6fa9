"""Hints on scenes that are legal, but probably in other units than metres, seconds and radians."""

import math
from collections.abc import Sequence

import numpy as np

from warp_rigid.kernels.enums import Coordinate
from warp_rigid.scene.body_columns import column, extents, is_dynamic, shapes_of
from warp_rigid.scene.scene import Motion, Scene

__all__ = ["hints_on"]

FULL_TURN = 2.0 * math.pi
LONGEST_STEP = 1.0
"""Largest way of a body in a step, relative to its largest extent."""
LARGEST_TURN = 0.5 * math.pi
"""Largest turn of a body in a step [rad]."""


def hints_on(scenes: Sequence[Scene], dt: float) -> list[str]:
    """Hints on scenes that are simulated with a time step, one line each.

    Args:
        scenes: the scenes at their start.
        dt: the time step [s].
    """
    found = [hint for scene in scenes for hint in (*_limits_in_degrees(scene), *_long_steps(scene, dt))]
    return list(dict.fromkeys(found))


def _limits_in_degrees(scene: Scene) -> list[str]:
    """Limits of hinges beyond a full turn. Files state their unit."""
    if scene.import_report is not None:
        return []
    hinges = [entry for entry in scene.joints if entry.joint.coordinate == Coordinate.ANGLE]
    beyond = [entry for entry in hinges if any(FULL_TURN < abs(limit) < math.inf for limit in entry.joint.range)]
    return [
        f"joint {entry.name}: limits of {_numbers(entry.joint.range)} rad are beyond a full turn; if they are degrees, "
        f"use limits=np.radians({_numbers(entry.joint.range)})"
        for entry in beyond[:1]
    ]


def _numbers(values: Sequence[float]) -> str:
    return f"({', '.join(f'{value:g}' for value in values)})"


def _long_steps(scene: Scene, dt: float) -> list[str]:
    """Steps in which a body moves by more than its size, or turns by more than a quarter turn."""
    moving = [body for body in scene.bodies if body.motion != Motion.STATIC and body.active]
    if not moving:
        return []
    shapes, shape_of = shapes_of(moving)
    size = extents(shapes).max(axis=1)[shape_of]
    gained = dt * np.linalg.norm(scene.gravity) * is_dynamic(moving)
    speed = np.linalg.norm(column(moving, "linear_velocity"), axis=1) + gained
    spin = np.linalg.norm(column(moving, "angular_velocity"), axis=1)
    found = []
    for rate, most, text in (
        (speed / size, LONGEST_STEP, "moves by {:.2g} times its size"),
        (spin, LARGEST_TURN, "turns by {:.2g} rad"),
    ):
        worst = int(np.argmax(rate))
        if rate[worst] * dt > most:
            way = text.format(rate[worst] * dt)
            found.append(f"dt: body {moving[worst].name} {way} in a step of {dt:.3g} s; a shorter dt is more accurate")
    return found
