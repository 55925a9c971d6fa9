"""Kinematic bodies that follow the animation of the file from which they were imported."""

import math
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from warp_rigid.rotations import inverse, multiply, rotate
from warp_rigid.scene.pose_path import PosePath
from warp_rigid.scene.scene import Scene

__all__ = ["follow_paths"]

INTERVAL = 1.0 / 60.0
"""Time between two changes of the velocity of a body [s]."""


def follow_paths(scene: Scene) -> list[tuple[float, Callable[[Any], Any]]]:
    """Events that give each kinematic body with a path the velocity that takes it along, from its start on."""
    paths = scene.import_report.paths if scene.import_report is not None else {}
    return [(0.0, partial(_steer, 0, body, path)) for body, path in paths.items()]


def _steer(count: int, body: int, path: PosePath, sim: Any) -> tuple[float, Callable] | None:
    """Set the velocity for one interval, toward the pose at its end; returns the event that follows.

    The path is compared with the present pose, so that rounding does not add up.

    Args:
        count: intervals passed; at least those of the simulator's time, after a run was resumed.
        body: index of the body.
        path: its path.
        sim: the simulator.
    """
    passed = math.floor(sim.time / INTERVAL + 1e-6)
    count = max(count, passed)
    time = count * INTERVAL
    position, orientation = path.at(time + INTERVAL)
    center = np.asarray(sim.scene.bodies[body].shape.center_of_mass)
    now = sim.get("orientation")[:, body].astype(np.float64)
    # The velocity of a body is that of its centre of mass.
    way = position + rotate(orientation, center) - sim.get("position")[:, body] - rotate(now, center)
    turn = multiply(orientation, inverse(now))
    turn *= np.where(turn[:, 3:] < 0.0, -1.0, 1.0)
    sine = np.linalg.norm(turn[:, :3], axis=1, keepdims=True)
    angle = 2.0 * np.arctan2(sine, turn[:, 3:])
    spin = np.where(sine > 1e-12, angle / np.maximum(sine, 1e-12), 2.0) * turn[:, :3]
    done = time >= path.time[-1]
    sim.set("linear_velocity", (0.0 if done else 1.0 / INTERVAL) * way[:, None], bodies=[body])
    sim.set("angular_velocity", (0.0 if done else 1.0 / INTERVAL) * spin[:, None], bodies=[body])
    return None if done else ((passed + 1) * INTERVAL, partial(_steer, count + 1, body, path))
