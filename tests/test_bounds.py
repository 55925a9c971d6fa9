"""Kernels read no array outside its bounds: bodies without colliders, and all kernels with Warp's checks."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import warp_rigid as wr

ROOT = Path(__file__).resolve().parents[1]

CHECKED = """
import os
import sys
os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:1])  # Warp's debug mode runs kernels on one thread only
import numpy as np
import warp as wp
wp.config.mode, wp.config.kernel_cache_dir = "debug", sys.argv[1]
import warp_rigid as wr
from tests import random_scenes
from tests.random_scenes import act, heap, random_scene, random_settings

for seed in range(4):
    rng = np.random.default_rng(seed)
    sim = wr.Simulator(random_scene(rng), settings=random_settings(rng), device="cpu", capacity={"contacts": 4})
    sim.watch([None, 1])
    for step in range(6):
        act(sim, step, rng)
        sim.step(12)
        sim.penetration()
few = wr.Settings(sleeping=True, contact_iterations=1)  # more rounds read the same places
sim = wr.Simulator(heap(rng), settings=few, device="cpu")
sim.step(8)
print("read", len(sim.contacts()), "contacts of a heap")
"""


def nothing():
    """A body with a mass and without colliders."""
    return wr.Compound([], (0.0, 0.0, 0.0), 0.1 * np.eye(3))


@pytest.mark.parametrize("beside", [False, True])
def test_bodies_without_colliders_touch_nothing(device, beside):
    """They fall freely through each other, and through a box; alone, the pool of shapes has no distance functions."""
    scene = wr.Scene()
    for height in (1.0, 1.2):
        scene.add_body(nothing(), mass=1.0, position=(0, 0, height), linear_velocity=(1, 0, 0))
    if beside:
        scene.add_static(wr.Box((1.0, 1.0, 1.0)))
        scene.add_body(wr.Box((0.1, 0.1, 0.1)), position=(0, 0, 1.1))
    sim = wr.Simulator(scene, device=device)
    steps, dt = 60, sim.settings.dt
    sim.step(steps)
    fallen = 0.5 * 9.81 * dt**2 * steps * (steps + 1)
    expected = [[steps * dt, 0, height - fallen] for height in (1.0, 1.2)]
    np.testing.assert_allclose(sim.get("position")[0, :2], expected, atol=1e-5)
    assert sim.counts()["pairs"] == beside and sim.penetration()[0] < 1e-3


@pytest.mark.long
@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="needs a process on one core")
def test_no_index_is_out_of_bounds(tmp_path):
    """Warp's debug mode ends the process at the first element that is read or written outside an array."""
    command = [sys.executable, "-W", "ignore", "-c", CHECKED, str(tmp_path)]
    done = subprocess.run(command, cwd=ROOT, env=os.environ, capture_output=True, text=True, timeout=1500)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    assert int(done.stdout.split()[-5]) > 100
