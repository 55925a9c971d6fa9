"""Axes of a sweep: lists of values and distributions, and their syntax on the command line."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import NormalDist
from typing import Any

import numpy as np

from warp_rigid.checks import number_in, shown, whole_in
from warp_rigid.runs.assignments import parse_assignment

MAX_VALUES = 10_000_000


class Distribution:
    """A distribution of values; `at` maps quantiles in [0, 1) to values."""

    def at(self, quantile: float) -> Any:
        """Value of the quantile function at `quantile`."""
        raise NotImplementedError


@dataclass(frozen=True)
class Uniform(Distribution):
    """Uniform distribution between `low` and `high`."""

    low: float
    high: float

    def __post_init__(self) -> None:
        """Check the range."""
        number_in("high", self.high, above=number_in("low", self.low))

    def at(self, quantile: float) -> float:
        """See Distribution."""
        return float(self.low + quantile * (self.high - self.low))


@dataclass(frozen=True)
class LogUniform(Distribution):
    """Distribution of positive numbers whose logarithm is uniform between those of `low` and `high`."""

    low: float
    high: float

    def __post_init__(self) -> None:
        """Check the range, which must be positive."""
        number_in("high", self.high, above=number_in("low", self.low, above=0.0))

    def at(self, quantile: float) -> float:
        """See Distribution."""
        return float(self.low * (self.high / self.low) ** quantile)


@dataclass(frozen=True)
class Normal(Distribution):
    """Normal distribution with a `mean` and a standard `deviation`, truncated at 6 deviations."""

    mean: float
    deviation: float

    def __post_init__(self) -> None:
        """Check that the deviation is positive."""
        number_in("mean", self.mean)
        number_in("deviation", self.deviation, above=0.0)

    def at(self, quantile: float) -> float:
        """See Distribution."""
        return NormalDist(self.mean, self.deviation).inv_cdf(min(max(quantile, 1e-9), 1.0 - 1e-9))


@dataclass(frozen=True)
class Integers(Distribution):
    """Uniform distribution of whole numbers from `low` to `high`, both included."""

    low: int
    high: int

    def __post_init__(self) -> None:
        """Check the range."""
        whole_in("high", self.high, whole_in("low", self.low, -(2**53), 2**53), 2**53)

    def at(self, quantile: float) -> int:
        """See Distribution."""
        return min(self.high, self.low + math.floor(quantile * (self.high - self.low + 1)))


class Choice(Distribution):
    """Uniform distribution over a list of values."""

    def __init__(self, *values: Any) -> None:
        """Store the values; at least one is required."""
        if not values:
            raise ValueError("choice: must have at least one value")
        self.values = tuple(plain(value) for value in values)

    def __repr__(self) -> str:
        """Show the values."""
        return f"Choice{self.values}"

    def at(self, quantile: float) -> Any:
        """See Distribution."""
        return self.values[min(len(self.values) - 1, math.floor(quantile * len(self.values)))]


DISTRIBUTIONS = {
    "uniform": Uniform,
    "log_uniform": LogUniform,
    "normal": Normal,
    "integers": Integers,
    "choice": Choice,
}
"""Distributions by name on the command line."""


def plain(value: Any) -> Any:
    """Convert an axis value to plain Python: number, boolean, string, None, or a tuple of those."""
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, list | tuple):
        return tuple(plain(part) for part in value)
    if value is None or isinstance(value, bool | int | float | str):
        return value
    raise ValueError(f"axis: values must be numbers, strings, booleans or vectors of them, got {value!r}")


def clean_axes(axes: Mapping[str, Any]) -> dict[str, list | Distribution]:
    """Validate axes and convert their values to plain Python.

    Args:
        axes: for each name a distribution, a sequence or array of values, or one value.

    Raises:
        ValueError: An axis is empty or has an invalid value.
    """
    if not isinstance(axes, Mapping):
        raise ValueError(f"axes: must be a mapping of names to values, got {type(axes).__name__}")
    clean: dict[str, list | Distribution] = {}
    for name, values in axes.items():
        if type(name) is not str or not name:
            raise ValueError(f"axes: names must be non-empty strings, got {shown(name)}")
        if isinstance(values, Distribution):
            clean[name] = values
            continue
        several = isinstance(values, Sequence) and not isinstance(values, str)
        if isinstance(values, np.ndarray):
            several = values.ndim > 0
        clean[name] = [plain(value) for value in (values if several else [values])]
        if not clean[name]:
            raise ValueError(f"{name}: must have at least one value")
    return clean


def parse_axis(text: str) -> tuple[str, list | Distribution]:
    """Parse an axis of the command line.

    Forms: "name=0.1:1.0:10" (first, last, count), "name=0.1:1.0" (uniform distribution), "name=off,one_pass" (list of
    values), "name=normal(0.5,0.1)" and similar (distribution).

    Raises:
        ValueError: The text has another form.
    """
    name, values = parse_assignment(text, "--vary")
    if len(values) > 1 or not isinstance(values[0], str):
        return name, values
    word = values[0]
    kind, bracket, inside = word.partition("(")
    if bracket and inside.endswith(")") and kind in DISTRIBUTIONS:
        _, arguments = parse_assignment(f"{kind}={inside[:-1]}", "--vary")
        try:
            return name, DISTRIBUTIONS[kind](*arguments)
        except TypeError:
            raise ValueError(f"--vary {name}: invalid arguments of {kind}, got {shown(inside[:-1])}") from None
        except ValueError as error:
            raise ValueError(f"--vary {name}: {kind}: {error}") from None
    if ":" in word:
        return name, _range(name, word)
    return name, values


def _range(name: str, word: str) -> list | Distribution:
    """Expand "low:high:count" to a list of numbers, and "low:high" to a uniform distribution."""
    parts = word.split(":")
    try:
        low, high = map(float, parts[:2])
        (count,) = map(int, parts[2:]) if len(parts) > 2 else (None,)
    except ValueError:
        low, high, count = math.nan, math.nan, None
    if not (math.isfinite(low) and math.isfinite(high)):
        raise ValueError(f"--vary {name}: must be low:high:count or low:high with numbers, got {word!r}")
    if count is None:
        return Uniform(low, high)
    whole_in(f"--vary {name}: count", count, 1, MAX_VALUES)
    spaced = np.linspace(low, high, count).tolist()
    whole = all(part.lstrip("+-").isdigit() for part in parts[:2]) and all(value.is_integer() for value in spaced)
    return [int(value) for value in spaced] if whole else spaced
