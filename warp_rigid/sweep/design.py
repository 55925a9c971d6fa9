"""Designs: from axes to the list of runs, each with its parameters, its seed and an address that follows from them."""

import hashlib
import itertools
import json
import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from warp_rigid.checks import one_of, whole_in
from warp_rigid.sweep.axes import Choice, Distribution

__all__ = ["DESIGNS", "Run", "address", "make_points", "shard_of"]

DESIGNS = ("grid", "zip", "random", "lhs")
MOST_RUNS = 10_000_000


@dataclass(frozen=True)
class Run:
    """One simulation of a sweep.

    Attributes:
        index: its place in the design.
        id: its address, a hash of all that decides the result.
        parameters: values of the axes, and of the settings that go with them.
        seed: of the scene's random numbers.
    """

    index: int
    id: str
    parameters: dict[str, Any]
    seed: int


def make_points(
    axes: dict[str, list | Distribution],
    design: str = "grid",
    samples: int | None = None,
    repeats: int = 1,
    seed: int = 0,
) -> list[tuple[dict[str, Any], int]]:
    """The points of a design, each with the number of its repeat.

    "grid" takes every combination of the lists' values, "zip" the first values of all lists, then the second ones and
    so on; in both a distribution is drawn anew for every point and repeat. "random" and "lhs" (a Latin hypercube, from
    scipy) take `samples` points, where a list is a choice of its values.

    Args:
        axes: from clean_axes.
        design: one of DESIGNS.
        samples: points of "random" and "lhs"; None for the other two.
        repeats: how often every point occurs.
        seed: of all draws.

    Raises:
        ValueError: The arguments contradict each other.
    """
    one_of("design", design, DESIGNS)
    repeats = whole_in("repeats", repeats, 1, MOST_RUNS)
    rng = np.random.default_rng(whole_in("seed", seed, 0, 2**63 - 1))
    if design in ("random", "lhs"):
        if samples is None:
            raise ValueError(f"samples: must be given for the design {design}")
        _check_runs(whole_in("samples", samples, 1, MOST_RUNS), repeats)
        sampled = _sampled(axes, design, samples, rng)
        return [(point, repeat) for point in sampled for repeat in range(repeats)]
    if samples is not None:
        raise ValueError(f"samples: is for the designs random and lhs, not {design}; repeats repeats every point")
    lists = {name: values for name, values in axes.items() if isinstance(values, list)}
    drawn = {name: values for name, values in axes.items() if isinstance(values, Distribution)}
    if design == "zip" and len({len(values) for values in lists.values()}) > 1:
        told = ", ".join(f"{name} has {len(values)}" for name, values in lists.items())
        raise ValueError(f"axes: a zip needs as many values on each, but {told}")
    together = design == "zip" and lists
    _check_runs(len(next(iter(lists.values()))) if together else math.prod(map(len, lists.values())), repeats)
    rows = list(zip(*lists.values(), strict=True) if together else itertools.product(*lists.values()))
    quantiles = rng.random((len(rows), repeats, len(drawn))).tolist()
    points = []
    for row, draws in zip(rows, quantiles, strict=True):
        values = dict(zip(lists, row, strict=True))
        for repeat, draw in enumerate(draws):
            values |= {name: source.at(q) for (name, source), q in zip(drawn.items(), draw, strict=True)}
            points.append(({name: values[name] for name in axes}, repeat))
    return points


def _check_runs(points: int, repeats: int) -> None:
    """Refuse a design that is too large, before it is made."""
    if points * repeats > MOST_RUNS:
        raise ValueError(f"axes: make {points * repeats} runs, more than {MOST_RUNS}")


def _sampled(axes: dict[str, list | Distribution], design: str, samples: int, rng: Any) -> list[dict[str, Any]]:
    """Points drawn from all axes at once."""
    if design == "lhs":
        from scipy.stats import qmc

        quantiles = qmc.LatinHypercube(max(1, len(axes)), rng=rng).random(samples)
    else:
        quantiles = rng.random((samples, len(axes)))
    sources = {name: Choice(*axis) if isinstance(axis, list) else axis for name, axis in axes.items()}
    return [
        {name: source.at(q) for (name, source), q in zip(sources.items(), row, strict=False)}
        for row in quantiles.tolist()
    ]


def address(*parts: Any) -> str:
    """A hash of plain values, 16 hexadecimal digits."""
    text = json.dumps(parts, sort_keys=True, separators=(",", ":"), default=repr)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def shard_of(runs: list[Run], shard: tuple[int, int] | None) -> list[Run]:
    """Every n-th run from the i-th on, for the shard (i, n), 1 <= i <= n; all for None.

    Raises:
        ValueError: There is no such shard.
    """
    if shard is None:
        return runs
    number, count = shard
    whole_in("shard", count, 1, MOST_RUNS)
    whole_in("shard", number, 1, count)
    return runs[number - 1 :: count]
