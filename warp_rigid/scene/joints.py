"""All kinds of joints, their placing between two bodies, and what a scene stores of one.

A kind of joint states which of the six relative motions of two frames are locked, and which coordinate is free: rows
and limits, motors, friction, checkpoints, USD and the exported name follow from that. The x axis of both frames is
the joint's axis.
"""

import math
from abc import ABC
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from warp_rigid import rotations
from warp_rigid.checks import LARGEST, finite_vector, instance_of, number_in, numbers_of, shown, unit_quaternion
from warp_rigid.kernels.enums import Coordinate, JointNumber, Motion

Vector3 = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]

LINEAR = 0b000111
ANGULAR = 0b111000
AXIAL_SLIDE = 0b000001
AXIAL_TURN = 0b001000
"""Relative motions, as bits: translations along x, y and z of the second body's frame, then rotations about them."""

_BREAKING = (JointNumber.BREAK_FORCE, JointNumber.BREAK_TORQUE)
NUMBERS_OF_KIND = {
    Coordinate.NONE: _BREAKING,
    Coordinate.ANGLE: tuple(JointNumber),
    Coordinate.SLIDE: tuple(JointNumber),
    Coordinate.CONE: (JointNumber.UPPER, JointNumber.DAMPING, *_BREAKING),
    Coordinate.LENGTH: (JointNumber.LOWER, JointNumber.UPPER, *_BREAKING),
}
"""The parameters that a joint can have, by its coordinate."""

FURTHEST = 0.1
"""Largest distance of two anchors that should coincide, as a fraction of the smaller body's size."""

JOINTS: dict[str, type["Joint"]] = {}
"""All kinds of joints by class name."""


@dataclass(frozen=True)
class Joint(ABC):
    """Base of all kinds of joints.

    Attributes:
        locked: bits of the relative motions that the joint prevents.
        coordinate: the coordinate that limits, drive and friction act on.
    """

    locked: ClassVar[int]
    coordinate: ClassVar[Coordinate] = Coordinate.NONE

    def __init_subclass__(cls) -> None:
        """Register a kind, which states what it locks."""
        if "locked" in vars(cls):
            JOINTS[cls.__name__] = cls

    @property
    def world_axis(self) -> Vector3:
        """Axis of the joint in the world frame when the joint is added."""
        return getattr(self, "axis", (1.0, 0.0, 0.0))

    @property
    def range(self) -> tuple[float, float]:
        """Smallest and largest value of the coordinate; infinite where there is no limit."""
        return getattr(self, "limits", None) or (-math.inf, math.inf)

    @property
    def resistance(self) -> float:
        """Largest force or torque of the joint's own friction [N or N m]."""
        return getattr(self, "friction", 0.0)


@dataclass(frozen=True)
class JointFrame:
    """A frame fixed to a body, in the frame of the body's shape, or to the world.

    Attributes:
        position: (3,) origin [m].
        orientation: (4,) unit quaternion (x, y, z, w); its x axis is the joint's axis.
    """

    position: Vector3
    orientation: Quaternion


@dataclass(frozen=True)
class Drive:
    """A motor: force stiffness (target_position - q) + damping (target_velocity - v), at most max_force.

    Attributes:
        stiffness: [N/m] or [N m/rad].
        damping: [N s/m] or [N m s/rad].
        max_force: largest force or torque [N or N m]; infinite by default.
        target_position: [m or rad].
        target_velocity: [m/s or rad/s].
    """

    stiffness: float = 0.0
    damping: float = 0.0
    max_force: float = math.inf
    target_position: float = 0.0
    target_velocity: float = 0.0

    def __post_init__(self) -> None:
        """Check the values."""
        for name in ("stiffness", "damping"):
            object.__setattr__(self, name, number_in(name, getattr(self, name), 0.0))
        object.__setattr__(self, "max_force", largest("max_force", self.max_force, low=0.0))
        for name in ("target_position", "target_velocity"):
            object.__setattr__(self, name, number_in(name, getattr(self, name)))


