"""Revolute joint (hinge): rotation about a common axis."""

from dataclasses import dataclass

from warp_rigid.checks import number_in
from warp_rigid.kernels.enums import Coordinate
from warp_rigid.scene.joints.joint import ANGULAR, AXIAL_TURN, LINEAR, Joint, Vector3, ordered_limits, unit_axis


@dataclass(frozen=True)
class RevoluteJoint(Joint):
    """Lets the first body turn about an axis of the second.

    Attributes:
        axis: (3,) in the world frame.
        limits: (lower, upper) angle [rad], 0 where the joint is added; None for no limits.
        friction: largest torque of friction [N m].
    """

    axis: Vector3
    limits: tuple[float, float] | None = None
    friction: float = 0.0

    locked = LINEAR | ANGULAR & ~AXIAL_TURN
    coordinate = Coordinate.ANGLE

    def __post_init__(self) -> None:
        """Check the parameters."""
        object.__setattr__(self, "axis", unit_axis(self.axis))
        object.__setattr__(self, "limits", ordered_limits(self.limits))
        object.__setattr__(self, "friction", number_in("friction", self.friction, 0.0))
