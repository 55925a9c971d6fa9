"""Kernel modules: groups that are loaded together, and their compilation before a step is recorded."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from functools import cache
from importlib import import_module
from typing import Any

import warp as wp

from warp_rigid.engine.cores import usable_cores
from warp_rigid.kernel_cache import load_module
from warp_rigid.kernels.collide import bake, broadphase, candidates, ccd, narrowphase, overlap
from warp_rigid.kernels.common import capacity, team
from warp_rigid.kernels.constraints import build_contacts
from warp_rigid.kernels.graph import coloring, islands, support
from warp_rigid.kernels.solve import contact_solver, impact_rounds, push_out, push_rounds, rest, restitution, rounds
from warp_rigid.kernels.update import ground_motion, health, integrate, paths, predict, sleep, watch

TEAM_MODULES = (contact_solver, restitution, support, coloring, push_out)
"""Modules whose kernels process an environment with a team."""

NAMES_OF_TEAM_MODULES = [module.__name__ for module in TEAM_MODULES]
"""Names of the modules that are compiled separately for each size of a team."""

HEAPS = (rounds, push_rounds, impact_rounds, rest)
"""Kernel modules for rounds, which exist in environments of many bodies only."""

STEP = (narrowphase, ccd, *TEAM_MODULES, integrate, health, predict, islands, broadphase, build_contacts, capacity)
"""Kernel modules that every step requires."""

GRIDS, OVERLAP, SLEEP, GROUND = (bake,), (overlap,), (sleep,), (ground_motion,)
CANDIDATES, WATCH, PATHS = (candidates,), (watch,), (paths,)
"""Kernel modules for distance grids, `deepest_overlap`, sleeping, moving ground or surfaces, large environments,
watches and paths."""

JOINTS = "warp_rigid.kernels.joints.joint_stages"
"""Kernel module for joints, which process an environment with a team, too. It is imported only where there are joints,
as this takes a tenth as long as the import of the package."""


DIVIDED = (narrowphase.__name__, ccd.__name__, JOINTS)
"""Modules whose kernels are compiled one by one for a GPU, so that many cores share the work: nearly all of it is the
optimization of functions that are inlined into each kernel. On a CPU, kernels of a module call the same functions, and
are compiled together."""

SLOWEST = (
    "sweep_with_joints",
    "move_untouched",
    "solve_impacts_with_joints",
    "contact_solver",
    "touch_near_samples",
    "settle_joints",
    "advance_solids",
    "choose_contacts",
    "trace_suspects",
)
"""Parts of the names of the Warp modules that take longest to compile for a GPU; they are compiled first.

Python generates the code of one module after another, 4 s for those of a step. The slowest compilation takes 10 s, and
27 s with joints.
"""


def everything() -> tuple[Any, ...]:
    """All kernel modules."""
    return (import_module(JOINTS), *STEP, *HEAPS, *OVERLAP, *GRIDS, *SLEEP, *GROUND, *CANDIDATES, *WATCH, *PATHS)


def block_of(name: str, lanes: int) -> int:
    """Lanes of a CUDA block of a module, if a team that processes an environment has the given number of lanes.

    Lanes that search samples take very different times, and a block ends with its slowest one.
    """
    if name in (*NAMES_OF_TEAM_MODULES, JOINTS):
        return team.block_of(lanes)
    return team.SMALL_BLOCK if name in (narrowphase.__name__, ccd.__name__) else team.BLOCK


@cache
def _copy(kernel: Any, name: str, blocks: int) -> Any:
    """A kernel in another Warp module. If teams execute it, each is a cluster of the given number of blocks."""
    module = wp.get_module(name)
    module.options.update(kernel.module.options)
    clustered = blocks > 1 and "lanes" in kernel.arg_indices
    options = kernel.options | {"cluster_dim": blocks} if clustered else kernel.options
    return wp.Kernel(kernel.func, kernel.key, module, options)


def kernel_for(kernel: Any, device: Any, lanes: int = 1) -> Any:
    """The kernel as it is compiled for a device: in its module, alone, or for teams that are clusters of blocks.

    Args:
        kernel: the kernel.
        device: the Warp device.
        lanes: lanes of a team that processes an environment.
    """
    name = kernel.module.name
    if device.is_cuda and name in DIVIDED:
        return _copy(kernel, f"{name}.{kernel.key}", 1)
    if device.is_cuda and name in NAMES_OF_TEAM_MODULES and lanes > team.BLOCK:
        return _copy(kernel, f"{name}.clusters", team.BLOCKS_OF_A_CLUSTER)
    return kernel


def units_of(module: Any, device: Any, lanes: int = 1) -> list[str]:
    """Names of the Warp modules that hold the kernels of a module (`kernel_for`)."""
    kernels = wp.get_module(module.__name__).kernels.values()
    return list(dict.fromkeys(kernel_for(kernel, device, lanes).module.name for kernel in kernels))


def load_kernels(
    device: Any,
    modules: Sequence[Any],
    lanes: Sequence[int] = (1,),
    on_module: Callable[[int, int], None] | None = None,
) -> None:
    """Compile kernels, or load them from Warp's cache, several modules in parallel, the slowest ones first.

    Modules cannot be compiled during graph capture, so all kernels of a recorded step must be loaded before. Kernels
    that are seldom needed are loaded on demand.

    Args:
        device: the Warp device.
        modules: modules of `warp_rigid.kernels` to load.
        lanes: sizes of the teams that will process environments.
        on_module: called after each module with the number of loaded modules and the total.
    """

    def blocks_of(module: Any, size: int) -> list[int]:
        if not device.is_cuda:
            return [1]
        if module in HEAPS:
            return [team.BLOCK, team.SMALL_BLOCK]
        return [block_of(module.__name__, size)]

    jobs = dict.fromkeys(
        (name, block)
        for module in modules
        for size in lanes
        for name in units_of(module, device, size)
        for block in blocks_of(module, size)
    )
    with ThreadPoolExecutor(usable_cores()) as pool:
        ordered = sorted(jobs, key=lambda job: [f"{slow}." not in f"{job[0]}." for slow in SLOWEST])
        loaded = [pool.submit(load_module, device, name, block) for name, block in ordered]
        for ready, done in enumerate(as_completed(loaded), start=1):
            done.result()
            if on_module is not None:
                on_module(ready, len(jobs))
