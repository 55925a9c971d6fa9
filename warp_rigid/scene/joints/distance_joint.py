"""Distance joint: a rod or a string between two points."""

import math
from dataclasses import dataclass

from warp_rigid.checks import number_in
from warp_rigid.kernels.enums import Coordinate
from warp_rigid.scene.joints.joint import Joint


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
