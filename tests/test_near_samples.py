"""The lists of near and of traced samples: they grow, nothing is lost, and a pair keeps the order of its samples."""

import numpy as np

import warp_rigid as wr
from tests.oracles import random_quaternion, stages_of
from warp_rigid.engine import pools
from warp_rigid.scenes.builders import meshes


def heap_of_boxes(count):
    """A scene of boxes that overlap slightly above the ground."""
    generator = np.random.default_rng(7)
    scene = wr.Scene()
    scene.add_static(wr.Plane())
    for k in range(count):
        scene.add_body(
            wr.Box((0.1, 0.1, 0.1)),
            position=(0.19 * (k % 3), 0.19 * (k // 3 % 3), 0.15 + 0.2 * (k // 9)),
            orientation=random_quaternion(generator),
        )
    return scene


def test_the_list_grows_beyond_its_first_capacity(device, monkeypatch):
    """With room for one sample at first, also with a given capacity of pairs and contacts: the same bits."""
    roomy = wr.Simulator(heap_of_boxes(18), 3, device=device)
    monkeypatch.setattr(pools, "NEAR_PER_PAIR", 0)
    monkeypatch.setattr(pools, "LEAST_NEAR", 1)
    tight = wr.Simulator(heap_of_boxes(18), 3, device=device)
    needed = {"pairs": 3000, "contacts": 3000}
    fixed = wr.Simulator(heap_of_boxes(18), 3, device=device, capacity=needed, on_overflow="raise")
    for sim in (roomy, tight, fixed):
        sim.step(30)
    assert roomy.counts()["contacts"] > 100
    for sim in (tight, fixed):
        assert sum(shard.pools.sizes["near_samples"] for shard in sim._world.shards) > 100
        assert sim.get("position").tobytes() == roomy.get("position").tobytes()
        assert sim.get("angular_velocity").tobytes() == roomy.get("angular_velocity").tobytes()


def test_the_list_of_traced_samples_grows(device, monkeypatch):
    """Two tori that fly at each other, with room for one sample at first: the same bits."""
    scene = wr.Scene(gravity=(0.0, 0.0, 0.0))
    scene.add_body(meshes.torus(0.2, 0.05), linear_velocity=(0.0, 0.0, 20.0), angular_velocity=(9.0, 0.0, 0.0))
    scene.add_body(meshes.torus(0.2, 0.05), position=(0.05, 0.0, 0.4))
    roomy = wr.Simulator(scene, device=device)
    monkeypatch.setattr(pools, "NEAR_PER_PAIR", 0)
    monkeypatch.setattr(pools, "LEAST_NEAR", 1)
    tight = wr.Simulator(scene, device=device)
    traced = 0
    for _ in range(4):
        for sim in (roomy, tight):
            sim.step()
        stages = stages_of(roomy)
        stages.open_iteration(is_first=1)
        stages._trace_fast_pairs()
        traced = max(traced, int(stages.pools.suspects.count.numpy()[0]))
        assert tight.get("position").tobytes() == roomy.get("position").tobytes()
        assert tight.get("orientation").tobytes() == roomy.get("orientation").tobytes()
    assert traced > 1
