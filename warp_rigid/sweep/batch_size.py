"""Splitting of runs into batches that fit into the available memory."""

import functools
import logging
import math
from typing import Any, NamedTuple

import warp as wp

from warp_rigid.engine.cores import usable_cores
from warp_rigid.engine.hash_grid import grid_sizes
from warp_rigid.engine.layout import layout_of
from warp_rigid.engine.memory import body_bytes, bytes_by_shape, device_memory, pool_bytes
from warp_rigid.engine.pools import expected_pairs, sizes_for
from warp_rigid.scene.scene import Scene
from warp_rigid.sweep.design import Run

log = logging.getLogger("warp_rigid")

MEMORY_FRACTION = 0.5
"""Fraction of the free memory for a batch. While a buffer grows, the old and the new one exist at the same time."""

MAX_ENVS_PER_CORE = 32
"""A core simulates environments sequentially, so that larger batches only delay the first rows."""

MAX_ENVS_ON_GPU = 16384
"""Larger batches do not increase the throughput of a GPU, but delay the first rows."""


class Footprint(NamedTuple):
    """Device memory that an environment needs.

    Attributes:
        own: bytes of its bodies, pairs and contacts.
        shapes: bytes of each of its shapes by content, which environments share.
    """

    own: int
    shapes: dict[str, int]


class SizedRun(NamedTuple):
    """A run, and the memory that it needs."""

    run: Run
    footprint: Footprint


def footprint_of(scene: Scene, known: dict[str, int] | None = None) -> Footprint:
    """Initial device memory of an environment; `known` as for bytes_by_shape."""
    layout = layout_of(scene, 1)
    pairs = int(expected_pairs(layout.dynamic_per_env)[0])
    own = {**layout.sizes, **grid_sizes(layout.bodies_per_env)}
    sizes = sizes_for(pairs, 6 * pairs, own)
    return Footprint(_bytes_of_sizes(tuple(sizes.items())), bytes_by_shape(layout, known))


@functools.lru_cache(maxsize=4096)
def _bytes_of_sizes(sizes: tuple[tuple[str, int], ...]) -> int:
    """Bytes of the arrays of an environment; many scenes of a sweep have the same numbers of bodies."""
    return body_bytes(dict(sizes)) + pool_bytes(dict(sizes))


def free_memory(device: Any) -> int:
    """Free memory of a CUDA device, or of the machine for the CPU [bytes]."""
    return device_memory(wp.get_device(device))[1]


def max_environments(device: Any) -> int:
    """Maximum batch size that is useful on a device; memory may require smaller batches."""
    return MAX_ENVS_ON_GPU if wp.get_device(device).is_cuda else MAX_ENVS_PER_CORE * usable_cores()


def split_into_batches(
    groups: list[list[SizedRun]], batch: int | str, most: int, memory: int, workers: int = 1
) -> list[list[Run]]:
    """Split groups of runs into batches, and log their estimated memory before anything is allocated.

    Args:
        groups: from group_runs.
        batch: maximum number of environments per batch, or "auto".
        most: maximum batch size for "auto", which also keeps to a fraction of the memory.
        memory: free memory of the device [bytes].
        workers: number of batches that run in parallel.
    """
    batches: list[list[SizedRun]] = []
    for runs in groups:
        # Spread evenly over batches and workers.
        rounds = math.ceil(len(runs) / (workers * (most if batch == "auto" else int(batch))))
        size = max(1, math.ceil(len(runs) / (workers * rounds)))
        for first in range(0, len(runs), size):
            some = runs[first : first + size]
            batches += [some] if batch != "auto" else _fitting(some, int(MEMORY_FRACTION * memory))
    log.info(
        "%d runs in %d %s of at most %d; at most %.3g MB per batch, %.3g GB free",
        sum(map(len, batches)),
        len(batches),
        "batch" if len(batches) == 1 else "batches",
        max(map(len, batches)),
        max(map(batch_bytes, batches)) / 1e6,
        memory / 1e9,
    )
    return [[sized.run for sized in runs] for runs in batches]


def batch_bytes(runs: list[SizedRun]) -> int:
    """Initial device memory of a batch; each distinct shape counts once [bytes]."""
    shapes: dict[str, int] = {}
    for footprint in {id(sized.footprint): sized.footprint for sized in runs}.values():
        shapes |= footprint.shapes
    return sum(sized.footprint.own for sized in runs) + sum(shapes.values())


def _fitting(runs: list[SizedRun], memory: int) -> list[list[SizedRun]]:
    """The runs in order, halved until each batch fits into the memory."""
    if len(runs) == 1 or batch_bytes(runs) <= memory:
        return [runs]
    middle = len(runs) // 2
    return _fitting(runs[:middle], memory) + _fitting(runs[middle:], memory)
