"""All environments of a simulator as shards: stepped together, undone together, with room that grows or must do."""

import logging
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np

from warp_rigid.engine.cores import spread, usable_cores
from warp_rigid.engine.memory import MemoryLimit, pool_bytes
from warp_rigid.engine.model import Model, other_constraints
from warp_rigid.engine.pools import LARGEST, NAMES, Pools
from warp_rigid.engine.shard import Shard
from warp_rigid.errors import CapacityError
from warp_rigid.scene.scene import Motion, Scene

log = logging.getLogger("warp_rigid")

LEAST_BODIES = 16
"""Dynamic bodies that are worth a shard: waking a thread takes as long as a step of about three of them."""

SHARDS_A_CORE = 2
"""More than one, so that a core whose environments are done sooner takes over some of another's."""


class Range(NamedTuple):
    """Environments of a shard, and the sizes of its pools at first."""

    first: int
    end: int
    sizes: dict[str, int]


class Tally(NamedTuple):
    """What steps wanted of the pools.

    Attributes:
        most: (2,) most pairs and contacts that a step wanted, all shards together.
        short: shards that had not enough room, and what each wanted of the pools that were too small.
        over: the pool of which a step wanted more than there may be, if there is one.
        wanted: how much that step wanted of it.
        fitted: how many steps there were before it.
    """

    most: np.ndarray
    short: list[tuple[Shard, dict[str, int]]]
    over: str | None = None
    wanted: int = 0
    fitted: int = 0


