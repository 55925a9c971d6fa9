"""Heaps that land: bodies that are hit within a step do not drive each other into one another."""

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from tests.oracles import stages_of
from warp_rigid.bench.cases import find_case
from warp_rigid.engine.cores import shared_by, usable_cores
from warp_rigid.engine.settings import Settings
from warp_rigid.engine.simulator import Simulator
from warp_rigid.rotations import about_axis
from warp_rigid.scene.scene import Scene
from warp_rigid.scene.shapes import Box, Plane, Sphere

HALF = 0.1
CUBE = Box((HALF,) * 3)


@pytest.mark.long
@pytest.mark.parametrize("bodies, steps, deepest", [(512, 2, 0.014), (216, 2, 0.012), (216, 1, 0.03)])
def test_a_heap_that_lands_overlaps_little(device, bodies, steps, deepest):
    """Cubes of 0.2 m that fall into a bin, over the first second; without common courses they overlap 2 to 8 times as
    much."""
    case = find_case(f"pile_box:{bodies}")
    sim = Simulator(case.build(), settings=Settings(dt=1 / 60 / steps), device=device)
    case.scatter(sim)
    overlaps = []
    for _ in range(30):
        sim.step(2 * steps)
        overlaps.append(sim.penetration().max())
    assert max(overlaps) < deepest


@pytest.mark.parametrize("dt", [1 / 60, 1 / 240])
@pytest.mark.parametrize("drop", [0.3, 3.0])
@pytest.mark.parametrize("count", [4, 10])
def test_a_column_that_lands_overlaps_little(device, count, drop, dt):
    """All its cubes stop in one step, one after the other."""
    scene = Scene()
    scene.add_static(Plane())
    for k in range(count):
        scene.add_body(CUBE, position=(0.006 * k, 0, drop + HALF + k * (2 * HALF + 0.002)))
    sim = Simulator(scene, settings=Settings(dt=dt), device=device)
    deepest = 0.0
    for _ in range(round(1.0 / dt)):
        sim.step()
        deepest = max(deepest, sim.penetration()[0])
    assert deepest < 0.05 * 2 * HALF


def test_rounds_end_when_motions_hardly_change(device):
    """Cubes that land in 16 bins at once, one step per frame: bodies between others are hit by both in turn."""
    case = find_case("pile_box:32")
    with shared_by(usable_cores()):  # one core, so one shard
        sim = Simulator(case.build(), num_envs=16, settings=Settings(dt=1 / 60), device=device)
    case.scatter(sim)
    sim.step(15)
    rounds, overlaps = [], []
    for _ in range(15):
        sim.step()
        rounds.append(int(stages_of(sim).pools.suspects.iteration.numpy()[0]))
        overlaps.append(sim.penetration())
    assert np.mean(rounds) < 7
    assert np.mean(overlaps) < 0.022 * 2 * HALF


@pytest.mark.parametrize("tilt", [0.02, 0.05, 0.08])
def test_a_deep_overlap_keeps_the_contacts_that_support(device, tilt):
    """A cube that is tilted by up to 5 degrees and has sunk into another one by up to a fifth of its size.

    The part of its lower face that is inside reaches over more than half of the face, and so must the contacts.
    """
    scene = Scene(gravity=(0, 0, -10))
    scene.add_static(Box((0.5, 0.5, HALF)))
    scene.add_body(CUBE)
    angles = np.linspace(0.1, 3.0, 8)
    sim = Simulator(scene, num_envs=len(angles), device=device)
    turn = [about_axis((np.cos(angle), np.sin(angle), 0.0), tilt) for angle in angles]
    sim.set("orientation", np.array(turn)[:, None], bodies=[1])
    sim.set("position", (0.01, -0.02, 2 * HALF - 0.03), bodies=[1])
    sim.step()
    contacts = sim.contacts()
    for env in range(len(angles)):
        deep = contacts["position"][(contacts["env"] == env) & (contacts["depth"] > 0.0)]
        assert len(deep) >= 3, env
        assert ConvexHull(deep[:, :2]).volume > 0.5 * (2 * HALF) ** 2, env


def test_a_body_that_is_hit_moves_on_with_the_slower_one(device):
    """A cube at 16 m/s reaches one that moves ahead of it at 8 m/s in the step, from further than contacts reach."""
    dt, gap, fast, slow = 1 / 30, 0.1, -16.0, -8.0
    scene = Scene(gravity=(0, 0, 0))
    scene.add_body(CUBE, linear_velocity=(0, 0, slow))
    scene.add_body(CUBE, position=(0.01, 0.02, 2 * HALF + gap), linear_velocity=(0, 0, fast))
    scene.add_body(CUBE, position=(0.03, -0.01, 4 * HALF + gap + 0.005), linear_velocity=(0, 0, fast))
    sim = Simulator(scene, settings=Settings(dt=dt), device=device)
    sim.step()
    z = sim.get("position")[0, :, 2]
    assert z[0] == pytest.approx(dt * slow, rel=1e-6)
    np.testing.assert_allclose(np.diff(z), 2 * HALF, atol=0.02 * 2 * HALF + 1e-6)
    sim.step(4)
    assert sim.penetration()[0] < 0.02 * 2 * HALF
    assert sim.get("linear_velocity")[0, :, 2].sum() == pytest.approx(slow + 2 * fast, rel=1e-5)


def test_a_kinematic_body_keeps_its_course(device):
    """However fast the bodies are that hit it, and whatever part of the step is left."""
    dt, count = 1 / 60, 12
    scene = Scene(gravity=(0, 0, 0))
    scene.add_kinematic(Box((0.5, 0.5, 0.02)), linear_velocity=(0, 0, 1.0), angular_velocity=(0, 0, 2.0))
    scene.add_body(Sphere(0.05), linear_velocity=(0, 0, -60.0))
    sim = Simulator(scene, num_envs=count, settings=Settings(dt=dt), device=device)
    sim.set("position", [[(0.2, 0, 0.1 + gap)] for gap in np.linspace(0.0, 1.5, count)], bodies=[1])
    for step in range(1, 5):
        sim.step()
        np.testing.assert_allclose(sim.get("position")[:, 0, 2], step * dt, rtol=1e-5)
        assert (sim.get("position")[:, 1, 2] > sim.get("position")[:, 0, 2] + 0.05).all()
    np.testing.assert_allclose(sim.get("orientation")[:, 0], [about_axis((0, 0, 1), 4 * dt * 2.0)] * count, atol=1e-5)
