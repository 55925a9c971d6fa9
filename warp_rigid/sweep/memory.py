"""Maximum batch size for the available memory."""

from typing import Any

import warp as wp

from warp_rigid.engine.cores import usable_cores
from warp_rigid.engine.memory import body_bytes, device_memory, pool_bytes
from warp_rigid.engine.pools import Pools, expected_capacity
from warp_rigid.scene.scene import Motion, Scene

__all__ = ["bytes_per_environment", "free_memory", "max_environments"]

MEMORY_FRACTION = 0.5
"""Fraction of the free memory for a batch. While a buffer grows, the old and the new one exist at the same time."""

MAX_ENVS_PER_CORE = 32
"""A core simulates environments sequentially, so that larger batches only delay the first rows."""

MAX_ENVS_ON_GPU = 16384
"""Larger batches do not increase the throughput of a GPU, but delay the first rows."""


def bytes_per_environment(scene: Scene) -> int:
    """Initial device memory per environment of a simulator [bytes]."""
    pairs, contacts = expected_capacity(1, sum(body.motion == Motion.DYNAMIC for body in scene.bodies))
    return body_bytes(scene, 1) + pool_bytes(Pools.sizes_for(1, len(scene.bodies), pairs, contacts))


def free_memory(device: Any) -> int:
    """Free memory of a CUDA device, or of the machine for the CPU [bytes]."""
    return device_memory(wp.get_device(device))[1]


def max_environments(scene: Scene, device: Any) -> int:
    """Maximum batch size of a scene on a device, limited by memory and by useful parallelism."""
    fits = int(MEMORY_FRACTION * free_memory(device) / bytes_per_environment(scene))
    return max(1, min(fits, MAX_ENVS_ON_GPU if wp.get_device(device).is_cuda else MAX_ENVS_PER_CORE * usable_cores()))
