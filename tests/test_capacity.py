"""Capacity that grows before it is needed: no step of a landing is simulated twice, and no bit changes."""

import logging

import numpy as np
import pytest

import warp_rigid as wr
from tests.oracles import ground_scene
from warp_rigid.engine.memory import MemoryLimit
from warp_rigid.engine.pools import CHUNK, POOLS

SIDE = 7
ROOM = {"pairs": 400, "contacts": 700}
"""Enough for the boxes in the air, which have a pair with the ground each, not for the heap."""


def falling_boxes():
    """Layers of boxes that land one after another, turned against each other, in a narrow shaft."""
    scene = ground_scene(friction=0.5)
    for k in range(SIDE * SIDE * 5):
        x, y, z = k % SIDE, k // SIDE % SIDE, k // SIDE**2
        turn = (0.0, 0.0, np.sin(0.1 * k), np.cos(0.1 * k))
        scene.add_body(wr.Box((0.05,) * 3), position=(0.16 * x, 0.16 * y, 0.15 + 0.3 * z), orientation=turn)
    return scene


def bits(sim):
    return [sim.get(name).tobytes() for name in ("position", "orientation", "linear_velocity")]


@pytest.mark.parametrize("steps", [120, 1])
def test_no_step_of_a_landing_is_repeated(device, steps):
    """Pairs and contacts come to exceed the capacity several times over; each of the steps is simulated once."""
    roomy = wr.Simulator(falling_boxes(), device=device, capacity={"pairs": 10_000, "contacts": 50_000})
    sim = wr.Simulator(falling_boxes(), device=device, capacity=ROOM)
    roomy.step(120)
    for _ in range(120 // steps):
        sim.step(steps)
    counts = sim.counts()
    assert counts["most_contacts"] > 1.5 * ROOM["contacts"] and counts["most_pairs"] > ROOM["pairs"]
    assert counts["repeated_steps"] == 0
    assert bits(sim) == bits(roomy)
    assert sim.contacts().tobytes() == roomy.contacts().tobytes()


def test_steps_that_are_repeated_are_counted_and_told(device, caplog):
    """Boxes that are moved into a heap between two steps, which no trend announces."""
    sim = wr.Simulator(falling_boxes(), device=device, capacity={"pairs": 400, "contacts": 2000})
    sim.step(20)
    assert sim.counts()["repeated_steps"] == 0
    crowd = np.random.default_rng(0).uniform(-0.2, 0.2, (sim.num_bodies - 1, 3)) + (0, 0, 1)
    sim.set("position", crowd, bodies=range(1, sim.num_bodies))
    with caplog.at_level(logging.INFO, logger="warp_rigid"):
        sim.step(3)
    repeated = sim.counts()["repeated_steps"]
    assert repeated >= 3 and repeated % 3 == 0
    assert len(caplog.records) == 1


def test_memory_too_small_to_grow_ahead_is_no_error(device):
    """Pools then grow when they must: where the estimate of the need does not fit, the need itself may."""
    sim = wr.Simulator(falling_boxes(), device=device, capacity=ROOM)
    sim.step(20)
    shards = sim.internals.shards
    shards._limit = MemoryLimit(sim.device, sim.memory + 1000)
    (shard,) = shards
    shard.demand.note(np.full((CHUNK, len(POOLS)), 10**6))
    before = dict(shard.pools.sizes)
    sim.step(1)
    assert shard.pools.sizes == before
