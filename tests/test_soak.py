"""A short soak: memory, speed and resting bodies stay as they are while a pile changes."""

import gc
import mmap

import numpy as np
import pytest
import warp as wp

from benchmarks import soak as benchmark
from benchmarks.soak import pile, soak
from warp_rigid.engine.simulator import Simulator


@pytest.mark.parametrize("sleeping", [pytest.param(False, marks=pytest.mark.long), True])
def test_a_pile_that_changes_leaves_no_trace(device, sleeping):
    """The long run is `python -m benchmarks.soak`; this one sees a leak of a few kilobytes a round."""
    lines = []
    found = soak(2000, count=10, envs=2, device=device, sleeping=sleeping, every=100, on_found=lines.append)
    assert found.failed == found.escaped == found.unequal == 0
    assert found.drift < 1e-3
    assert found.memory_growth < 0.01
    if device == "cpu":
        # On a GPU other processes count, too.
        assert found.device_growth < 0.01
    # Another process may take the core for a while: only a plain trend would fail.
    assert found.slowdown < 2.0
    assert len(lines) == benchmark.LINES and lines[-1] == found
    assert (found.steps, found.changes) == (2000, 19)


def test_what_goes_wrong_is_told(device, monkeypatch):
    """The tower is moved, a gravity differs, all break down, bodies leave the bin, and memory leaks."""
    rounds, leak = [], []

    def step(sim, count, plain=Simulator.step):
        plain(sim, count)
        rounds.append(sim)
        if len(rounds) == 3:
            sim.set("gravity", (0, 0, -9), envs=[3])
        if len(rounds) == 5:
            # New pages: a worker that has freed memory would reuse that.
            leak.append(mmap.mmap(-1, benchmark._resident() // 20))
            np.frombuffer(leak[-1], np.uint8)[:] = 1
            sim.set("position", (-5, 0.01, 0.1), bodies=[5], envs=[0])
            sim.array("linear_velocity").fill_(wp.vec3(wp.nan, 0, 0))
        if len(rounds) == 10:
            sim.set("position", (5, 0, 1), envs=[0], bodies=range(8, 12))

    monkeypatch.setattr(Simulator, "step", step)
    found = soak(200, count=4, envs=4, device=device, every=20)
    assert found.drift == pytest.approx(0.01, abs=1e-3)
    assert found.escaped == 3, "one of the four is taken out"
    assert found.unequal == 2
    assert found.failed == 4
    assert found.memory_growth > 0.02


def test_time_that_is_over_ends_it():
    lines = []
    found = soak(10**6, count=2, device="cpu", every=10, minutes=1e-3, on_found=lines.append)
    assert 10 <= found.steps < 10**6 and found.requested == 10**6
    assert lines == [found]


def test_the_pile_is_what_it_says():
    kinds = [body.name.partition("_")[0] for body in pile(100).bodies]
    assert (kinds.count("loose"), kinds.count("wall"), kinds.count("resting")) == (100, 4, 3)


def test_what_is_recorded_anew_saved_or_dropped_leaves_nothing(device, tmp_path):
    """Steps recorded for other settings, checkpoints, and whole simulators."""
    scene, where = pile(8), wp.get_device(device)

    def held():
        gc.collect()
        return benchmark._resident(), wp.get_mempool_used_mem_current(where) if where.is_cuda else 0

    def use(times):
        sim = Simulator(scene, device=device, capacity={"pairs": 1, "contacts": 1})
        for k in range(times):
            sim.set("shock_iterations", 1 + k % 2)
            sim.step(2)
            sim.penetration()
            if k % 5 == 0:
                sim.save(tmp_path / "a.ckpt")
                sim = Simulator.load(tmp_path / "a.ckpt")

    use(25)
    before = held()
    use(25)
    after = held()
    # A driver of a GPU keeps memory of its own for what was recorded.
    assert after[0] - before[0] < (1_000_000 if device == "cpu" else 16_000_000)
    assert after[1] <= before[1]
