"""Designs: the list of runs of a sweep, each with its parameters, its seed and an id derived from both."""

import hashlib
import itertools
import json
import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from warp_rigid.checks import one_of, whole_in
from warp_rigid.sweep.axes import Choice, Distribution

DESIGNS = ("grid", "zip", "random", "lhs")
MAX_RUNS = 10_000_000


@dataclass(frozen=True)
class Run:
    """One simulation of a sweep.

    Attributes:
        index: position in the design.
        id: hash of everything that determines the result.
        parameters: values of the axes and of the settings implied by them.
        seed: seed of the random numbers of the scene.
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
    """Generate the points of a design, each with its repeat index.

    "grid" uses every combination of the listed values, "zip" pairs the lists element by element; in both, distributions
    are sampled again for every point and repeat. "random" and "lhs" (Latin hypercube, from scipy) sample `samples`
    points, in which a list is sampled as a Choice of its values.

    Args:
        axes: from clean_axes.
        design: one of DESIGNS.
        samples: number of points for "random" and "lhs"; None otherwise.
        repeats: number of runs per point.
        seed: seed of all samples.

    Raises:
        ValueError: The arguments are out of range or inconsistent.
    """
    one_of("design", design, DESIGNS)
    repeats = whole_in("repeats", repeats, 1, MAX_RUNS)
    rng = np.random.default_rng(whole_in("seed", seed, 0, 2**63 - 1))
    sampled = design in ("random", "lhs")
    if sampled and samples is None:
        raise ValueError(f"samples: is required by the design {design}")
    if not sampled and samples is not None:
        raise ValueError(f"samples: applies to the designs random and lhs, not {design}; use repeats to repeat points")
    lists = {name: axis for name, axis in axes.items() if isinstance(axis, list) and not sampled}
    drawn = {
        name: Choice(*axis) if isinstance(axis, list) else axis for name, axis in axes.items() if name not in lists
    }
    if design == "zip" and len({len(values) for values in lists.values()}) > 1:
        lengths = ", ".join(f"{name} has {len(values)}" for name, values in lists.items())
        raise ValueError(f"axes: the design zip requires lists of equal length, but {lengths}")
    zipped = design == "zip" and lists
    count = len(next(iter(lists.values()))) if zipped else math.prod(map(len, lists.values()))
    if samples is not None:
        count = whole_in("samples", samples, 1, MAX_RUNS)
    if count * repeats > MAX_RUNS:
        raise ValueError(f"axes: must make at most {MAX_RUNS} runs, got {count * repeats}")
    listed = zip(*lists.values(), strict=True) if zipped else itertools.product(*lists.values())
    rows = [()] * count if sampled else list(listed)
    if design == "lhs":
        from scipy.stats import qmc

        quantiles = qmc.LatinHypercube(max(1, len(axes)), rng=rng).random(count)[:, None, : len(axes)]
    else:
        quantiles = rng.random((count, 1 if sampled else repeats, len(drawn)))
    if drawn and not sampled and count * repeats == 1:
        name, source = next(iter(drawn.items()))
        raise ValueError(
            f"axes: the design {design} draws {name} once from {source}, which makes a single run; give the number of "
            f"values (low:high:count), or repeats, or samples with the design random or lhs"
        )
    points = []
    for row, draws in zip(rows, np.broadcast_to(quantiles, (count, repeats, len(drawn))).tolist(), strict=True):
        values = dict(zip(lists, row, strict=True))
        for repeat, draw in enumerate(draws):
            values |= {name: source.at(q) for (name, source), q in zip(drawn.items(), draw, strict=True)}
            points.append(({name: values[name] for name in axes}, repeat))
    return points


def stable_hash(*parts: Any) -> str:
    """Hash plain values to 16 hexadecimal digits."""
    return digest(json.dumps(parts, sort_keys=True, separators=(",", ":"), default=repr).encode())


def digest(content: bytes) -> str:
    """Hash bytes to 16 hexadecimal digits."""
    return hashlib.sha256(content).hexdigest()[:16]


def shard_of(runs: list[Run], shard: tuple[int, int] | None) -> list[Run]:
    """Select every n-th run, starting with the i-th, for the shard (i, n), 1 <= i <= n; all runs for None.

    Raises:
        ValueError: The shard is out of range.
    """
    if shard is None:
        return runs
    number, count = shard
    whole_in("shard", count, 1, MAX_RUNS)
    whole_in("shard", number, 1, count)
    return runs[number - 1 :: count]
