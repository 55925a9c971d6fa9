"""Soak: a pile whose bodies come and go for very many steps; `python -m benchmarks.soak --steps 1000000`.

Prints whether memory stays flat, whether resting bodies drift, and whether steps become slower.
"""

import argparse
import gc
import json
import os
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

import warp_rigid as wr

ROUND = 200
"""Steps between two changes of the pile."""

AWAY = 100.0
"""Bodies that are taken out wait this far to the side, on the same ground [m]."""

WARM = 0.1
"""The first part of a run fills caches and pools; flatness is measured after it."""


@dataclass(frozen=True)
class Soak:
    """What a soak run found.

    Attributes:
        steps: done in each environment.
        envs: environments.
        bodies: in each.
        seconds: that the steps took.
        memory_growth: of the process, from after warming up to the end, in parts of what it was.
        device_growth: of the simulator's arrays, likewise.
        slowdown: time of the last fifth of the steps over that of the first fifth after warming up.
        drift: most that a body at rest moved [m].
        failed: environments that are not healthy.
    """

    steps: int
    envs: int
    bodies: int
    seconds: float
    memory_growth: float
    device_growth: float
    slowdown: float
    drift: float
    failed: int


def pile(count: int) -> wr.Scene:
    """Boxes and balls that fall into a bin; far away, a box that nothing touches, and room for those taken out."""
    scene = wr.Scene()
    scene.add_static(wr.Plane(), friction=0.5, name="ground")
    side = 0.12 * np.ceil(np.sqrt(count))
    for x, y in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        half = (0.05, side + 0.1, 1.0) if x else (side + 0.1, 0.05, 1.0)
        scene.add_static(wr.Box(half), position=(x * (side + 0.05), y * (side + 0.05), 1.0), name="wall")
    for k in range(3):
        scene.add_body(wr.Box((0.1, 0.1, 0.1)), position=(-50, 0, 0.1 + 0.2 * k), name="resting")
    for k in range(count):
        shape = wr.Sphere(0.09) if k % 5 == 0 else wr.Box((0.1, 0.08, 0.06 + 0.01 * (k % 5)))
        row, layer = k % 25, k // 25
        place = (0.25 * (row % 5) - 0.5, 0.25 * (row // 5) - 0.5, 0.3 + 0.3 * layer)
        scene.add_body(shape, position=place, rolling_friction=0.005, name="loose")
    return scene


def soak(steps: int, count: int = 100, envs: int = 1, device: str | None = None, seed: int = 0) -> Soak:
    """Run a pile; after every ROUND steps a tenth of it is taken out, or let fall in again.

    Args:
        steps: in each environment.
        count: bodies of the pile.
        envs: environments.
        device: a Warp device.
        seed: of what is taken.
    """
    scene = pile(count)
    sim = wr.Simulator(scene, num_envs=envs, device=device)
    resting = [i for i, body in enumerate(scene.bodies) if body.name == "resting"]
    loose = np.array([i for i, body in enumerate(scene.bodies) if body.name == "loose"])
    generator = np.random.default_rng(seed)
    out: list[int] = []
    seconds, memory, held = [], [], []
    sim.step(ROUND)
    start = sim.get("position")[:, resting]
    # On the CPU what other processes take does not count.
    clock = time.process_time if sim.device.is_cpu else time.perf_counter
    for _ in range(max(10, steps // ROUND)):
        begin = clock()
        sim.step(ROUND)
        sim.counts()
        seconds.append(clock() - begin)
        out = _let_fall(sim, out, generator) if out else _take_out(sim, loose, generator)
        gc.collect()
        memory.append(_resident())
        held.append(sim.memory)
    warm = max(1, int(WARM * len(seconds)))
    # A round with bodies away is quicker than one without: compare whole pairs of rounds.
    fifth = max(2, 2 * (len(seconds[warm:]) // 10))
    return Soak(
        steps=ROUND * len(seconds),
        envs=envs,
        bodies=sim.num_bodies,
        seconds=sum(seconds),
        memory_growth=memory[-1] / memory[warm] - 1.0,
        device_growth=held[-1] / held[warm] - 1.0,
        slowdown=float(np.median(seconds[-fifth:]) / np.median(seconds[warm : warm + fifth])),
        drift=float(np.linalg.norm(sim.get("position")[:, resting] - start, axis=-1).max()),
        failed=int((sim.status()["status"] != "ok").sum()),
    )


def _take_out(sim: wr.Simulator, loose: np.ndarray, generator: np.random.Generator) -> list[int]:
    """Set a tenth of the loose bodies aside, each at a place of its own."""
    chosen = generator.choice(loose, max(1, len(loose) // 10), replace=False).tolist()
    places = [(AWAY + 0.5 * k, 0.0, 0.2) for k in range(len(chosen))]
    _place(sim, chosen, places)
    return chosen


def _let_fall(sim: wr.Simulator, out: list[int], generator: np.random.Generator) -> list[int]:
    """Let them fall into the bin again, one above the other."""
    places = [(*generator.uniform(-0.4, 0.4, 2), 2.5 + 0.3 * k) for k in range(len(out))]
    _place(sim, out, places)
    return []


def _place(sim: wr.Simulator, bodies: list[int], places: list) -> None:
    sim.set("position", places, bodies=bodies)
    sim.set("orientation", (0, 0, 0, 1), bodies=bodies)
    sim.set("linear_velocity", 0.0, bodies=bodies)
    sim.set("angular_velocity", 0.0, bodies=bodies)


def _resident() -> int:
    """Memory of this process [bytes]."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def main() -> None:
    """Run it and print one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=1_000_000)
    parser.add_argument("--bodies", type=int, default=100)
    parser.add_argument("--envs", type=int, default=1)
    parser.add_argument("--device")
    given = parser.parse_args()
    print(json.dumps(asdict(soak(given.steps, given.bodies, given.envs, given.device))))


if __name__ == "__main__":
    main()
