"""Team sizes: the number of device lanes that process one environment, or one pair of bodies."""

from typing import Any

from warp_rigid.kernels.common import team

WARP = 32

MOST_BODIES_OF_A_WARP = 128
"""Above this number of bodies, an environment is processed by a block."""

BUILD_LANES, TRACE_LANES, ROUND_LANES = 4, 32, 4
"""GPU lanes that build the rows of one pair, that trace it, and that visit it in a round."""

FEW_SAMPLES = 128
"""Up to this number of samples of the largest shape, few lanes search for the contacts of a pair: of a box, five
samples are near another box."""

RESIDENT_LANES, RESIDENT_WARPS = 2048, 16
"""Resident lanes of a multiprocessor, and resident warps of the solver's kernels, which use many registers."""


def team_lanes(device: Any, num_envs: int, most_bodies: int) -> int:
    """Number of lanes that process one environment.

    It is one warp for each environment if all of them can be resident on the GPU at once. Otherwise teams are smaller
    and share a warp, which slows each of them slightly; they are not made smaller than a small environment can use.
    Large environments get one block.

    Args:
        device: the Warp device.
        num_envs: number of environments.
        most_bodies: number of bodies of the largest environment.
    """
    if not device.is_cuda:
        return 1
    if most_bodies > MOST_BODIES_OF_A_WARP:
        return team.BLOCK
    lanes = WARP
    resident = device.sm_count * RESIDENT_WARPS * WARP
    while lanes > 8 and num_envs * lanes > resident and most_bodies < 2 * lanes:
        lanes //= 2
    return lanes


def most_lanes(device: Any) -> int:
    """Number of lanes that can be resident on a GPU at the same time."""
    return device.sm_count * RESIDENT_LANES


def search_lanes(most_samples: int) -> int:
    """Number of lanes that search for the contacts of a pair.

    Args:
        most_samples: number of samples of the shape that has most.
    """
    return 4 if most_samples <= FEW_SAMPLES else WARP
