"""Reading and writing the quantities of joints by their names."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from warp_rigid import rotations
from warp_rigid.checks import LARGEST, flags, numbers_of_shape, refuse_others
from warp_rigid.engine.joints import NAME
from warp_rigid.engine.layout import spread_rows
from warp_rigid.engine.selection import existing
from warp_rigid.engine.world import World
from warp_rigid.kernels.enums import Coordinate, JointNumber, Motion
from warp_rigid.scene.joints import NUMBERS_OF_KIND, JointEntry

NUMBERS = {f"joint_{number.name.lower()}": number for number in JointNumber}
WRITABLE = (*NUMBERS, "joint_broken")
DERIVED = ("joint_position", "joint_velocity", "joint_force")
READABLE = (*DERIVED, *WRITABLE)

NEGATIVE = ("joint_lower", "joint_upper", "joint_target_position", "joint_target_velocity")
"""Names whose values may be negative."""

WITHOUT = ("joint_upper", "joint_max_force", "joint_break_force", "joint_break_torque")
NONE = {"joint_lower": -np.inf} | dict.fromkeys(WITHOUT, np.inf)
"""The infinite values that numbers may have, which have no effect; of the others 0 has none."""

WIDEST = float(np.float32(np.pi))
"""Largest limit of a cone [rad]: a larger one, as in degrees, would have no effect."""

SAME_ORIENTATION = 1.0 - 1e-6
"""Two orientations whose quaternions have a larger scalar product differ by rounding errors."""


def read(world: World, name: str) -> np.ndarray:
    """A copy of a quantity of the joints, (envs, most joints, ...), NaN or False where an environment has fewer.

    See Simulator.get.
    """
    return spread_rows(_values(world, name), world.layout.table(NAME))


def _values(world: World, name: str) -> np.ndarray:
    """A quantity of all joints of all environments, (joints, ...)."""
    if name in NUMBERS:
        return _array(world, "numbers")[:, NUMBERS[name]]
    if name == "joint_broken":
        return _array(world, "broken").astype(bool)
    if name == "joint_force":
        return np.concatenate([_array(world, "impulse"), _array(world, "angular_impulse")], axis=-1) / world.settings.dt
    motion = _Motion(world)
    return motion.positions() if name == "joint_position" else motion.velocities()


def check(name: str, value: Any, shape: tuple[int, ...]) -> np.ndarray:
    """The value as an array of the shape."""
    if name == "joint_broken":
        return flags(name, value, shape)
    values = numbers_of_shape(name, value, shape)
    if ((np.abs(values) > LARGEST) & np.isfinite(values)).any():
        raise ValueError(f"{name}: must be up to {LARGEST:g}{' or infinite' if name in NONE else ''}")
    return values.astype(np.float32)


def check_range(name: str, values: np.ndarray) -> None:
    """Check numbers of a quantity.

    Raises:
        ValueError: one of them is out of its range.
    """
    allowed = np.isfinite(values) | (values == NONE.get(name))
    if name not in NEGATIVE:
        allowed &= values >= 0.0
    kind = "finite numbers" if name in NEGATIVE else "finite numbers >= 0"
    refuse_others(name, values, allowed, f"{kind} or {NONE[name]:g}" if name in NONE else kind)


def can_have(entry: JointEntry, name: str) -> bool:
    """Whether a joint of its kind can have a quantity."""
    return name not in NUMBERS or NUMBERS[name] in NUMBERS_OF_KIND[entry.joint.coordinate]


def check_of_joints(name: str, entries: Sequence[JointEntry], values: Any) -> None:
    """Check whether joints can have values; that without an effect is allowed.

    Args:
        name: the quantity.
        entries: the joints.
        values: one, or one for each joint.

    Raises:
        ValueError: one of the joints cannot have its value.
    """
    none = NONE.get(name, 0.0)
    for entry, value in zip(entries, np.broadcast_to(values, len(entries)), strict=True):
        kind = type(entry.joint).__name__
        if value != none and not can_have(entry, name):
            known = ", ".join([*(own for own in NUMBERS if can_have(entry, own)), "joint_broken"])
            raise ValueError(f"{name}: must be {none:g} for {entry.name}: a {kind} can have {known}")
        if value < 0.0 and value != none and entry.joint.coordinate in (Coordinate.CONE, Coordinate.LENGTH):
            raise ValueError(f"{name}: must be >= 0 for {entry.name}, a {kind}, got {value:g}")
        if name == "joint_upper" and entry.joint.coordinate == Coordinate.CONE and WIDEST < value < np.inf:
            raise ValueError(f"{name}: must be at most pi, or inf, for {entry.name}, a {kind}, got {value:g}")


def write(world: World, name: str, value: Any, rows: np.ndarray, of_all: bool) -> None:
    """Change a quantity of joints by their rows (n, m); see Simulator.set.

    Args:
        world: that of the simulator.
        name: the quantity.
        value: the value.
        rows: of the joints.
        of_all: whether no joints were chosen; then joints that cannot have the quantity keep theirs.
    """
    if not world.layout.has_joints:
        raise ValueError(f"{name}: the scene has no joints")
    present = existing(rows)
    values, rows = check(name, value, rows.shape)[present], rows[present]
    check_range(name, values)
    if name == "joint_broken":
        host = _array(world, "broken")
        host[rows] = values
        for shard in world.shards:
            shard.pools.forget_graph()
        world.model.joints.broken.assign(host)
        return
    kinds = [kind for kind, numbers in NUMBERS_OF_KIND.items() if NUMBERS[name] in numbers]
    able = np.isin(_array(world, "coordinate")[rows], kinds)
    unlikely = (values < 0.0) | ((values > WIDEST) & (values < np.inf))
    doubtful = np.where(able, unlikely, not (of_all and able.any()))
    if doubtful.any():
        entries, source = _entries(world)
        check_of_joints(name, [entries[index] for index in source[rows[doubtful]]], values[doubtful])
    host = _array(world, "numbers")
    host[rows[able], NUMBERS[name]] = values[able]
    if (host[:, JointNumber.LOWER] > host[:, JointNumber.UPPER]).any():
        raise ValueError(f"{name}: the lower limit must be at most the upper one")
    world.model.joints.numbers.assign(host)


def _entries(world: World) -> tuple[list[JointEntry], np.ndarray]:
    """The joints of the distinct scenes, and for each joint of all environments its index among them."""
    return world.layout.entries(lambda scene: scene.joints)


def bodies_of(world: World, rows: np.ndarray) -> np.ndarray:
    """Rows of the bodies of joints by their rows (n, m), (n, 2 m); LACKING where there is no joint."""
    both = [getattr(world.model.joints, name).numpy() for name in ("body_a", "body_b")]
    return np.concatenate([spread_rows(some, rows) for some in both], axis=1)


def _array(world: World, name: str) -> np.ndarray:
    """A copy of an array of the joints, (joints, ...)."""
    return getattr(world.model.joints, name).numpy()[: world.layout.sizes[NAME]].copy()


def forget_turns(world: World, orientation: np.ndarray, rows: np.ndarray) -> None:
    """Let angles of joints count anew where dynamic bodies (n, m) are set to other orientations (n, m, 4)."""
    if not world.layout.has_joints:
        return
    present = existing(rows)
    cosine = (world.state.orientation.numpy()[rows[present]] * orientation[present]).sum(axis=-1)
    dynamic = world.model.bodies.motion.numpy()[rows[present]] == Motion.DYNAMIC
    changed = rows[present][dynamic & (np.abs(cosine) < SAME_ORIENTATION)]
    joints = world.model.joints
    near = joints.position.numpy()
    near[np.isin(joints.body_a.numpy(), changed) | np.isin(joints.body_b.numpy(), changed)] = 0.0
    joints.position.assign(near)


class _Motion:
    """Frames of all joints in the world and their relative motion, in float64.

    Args:
        world: that of the simulator.
    """

    def __init__(self, world: World) -> None:
        """Compute the frames and velocities of both sides."""
        self._world = world
        entries, source = _entries(world)
        self._coordinate = np.array([int(entry.joint.coordinate) for entry in entries], int)[source]
        fixed = np.array([entry.body_b is None for entry in entries], bool)[source]
        self._a = self._side("body_a", [entry.frame_a for entry in entries], source, np.zeros_like(fixed))
        self._b = self._side("body_b", [entry.frame_b for entry in entries], source, fixed)
        self._apart = self._a[0] - self._b[0]
        self._axis_a, self._axis_b = (rotations.matrix(side[1])[..., 0] for side in (self._a, self._b))

    def _side(self, bodies: str, frames: list, source: np.ndarray, fixed: np.ndarray) -> tuple[np.ndarray, ...]:
        """Origins, orientations, velocities of the origins and angular velocities, (joints, ...) each."""
        world = self._world
        index, to_world = _array(world, bodies), fixed[:, None]

        def rows(array: Any) -> np.ndarray:
            return array.numpy().astype(np.float64)[index]

        origin = np.array([frame.position for frame in frames]).reshape(-1, 3)[source]
        orientation = np.array([frame.orientation for frame in frames]).reshape(-1, 4)[source]
        body_orientation = rows(world.state.orientation)
        arm = rotations.rotate(body_orientation, origin)
        center = rotations.rotate(body_orientation, rows(world.model.bodies.center_of_mass))
        spin = np.where(to_world, 0.0, rows(world.state.angular_velocity))
        speed = rows(world.state.linear_velocity) + np.cross(spin, arm - center)
        return (
            np.where(to_world, origin, rows(world.state.position) + arm),
            np.where(to_world, orientation, rotations.multiply(body_orientation, orientation)),
            np.where(to_world, 0.0, speed),
            spin,
        )

    def positions(self) -> np.ndarray:
        """Coordinates (joints,) [m or rad], 0 for joints without one."""
        between = rotations.multiply(rotations.inverse(self._b[1]), self._a[1])
        angle = 2.0 * np.arctan2(between[..., 0], between[..., 3])
        near = _array(self._world, "position")
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
        """Rates of the coordinates (joints,) [m/s or rad/s], 0 for joints without one."""
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
        result = np.zeros(len(self._coordinate))
        for coordinate, own in values.items():
            result = np.where(self._coordinate == coordinate, own, result)
        return result.astype(np.float32)


def _along(vectors: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Component of vectors along directions of any length; 0 along zero."""
    lengths = np.linalg.norm(directions, axis=-1)
    return (vectors * directions).sum(-1) / np.where(lengths > 0.0, lengths, np.inf)
