"""Soak test: a pile from which bodies are removed and to which they return.

`python -m benchmarks.soak --steps 1000000` reports whether memory stays constant, whether resting bodies drift, whether
bodies escape, whether identical environments stay identical, and whether steps become slower. It prints a JSON line
after every twentieth of the steps, so that an interrupted run has reported its results so far. On a GPU:
`--device cuda:0 --envs 4096 --steps 100000 --minutes 8`.
"""

import argparse
import gc
import json
import os
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

import warp_rigid as wr
from warp_rigid.scenes.builders import grounds, piles, stacks
from warp_rigid.scenes.builders.bodies import add_bodies
from warp_rigid.scenes.demo import indices
from warp_rigid.warp_start import start_warp

WARM = 0.1
"""Fraction of the rounds that fill caches and pools; growth of memory is measured after it."""

MEMORY_SAMPLES = 100
"""How many times memory is measured."""

LINES = 20
"""How many lines are printed."""

PAIRS_PER_BODY = 12
"""Initial capacity of the pool of pairs, large enough that the pool does not grow."""

PITCH = 0.26
"""Distance of the columns in which a pile starts [m]."""


@dataclass(frozen=True)
class Soak:
    """Results of a soak run so far.

    Attributes:
        steps: steps done in each environment.
        requested: requested number of steps.
        envs: number of environments.
        bodies: number of bodies in an environment.
        changes: how many times bodies were removed or returned.
        seconds: time of the steps.
        memory: of the process [bytes].
        memory_growth: relative growth of the process's memory after the warm-up.
        device_memory: used on the device by all processes; on the CPU by the simulator's arrays [bytes].
        device_growth: relative growth of it after the warm-up.
        slowdown: time of the last fifth of the rounds over that of the first fifth after the warm-up.
        drift: largest distance of a resting body from its position after the first round [m].
        contacts: in all environments in the last step.
        escaped: active bodies outside the bin.
        unequal: pairs of environments that started alike and differ now.
        failed: environments whose status is not ok.
    """

    steps: int
    requested: int
    envs: int
    bodies: int
    changes: int
    seconds: float
    memory: int
    memory_growth: float
    device_memory: int
    device_growth: float
    slowdown: float
    drift: float
    contacts: int
    escaped: int
    unequal: int
    failed: int


def half_width(count: int) -> float:
    """Half the width of the bin in which a pile of `count` bodies is about half a metre high [m]."""
    return max(0.3, 0.06 * count**0.5)


def pile(count: int) -> wr.Scene:
    """Boxes and balls that fall into a bin, and a resting tower beside it that nothing touches."""
    scene = grounds.level_scene(friction=0.5, name="ground")
    side = half_width(count)
    grounds.add_bin(scene, side, 3.0, 0.1, sides=((1, 0), (-1, 0), (0, 1), (0, -1)), names="wall")
    stacks.add_stack(scene, 3, x=-5.0, names="resting")
    shapes = [wr.Sphere(0.09) if k % 5 == 0 else wr.Box((0.1, 0.08, 0.06 + 0.01 * (k % 5))) for k in range(count)]
    positions = piles.lattice(count, int(2.0 * side / PITCH), PITCH, 0.3, rise=0.25)
    angles = 0.3 * np.arange(count)
    turns = np.stack([0.0 * angles, 0.0 * angles, np.sin(angles), np.cos(angles)], axis=1)
    add_bodies(scene, shapes, positions, turns, names="loose", rolling_friction=0.005)
    return scene


