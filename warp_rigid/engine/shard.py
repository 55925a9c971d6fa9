"""Shards: ranges of environments that are stepped independently, in parallel on the cores of a CPU.

A shard has its own pools, recorded step and saved copies for undoing steps. Its state and parameters are slices of the
arrays of all environments. Kernels index bodies and environments within their shard. The result of an environment does
not depend on the other environments, to the bit, so it does not depend on the division into shards.
"""

import time
from typing import Any

import numpy as np
import warp as wp

from warp_rigid.engine import health_checks
from warp_rigid.engine.loading import OVERLAP, load_kernels
from warp_rigid.engine.model import Arrays
from warp_rigid.engine.pools import Demand, Pools
from warp_rigid.engine.step import Stages, StepOptions
from warp_rigid.kernels import declare
from warp_rigid.kernels.declare import Lifetime
from warp_rigid.threads import exclusive


class Shard:
    """Environments that are stepped together.

    Args:
        first: the first environment.
        end: one past the last.
        sizes: sizes of its pools.
        arrays: of all environments.
        workers: threads that execute its steps on a CPU, where it has many bodies.

    Attributes:
        first: as given.
        end: as given.
        num_envs: number of its environments.
        layout: its environments.
        first_body: row of its first body in the arrays of all environments.
        end_body: one past the row of its last body.
        pools: pairs, contacts and graph.
        demand: what the last steps required of the pools.
        watches: what its steps record for observers, None for nothing.
        seconds: duration of the last `advance` [s].
    """

    watches: Any = None
    seconds = 0.0
    _stages: Stages | None = None
    _options: StepOptions | None = None

    def __init__(self, first: int, end: int, sizes: dict[str, int], arrays: Arrays, workers: int) -> None:
        """Allocate the arrays; `choose` must be called next."""
        self.first, self.end = first, end
        self.num_envs, self._workers = end - first, workers
        self.first_body, self.end_body = arrays.model.layout.ranges(first, end)["bodies"]
        self._arrays = arrays.part(first, end)
        self.layout = self._arrays.model.layout
        self._device: Any = arrays.envs.step.device
        self._saved_in: int | None = None
        self.pools = Pools.allocate(self.layout, sizes, self._device)
        self.demand = Demand()
        self.note_masses()

    def note_masses(self) -> None:
        """Read the masses of the bodies; to be called when they have been changed."""
        self._overload = health_checks.may_be_overloaded(self._arrays.model)

    @property
    def stages(self) -> Stages:
        """The recorded step. It is recorded when it is first needed, so that several changes cost one recording.

        Only one shard at a time can record, while no other one is stepping. If that fails, the shard is unchanged.
        """
        if self._stages is None:
            self._record(self.pools)
        assert self._stages is not None
        return self._stages

    def choose(self, options: StepOptions) -> None:
        """Choose what the step consists of."""
        if self._options != options:
            self._options, self._stages = options, None

    @property
    def sleeping(self) -> bool:
        """Whether the step includes sleeping."""
        assert self._options is not None
        return self._options.sleeping

    @exclusive()
    def _record(self, pools: Pools) -> None:
        assert self._options is not None
        stages = Stages(self._arrays, pools, self._options, self.watches, self._workers)
        kept = self._kept_arrays(pools)
        with wp.ScopedCapture(self._device, force_module_load=False) as capture:
            for array, saved in kept:
                wp.copy(saved, array)
            pools.begin()
        with wp.ScopedCapture(self._device, force_module_load=False) as checking:
            health_checks.check(stages)
        with wp.ScopedCapture(self._device, force_module_load=False) as loads:
            health_checks.check_loads(stages)
        with wp.ScopedCapture(self._device, force_module_load=False) as candidates:
            stages.grid.note_use()
        self.pools, self._stages, self._kept, self._keeping = pools, stages, kept, capture.graph
        self._checking, self._checking_loads, self._noting = checking.graph, loads.graph, candidates.graph
        self._measuring: Any = None

    def watch(self, watches: Any) -> None:
        """Record watches of all environments, an instance of schema.Watches, from now on."""
        self.watches = declare.part(watches, {"envs": (self.first, self.end)})
        self._stages = None

    def advance(self, steps: int, done: int, attempt: int) -> None:
        """Execute steps that can be undone, at most CHUNK of them; `done` were executed before.

        The step must have been recorded, as this may run beside other shards.
        """
        begin = time.perf_counter()
        self.save(attempt)
        for step in range(done + 1, done + steps + 1):
            self.stages.replay()
            if step % health_checks.EVERY == 0:
                wp.capture_launch(self._checking)
            elif self._overload:
                wp.capture_launch(self._checking_loads)
        wp.capture_launch(self._noting)
        self.seconds = time.perf_counter() - begin

    def save(self, attempt: int) -> None:
        """Save what a step changes, with the number of the attempt, and reset the required sizes of the pools."""
        self._saved_in = None
        wp.capture_launch(self._keeping)
        self._saved_in = attempt

    def undo(self, attempt: int) -> None:
        """Undo the steps since `save`, if it was called in this attempt and they have not been undone already."""
        if self._saved_in == attempt:
            for array, saved in self._kept:
                wp.copy(array, saved)
            self.pools.forget_graph()
            self._saved_in = None

    def grow(self, sizes: dict[str, int]) -> None:
        """Enlarge the pools and record the step again."""
        self._record(self.pools.grown(sizes))

    def record_measuring(self) -> None:
        """Record the kernels of `deepest_overlap`, unless recorded already; one shard at a time, as for the step."""
        stages = self.stages
        if self._measuring is not None:
            return
        with exclusive():
            load_kernels(self._device, OVERLAP)
            self._deepest = wp.zeros((self.num_envs, 1), dtype=float, device=self._device)
            with wp.ScopedCapture(self._device, force_module_load=False) as capture:
                self.pools.begin()
                stages.deepest_overlap(self._deepest)
            self._measuring = capture.graph

    def deepest_overlap(self) -> np.ndarray:
        """Deepest overlap in each of its environments, (envs,) [m]; see Simulator.penetration."""
        wp.capture_launch(self._measuring)
        return self._deepest.numpy()[:, 0]

    def _kept_arrays(self, pools: Pools) -> list[tuple[wp.array, wp.array]]:
        """What a step leaves to the next one or to users, with the copies that undo it."""
        model, state, sleep_state, envs = self._arrays
        lasting = [state, envs, pools.history, pools.graph, model.joints]
        lasting += [sleep_state] if self.sleeping else []
        lasting += [] if self.watches is None else [self.watches]
        arrays = [array for some in lasting for _, _, array in declare.arrays_of(some, Lifetime.REMEMBERED)]
        return [(array, wp.clone(array)) for array in arrays]