def plan(scene: Scene, num_envs: int, room: dict[str, int], device: Any) -> list[Range]:
    """Ranges of about as many environments each, and their part of the room; one range on a GPU."""
    cores = 1 if device.is_cuda else usable_cores()
    dynamic = sum(body.motion == Motion.DYNAMIC for body in scene.bodies)
    worth = num_envs * dynamic // LEAST_BODIES
    count = 1 if cores == 1 else max(1, min(cores * SHARDS_A_CORE, worth, num_envs))

    def sizes(first: int, end: int) -> dict[str, int]:
        part = {name: max(1, all_ * end // num_envs - all_ * first // num_envs) for name, all_ in room.items()}
        return Pools.sizes_for(end - first, len(scene.bodies), other_constraints(scene), **part)

    bounds = [num_envs * k // count for k in range(count + 1)]
    return [Range(first, end, sizes(first, end)) for first, end in zip(bounds, bounds[1:], strict=False)]


class Shards:
    """The shards of a simulator.

    Args:
        ranges: as from `plan`.
        model: what is constant.
        state: what a step changes.
        rest: who sleeps.
        envs: settings of the environments.
        capacity: largest numbers of "pairs" and "contacts" of all together; None if pools grow.
        limit: what the simulator may take of the memory.
        other_bytes: what it takes beside pools.

    Attributes:
        steps: steps done.
        capacity: as given.
        most_wanted: (2,) most pairs and contacts that a step has wanted.
    """

    def __init__(
        self,
        ranges: list[Range],
        model: Model,
        state: Any,
        sleep_state: Any,
        envs: Any,
        capacity: dict[str, int] | None,
        limit: MemoryLimit,
        other_bytes: int,
    ) -> None:
        """Make the shards; `record` must follow."""
        self._shards = [Shard(*some, model, state, sleep_state, envs) for some in ranges]
        self._envs, self._limit, self._other_bytes, self._growth_told = envs, limit, other_bytes, False
        self._threads, self._attempt = usable_cores(), 0
        self.steps, self.capacity, self.most_wanted = 0, capacity, np.zeros(2, np.int64)

    def __iter__(self) -> Iterator[Shard]:
        """In the order of their environments."""
        return iter(self._shards)

    def of(self, chosen: np.ndarray) -> Iterator[tuple[Shard, np.ndarray]]:
        """Shards that have some of the chosen environments, and the numbers of these within them."""
        for shard in self._shards:
            own = chosen[(chosen >= shard.first) & (chosen < shard.end)]
            if len(own):
                yield shard, own - shard.first

    def gather(self, read: Callable[[Shard], np.ndarray]) -> np.ndarray:
        """Rows of all environments, from those of the shards."""
        return np.concatenate([read(shard) for shard in self._shards])

    def sizes(self) -> dict[str, int]:
        """Pairs and contacts that there is room for, or may be, in all environments together."""
        return self.capacity or {name: sum(shard.pools.sizes[name] for shard in self._shards) for name in NAMES}

    @property
    def memory(self) -> int:
        """Bytes that the simulator holds on its device."""
        return self._other_bytes + sum(pool_bytes(shard.pools.sizes) for shard in self._shards)

    @property
    def sleeping(self) -> bool:
        """Whether the recorded step lets bodies fall asleep."""
        return self._shards[0].stages.sleeping

    def record(self, dt: float, repetitions: int, sleeping: bool) -> None:
        """Record the step, unless it is recorded so already; the arguments are those of Stages."""
        for shard in self._shards:
            if shard.recorded != (dt, repetitions, sleeping):
                shard.record(dt, repetitions, sleeping)

    def step(self, count: int) -> None:
        """Do at most CHUNK steps in all environments, or raise: then the last step that fitted stands in all of them.

        Raises:
            CapacityError: there is not enough room, and it may not grow.
        """
        try:
            self._confirm(self._advance(count), count)
        except BaseException:
            self._undo()
            raise

    def deepest_overlap(self) -> np.ndarray:
        """Deepest overlap now in each environment, (envs,) [m]; see Simulator.penetration.

        Raises:
            CapacityError: there is not enough room, and it may not grow.
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
        """Enlarge the pools of a shard that are smaller than what is wanted of them."""
        short = {name: n for name, n in wanted.items() if n > shard.pools.sizes[name]}
        if short:
            self._grow([(shard, short)])

    def _advance(self, count: int) -> Tally:
        """Do steps that can be undone, again where a pool was too small."""
        left = self._shards
        while True:
            self._try(left, count)
            tally = self._count(count)
            if tally.over:
                self._go_to_overflow(tally)
                raise self._overflow(tally)
            if not tally.short:
                return tally
            self._grow(tally.short)
            left = [shard for shard, _ in tally.short]

    def _try(self, shards: list[Shard], count: int) -> None:
        """The slowest of late go first, so that no core is left with one of them at the end."""
        slowest_first = sorted(shards, key=lambda shard: -shard.seconds)
        spread(lambda shard: shard.advance(count, self._attempt), slowest_first, self._threads)

    def _go_to_overflow(self, tally: Tally) -> None:
        """From the steps that were tried to the last one that fitted, and one that can be undone beyond it."""
        self._undo()
        if tally.fitted:
            self._try(self._shards, tally.fitted)
            self._confirm(tally, tally.fitted)
        self._try(self._shards, 1)

    def _confirm(self, tally: Tally, count: int) -> None:
        """Let the steps stand that were done last: nothing of this attempt can be undone any more."""
        self._attempt += 1
        self.steps += count
        self.most_wanted = np.maximum(self.most_wanted, tally.most)

    def _undo(self) -> None:
        for shard in self._shards:
            shard.undo(self._attempt)

    def _count(self, steps: int) -> Tally:
        """What the last steps wanted, and whether there was room for it."""
        wanted = np.array([shard.pools.wanted.numpy()[:steps] for shard in self._shards], np.int64)
        too_much = wanted > np.array([[[shard.pools.sizes[name] for name in NAMES]] for shard in self._shards])
        void, short = steps, []
        if too_much.any():
            void, short = self._shortage(wanted, too_much)
        known = wanted[:, : void + 1].sum(axis=0)
        if void < steps and too_much[:, void, 0].any():
            known[void, 1] = 0
        over = np.argwhere(known > [self.capacity[name] if self.capacity else LARGEST for name in NAMES])
        if len(over) == 0:
            return Tally(known.max(axis=0), short)
        step, pool = (int(k) for k in over[0])
        return Tally(known[:step].max(axis=0, initial=0), short, NAMES[pool], int(known[step, pool]), step)

    def _shortage(self, wanted: np.ndarray, too_much: np.ndarray) -> tuple[int, list[tuple[Shard, dict[str, int]]]]:
        """The first step that is void somewhere, and what each shard wanted of what was too small in its first one.

        A step is void where a pool was too small, and so are all after it; but the pairs wanted in it are known.
        """
        short = []
        void = too_much.shape[1]
        for shard, rows, much in zip(self._shards, wanted, too_much, strict=True):
            if much.any():
                first = int(much.any(axis=1).argmax())
                void = min(void, first)
                short.append((shard, {NAMES[k]: int(rows[first, k]) for k in np.flatnonzero(much[first])}))
        return void, short

    def _grow(self, short: list[tuple[Shard, dict[str, int]]]) -> None:
        """Enlarge pools that were too small; their shards' steps are undone."""
        larger = [(shard, shard.pools.larger_sizes(wanted)) for shard, wanted in short]
        names = [name for name in NAMES if any(name in wanted for _, wanted in short)]
        told = ", ".join(
            f"{name} {now} -> {now + sum(sizes[name] - shard.pools.sizes[name] for shard, sizes in larger)}"
            for name, now in ((name, sum(shard.pools.sizes[name] for shard in self._shards)) for name in names)
        )
        self._limit.check(self.memory, sum(pool_bytes(sizes) for _, sizes in larger), f"room for more ({told})")
        level = logging.DEBUG if self._growth_told or self.capacity else logging.INFO
        log.log(level, "room grows: %s; the steps are repeated", told)
        self._growth_told = True
        for shard, sizes in larger:
            shard.undo(self._attempt)
            shard.grow(sizes)

    def _overflow(self, tally: Tally) -> CapacityError:
        """The error for a step that wanted too much; that step is undone."""
        assert tally.over is not None
        name, wanted, room = tally.over, tally.wanted, self.sizes()[tally.over]
        env = int(self.gather(lambda shard: shard.pools.wanted_by_environment(name)).argmax())
        self._undo()
        step = int(self._envs.step.numpy()[env])
        advice = f"give capacity={{'{name}': {wanted}}} or more, or on_overflow='grow'"
        if wanted > LARGEST:
            advice = f"more than {LARGEST} cannot be counted: simulate fewer environments at once"
        return CapacityError(
            f"{name}: {wanted} wanted, room for {room} (most wanted by environment {env} in step {step}); {advice}",
            name,
            wanted,
            room,
            env,
            step,
        )
