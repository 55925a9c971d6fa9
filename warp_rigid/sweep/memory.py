"""How many environments fit into the memory at hand."""

from typing import Any

import warp as wp

from warp_rigid.engine.cores import usable_cores
from warp_rigid.engine.memory import body_bytes, device_memory, pool_bytes
from warp_rigid.engine.model import other_constraints
from warp_rigid.engine.pools import Pools, expected_capacity
from warp_rigid.scene.scene import Motion, Scene

__all__ = ["bytes_an_environment", "memory_at_hand", "most_environments"]

SHARE = 0.5
"""Share of the free memory that a batch may take: pools grow, and the old ones are still there while they do."""

MOST_ON_A_CORE = 32
"""A core does environments one after another, so that more only delay the first rows."""

MOST_ON_GPU = 16384
"""More environments than this no longer make a GPU quicker, but delay the first rows."""


def bytes_an_environment(scene: Scene) -> int:
    """Device memory that each further environment of a simulator takes at first [bytes]."""
    pairs, contacts = expected_capacity(1, sum(body.motion == Motion.DYNAMIC for body in scene.bodies))
    return body_bytes(scene, 1) + pool_bytes(
        Pools.sizes_for(1, len(scene.bodies), other_constraints(scene), pairs, contacts)
    )


def memory_at_hand(device: Any) -> int:
    """Free memory of a Warp device, or of the machine for the CPU [bytes]."""
    return device_memory(wp.get_device(device))[1]


def most_environments(scene: Scene, device: Any) -> int:
    """The largest batch that is worth while on a device and fits into its memory."""
    fits = int(SHARE * memory_at_hand(device) / bytes_an_environment(scene))
    return max(1, min(fits, MOST_ON_GPU if wp.get_device(device).is_cuda else MOST_ON_A_CORE * usable_cores()))
