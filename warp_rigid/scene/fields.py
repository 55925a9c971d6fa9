"""Force fields: accelerations that act on every dynamic body besides the scene's gravity.

A field is a frozen dataclass derived from `ForceField`. Its declaration defines the checks, the device rows,
checkpoints, USD files and the list of exported names. `kernels/update/force_fields.py` has its device function.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass, fields
from itertools import accumulate
from typing import Any, ClassVar

import numpy as np

from warp_rigid.checks import finite_vector, number_in
from warp_rigid.kernels.enums import FieldKind

__all__ = ["DragField", "ForceField", "PointField", "UniformField"]

Vector3 = tuple[float, float, float]

NEAREST = 1e-6
"""Least distance from the centre of a PointField, as in its device function [m]."""

FIELDS: dict[str, type["ForceField"]] = {}
"""All kinds of force fields by class name."""


class ForceField(ABC):
    """Base of all force fields. Each attribute is a number or three numbers, and becomes a parameter on the device.

    Attributes:
        kind: selects the device function.

    Raises:
        ValueError: A parameter is not finite.
    """

    kind: ClassVar[FieldKind]

    def __init_subclass__(cls) -> None:
        """Register the kind."""
        FIELDS[cls.__name__] = cls

    def __post_init__(self) -> None:
        """Check the parameters."""
        for name, is_vector in self.parameters().items():
            check = finite_vector if is_vector else number_in
            object.__setattr__(self, name, check(name, getattr(self, name)))

    @classmethod
    def parameters(cls) -> dict[str, bool]:
        """Return for each parameter whether it is a vector."""
        return {entry.name: entry.type is Vector3 for entry in fields(cls)}  # type: ignore[arg-type]

    def values(self) -> dict[str, Any]:
        """Return the parameters by name, as for the constructor."""
        return {name: getattr(self, name) for name in self.parameters()}

    @classmethod
    def columns(cls) -> dict[str, slice]:
        """Return the columns of `row` with each parameter."""
        ends = list(accumulate(3 if is_vector else 1 for is_vector in cls.parameters().values()))
        return dict(zip(cls.parameters(), map(slice, [0, *ends], ends), strict=True))

    @classmethod
    def from_row(cls, row: np.ndarray) -> "ForceField":
        """Return the field with the parameters of `row`."""
        numbers = {name: row[own].tolist() for name, own in cls.columns().items()}
        return cls(**{name: tuple(own) if len(own) == 3 else own[0] for name, own in numbers.items()})

    def row(self) -> np.ndarray:
        """Return the concatenated parameters, (n,) float32, as the device function reads them."""
        return np.hstack([np.asarray(value, np.float32) for value in self.values().values()])

    @abstractmethod
    def potential(self, x: np.ndarray) -> np.ndarray:
        """Return the potential energy per mass at points.

        Args:
            x: (..., 3) points [m].

        Returns:
            (...) potential [J/kg].
        """


@dataclass(frozen=True)
class UniformField(ForceField):
    """The same acceleration everywhere.

    Attributes:
        acceleration: (3,) acceleration in the world frame [m/s^2].
    """

    kind = FieldKind.UNIFORM
    acceleration: Vector3

    def potential(self, x: np.ndarray) -> np.ndarray:
        """Return -acceleration . x [J/kg]."""
        return -(x @ np.array(self.acceleration))


@dataclass(frozen=True)
class PointField(ForceField):
    """Attraction by a point: acceleration strength / d^2 toward the centre at distance d.

    Attributes:
        center: (3,) the attracting point in the world frame [m].
        strength: acceleration times distance squared [m^3/s^2]; a negative one repels.
    """

    kind = FieldKind.POINT
    center: Vector3
    strength: float

    def potential(self, x: np.ndarray) -> np.ndarray:
        """Return -strength / d [J/kg], with d at least NEAREST."""
        return -self.strength / np.maximum(np.linalg.norm(x - np.array(self.center), axis=-1), NEAREST)


@dataclass(frozen=True)
class DragField(ForceField):
    """Resistance of a medium: a body approaches the velocity of the medium exponentially, in a time of 1 / drag.

    The drags of several media add up. In gravity, a body reaches the velocity g / drag. This holds for any time step.
    Reported impulses of impacts are too large by a fraction of drag * dt / 2. Above drag * dt = 100, impulses at rest
    are too small, and `warnings()` may report loads and energy that are none.

    Attributes:
        drag: deceleration over relative velocity [1/s], at least 0.
        velocity: (3,) velocity of the medium in the world frame, such as wind [m/s].

    Raises:
        ValueError: The drag is negative.
    """

    kind = FieldKind.DRAG
    drag: float
    velocity: Vector3 = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        """Check the parameters."""
        super().__post_init__()
        number_in("drag", self.drag, 0.0)

    def potential(self, x: np.ndarray) -> np.ndarray:
        """Return 0: drag dissipates energy and has no potential."""
        return np.zeros(x.shape[:-1])