def soak(
    steps: int,
    count: int = 100,
    envs: int = 1,
    device: str | None = None,
    sleeping: bool = False,
    every: int = 200,
    minutes: float | None = None,
    seed: int = 0,
    on_found: Callable[[Soak], None] | None = None,
) -> Soak:
    """Run a pile; after each round a tenth of it is removed, or falls in again.

    Environments 2k and 2k + 1 start alike; each such pair has a different friction.

    Args:
        steps: in each environment.
        count: number of bodies in the pile.
        envs: number of environments.
        device: a Warp device.
        sleeping: whether bodies at rest fall asleep.
        every: steps in a round; at least ten rounds are done.
        minutes: stop after this wall-clock time.
        seed: of the choice of removed bodies.
        on_found: called with the results whenever one of LINES parts of the steps is complete.
    """
    scene, settings = pile(count), wr.Settings(sleeping=sleeping)
    capacity = {"pairs": PAIRS_PER_BODY * envs * len(scene.bodies)}
    sim = wr.Simulator(scene, num_envs=envs, settings=settings, device=device, capacity=capacity)
    sim.set("friction", np.linspace(0.5, 0.8, envs)[np.arange(envs) // 2 * 2, None])
    watch = _Watch(sim, steps, every)
    changes = _changes(sim, watch.loose, half_width(count) - 0.17, np.random.default_rng(seed))
    rounds = max(10, steps // every)
    end = time.monotonic() + 60.0 * minutes if minutes else np.inf
    for done in range(1, rounds + 1):
        watch.round()
        over = done == rounds or time.monotonic() > end
        if over or _crosses(done, rounds, MEMORY_SAMPLES):
            watch.measure_memory()
        if on_found and (over or _crosses(done, rounds, LINES)):
            on_found(watch.found())
        if over:
            break
        next(changes)
    return watch.found()


class _Watch:
    """Runs rounds and stores their measurements."""

    def __init__(self, sim: wr.Simulator, requested: int, every: int) -> None:
        self.sim, self.requested, self.every = sim, requested, every
        self.resting, self.loose = (np.array(indices(sim.scene, prefix)) for prefix in ("resting_", "loose_"))
        self.inside = half_width(len(self.loose))
        # Processor time on the CPU does not depend on other processes.
        self.clock = time.process_time if sim.device.is_cpu else time.perf_counter
        self.seconds: list[float] = []
        self.memory_samples: list[tuple[int, int, int]] = []
        self.start = np.zeros(0)

    def round(self) -> None:
        begin = self.clock()
        self.sim.step(self.every)
        self.seconds.append(self.clock() - begin)
        if len(self.seconds) == 1:
            self.start = self.sim.get("position")[:, self.resting]

    def measure_memory(self) -> None:
        gc.collect()
        device = self.sim.device
        held = device.total_memory - device.free_memory if device.is_cuda else self.sim.memory
        self.memory_samples.append((len(self.seconds), _resident(), held))

    def found(self) -> Soak:
        """The results of the rounds so far."""
        position = self.sim.get("position")
        rows = np.array(self.memory_samples)
        first = rows[min(np.searchsorted(rows[:, 0], WARM * len(self.seconds)), len(rows) - 1)]
        growth = rows[-1] / first - 1.0
        return Soak(
            steps=self.every * len(self.seconds),
            requested=self.requested,
            envs=self.sim.num_envs,
            bodies=self.sim.num_bodies,
            changes=len(self.seconds) - 1,
            seconds=sum(self.seconds),
            memory=int(rows[-1, 1]),
            memory_growth=float(growth[1]),
            device_memory=int(rows[-1, 2]),
            device_growth=float(growth[2]),
            slowdown=self._slowdown(),
            drift=float(np.linalg.norm(position[:, self.resting] - self.start, axis=-1).max()),
            contacts=self.sim.counts()["contacts"],
            escaped=self._escaped(position[:, self.loose]),
            unequal=self._unequal(),
            failed=int((self.sim.status()["status"] != "ok").sum()),
        )

    def _slowdown(self) -> float:
        # Rounds with and without the removed bodies take different times; pairs of rounds are comparable.
        pairs = np.array(self.seconds[len(self.seconds) % 2 :]).reshape(-1, 2).sum(axis=1)
        if len(pairs) < 2:
            return 1.0
        warm, fifth = int(WARM * len(pairs)), max(1, len(pairs) // 5)
        return float(np.median(pairs[-fifth:]) / np.median(pairs[warm : warm + fifth]))

    def _escaped(self, position: np.ndarray) -> int:
        away = (np.abs(position[..., :2]) > self.inside).any(axis=-1) | (position[..., 2] < 0.0)
        return int((away & self.sim.get("active")[:, self.loose]).sum())

    def _unequal(self) -> int:
        states = [self.sim.get(name) for name in ("position", "orientation", "linear_velocity", "angular_velocity")]
        return sum(
            any(one[e].tobytes() != one[e + 1].tobytes() for one in states) for e in range(0, len(states[0]) - 1, 2)
        )


def _crosses(done: int, whole: int, parts: int) -> bool:
    """Whether one more of `parts` parts of the whole is complete."""
    return done * parts // whole > (done - 1) * parts // whole


def _changes(sim: wr.Simulator, loose: np.ndarray, reach: float, generator: np.random.Generator) -> Iterator[None]:
    """Alternately remove a tenth of the loose bodies, the same in every environment, and let them fall in again."""
    while True:
        out = generator.choice(loose, max(1, len(loose) // 10), replace=False)
        sim.set("active", False, bodies=out)
        yield
        above = 1.5 + 0.3 * np.arange(len(out))
        sim.set("position", np.column_stack([generator.uniform(-reach, reach, (len(out), 2)), above]), bodies=out)
        sim.set("orientation", generator.normal(size=(len(out), 4)), bodies=out)
        sim.set("linear_velocity", 0.0, bodies=out)
        sim.set("angular_velocity", 0.0, bodies=out)
        sim.set("active", True, bodies=out)
        yield


def _resident() -> int:
    """Memory of this process [bytes]."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def main() -> None:
    """Run it and print JSON lines; the last one covers the whole run."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=1_000_000)
    parser.add_argument("--bodies", type=int, help="default: 100; 8 if there is more than one environment")
    parser.add_argument("--envs", type=int, default=1)
    parser.add_argument("--device")
    parser.add_argument("--sleeping", action="store_true")
    parser.add_argument("--every", type=int, default=200, help="steps between changes of the pile")
    parser.add_argument("--minutes", type=float)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    start_warp()

    def print_line(found: Soak) -> None:
        print(json.dumps(asdict(found)), flush=True)

    soak(
        given.steps,
        given.bodies or (100 if given.envs == 1 else 8),
        given.envs,
        given.device,
        given.sleeping,
        given.every,
        given.minutes,
        given.seed,
        on_found=print_line,
    )


if __name__ == "__main__":
    main()
