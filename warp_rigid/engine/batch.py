"""All environments of a simulator as shards: stepped and undone together, with growing or fixed capacity."""

import logging
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np

from warp_rigid.engine.cores import spread, usable_cores
from warp_rigid.engine.hash_grid import grid_sizes
from warp_rigid.engine.layout import Layout, exclusive_sums
from warp_rigid.engine.memory import MemoryLimit, pool_bytes
from warp_rigid.engine.model import Arrays
from warp_rigid.engine.pools import CHUNK, LARGEST, NAMES, POOLS, sizes_for
from warp_rigid.engine.shard import Shard
from warp_rigid.engine.step import StepOptions
from warp_rigid.errors import CapacityError

log = logging.getLogger("warp_rigid")

LEAST_BODIES = 16
"""Minimum number of dynamic bodies for a shard: starting a thread takes as long as a step of about three bodies."""

SHARDS_A_CORE = 2
"""Shards per core; more than one, so that a core that finishes early can take over shards of another core."""


class Range(NamedTuple):
    """Environments of a shard, and the initial sizes of its pools."""

    first: int
    end: int
    sizes: dict[str, int]


class Tally(NamedTuple):
    """Sizes that steps required of the pools.

    Attributes:
        rows: (shards, steps, 4) sizes that each step required of the pools.
        most: (2,) largest number of pairs and contacts that a step required, over all shards together.
        short: shards whose capacity was exceeded, with the required sizes of the pools that were too small.
        over: the pool whose maximum capacity was exceeded, if there is one.
        wanted: the required size of that pool.
        fitted: number of steps before the one that exceeded it.
    """

    rows: np.ndarray
    most: np.ndarray
    short: list[tuple[Shard, dict[str, int]]]
    over: str | None = None
    wanted: int = 0
    fitted: int = 0


