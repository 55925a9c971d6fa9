"""Kernel modules: groups that are loaded together, and their compilation before a step is recorded."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from typing import Any

import warp as wp

from warp_rigid.engine.cores import usable_cores
from warp_rigid.kernels.collide import bake, broadphase, ccd, narrowphase, overlap
from warp_rigid.kernels.common import capacity, team
from warp_rigid.kernels.constraints import build_contacts, records, rows
from warp_rigid.kernels.graph import coloring, support
from warp_rigid.kernels.joints import joint_stages
from warp_rigid.kernels.solve import gauss_seidel, line_search, push_out, restitution, shock
from warp_rigid.kernels.update import ground_motion, integrate, predict, sleep

TEAM_MODULES = (restitution, shock, gauss_seidel, support, coloring, line_search, push_out)
"""Modules whose kernels process an environment with a team; the slowest to compile come first."""

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
"""Kernel modules that every step requires; the slowest to compile come first."""

GRIDS, OVERLAP, SLEEP, GROUND, JOINT = (bake,), (overlap,), (sleep,), (ground_motion,), (joint_stages,)
"""Kernel modules for distance grids, `deepest_overlap`, sleeping, moving ground and joints."""

EVERYTHING = (narrowphase, ccd, *OVERLAP, *GRIDS, *STEP[2:], *SLEEP, *GROUND, *JOINT)


def load_kernels(
    device: Any,
    modules: Sequence[Any],
    lanes: Sequence[int] = (1,),
    on_module: Callable[[int, int], None] | None = None,
) -> None:
    """Compile kernels, or load them from Warp's cache, several modules in parallel, in the given order.

    Modules cannot be compiled during graph capture, so all kernels of a recorded step must be loaded before. Kernels
    that are seldom needed are loaded on demand.

    Args:
        device: the Warp device.
        modules: modules of `warp_rigid.kernels` to load.
        lanes: sizes of the teams that will process environments.
        on_module: called after each module with the number of loaded modules and the total.
    """
    teams = sorted({team.block_of(size) for size in lanes}) if device.is_cuda else [1]
    others = [team.BLOCK if device.is_cuda else 1]
    jobs = [(module, block) for module in modules for block in (teams if module in (*TEAM_MODULES, *JOINT) else others)]
    with ThreadPoolExecutor(usable_cores()) as pool:
        loaded = [pool.submit(wp.force_load, device, [wp.get_module(module.__name__)], block) for module, block in jobs]
        for ready, done in enumerate(as_completed(loaded), start=1):
            done.result()
            if on_module is not None:
                on_module(ready, len(jobs))
