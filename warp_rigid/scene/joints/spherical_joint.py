"""Spherical joint (ball and socket): any rotation about a common point."""

import math
from dataclasses import dataclass

from warp_rigid.checks import number_in
from warp_rigid.kernels.enums import Coordinate
from warp_rigid.scene.joints.joint import LINEAR, Joint, Vector3, unit_axis


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
