"""Joint: the base of all kinds of joints, and what a scene stores of a joint between two bodies.

A kind of joint states which of the six relative motions of two frames are locked, and which coordinate is free: rows
and limits, motors, friction, checkpoints, USD and the exported name follow from that. The x axis of both frames is
the joint's axis.
"""

import math
from abc import ABC
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from warp_rigid import rotations
from warp_rigid.checks import LARGEST, finite_vector, number_in, numbers_of, shown
from warp_rigid.kernels.enums import Coordinate, JointNumber

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
