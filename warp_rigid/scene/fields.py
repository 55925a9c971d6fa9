"""Force fields: accelerations that act on every dynamic body, beside the scene's gravity."""

from dataclasses import dataclass

from warp_rigid.checks import finite_number, finite_vector

__all__ = ["PointField", "UniformField"]


@dataclass(frozen=True)
class UniformField:
    """The same acceleration everywhere.

    Attributes:
        acceleration: (3,) acceleration in the world frame [m/s^2].
    """

    acceleration: tuple[float, float, float]

    def __post_init__(self):
        """Refuse an acceleration that is not three finite numbers with a ValueError."""
        object.__setattr__(self, "acceleration", finite_vector("acceleration", self.acceleration))


@dataclass(frozen=True)
class PointField:
    """Attraction by a point: acceleration strength / d^2 toward the centre at distance d.

    Attributes:
        center: (3,) the attracting point in the world frame [m].
        strength: acceleration times distance squared [m^3/s^2]; a negative one repels.
    """

    center: tuple[float, float, float]
    strength: float

    def __post_init__(self):
        """Refuse a centre or strength that is not finite with a ValueError."""
        object.__setattr__(self, "center", finite_vector("center", self.center))
        object.__setattr__(self, "strength", finite_number("strength", self.strength))
