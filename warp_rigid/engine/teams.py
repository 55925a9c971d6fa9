"""How many lanes of a device work on one environment, and on one pair of bodies."""

from typing import Any, NamedTuple

from warp_rigid.kernels.common import team

WARP = 32

MOST_BODIES_OF_A_WARP = 128
"""Beyond so many bodies an environment, a whole block solves it."""

SEARCH_LANES, BUILD_LANES = 32, 4
"""Lanes of a GPU that search the contacts of one pair together, and that make its rows."""

RESIDENT_LANES, RESIDENT_WARPS = 2048, 16
"""Lanes that a multiprocessor can hold at a time, and warps of the solver's kernels, which need many registers."""


class Teams(NamedTuple):
    """Lanes that do one environment together: in the graph's stages, and in one colour."""

    graph: int
    color: int


BODIES_OF_A_BLOCK = Teams(graph=64, color=256)
"""So many bodies give the lanes of a block something to do. More blocks wait longer for each other."""


def team_sizes(device: Any, num_envs: int, most_bodies: int) -> Teams:
    """How many lanes do one environment together.

    A warp each, as long as all fit on the GPU at once; then smaller teams, which share a warp and slow each other down
    a little, and no smaller than a small environment can use. Large environments get a block, or as many blocks as
    they have use for while every block has a multiprocessor of its own.

    Args:
        device: the Warp device, whose multiprocessors count.
        num_envs: environments.
        most_bodies: bodies of the largest of them.
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
    """Lanes that can be resident on a GPU at the same time."""
    return device.sm_count * RESIDENT_LANES


def _blocks(device: Any, num_envs: int, most_bodies: int, share: int) -> int:
    """Blocks for an environment if each has enough to do with so many bodies."""
    blocks = 1
    while 2 * blocks * num_envs <= device.sm_count and most_bodies > blocks * share:
        blocks *= 2
    return blocks
