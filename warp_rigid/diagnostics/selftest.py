"""Self-test: a short simulation with known results on one device.

`python -m warp_rigid.diagnostics.selftest DEVICE` prints the results as JSON.
"""

import json
import sys
import time
from typing import Any

import numpy as np

from warp_rigid.engine.settings import Settings
from warp_rigid.engine.simulator import Simulator
from warp_rigid.scene.scene import Scene
from warp_rigid.scene.shapes import Box, Plane, Sphere

SECONDS = 2.0
"""Duration of the throughput measurement [s]."""
STACK = 4
STEPS = 120


def self_test(device: str) -> dict[str, Any]:
    """Simulate on a device, compare with closed forms and check reproducibility.

    Args:
        device: name of a Warp device.

    Returns:
        "checks": whether each check passed, by description; "compile_seconds", "steps_per_second".
    """
    start = time.perf_counter()
    sim = Simulator(_scene(), num_envs=3, device=device)
    compiled = time.perf_counter() - start
    sim.step(STEPS)
    alone = Simulator(_scene(), device=device)
    alone.step(STEPS)
    checks = {
        "a falling ball follows the closed form": _falls(sim),
        "a stack of boxes stays in place": _stands(sim),
        "equal environments are bitwise equal": _alike(sim, alone),
    }
    return {"checks": checks, "compile_seconds": compiled, "steps_per_second": _speed(sim)}


def _scene() -> Scene:
    """A stack of boxes and a falling ball."""
    scene = Scene()
    scene.add_static(Plane(), friction=0.5)
    for k in range(STACK):
        scene.add_body(Box((0.1, 0.1, 0.1)), position=(0, 0, 0.1 + 0.2 * k), friction=0.5)
    scene.add_body(Sphere(0.1), position=(2, 0, 5))
    return scene


def _falls(sim: Simulator) -> bool:
    """Whether the height of the ball is that of n steps of the semi-implicit Euler method."""
    dt = Settings().dt
    height = 5.0 - 9.81 * dt * dt * STEPS * (STEPS + 1) / 2
    return bool(np.abs(sim.get("position")[:, -1, 2] - height).max() < 1e-4)


def _stands(sim: Simulator) -> bool:
    """Whether all boxes moved by less than 0.1 mm."""
    start = [[0, 0, 0.1 + 0.2 * k] for k in range(STACK)]
    return bool(np.abs(sim.get("position")[:, 1 : 1 + STACK] - start).max() < 1e-4)


def _alike(sim: Simulator, alone: Simulator) -> bool:
    return all(
        sim.get(name)[env].tobytes() == alone.get(name)[0].tobytes()
        for name in ("position", "orientation", "linear_velocity", "angular_velocity")
        for env in range(sim.num_envs)
    )


def _speed(sim: Simulator) -> float:
    """Steps of the batch per second."""
    start, steps = time.perf_counter(), 0
    while time.perf_counter() - start < SECONDS:
        sim.step(16)
        sim.counts()
        steps += 16
    return steps / (time.perf_counter() - start)


if __name__ == "__main__":
    print(json.dumps(self_test(sys.argv[1])))
