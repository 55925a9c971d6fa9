"""Solver statistics: what the solver decided and did in the last step."""

import numpy as np

from tests.oracles import ground_scene, random_pile
from warp_rigid.engine.settings import Settings
from warp_rigid.engine.simulator import Simulator
from warp_rigid.scene.shapes import Box, Sphere
from warp_rigid.scenes.builders import stacks
from warp_rigid.scenes.builders.bodies import add_bodies


def two_stacks():
    """Two stacks of three cubes that do not touch each other, and a cube in the air."""
    scene = ground_scene()
    for x in (0.0, 2.0):
        for level in range(3):
            scene.add_body(Box((0.1,) * 3), position=(x, 0.0, 0.1 + 0.2 * level))
    scene.add_body(Box((0.1,) * 3), position=(5.0, 0.0, 30.0))
    return scene


def test_counts_of_every_environment(device):
    sim = Simulator(two_stacks(), num_envs=2, device=device)
    sim.set("position", (5.0, 0.0, 0.1), envs=[1], bodies=[7])
    sim.step(3)
    stats = sim.stats()
    assert all(values.shape == (2,) for values in stats.values())
    contacts = sim.contacts()
    np.testing.assert_array_equal(stats["contacts"], np.bincount(contacts["env"], minlength=2))
    np.testing.assert_array_equal(stats["islands"], [3, 3])
    assert stats["pairs"].sum() == sim.counts()["pairs"]
    for name in ("pair", "contact"):
        capacity = sim.counts()[f"{name}_capacity"]
        used = stats[f"{name}_capacity_used"]
        assert (used > 0).all() and (used <= 1).all() and capacity > 0


def test_islands_are_counted_by_how_they_were_solved(device):
    modes = ["off", "two_pass", "two_pass"]
    sim = Simulator(two_stacks(), num_envs=3, device=device)
    sim.set("shock_propagation", modes)
    sim.set("warm_starting", [False, False, True])
    sim.set("contact_iterations", [4, 4, 40])
    sim.step(1)
    stats = sim.stats()
    parts = stats["islands_shock"] + stats["islands_sweeps"] + stats["islands_asleep"]
    np.testing.assert_array_equal(parts, stats["islands"])
    assert stats["islands_shock"][0] == 0 and stats["shock_sweeps"][0] == 0
    assert stats["islands_shock"][1] == 3 and stats["shock_sweeps"][1] > 0
    sim.step(100)
    settled = sim.stats()
    assert settled["islands_shock"][2] == 0 and settled["residual"][2] < 1e-6


def test_sweeps_with_impacts_are_counted(device):
    """In the step in which a ball lands on the ground, and in no other."""
    scene = ground_scene(restitution=0.5)
    scene.add_body(Sphere(0.1), position=(0.0, 0.0, 0.2), restitution=0.5)
    sim = Simulator(scene, device=device)
    counts = []
    for _ in range(60):
        sim.step(1)
        counts.append((sim.stats()["impact_sweeps"][0], sim.get("linear_velocity")[0, 1, 2] > 0.0))
    landed = [rises for _, rises in counts].index(True)
    assert 30 < landed < 40  # a fall of 0.1 m takes 34 steps
    assert [count for count, _ in counts] == [int(step == landed) for step in range(60)]


def test_rounds_with_impacts_are_counted(device):
    """A ball lands on a tower, most of whose boxes have no restitution, in an environment that is solved in rounds."""
    scene = ground_scene()
    for k in range(130):
        scene.add_body(Box((0.1,) * 3), position=(0.5 * (k % 13), 0.5 * (k // 13), 0.1))
    for k in range(1, 4):
        scene.add_body(Box((0.1,) * 3), position=(0.0, 0.0, 0.1 + 0.2 * k), restitution=float(k == 3))
    scene.add_body(Sphere(0.1), position=(0.0, 0.0, 0.95), restitution=1.0)
    sim = Simulator(scene, device=device)
    counts = []
    for _ in range(40):
        sim.step(1)
        counts.append([sim.stats()[name][0] for name in ("impact_rounds", "impact_sweeps")])
    rounds, sweeps = np.transpose(counts)
    assert sweeps.sum() == 0 and 1 <= rounds.max() <= sim.settings.collision_iterations
    assert 20 < rounds.argmax() < 30 and np.count_nonzero(rounds) <= 2  # a fall of 0.05 m takes 24 steps


def test_the_accepted_share_is_the_smallest_of_all_islands(device):
    """It is below 1 while bodies fall on each other, and 1 in the air and without shock propagation."""
    sim = Simulator(random_pile(np.random.default_rng(2)), num_envs=2, device=device)
    sim.set("shock_propagation", ["two_pass", "off"])
    shares = []
    for _ in range(100):
        sim.step(1)
        shares.append(sim.stats()["accepted_share"])
    shares = np.array(shares)
    assert (shares >= 0.0).all() and (shares[:, 1] == 1.0).all()
    assert shares[0, 0] == 1.0 and shares[:, 0].min() < 0.99


def test_sweeps_are_those_of_the_settings_where_nothing_converges(device):
    """Cold starts of a stack under its weight: no sweep converges, so all that are allowed are done."""
    iterations = [1, 5, 10]
    scene = ground_scene()
    add_bodies(scene, stacks.CUBE, stacks.column(8))
    sim = Simulator(scene, num_envs=3, settings=Settings(warm_starting=False), device=device)
    sim.set("shock_propagation", ["off"] * 3)
    sim.set("contact_iterations", iterations)
    sim.step(20)
    stats = sim.stats()
    np.testing.assert_array_equal(stats["sweeps"], iterations)
    assert (stats["residual"] > 1e-6).all()
    assert stats["residual"][0] > stats["residual"][2]


def test_sleeping_islands_are_counted(device):
    sim = Simulator(two_stacks(), settings=Settings(sleeping=True), device=device)
    sim.set("position", (5.0, 0.0, 0.1), bodies=[7])
    sim.step(480)
    stats = sim.stats()
    assert sim.get("asleep")[0, 1:].all()
    assert (stats["islands"][0], stats["islands_asleep"][0]) == (3, 3)
    assert stats["islands_shock"][0] == stats["islands_sweeps"][0] == 0


def test_a_reset_environment_has_had_no_step(device):
    sim = Simulator(two_stacks(), num_envs=2, device=device)
    fresh = sim.stats()
    sim.step(10)
    before = sim.stats()
    assert (before["islands"] == 3).all() and (before["sweeps"] > 0).all()
    sim.reset([1])
    for name, values in sim.stats().items():
        if not name.endswith("_used"):
            assert values[0] == before[name][0], name
            assert values[1] == fresh[name][1] == (name == "accepted_share"), name
