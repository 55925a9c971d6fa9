"""Soak: a pile whose bodies come and go for very many steps; `python -m benchmarks.soak --steps 1000000`.

Tells whether memory stays flat, whether resting bodies drift, whether bodies get lost, whether environments that are
alike stay so, and whether steps become slower: a JSON line whenever a twentieth of the steps is done, so that a run
that is cut short has told what it found so far. On a GPU: `--device cuda:0 --envs 4096 --steps 100000 --minutes 8`.
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
from warp_rigid.commands.terminal import start_warp
from warp_rigid.scenes.builders import grounds, piles, stacks
from warp_rigid.scenes.builders.bodies import add_bodies
from warp_rigid.scenes.demo import indices

WARM = 0.1
"""The first part of the rounds fills caches and pools; flatness is measured after it."""

LOOKS = 100
"""So often memory is measured."""

LINES = 20
"""So often a line is told."""

ROOM = 12
"""Pairs a body for which there is room from the start, so that what grows is not a pool."""

PITCH = 0.26
"""Distance of the columns in which a pile starts [m]."""


@dataclass(frozen=True)
class Soak:
    """What a soak run has found so far.

    Attributes:
        steps: done in each environment.
        asked: steps that were asked for.
        envs: environments.
        bodies: in each.
        changes: how often bodies were taken out or let fall.
        seconds: that the steps took.
        memory: of the process [bytes].
        memory_growth: of the process after warming up, in parts of what it was then.
        device_memory: taken on the device, by whomever; on the CPU by the simulator's arrays [bytes].
        device_growth: likewise, after warming up.
        slowdown: time of the last fifth of the rounds over that of the first fifth after warming up.
        drift: most that a body at rest is away from where it was after the first round [m].
        contacts: of all environments in the last step.
        escaped: bodies that are neither taken out nor in the bin.
        unequal: pairs of environments that started alike and are different now.
        failed: environments that are not healthy.
    """

    steps: int
    asked: int
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
    """Boxes and balls that fall into a bin, and beside it a tower that nothing touches."""
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
    """Run a pile; now and then a tenth of it is taken out, or let fall in again.

    Environments 2k and 2k + 1 start alike, with a friction of their own.

    Args:
        steps: in each environment.
        count: bodies of the pile.
        envs: environments.
        device: a Warp device.
        sleeping: whether bodies at rest fall asleep.
        every: steps between two changes, a round; at least ten rounds are done.
        minutes: stop after so many, whatever is left to do.
        seed: of what is taken out.
        on_found: told what was found whenever a part of the steps is done.
    """
    scene, settings = pile(count), wr.Settings(sleeping=sleeping)
    room = {"pairs": ROOM * envs * len(scene.bodies)}
    sim = wr.Simulator(scene, num_envs=envs, settings=settings, device=device, capacity=room)
    sim.set("friction", np.linspace(0.5, 0.8, envs)[np.arange(envs) // 2 * 2, None])
    watch = _Watch(sim, steps, every)
    changes = _changes(sim, watch.loose, half_width(count) - 0.17, np.random.default_rng(seed))
    rounds = max(10, steps // every)
    end = time.monotonic() + 60.0 * minutes if minutes else np.inf
    for done in range(1, rounds + 1):
        watch.round()
        over = done == rounds or time.monotonic() > end
        if over or _crosses(done, rounds, LOOKS):
            watch.look()
        if on_found and (over or _crosses(done, rounds, LINES)):
            on_found(watch.found())
        if over:
            break
        next(changes)
    return watch.found()


class _Watch:
    """Runs rounds and keeps what is measured of them."""

    def __init__(self, sim: wr.Simulator, asked: int, every: int) -> None:
        self.sim, self.asked, self.every = sim, asked, every
        self.resting, self.loose = (np.array(indices(sim.scene, prefix)) for prefix in ("resting_", "loose_"))
        self.inside = half_width(len(self.loose))
        # On the CPU what other processes take does not count.
        self.clock = time.process_time if sim.device.is_cpu else time.perf_counter
        self.seconds: list[float] = []
        self.looks: list[tuple[int, int, int]] = []
        self.start = np.zeros(0)

    def round(self) -> None:
        begin = self.clock()
        self.sim.step(self.every)
        self.seconds.append(self.clock() - begin)
        if len(self.seconds) == 1:
            self.start = self.sim.get("position")[:, self.resting]

    def look(self) -> None:
        gc.collect()
        device = self.sim.device
        held = device.total_memory - device.free_memory if device.is_cuda else self.sim.memory
        self.looks.append((len(self.seconds), _resident(), held))

    def found(self) -> Soak:
        """Everything, of the rounds so far."""
        position = self.sim.get("position")
        rows = np.array(self.looks)
        first = rows[min(np.searchsorted(rows[:, 0], WARM * len(self.seconds)), len(rows) - 1)]
        growth = rows[-1] / first - 1.0
        return Soak(
            steps=self.every * len(self.seconds),
            asked=self.asked,
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
        # A round with bodies away is quicker than one without: they are compared two by two.
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
    """Whether one more of `parts` parts of the whole is done."""
    return done * parts // whole > (done - 1) * parts // whole


def _changes(sim: wr.Simulator, loose: np.ndarray, reach: float, generator: np.random.Generator) -> Iterator[None]:
    """Take a tenth of the loose bodies out, the same in every environment, then let them fall in again, and so on."""
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
    """Run it and print JSON lines; the last one tells of the whole run."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=1_000_000)
    parser.add_argument("--bodies", type=int, help="100; 8 where there are many environments")
    parser.add_argument("--envs", type=int, default=1)
    parser.add_argument("--device")
    parser.add_argument("--sleeping", action="store_true")
    parser.add_argument("--every", type=int, default=200, help="steps between two changes of the pile")
    parser.add_argument("--minutes", type=float)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    start_warp()

    def tell(found: Soak) -> None:
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
        on_found=tell,
    )


if __name__ == "__main__":
    main()
