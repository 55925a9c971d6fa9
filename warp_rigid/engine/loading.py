"""Modules of kernels: which are needed when, and compiling them before a step is recorded."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from typing import Any

import warp as wp

from warp_rigid.engine.cores import usable_cores
from warp_rigid.kernels.collide import bake, broadphase, ccd, narrowphase, overlap
from warp_rigid.kernels.common import capacity, team
from warp_rigid.kernels.constraints import build_contacts, records, rows
from warp_rigid.kernels.graph import coloring, support
from warp_rigid.kernels.solve import gauss_seidel, line_search, push_out, restitution, shock
from warp_rigid.kernels.update import ground_motion, integrate, predict, sleep

TEAM_MODULES = (restitution, shock, gauss_seidel, support, coloring, line_search, push_out)
"""Their kernels solve an environment by a team; those that take longest to compile first."""

STEP = (
    narrowphase,
    ccd,
    *TEAM_MODULES,
    integrate,
    predict,
    broadphase,
    build_contacts,
    records,
    capacity,
    *rows.OTHER_KINDS,
)
"""Modules of kernels that every step needs, those that take longest to compile first."""

GRIDS, OVERLAP, SLEEP, GROUND = (bake,), (overlap,), (sleep,), (ground_motion,)
"""Those of distance grids, of `deepest_overlap`, of bodies that may sleep, and of ground that moves."""

EVERYTHING = (narrowphase, ccd, *OVERLAP, *GRIDS, *STEP[2:], *SLEEP, *GROUND)


def load_kernels(
    device: Any,
    modules: Sequence[Any],
    lanes: Sequence[int] = (1,),
    on_module: Callable[[int, int], None] | None = None,
) -> None:
    """Compile kernels, or load them from Warp's cache, several modules at a time, in their order.

    A graph cannot contain a compilation, so everything that is recorded must have been loaded. Kernels that are seldom
    needed are loaded when they are needed.

    Args:
        device: the Warp device.
        modules: those of `warp_rigid.kernels` that are needed.
        lanes: sizes of the teams that will solve environments.
        on_module: called with the number of modules that are ready and the number of all, whenever one more is.
    """
    teams = sorted({team.block_of(size) for size in lanes}) if device.is_cuda else [1]
    others = [team.BLOCK if device.is_cuda else 1]
    jobs = [(module, block) for module in modules for block in (teams if module in TEAM_MODULES else others)]
    with ThreadPoolExecutor(usable_cores()) as pool:
        loaded = [pool.submit(wp.force_load, device, [wp.get_module(module.__name__)], block) for module, block in jobs]
        for ready, done in enumerate(as_completed(loaded), start=1):
            done.result()
            if on_module is not None:
                on_module(ready, len(jobs))