@dataclass(frozen=True)
class JointEntry:
    """A joint of a scene.

    Attributes:
        joint: its kind, with parameters.
        body_a: index of the first body.
        body_b: index of the second body; None for the world.
        frame_a: frame fixed to the first body.
        frame_b: frame fixed to the second body.
        name: a label.
        break_force: largest force that it withstands [N].
        break_torque: largest torque that it withstands [N m].
        collide: whether the two bodies can touch each other.
        armature: inertia that the rotor of a motor adds to the coordinate [kg m^2 or kg].
        drive: its motor, or None.
    """

    joint: Joint
    body_a: int
    body_b: int | None
    frame_a: JointFrame
    frame_b: JointFrame
    name: str
    break_force: float = math.inf
    break_torque: float = math.inf
    collide: bool = False
    armature: float = 0.0
    drive: Drive | None = None

    def anchors(self, position: np.ndarray, orientation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Both anchors in the world, (..., 3) [m], at poses (..., bodies, 3) [m] and (..., bodies, 4) of all bodies."""
        first, second = (
            np.broadcast_to(np.array(frame.position), (*position.shape[:-2], 3))
            if body is None
            else position[..., body, :] + rotations.rotate(orientation[..., body, :], np.array(frame.position))
            for body, frame in ((self.body_a, self.frame_a), (self.body_b, self.frame_b))
        )
        return first, second


def largest(name: str, value: Any, **bounds: float) -> float:
    """Check a number that may be infinite; `bounds` as for number_in."""
    if isinstance(value, int | float | np.number) and value == math.inf:
        return math.inf
    return number_in(name, value, **bounds)


def unit_axis(value: Any) -> Vector3:
    """Check an axis and scale it to unit length."""
    axis = finite_vector("axis", value)
    length = math.hypot(*axis)
    if length < 1e-6:
        raise ValueError(f"axis: must be a vector of length > 0, got {shown(value)}")
    x, y, z = (component / length for component in axis)
    return x, y, z


def ordered_limits(value: Any) -> tuple[float, float] | None:
    """Check (lower, upper) limits; None for no limits."""
    if value is None:
        return None
    limits = numbers_of(value)
    if limits is None or limits.shape != (2,):
        raise ValueError(f"limits: must be (lower, upper) or None, got {shown(value)}")
    if not ((np.abs(limits) <= LARGEST) | np.isinf(limits)).all():
        raise ValueError(f"limits: must be up to {LARGEST:g} or infinite, got {shown(value)}")
    lower, upper = limits.tolist()
    if not lower <= upper or lower == math.inf or upper == -math.inf:
        raise ValueError(f"limits: lower must be at most upper, got {shown(value)}")
    return lower, upper


@dataclass(frozen=True)
class FixedJoint(Joint):
    """Holds two bodies in their relative pose, as if they were welded."""

    locked = LINEAR | ANGULAR


@dataclass(frozen=True)
class SphericalJoint(Joint):
    """Holds a point of one body at a point of another.

    Attributes:
        cone_limit: largest angle between the axis in both bodies [rad], above 0 and at most pi; None for no limit.
        axis: (3,) middle of the cone in the world frame.
    """

    cone_limit: float | None = None
    axis: Vector3 = (0.0, 0.0, 1.0)

    locked = LINEAR
    coordinate = Coordinate.CONE

    def __post_init__(self) -> None:
        """Check the parameters."""
        object.__setattr__(self, "axis", unit_axis(self.axis))
        if self.cone_limit is not None:
            object.__setattr__(self, "cone_limit", number_in("cone_limit", self.cone_limit, high=math.pi, above=0.0))

    @property
    def range(self) -> tuple[float, float]:
        """Limits of the angle between the axes [rad]."""
        return -math.inf, math.inf if self.cone_limit is None else self.cone_limit


@dataclass(frozen=True)
class _AxialJoint(Joint):
    """Leaves one motion about or along an axis free."""

    axis: Vector3
    limits: tuple[float, float] | None = None
    friction: float = 0.0

    def __post_init__(self) -> None:
        """Check the parameters."""
        object.__setattr__(self, "axis", unit_axis(self.axis))
        object.__setattr__(self, "limits", ordered_limits(self.limits))
        object.__setattr__(self, "friction", number_in("friction", self.friction, 0.0))


@dataclass(frozen=True)
class RevoluteJoint(_AxialJoint):
    """Lets the first body turn about an axis of the second.

    Attributes:
        axis: (3,) in the world frame.
        limits: (lower, upper) angle [rad], 0 where the joint is added; None for no limits.
        friction: largest torque of friction [N m].
    """

    locked = LINEAR | ANGULAR & ~AXIAL_TURN
    coordinate = Coordinate.ANGLE


@dataclass(frozen=True)
class PrismaticJoint(_AxialJoint):
    """Lets the first body slide along an axis of the second, without rotation.

    Attributes:
        axis: (3,) in the world frame.
        limits: (lower, upper) displacement [m], 0 where the joint is added; None for no limits.
        friction: largest force of friction [N].
    """

    locked = LINEAR & ~AXIAL_SLIDE | ANGULAR
    coordinate = Coordinate.SLIDE


@dataclass(frozen=True)
class DistanceJoint(Joint):
    """Keeps the distance of two points within limits. Equal limits make a rod, a maximum alone makes a string.

    Attributes:
        minimum: smallest distance [m]; None for no minimum.
        maximum: largest distance [m]; None for no maximum.
    """

    minimum: float | None = None
    maximum: float | None = None

    locked = 0
    coordinate = Coordinate.LENGTH

    def __post_init__(self) -> None:
        """Check the parameters."""
        for name in ("minimum", "maximum"):
            value = getattr(self, name)
            if value is not None:
                object.__setattr__(self, name, number_in(name, value, 0.0))
        lower, upper = self.range
        if lower > upper:
            raise ValueError(f"maximum: must be at least the minimum {lower:g}, got {upper:g}")

    @property
    def range(self) -> tuple[float, float]:
        """Limits of the distance [m]."""
        return (
            -math.inf if self.minimum is None else self.minimum,
            math.inf if self.maximum is None else self.maximum,
        )


def place_joint(
    bodies: Sequence[Any],
    joint: Joint,
    body_a: int,
    body_b: int | None,
    anchors: tuple[Any, Any],
    frames: tuple[JointFrame | None, JointFrame | None],
    **more: Any,
) -> JointEntry:
    """Return the entry of a joint; see Scene.add_joint.

    Args:
        bodies: the bodies of the scene.
        joint: the joint.
        body_a: index of the first body.
        body_b: index of the second body; None for the world.
        anchors: (3,) points of the two bodies in the world [m]; the second one None where both are the same.
        frames: frames fixed to the bodies, used instead of the anchors; None for both otherwise.
        **more: the other attributes of JointEntry.
    """
    _check_bodies(bodies, joint, body_a, body_b)
    a = bodies[body_a]
    b = None if body_b is None else bodies[body_b]
    if frames[0] is None or frames[1] is None:
        point_a = finite_vector("anchor", anchors[0])
        point_b = point_a if anchors[1] is None else finite_vector("anchor_b", anchors[1])
        orientation = rotation_of_x_to(joint.world_axis)
        frame_a, frame_b = local_frame(a, point_a, orientation), local_frame(b, point_b, orientation)
    else:
        frame_a, frame_b = _checked_frame("frame_a", frames[0]), _checked_frame("frame_b", frames[1])
    _check_anchors(joint, a, b, frame_a, frame_b)
    return JointEntry(joint, body_a, body_b, frame_a, frame_b, **_checked_rest(joint, more))


def rotation_of_x_to(axis: Sequence[float]) -> np.ndarray:
    """Return the shortest rotation of the x axis to a unit vector, as a quaternion (x, y, z, w)."""
    x, y, z = axis
    if x < -0.999999:
        return np.array([0.0, 0.0, 1.0, 0.0])
    orientation = np.array([0.0, -z, y, 1.0 + x])
    return orientation / np.linalg.norm(orientation)


def world_frame(body: Any, frame: JointFrame) -> tuple[np.ndarray, np.ndarray]:
    """Return the origin and the orientation of a frame in the world, at the body's initial pose; None is the world."""
    if body is None:
        return np.array(frame.position), np.array(frame.orientation)
    orientation = np.array(body.orientation)
    origin = np.array(body.position) + rotations.matrix(orientation) @ np.array(frame.position)
    return origin, rotations.multiply(orientation, np.array(frame.orientation))


def local_frame(body: Any, point: Sequence[float] | np.ndarray, orientation: np.ndarray) -> JointFrame:
    """Return a frame of the world (3,), (4,) in the frame of a body at its initial pose; None is the world."""
    position = np.array(point, np.float64)
    if body is not None:
        own = np.array(body.orientation)
        position = rotations.rotate(rotations.inverse(own), position - body.position)
        orientation = rotations.multiply(rotations.inverse(own), orientation)
    x, y, z, w = orientation.tolist()
    return JointFrame((float(position[0]), float(position[1]), float(position[2])), (x, y, z, w))


def _checked_frame(name: str, frame: JointFrame) -> JointFrame:
    instance_of(name, frame, JointFrame, "a JointFrame")
    return JointFrame(
        finite_vector(f"{name} position", frame.position), unit_quaternion(f"{name} orientation", frame.orientation)
    )


def _check_bodies(bodies: Sequence[Any], joint: Joint, body_a: int, body_b: int | None) -> None:
    instance_of("joint", joint, Joint, f"a {', '.join(sorted(JOINTS))}")
    if body_a == body_b:
        raise ValueError(f"body_b: must be another body than body_a, got {body_b} for both")
    both = [bodies[body].motion for body in (body_a, body_b) if body is not None]
    if Motion.DYNAMIC not in both:
        kinds = " and ".join([motion.name.lower() for motion in both] + ["the world"] * (body_b is None))
        raise ValueError(f"body_b: one of the two bodies must be dynamic, got {kinds}")


def _check_anchors(joint: Joint, a: Any, b: Any, frame_a: JointFrame, frame_b: JointFrame) -> None:
    """Points that the joint holds together must be close, and a distance must not be far from its limits."""
    (point_a, _), (point_b, turn_b) = world_frame(a, frame_a), world_frame(b, frame_b)
    size = min(float(body.shape.size) for body in (a, b) if body is not None)
    apart = rotations.matrix(turn_b).T @ (point_a - point_b)
    if joint.coordinate == Coordinate.LENGTH:
        lower, upper = joint.range
        distance = float(np.linalg.norm(apart))
        error, what = max(lower - distance, distance - upper, 0.0), f"distance {distance:g} m from its limits"
        if distance < 1e-6 and upper > 1e-6 and lower > 0.0:
            raise ValueError("anchor_b: must not coincide with anchor for a joint with a minimum")
    else:
        held = np.array([bool(joint.locked >> axis & 1) for axis in range(3)])
        error, what = float(np.linalg.norm(apart[held])), "anchors"
    if error > FURTHEST * size:
        raise ValueError(
            f"anchor: the {what} must be at most {FURTHEST * size:g} m apart, a tenth of the smaller body's size, "
            f"got {error:g} m"
        )


def _checked_rest(joint: Joint, more: dict[str, Any]) -> dict[str, Any]:
    """Check the remaining attributes of an entry."""
    for name in ("break_force", "break_torque"):
        more[name] = largest(name, more[name], above=0.0)
    more["armature"] = number_in("armature", more["armature"], 0.0)
    if more["armature"] > 0.0 and joint.coordinate not in (Coordinate.ANGLE, Coordinate.SLIDE):
        raise ValueError(f"armature: needs a RevoluteJoint or a PrismaticJoint, got a {type(joint).__name__}")
    instance_of("collide", more["collide"], bool, "True or False")
    instance_of("name", more["name"], str, "a string")
    return more
