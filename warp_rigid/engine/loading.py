"""Kernel modules: groups that are loaded together, and their compilation before a step is recorded."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from importlib import import_module
from typing import Any

from warp_rigid.engine.cores import usable_cores
from warp_rigid.kernel_cache import load_module
from warp_rigid.kernels.collide import bake, broadphase, candidates, ccd, narrowphase, overlap
from warp_rigid.kernels.common import capacity, team
from warp_rigid.kernels.constraints import build_contacts, records, rows
from warp_rigid.kernels.graph import coloring, islands, support
from warp_rigid.kernels.solve import (
    effectiveness,
    gauss_seidel,
    impact_rounds,
    line_search,
    push_out,
    push_rounds,
    restitution,
    rounds,
    shock,
)
from warp_rigid.kernels.update import ground_motion, health, integrate, predict, sleep, watch

TEAM_MODULES = (restitution, shock, gauss_seidel, support, coloring, line_search, push_out)
"""Modules whose kernels process an environment with a team; the slowest to compile come first."""

HEAPS = (rounds, push_rounds, impact_rounds)
"""Kernel modules for heaps, which exist in environments of many bodies only."""

STEP = (
    narrowphase,
    ccd,
    *TEAM_MODULES,
    integrate,
    health,
    predict,
    islands,
    effectiveness,
    broadphase,
    build_contacts,
    records,
    capacity,
    *rows.OTHER_KINDS,
)
"""Kernel modules that every step requires; the slowest to compile come first."""

GRIDS, OVERLAP, SLEEP, GROUND = (bake,), (overlap,), (sleep,), (ground_motion,)
CANDIDATES, WATCH = (candidates,), (watch,)
"""Kernel modules for distance grids, `deepest_overlap`, sleeping, moving ground, large environments and watches."""

JOINTS = "warp_rigid.kernels.joints.joint_stages"
"""Kernel module for joints, which process an environment with a team, too. It is imported only where there are joints,
as this takes a tenth as long as the import of the package."""


def everything() -> tuple[Any, ...]:
    """All kernel modules; the slowest to compile come first."""
    others = (*OVERLAP, *GRIDS, *STEP[2:], *HEAPS, *SLEEP, *GROUND, *CANDIDATES, *WATCH)
    return (import_module(JOINTS), *STEP[:2], *others)


def blocks_of_searches(search_block: int) -> dict[str, int]:
    """Lanes of the blocks of modules that search samples, by name; of the narrow phase they are `search_block`."""
    return {narrowphase.__name__: search_block, ccd.__name__: team.SMALL_BLOCK}


def load_kernels(
    device: Any,
    modules: Sequence[Any],
    lanes: Sequence[int] = (1,),
    search_blocks: Sequence[int] = (team.BLOCK, team.SMALL_BLOCK),
    on_module: Callable[[int, int], None] | None = None,
) -> None:
    """Compile kernels, or load them from Warp's cache, several modules in parallel, in the given order.

    Modules cannot be compiled during graph capture, so all kernels of a recorded step must be loaded before. Kernels
    that are seldom needed are loaded on demand.

    Args:
        device: the Warp device.
        modules: modules of `warp_rigid.kernels` to load.
        lanes: sizes of the teams that will process environments.
        search_blocks: lanes of the blocks that will search for contacts.
        on_module: called after each module with the number of loaded modules and the total.
    """

    def blocks_of(module: Any) -> list[int]:
        if not device.is_cuda:
            return [1]
        if module in TEAM_MODULES or module.__name__ == JOINTS:
            return sorted({team.block_of(size) for size in lanes})
        if module in HEAPS:
            return [team.BLOCK, team.SMALL_BLOCK]
        return sorted({blocks_of_searches(block).get(module.__name__, team.BLOCK) for block in search_blocks})

    jobs = [(module, block) for module in modules for block in blocks_of(module)]
    with ThreadPoolExecutor(usable_cores()) as pool:
        loaded = [pool.submit(load_module, device, module.__name__, block) for module, block in jobs]
        for ready, done in enumerate(as_completed(loaded), start=1):
            done.result()
            if on_module is not None:
                on_module(ready, len(jobs))
