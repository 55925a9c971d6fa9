"""Axes of a sweep: lists of values, and distributions to draw from; their notation on the command line."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import NormalDist
from typing import Any

import numpy as np

from warp_rigid.checks import finite_number, number_in, shown, whole_in
from warp_rigid.runs.assignments import parse_assignment

__all__ = [
    "Choice", "Distribution", "Integers", "LogUniform", "Normal", "Uniform", "clean_axes", "parse_axis", "plain",
]  # fmt: skip

MOST_VALUES = 10_000_000


class Distribution:
    """Something to draw values from: `at` maps [0, 1) to values, so that any design can use it."""

    def at(self, quantile: float) -> Any:
        """The value below which a fraction `quantile` of the draws lies."""
        raise NotImplementedError


@dataclass(frozen=True)
class Uniform(Distribution):
    """Numbers between `low` and `high`, all as likely."""

    low: float
    high: float

    def __post_init__(self) -> None:
        """Refuse an empty range."""
        number_in("high", self.high, above=finite_number("low", self.low))

    def at(self, quantile: float) -> float:
        """See Distribution."""
        return float(self.low + quantile * (self.high - self.low))


@dataclass(frozen=True)
class LogUniform(Distribution):
    """Positive numbers whose logarithm is uniform between those of `low` and `high`."""

    low: float
    high: float

    def __post_init__(self) -> None:
        """Refuse an empty range or one that reaches zero."""
        number_in("high", self.high, above=number_in("low", self.low, above=0.0))

    def at(self, quantile: float) -> float:
        """See Distribution."""
        return float(self.low * (self.high / self.low) ** quantile)


@dataclass(frozen=True)
class Normal(Distribution):
    """Numbers about `mean` with a standard `deviation`, drawn within 6 deviations of it."""

    mean: float
    deviation: float

    def __post_init__(self) -> None:
        """Refuse a deviation that is not positive."""
        finite_number("mean", self.mean)
        number_in("deviation", self.deviation, above=0.0)

    def at(self, quantile: float) -> float:
        """See Distribution."""
        return NormalDist(self.mean, self.deviation).inv_cdf(min(max(quantile, 1e-9), 1.0 - 1e-9))


@dataclass(frozen=True)
class Integers(Distribution):
    """Whole numbers from `low` to `high`, both included, all as likely."""

    low: int
    high: int

    def __post_init__(self) -> None:
        """Refuse an empty range."""
        whole_in("high", self.high, whole_in("low", self.low, -(2**53), 2**53), 2**53)

    def at(self, quantile: float) -> int:
        """See Distribution."""
        return min(self.high, self.low + math.floor(quantile * (self.high - self.low + 1)))


class Choice(Distribution):
    """One of some values, all as likely."""

    def __init__(self, *values: Any) -> None:
        """Keep the values; there must be at least one."""
        if not values:
            raise ValueError("choice: must have at least one value")
        self.values = tuple(plain(value) for value in values)

    def __repr__(self) -> str:
        """Tell the values."""
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
"""Distributions by their name on the command line."""


def plain(value: Any) -> Any:
    """A value of an axis as plain Python: number, boolean, text, None, or a tuple of those."""
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, list | tuple):
        return tuple(plain(part) for part in value)
    if value is None or isinstance(value, bool | int | float | str):
        return value
    raise ValueError(f"axis: values must be numbers, texts, booleans or vectors of them, got {value!r}")


def clean_axes(axes: Mapping[str, Any]) -> dict[str, list | Distribution]:
    """Check a caller's axes and turn their values into plain Python.

    Args:
        axes: for each name a distribution, a sequence or array of values, or one value.

    Raises:
        ValueError: An axis is empty or holds what is no value.
    """
    if not isinstance(axes, Mapping):
        raise ValueError(f"axes: must be a mapping of names to values, got {type(axes).__name__}")
    clean: dict[str, list | Distribution] = {}
    for name, values in axes.items():
        if type(name) is not str or not name:
            raise ValueError(f"axes: must have words as names, got {shown(name)}")
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
    """Read an axis of the command line.

    Forms: "name=0.1:1.0:10" (so many values from the first to the second), "name=0.1:1.0" (uniform between them),
    "name=off,one_pass" (these values), "name=normal(0.5,0.1)" and the like (a distribution).

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
            raise ValueError(f"--vary {name}: {kind} takes other arguments than {shown(inside[:-1])}") from None
        except ValueError as error:
            raise ValueError(f"--vary {name}: {kind}: {error}") from None
    if ":" in word:
        return name, _range(name, word)
    return name, values


def _range(name: str, word: str) -> list | Distribution:
    """The numbers of "low:high:count", or a uniform distribution for "low:high"."""
    parts = word.split(":")
    numbers: list[float] = []
    count = None
    try:
        count = int(parts[2]) if len(parts) == 3 else None
        numbers = [float(part) for part in parts[:2]]
    except ValueError:
        pass
    if len(numbers) != 2 or len(parts) > 3 or not all(map(math.isfinite, numbers)):
        raise ValueError(f"--vary {name}: must be low:high:count or low:high in numbers, got {word!r}")
    if count is None:
        return Uniform(*numbers)
    whole_in(f"--vary {name}: count", count, 1, MOST_VALUES)
    spaced = np.linspace(numbers[0], numbers[1], count).tolist()
    whole = all(part.lstrip("+-").isdigit() for part in parts[:2]) and all(value.is_integer() for value in spaced)
    return [int(value) for value in spaced] if whole else spaced