def plan(layout: Layout, capacity: dict[str, int], device: Any) -> list[Range]:
    """Ranges of environments with about equally many dynamic bodies, and their capacity; one range on a GPU."""
    cores = 1 if device.is_cuda else usable_cores()
    weight = exclusive_sums(np.maximum(layout.dynamic_per_env, 1))
    worth = int(layout.dynamic_per_env.sum()) // LEAST_BODIES
    count = 1 if cores == 1 else max(1, min(cores * SHARDS_A_CORE, worth, layout.num_envs))
    total = int(weight[-1])
    ends = [int(np.searchsorted(weight, total * k // count, side="right")) - 1 for k in range(1, count)]
    bounds = sorted({0, *ends, layout.num_envs})

    def sizes(first: int, end: int) -> dict[str, int]:
        low, high = int(weight[first]), int(weight[end])
        part = {name: max(1, all_ * high // total - all_ * low // total) for name, all_ in capacity.items()}
        own = {symbol: last - begin for symbol, (begin, last) in layout.ranges(first, end).items()}
        own |= grid_sizes(layout.bodies_per_env[first:end])
        return sizes_for(part["pairs"], part["contacts"], own)

    return [Range(first, end, sizes(first, end)) for first, end in zip(bounds, bounds[1:], strict=False)]


class Shards:
    """The shards of a simulator.

    Args:
        ranges: as from `plan`.
        arrays: the scenes and their state.
        capacity: fixed capacity for "pairs" and "contacts" of all shards together; None if pools grow.
        limit: memory limit of the simulator.
        other_bytes: bytes that the simulator uses besides the pools.

    Attributes:
        steps: number of completed steps.
        capacity: as given.
        most_wanted: (2,) largest number of pairs and contacts that a step has required.
        repeated: number of steps that were simulated again because a pool was too small.
    """

    def __init__(
        self, ranges: list[Range], arrays: Arrays, capacity: dict[str, int] | None, limit: MemoryLimit, other_bytes: int
    ) -> None:
        """Create the shards; `choose` must be called next."""
        self._threads, self._attempt = usable_cores(), 0
        workers = self._threads if len(ranges) == 1 else 1
        self._shards = [Shard(*some, arrays, workers) for some in ranges]
        self._envs, self._limit, self._other_bytes = arrays.envs, limit, other_bytes
        self._growth_reported, self._growing_ahead = False, True
        self.steps, self.capacity, self.most_wanted, self.repeated = 0, capacity, np.zeros(2, np.int64), 0

    def __iter__(self) -> Iterator[Shard]:
        """Iterate over the shards in the order of their environments."""
        return iter(self._shards)

    def of(self, chosen: np.ndarray) -> Iterator[tuple[Shard, np.ndarray]]:
        """Shards that contain some of the chosen environments, and the indices of these within each shard."""
        for shard in self._shards:
            own = chosen[(chosen >= shard.first) & (chosen < shard.end)]
            if len(own):
                yield shard, own - shard.first

    def gather(self, read: Callable[[Shard], np.ndarray]) -> np.ndarray:
        """Rows of all environments, concatenated from those of the shards."""
        return np.concatenate([read(shard) for shard in self._shards])

    def of_graph(self, name: str) -> np.ndarray:
        """An array of the contact graph of the last step."""
        return self.gather(lambda shard: getattr(shard.pools.graph, name).numpy())

    def first_bodies(self) -> np.ndarray:
        """For each body the first one of its shard, (bodies,)."""
        counts = [shard.end_body - shard.first_body for shard in self._shards]
        return np.repeat([shard.first_body for shard in self._shards], counts)

    def sizes(self) -> dict[str, int]:
        """Capacity for pairs and contacts of all environments together."""
        return self.capacity or {name: sum(shard.pools.sizes[name] for shard in self._shards) for name in NAMES}

    @property
    def memory(self) -> int:
        """Bytes that the simulator uses on its device."""
        return self._other_bytes + sum(pool_bytes(shard.pools.sizes) for shard in self._shards)

    @property
    def sleeping(self) -> bool:
        """Whether the recorded step includes sleeping."""
        return self._shards[0].sleeping

    def choose(self, options: StepOptions) -> None:
        """Choose what the step consists of."""
        for shard in self._shards:
            shard.choose(options)

    @property
    def most_steps(self) -> int:
        """Steps to execute until the next capacity check: one until the requirements of a step are known."""
        return CHUNK if all(shard.demand.known for shard in self._shards) else 1

    def record(self) -> None:
        """Record the step where this is needed, one shard after another."""
        for shard in self._shards:
            _ = shard.stages

    def step(self, count: int) -> None:
        """Execute at most CHUNK steps in all environments.

        Raises:
            CapacityError: the capacity is exceeded and cannot grow; all environments are at the last valid step.
        """
        self._grow_ahead()
        try:
            self._confirm(self._advance(count), count)
        except BaseException:
            self._undo()
            raise

    def deepest_overlap(self) -> np.ndarray:
        """Deepest overlap in each environment, (envs,) [m]; see Simulator.penetration.

        Raises:
            CapacityError: the capacity is exceeded and cannot grow.
        """
        while True:
            for shard in self._shards:
                shard.record_measuring()
            deepest = spread(Shard.deepest_overlap, self._shards, self._threads)
            tally = self._count(1)
            if tally.over:
                raise self._overflow(tally)
            if not tally.short:
                self.most_wanted = np.maximum(self.most_wanted, tally.most)
                return np.concatenate(deepest)
            self._grow(tally.short)

    def ensure_capacity(self, shard: Shard, wanted: dict[str, int]) -> None:
        """Enlarge the pools of a shard that are smaller than the required sizes."""
        short = {name: n for name, n in wanted.items() if n > shard.pools.sizes[name]}
        if short:
            self._grow([(shard, short)])

    def _advance(self, count: int) -> Tally:
        """Execute steps that can be undone, and repeat them in shards where a pool was too small."""
        left = self._shards
        while True:
            self._try(left, count)
            tally = self._count(count)
            if tally.over:
                self._go_to_overflow(tally)
                raise self._overflow(tally)
            if not tally.short:
                return tally
            self._grow(tally.short, f"; {count} step{'s' * (count > 1)} repeated")
            self.repeated += count
            left = [shard for shard, _ in tally.short]

    def _try(self, shards: list[Shard], count: int) -> None:
        """Step the shards, starting with those that were slowest last time, to balance the load of the cores."""
        self.record()
        slowest_first = sorted(shards, key=lambda shard: -shard.seconds)
        spread(lambda shard: shard.advance(count, self.steps, self._attempt), slowest_first, self._threads)

    def _go_to_overflow(self, tally: Tally) -> None:
        """Undo the attempt, repeat the valid steps, and execute the overflowing step, which can be undone."""
        self._undo()
        if tally.fitted:
            self._try(self._shards, tally.fitted)
            self._confirm(tally, tally.fitted)
        self._try(self._shards, 1)

    def _confirm(self, tally: Tally, count: int) -> None:
        """Accept the last steps; this attempt can no longer be undone."""
        for shard, rows in zip(self._shards, tally.rows, strict=True):
            shard.demand.note(rows[:count])
        self._attempt += 1
        self.steps += count
        self.most_wanted = np.maximum(self.most_wanted, tally.most)

    def _undo(self) -> None:
        for shard in self._shards:
            shard.undo(self._attempt)

    def _count(self, steps: int) -> Tally:
        """Sizes that the last steps required, compared with the capacity."""
        wanted = np.array([shard.pools.wanted.numpy()[:steps] for shard in self._shards], np.int64)
        too_much = wanted > np.array([[[shard.pools.sizes[name] for name in POOLS]] for shard in self._shards])
        void, short = steps, []
        if too_much.any():
            void, short = self._shortage(wanted, too_much)
        known = wanted[:, : void + 1, : len(NAMES)].sum(axis=0)
        if void < steps and too_much[:, void, [0, 3]].any():
            known[void, 1] = 0
        if void < steps and too_much[:, void, 2].any():
            known[void] = 0
        over = np.argwhere(known > [self.capacity[name] if self.capacity else LARGEST for name in NAMES])
        if len(over) == 0:
            return Tally(wanted, known.max(axis=0), short)
        step, pool = (int(k) for k in over[0])
        most = known[:step].max(axis=0, initial=0)
        return Tally(wanted, most, short, NAMES[pool], int(known[step, pool]), step)

    def _shortage(self, wanted: np.ndarray, too_much: np.ndarray) -> tuple[int, list[tuple[Shard, dict[str, int]]]]:
        """The first step invalid in any shard, and the sizes required by each shard in its first invalid step.

        A step in which a pool was too small is invalid, as are all later steps. Its number of pairs is still known,
        unless the candidates were too many, and its number of contacts, unless the pairs or near samples were.
        """
        short = []
        void = too_much.shape[1]
        for shard, rows, much in zip(self._shards, wanted, too_much, strict=True):
            if much.any():
                first = int(much.any(axis=1).argmax())
                void = min(void, first)
                short.append((shard, {POOLS[k]: int(rows[first, k]) for k in np.flatnonzero(much[first])}))
        return void, short

    def _grow_ahead(self) -> None:
        """Enlarge pools that the next steps may exceed, unless memory is short; a fixed capacity stays."""
        if not self._growing_ahead:
            return
        fixed = dict.fromkeys(NAMES, LARGEST) if self.capacity else {}
        larger = []
        for shard in self._shards:
            short = shard.demand.missing({**shard.pools.sizes, **fixed})
            if short:
                larger.append((shard, shard.pools.larger_sizes(short)))
        if larger:
            try:
                growth = self._check_growth(larger)
            except CapacityError:
                self._growing_ahead = False
                return
            log.debug("capacity grows ahead of need: %s", growth)
            for shard, sizes in larger:
                shard.grow(sizes)

    def _grow(self, short: list[tuple[Shard, dict[str, int]]], what: str = "") -> None:
        """Enlarge pools that were too small; their shards' steps are undone."""
        larger = [(shard, shard.pools.larger_sizes(wanted)) for shard, wanted in short]
        growth = self._check_growth(larger)
        level = logging.DEBUG if self._growth_reported or self.capacity else logging.INFO
        log.log(level, "capacity grows: %s%s", growth, what)
        self._growth_reported = True
        for shard, sizes in larger:
            shard.undo(self._attempt)
            shard.grow(sizes)

    def _check_growth(self, larger: list[tuple[Shard, dict[str, int]]]) -> str:
        """Describe the growth of the pools of all shards together.

        Raises:
            CapacityError: the larger pools do not fit into memory.
        """
        now = {name: sum(shard.pools.sizes[name] for shard in self._shards) for name in POOLS}
        more = {name: sum(sizes[name] - shard.pools.sizes[name] for shard, sizes in larger) for name in POOLS}
        growth = ", ".join(f"{name} {now[name]} -> {now[name] + more[name]}" for name in POOLS if more[name])
        self._limit.check(self.memory, sum(pool_bytes(sizes) for _, sizes in larger), f"larger capacity ({growth})")
        return growth

    def _overflow(self, tally: Tally) -> CapacityError:
        """The error for a step that exceeds the capacity; the step is undone."""
        assert tally.over is not None
        name, wanted, capacity = tally.over, tally.wanted, self.sizes()[tally.over]
        env = int(self.gather(lambda shard: shard.pools.wanted_by_environment(name)).argmax())
        self._undo()
        step = int(self._envs.step.numpy()[env])
        advice = f"give capacity={{'{name}': {wanted}}} or more, or on_overflow='grow'"
        if wanted > LARGEST:
            advice = f"more than {LARGEST} cannot be counted: simulate fewer environments at once"
        return CapacityError(
            f"{name}: {wanted} required, capacity {capacity} (most by environment {env} in step {step}); {advice}",
            name,
            wanted,
            capacity,
            env,
            step,
        )
