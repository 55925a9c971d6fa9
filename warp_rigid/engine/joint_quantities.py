"""Reading and writing the quantities of joints by their names."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from warp_rigid import rotations
from warp_rigid.checks import shown
from warp_rigid.engine.joints import NAME
from warp_rigid.engine.world import World
from warp_rigid.kernels.enums import Coordinate, JointNumber

NUMBERS = {f"joint_{number.name.lower()}": number for number in JointNumber}
WRITABLE = (*NUMBERS, "joint_broken")
READABLE = ("joint_position", "joint_velocity", "joint_force", *WRITABLE)

INFINITE = ("joint_lower", "joint_upper", "joint_max_force", "joint_break_force", "joint_break_torque")
NEGATIVE = ("joint_lower", "joint_upper", "joint_target_position", "joint_target_velocity")
"""Names whose values may be infinite, and negative."""


def read(world: World, name: str) -> np.ndarray:
    """A copy of a quantity of the joints, (envs, joints, ...); see Simulator.get."""
    if name in NUMBERS:
        return _rows(world, "numbers")[:, :, NUMBERS[name]]
    if name == "joint_broken":
        return _rows(world, name.removeprefix("joint_")).astype(bool)
    if name == "joint_force":
        return np.concatenate([_rows(world, "impulse"), _rows(world, "angular_impulse")], axis=-1) / world.settings.dt
    if name == "joint_position":
        return _Motion(world).positions()
    if name == "joint_velocity":
        return _Motion(world).velocities()
    raise ValueError(f"name: must be one of {', '.join(READABLE)}, got {shown(name)}")


def check(world: World, name: str, value: Any, shape: tuple[int, ...]) -> np.ndarray:
    """The value as an array of the shape, in its range."""
    if name not in WRITABLE:
        raise ValueError(f"name: must be one of {', '.join(WRITABLE)}, got {shown(name)}")
    if not world.scene.joints:
        raise ValueError(f"{name}: the scene has no joints")
    if name == "joint_broken" and np.asarray(value).dtype != bool:
        raise ValueError(f"{name}: must be True or False, got {shown(value)}")
    try:
        values = np.broadcast_to(np.asarray(value, np.float32), shape)
    except (ValueError, TypeError, OverflowError) as error:
        raise ValueError(f"{name}: must be numbers that broadcast to {shape}, got shape {np.shape(value)}") from error
    finite = not np.isnan(values).any() if name in INFINITE else np.isfinite(values).all()
    if not finite or (name not in NEGATIVE and (values < 0.0).any()):
        kind = "numbers" if name in NEGATIVE else "numbers >= 0"
        raise ValueError(f"{name}: must be {kind if name in INFINITE else 'finite ' + kind}")
    return values


def write(world: World, name: str, value: Any, envs: np.ndarray, joints: np.ndarray) -> None:
    """Change a quantity of some joints of some environments; see Simulator.set."""
    values = check(world, name, value, (len(envs), len(joints)))
    chosen = np.ix_(envs, joints)
    column = "broken" if name == "joint_broken" else "numbers"
    rows = _rows(world, column)
    if column == "broken":
        rows[chosen] = values
    else:
        own = rows[:, :, NUMBERS[name]]
        own[chosen] = values
        if (rows[:, :, JointNumber.LOWER] > rows[:, :, JointNumber.UPPER]).any():
            raise ValueError(f"{name}: the lower limit must be at most the upper one")
    array = getattr(world.model.constraint_rows[NAME], column)
    array.assign(rows.reshape(-1, *rows.shape[2:]))


def bodies_of(world: World, joints: np.ndarray) -> np.ndarray:
    """The bodies of some joints."""
    entries = [world.scene.joints[joint] for joint in joints]
    both = {body for entry in entries for body in (entry.body_a, entry.body_b) if body is not None}
    return np.array(sorted(both), np.int64)


def _rows(world: World, name: str) -> np.ndarray:
    """A copy of an array of the joints, (envs, joints, ...)."""
    joints = len(world.scene.joints)
    values = getattr(world.model.constraint_rows[NAME], name).numpy()[: world.num_envs * joints].copy()
    return values.reshape(world.num_envs, joints, *values.shape[1:])


class _Motion:
    """Frames of all joints in the world and their relative motion, in float64.

    Args:
        world: that of the simulator.
    """

    def __init__(self, world: World) -> None:
        """Compute the frames and velocities of both sides."""
        self._world = world
        joints = world.scene.joints
        self._coordinate = np.array([int(entry.joint.coordinate) for entry in joints], int)
        first = [entry.body_a for entry in joints]
        second = [entry.body_b for entry in joints]
        self._a = self._side(first, [entry.frame_a for entry in joints])
        self._b = self._side(second, [entry.frame_b for entry in joints])
        self._apart = self._a[0] - self._b[0]
        self._axis_a, self._axis_b = (rotations.matrix(side[1])[..., 0] for side in (self._a, self._b))

    def _side(self, bodies: Sequence[int | None], frames: list) -> tuple[np.ndarray, ...]:
        """Origins, orientations, velocities of the origins and angular velocities, (envs, joints, ...) each."""
        world = self._world
        index = np.array([0 if body is None else body for body in bodies], int)
        fixed = np.array([body is None for body in bodies], bool)[:, None]
        shape = (world.num_envs, world.num_bodies)

        def rows(array: Any) -> np.ndarray:
            values = array.numpy().astype(np.float64)
            return values.reshape(*shape, *values.shape[1:])[:, index]

        origin = np.array([frame.position for frame in frames]).reshape(-1, 3)
        turn = np.array([frame.orientation for frame in frames]).reshape(-1, 4)
        body_turn = rows(world.state.orientation)
        arm = rotations.rotate(body_turn, origin)
        center = rotations.rotate(body_turn, rows(world.model.bodies.center_of_mass))
        spin = np.where(fixed, 0.0, rows(world.state.angular_velocity))
        speed = rows(world.state.linear_velocity) + np.cross(spin, arm - center)
        return (
            np.where(fixed, origin, rows(world.state.position) + arm),
            np.where(fixed, turn, rotations.multiply(body_turn, turn)),
            np.where(fixed, 0.0, speed),
            spin,
        )

    def positions(self) -> np.ndarray:
        """Coordinates (envs, joints) [m or rad], 0 for joints without one."""
        between = rotations.multiply(rotations.inverse(self._b[1]), self._a[1])
        angle = 2.0 * np.arctan2(between[..., 0], between[..., 3])
        near = _rows(self._world, "position")
        cross = np.linalg.norm(np.cross(self._axis_b, self._axis_a), axis=-1)
        return self._chosen(
            {
                Coordinate.ANGLE: angle + 2.0 * np.pi * np.round((near - angle) / (2.0 * np.pi)),
                Coordinate.SLIDE: (self._apart * self._axis_b).sum(-1),
                Coordinate.CONE: np.arctan2(cross, (self._axis_a * self._axis_b).sum(-1)),
                Coordinate.LENGTH: np.linalg.norm(self._apart, axis=-1),
            }
        )

    def velocities(self) -> np.ndarray:
        """Rates of the coordinates (envs, joints) [m/s or rad/s], 0 for joints without one."""
        relative, spin = self._a[2] - self._b[2], self._a[3] - self._b[3]
        cross = np.cross(self._axis_b, self._axis_a)
        sliding = relative - np.cross(self._b[3], self._apart)
        return self._chosen(
            {
                Coordinate.ANGLE: (spin * self._axis_b).sum(-1),
                Coordinate.SLIDE: (sliding * self._axis_b).sum(-1),
                Coordinate.CONE: _along(spin, cross),
                Coordinate.LENGTH: _along(relative, self._apart),
            }
        )

    def _chosen(self, values: dict[Coordinate, np.ndarray]) -> np.ndarray:
        """For each joint the value of its own coordinate."""
        result = np.zeros((self._world.num_envs, len(self._coordinate)))
        for coordinate, own in values.items():
            result = np.where(self._coordinate == coordinate, own, result)
        return result.astype(np.float32)


def _along(vectors: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Component of vectors along directions of any length; 0 along zero."""
    lengths = np.linalg.norm(directions, axis=-1)
    return (vectors * directions).sum(-1) / np.where(lengths > 0.0, lengths, np.inf)
