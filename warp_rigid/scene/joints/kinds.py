"""All kinds of joints."""

import math
from dataclasses import dataclass

from warp_rigid.checks import number_in
from warp_rigid.kernels.enums import Coordinate
from warp_rigid.scene.joints.joint import (
    ANGULAR,
    AXIAL_SLIDE,
    AXIAL_TURN,
    LINEAR,
    Joint,
    Vector3,
    ordered_limits,
    unit_axis,
)


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
