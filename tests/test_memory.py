"""The arrays of a simulator are freed with the last reference to it, without the garbage collector."""

import gc

import numpy as np
import pytest
import warp as wp

from tests.oracles import ground_scene, random_pile
from warp_rigid import Sphere, scenes, sweep
from warp_rigid.engine.simulator import Simulator
from warp_rigid.sweep import batch_run


@pytest.fixture
def no_collector():
    """Nothing is freed that is part of a cycle of references."""
    gc.collect()
    gc.disable()
    yield
    gc.enable()


def live_arrays():
    return sum(isinstance(known, wp.array) for known in gc.get_objects())


def simulate(scene, device):
    sim = Simulator(scene, num_envs=2, device=device, capacity={"pairs": 1, "contacts": 1})
    sim.step(3)
    sim.penetration()
    sim.contacts()


@pytest.mark.usefixtures("no_collector")
@pytest.mark.parametrize("kind", ["pile", "heap", "ragdolls", "crane"])
def test_a_simulator_leaves_no_arrays(device, kind):
    """Also the arrays of capacities that were exceeded, which they are in the first step."""
    count = {"pile": 24, "heap": 150}.get(kind)
    scene = random_pile(np.random.default_rng(1), count) if count else scenes.load(kind)
    simulate(scene, device)
    before = live_arrays()
    simulate(scene, device)
    assert live_arrays() == before


def drop(height: float = 1.0):
    scene = ground_scene()
    scene.add_body(Sphere(0.1), position=(0, 0, height))
    return scene


@pytest.mark.long
@pytest.mark.usefixtures("no_collector")
def test_a_sweep_leaves_no_arrays(device, monkeypatch):
    """Neither do batches that did not fit into memory; they are freed before their halves are built."""
    at_start = []

    def run_small(job, prepared, start, on_done):
        at_start.append(live_arrays())
        if len(prepared.runs) > 2:
            raise MemoryError("more than two runs")
        return run_batch_in(job, prepared, start, on_done)

    run_batch_in = batch_run._run
    monkeypatch.setattr(batch_run, "_run", run_small)
    for _ in range(2):
        before = live_arrays()
        rows = sweep(drop, {"height": [0.2, 0.3, 0.4, 0.5, 0.6]}, duration=0.1, batch=4, device=device).rows
    assert [row["status"] for row in rows] == ["ok"] * 5
    assert live_arrays() == before
    # Batches of 4, 2, 2 and 1 runs, twice; each has as many arrays as the others.
    assert len(at_start) == 8 and len(set(at_start[4:])) == 1
