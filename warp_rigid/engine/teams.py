"""Team sizes: the number of device lanes that process one environment, or one pair of bodies."""

from typing import Any

from warp_rigid.kernels.common import team

WARP = 32

MOST_BODIES_OF_A_WARP, MOST_BODIES_OF_A_BLOCK = 128, 512
"""Above these numbers of bodies, an environment is processed by a block and by a cluster of blocks."""

FIRST_WITH_CLUSTERS = 90
"""Compute capability, times ten, of the first GPUs with clusters of blocks."""

BUILD_LANES, TRACE_LANES, LOOK_LANES, MEASURING_LANES = 4, 32, 8, 32
"""GPU lanes that build the rows of a pair, trace clusters of a body, test samples, and measure an overlap."""

ADVANCE_LANES, ADVANCE_LANES_IN_CROWDS = 8, 32
"""GPU lanes that advance two convex solids, each in its part of the step; more in environments with heaps, where the
slowest pair decides."""

RESIDENT_LANES, RESIDENT_WARPS = 2048, 16
"""Resident lanes of a multiprocessor, and resident warps of the solver's kernels, which use many registers."""


def team_lanes(device: Any, num_envs: int, most_bodies: int, has_joints: bool) -> int:
    """Number of lanes that process one environment.

    It is one warp for each environment if all of them can be resident on the GPU at once. Otherwise teams are smaller
    and share a warp, which slows each of them slightly; they are not made smaller than a small environment can use.
    Large environments get one block, or one cluster if all clusters can be resident and there are no joints.

    Args:
        device: the Warp device.
        num_envs: number of environments.
        most_bodies: number of bodies of the largest environment.
        has_joints: whether a scene has joints; their kernels are not compiled for clusters.
    """
    if not device.is_cuda:
        return 1
    if most_bodies > MOST_BODIES_OF_A_WARP:
        fits = num_envs * team.BLOCKS_OF_A_CLUSTER <= device.sm_count and device.arch >= FIRST_WITH_CLUSTERS
        return team.CLUSTER if fits and not has_joints and most_bodies > MOST_BODIES_OF_A_BLOCK else team.BLOCK
    lanes = WARP
    resident = device.sm_count * RESIDENT_WARPS * WARP
    while lanes > 8 and num_envs * lanes > resident and most_bodies < 2 * lanes:
        lanes //= 2
    return lanes


def sizes_of_teams(device: Any) -> tuple[int, ...]:
    """The sizes of teams for which kernels are compiled separately on a device, in lanes."""
    sizes = (WARP, team.BLOCK)
    return (*sizes, team.CLUSTER) if device.is_cuda and device.arch >= FIRST_WITH_CLUSTERS else sizes


def most_lanes(device: Any) -> int:
    """Number of lanes that can be resident on a GPU at the same time."""
    return device.sm_count * RESIDENT_LANES


def search_lanes(many_samples: bool, crowded: bool) -> tuple[int, int]:
    """Lanes that list the near samples of a pair, and lanes that choose its contacts.

    Of the samples of a box, five are near another box, and two or three touch it, so a few lanes are enough. The pairs
    of a batch occupy all lanes of a GPU. Those of a single large environment do not, and its slowest pair decides.

    Args:
        many_samples: whether a shape has hundreds of samples.
        crowded: whether an environment has many bodies.
    """
    if many_samples:
        return WARP, 16
    return 4, 4 if crowded else 1
