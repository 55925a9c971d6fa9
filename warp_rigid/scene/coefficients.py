"""Body coefficients, such as friction: each is declared here once.

A declaration defines the keyword of `Scene.add_body` with its default and range, the attribute of `Body`, the name in
`Simulator.get` and `Simulator.set`, on the command line and as a sweep axis, the device upload, checkpoints,
recordings, the attribute of a USD material and the slider of the viewer. The kernels declare the device array of the
same name in `kernels/schema.py`.
"""

import inspect
import math
import re
from collections.abc import Callable
from dataclasses import dataclass, field, fields
from typing import Any, TypedDict, TypeVar

import numpy as np

from warp_rigid.checks import number_in, refuse_others

Method = TypeVar("Method", bound=Callable[..., Any])


@dataclass(frozen=True)
class Coefficient:
    """Declaration of a body coefficient.

    Attributes:
        name: the keyword.
        default: value of a body for which none is given.
        unit: product of powers of kg, m, s and rad; empty for a pure number.
        description: meaning of the coefficient.
        lower: smallest value allowed.
        upper: largest value allowed.
        typical_max: upper end of the viewer's slider.
        usd: attributes of a USD material that hold the value; the first one is read.
    """

    name: str
    default: float
    unit: str
    description: str
    typical_max: float
    lower: float = 0.0
    upper: float = math.inf
    usd: tuple[str, ...] = ()

    def check(self, value: Any) -> float:
        """Return a value as a float.

        Raises:
            ValueError: The value is not a finite number in the range.
        """
        return number_in(self.name, value, self.lower, self.upper)

    def check_array(self, values: np.ndarray) -> None:
        """Check that all values of an array are in the range.

        Raises:
            ValueError: A value is outside the range.
        """
        refuse_others(self.name, values, ~((values < self.lower) | (values > self.upper)), self._range)

    @property
    def _range(self) -> str:
        return f">= {self.lower:g}" if math.isinf(self.upper) else f"from {self.lower:g} to {self.upper:g}"

    @property
    def usd_attributes(self) -> tuple[str, ...]:
        """Attributes of a USD material that hold the value."""
        return self.usd or (f"warpRigid:{self.name}",)

    @property
    def length_power(self) -> int:
        """Power of the metre in the unit, by which a file with another length unit is converted."""
        above, _, below = self.unit.partition("/")
        powers = [re.findall(r"\bm\b(?:\^(\d+))?", part) for part in (above, below)]
        return sum(int(p or 1) for p in powers[0]) - sum(int(p or 1) for p in powers[1])

    def __str__(self) -> str:
        """Description, range and unit in one line."""
        return f"{self.description}, {self._range}" + (f" [{self.unit}]" if self.unit else "")


def _declare(default: float, **declaration: Any) -> Any:
    """Return a dataclass field that holds the declaration of a coefficient."""
    return field(default=default, metadata={"default": default, **declaration})


@dataclass(frozen=True, kw_only=True)
class Coefficients:
    """Coefficients of one body, checked. `CoefficientKeywords` has the same names.

    Raises:
        ValueError: A value is not a finite number in its range.
    """

    friction: float = _declare(
        0.5,
        unit="",
        description="Coulomb coefficient, static and sliding alike",
        typical_max=1.5,
        usd=("physics:dynamicFriction", "physics:staticFriction"),
    )
    restitution: float = _declare(
        0.0,
        unit="",
        description="rebound speed over approach speed",
        upper=1.0,
        typical_max=1.0,
        usd=("physics:restitution",),
    )
    rolling_friction: float = _declare(
        0.0,
        unit="m",
        description="resisting torque over normal force, against rolling",
        typical_max=0.05,
        usd=("newton:rollingFriction",),
    )
    spinning_friction: float = _declare(
        0.0,
        unit="m",
        description="resisting torque over normal force, about the contact normal",
        typical_max=0.05,
        usd=("newton:torsionalFriction",),
    )

    def __post_init__(self) -> None:
        """Check all values."""
        for name, coefficient in COEFFICIENTS.items():
            value = getattr(self, name)
            if value is not coefficient.default:
                object.__setattr__(self, name, coefficient.check(value))


class CoefficientKeywords(TypedDict, total=False):
    """Keywords for type checkers and editors; names as in `Coefficients`."""

    friction: float
    restitution: float
    rolling_friction: float
    spinning_friction: float


COEFFICIENTS: dict[str, Coefficient] = {
    entry.name: Coefficient(entry.name, **entry.metadata) for entry in fields(Coefficients)
}
"""All coefficients by name."""

assert list(CoefficientKeywords.__annotations__) == list(COEFFICIENTS)

_PLACEHOLDER = "            **coefficients: coefficients of the body by name; see Coefficients.\n"


def list_coefficients(method: Method) -> Method:
    """List the coefficients individually in the signature and the docstring of a method with `**coefficients`."""
    signature = inspect.signature(method)
    kept = [p for p in signature.parameters.values() if p.kind is not p.VAR_KEYWORD]
    keywords = [
        inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=coefficient.default, annotation=float)
        for name, coefficient in COEFFICIENTS.items()
    ]
    method.__dict__["__signature__"] = signature.replace(parameters=[*kept, *keywords])
    lines = "".join(f"            {name}: {coefficient}.\n" for name, coefficient in COEFFICIENTS.items())
    method.__doc__ = (method.__doc__ or "").replace(_PLACEHOLDER, lines)
    return method
