"""Splitting of runs into batches that fit into the available memory."""

import logging
import math
from collections.abc import Callable
from typing import Any

import warp as wp

from warp_rigid.engine.cores import usable_cores
from warp_rigid.engine.memory import body_bytes, device_memory, pool_bytes
from warp_rigid.engine.model import other_constraints
from warp_rigid.engine.pools import Pools, expected_capacity
from warp_rigid.scene.scene import Motion, Scene
from warp_rigid.sweep.design import Run

__all__ = ["bytes_per_environment", "free_memory", "max_environments", "split_into_batches"]

log = logging.getLogger("warp_rigid")

MEMORY_FRACTION = 0.5
"""Fraction of the free memory for a batch. While a buffer grows, the old and the new one exist at the same time."""

MAX_ENVS_PER_CORE = 32
"""A core simulates environments sequentially, so that larger batches only delay the first rows."""

MAX_ENVS_ON_GPU = 16384
"""Larger batches do not increase the throughput of a GPU, but delay the first rows."""


def bytes_per_environment(scene: Scene) -> int:
    """Initial device memory per environment of a simulator [bytes]."""
    pairs, contacts = expected_capacity(1, sum(body.motion == Motion.DYNAMIC for body in scene.bodies))
    return body_bytes(scene, 1) + pool_bytes(
        Pools.sizes_for(1, len(scene.bodies), other_constraints(scene), pairs, contacts)
    )


def free_memory(device: Any) -> int:
    """Free memory of a CUDA device, or of the machine for the CPU [bytes]."""
    return device_memory(wp.get_device(device))[1]


def max_environments(scene: Scene, device: Any) -> int:
    """Maximum batch size of a scene on a device, limited by memory and by useful parallelism."""
    fits = int(MEMORY_FRACTION * free_memory(device) / bytes_per_environment(scene))
    return max(1, min(fits, MAX_ENVS_ON_GPU if wp.get_device(device).is_cuda else MAX_ENVS_PER_CORE * usable_cores()))


def split_into_batches(
    groups: list[tuple[Scene, list[Run]]], batch: int | str, most: Callable[[Scene], int], memory: int, workers: int = 1
) -> list[list[Run]]:
    """Split groups of runs into batches, and log their estimated memory before anything is allocated.

    Args:
        groups: from group_runs.
        batch: maximum number of environments per batch, or "auto".
        most: maximum batch size of a scene, for "auto".
        memory: free memory of the device, for the log message [bytes].
        workers: number of batches that run in parallel.
    """
    parts, largest = [], 0
    for scene, runs in groups:
        size = _batch_size(len(runs), most(scene) if batch == "auto" else int(batch), workers)
        parts += [runs[first : first + size] for first in range(0, len(runs), size)]
        largest = max(largest, size * bytes_per_environment(scene))
    log.info(
        "%d runs in %d batches of at most %d; at most %.3g MB per batch, %.3g MB free",
        sum(map(len, parts)),
        len(parts),
        max(map(len, parts)),
        largest / 1e6,
        memory / 1e6,
    )
    return parts


def _batch_size(count: int, most: int, workers: int = 1) -> int:
    """Batch size, at most `most`, that distributes `count` runs evenly over batches and workers."""
    rounds = math.ceil(count / (workers * most))
    return max(1, math.ceil(count / (workers * rounds)))
