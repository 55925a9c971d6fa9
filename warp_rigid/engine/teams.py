"""Team sizes: the number of device lanes that process one environment, or one pair of bodies."""

from typing import Any, NamedTuple

from warp_rigid.kernels.common import team

WARP = 32

MOST_BODIES_OF_A_WARP = 128
"""Above this number of bodies, an environment is processed by whole blocks."""

SEARCH_LANES, BUILD_LANES, TRACE_LANES = 32, 4, 32
"""GPU lanes that search for the contacts of one pair, that build its rows, and that trace it."""

RESIDENT_LANES, RESIDENT_WARPS = 2048, 16
"""Resident lanes of a multiprocessor, and resident warps of the solver's kernels, which use many registers."""


class Teams(NamedTuple):
    """Lanes that process one environment: in the graph stages, and in the solver stages."""

    graph: int
    color: int


BODIES_OF_A_BLOCK = Teams(graph=64, color=256)
"""Bodies that occupy the lanes of a block. With more blocks, barriers take longer."""


def team_sizes(device: Any, num_envs: int, most_bodies: int) -> Teams:
    """Number of lanes that process one environment.

    It is one warp for each environment if all of them can be resident on the GPU at once. Otherwise teams are smaller
    and share a warp, which slows each of them slightly; they are not made smaller than a small environment can use.
    Large environments get one block, or several blocks if these are useful and each has its own multiprocessor.

    Args:
        device: the Warp device.
        num_envs: number of environments.
        most_bodies: number of bodies of the largest environment.
    """
    if not device.is_cuda:
        return Teams(1, 1)
    if most_bodies > MOST_BODIES_OF_A_WARP:
        return Teams(*(_blocks(device, num_envs, most_bodies, share) * team.BLOCK for share in BODIES_OF_A_BLOCK))
    lanes = WARP
    resident = device.sm_count * RESIDENT_WARPS * WARP
    while lanes > 8 and num_envs * lanes > resident and most_bodies < 2 * lanes:
        lanes //= 2
    return Teams(lanes, lanes)


def most_lanes(device: Any) -> int:
    """Number of lanes that can be resident on a GPU at the same time."""
    return device.sm_count * RESIDENT_LANES


def _blocks(device: Any, num_envs: int, most_bodies: int, share: int) -> int:
    """Number of blocks for an environment, with `share` bodies for each block."""
    blocks = 1
    while 2 * blocks * num_envs <= device.sm_count and most_bodies > blocks * share:
        blocks *= 2
    return blocks
