"""Values of a scene at the start of a recording: those that a program has set, and the scene's own elsewhere."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from warp_rigid.engine.field_values import PREFIX
from warp_rigid.engine.joints import numbers_of
from warp_rigid.kernels.enums import Coordinate, JointNumber
from warp_rigid.scene.fields import ForceField
from warp_rigid.scene.scene import Scene

ANGLES = (JointNumber.LOWER, JointNumber.UPPER, JointNumber.TARGET_POSITION)
"""Numbers of a hinge that count full turns; a file counts from the poses that it states, less than half a turn."""


def joints_at_start(scene: Scene, start: Mapping[str, np.ndarray], row: int) -> list[dict[JointNumber, float]]:
    """Numbers of the joints of a recorded environment.

    Args:
        scene: the recorded scene.
        start: quantities of the first frame, see `Recording`.
        row: of the environment.
    """
    found = []
    for k, entry in enumerate(scene.joints):
        own = zip(JointNumber, numbers_of(entry), strict=True)
        numbers = {number: _kept(value, start[f"joint_{number.name.lower()}"][row, k]) for number, value in own}
        if entry.joint.coordinate == Coordinate.ANGLE:
            turns = 2.0 * math.pi * round(float(start["joint_position"][row, k]) / (2.0 * math.pi))
            numbers |= {number: numbers[number] - turns for number in ANGLES}
        found.append(numbers)
    return found


def fields_at_start(scene: Scene, start: Mapping[str, np.ndarray], row: int) -> list[ForceField]:
    """The force fields of a recorded environment; arguments as for `joints_at_start`."""
    found = []
    for k, field in enumerate(scene.force_fields):
        now = {name: start[PREFIX + name][row, k] for name in type(field).parameters()}
        own = field.values()
        found.append(type(field)(**{name: _kept(own[name], now[name]) for name in now}))
    return found


def _kept(own: Any, now: Any) -> Any:
    """The scene's number or vector, of which the simulator has only single precision, or what was set since."""
    return np.where(np.float32(own) == now, own, now).tolist()
