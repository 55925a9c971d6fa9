"""Walls and stacks at rest: few sweeps and no creep, but whatever would move, moves."""

import numpy as np
import pytest

from tests.oracles import ground_scene, stages_of
from warp_rigid.engine.settings import Settings
from warp_rigid.engine.simulator import Simulator
from warp_rigid.scene.scene import Scene
from warp_rigid.scene.shapes import Box
from warp_rigid.scenes.builders import stacks
from warp_rigid.scenes.builders.bodies import add_bodies

BRICK = (0.1, 0.2, 0.1)
CUBES = 10


def wall(rows, bricks):
    """A wall of bricks in running bond; neighbours in a row touch."""
    scene = ground_scene(friction=0.6)
    places = [(0.0, 0.4 * k + 0.1 * (row % 2), 0.1 + 0.2 * row) for row in range(rows) for k in range(bricks)]
    add_bodies(scene, Box(BRICK), np.array(places), names="brick", friction=0.6)
    return scene


def stack_on(scene, friction):
    """A stack of cubes on the scene's ground."""
    add_bodies(scene, stacks.CUBE, stacks.column(CUBES), friction=friction)
    return scene


def tilted(tangent):
    """Gravity with this ratio of its horizontal to its vertical part."""
    direction = np.array([tangent, 0.0, -1.0])
    return 9.81 * direction / np.linalg.norm(direction)


def moved(sim, seconds):
    """Largest displacement of a body [m] within a time."""
    start = sim.get("position")
    sim.step(round(seconds / sim.settings.dt))
    return np.abs(sim.get("position") - start).max()


@pytest.mark.parametrize("rate", [60, 240])
def test_a_wall_at_rest_needs_few_sweeps_and_does_not_creep(device, rate):
    """It bends by errors of the solver, which shock propagation would not remove in more than 100 sweeps a step."""
    sim = Simulator(wall(20, 8), settings=Settings(dt=1 / rate), device=device)
    sim.step(rate // 2)
    start, sweeps = sim.get("position"), []
    for _ in range(rate // 2):
        sim.step(1)
        sweeps.append(sim.stats()["sweeps"][0] + sim.stats()["shock_sweeps"][0])
    assert np.mean(sweeps) < 6
    assert np.array_equal(sim.get("position"), start)


def test_a_wall_at_rest_falls_when_it_is_hit(device):
    sim = Simulator(wall(20, 4), settings=Settings(dt=1 / 60), device=device)
    sim.step(30)
    assert stages_of(sim).pools.graph.resting.numpy().any()
    sim.set("linear_velocity", (3.0, 0.0, 0.0), bodies=[78])
    assert moved(sim, 1.0) > 1.0


@pytest.mark.parametrize("rate", [60, 240])
def test_a_stack_at_rest_topples_just_beyond_its_limit(device, rate):
    """Beyond the limit by a part of 3e-4, it gains less than SLOW in the first step, but presses on an edge only."""
    for beyond, least, most in ((-1e-2, 0.0, 1e-5), (3e-4, 0.1, np.inf)):
        sim = Simulator(stack_on(ground_scene(friction=1.0), 1.0), settings=Settings(dt=1 / rate), device=device)
        sim.step(rate // 2)
        sim.set("gravity", tilted((1.0 + beyond) / CUBES))
        assert least <= moved(sim, 4.0) <= most


def test_a_stack_at_rest_slides_just_beyond_its_limit(device):
    """It gains half of SLOW in a step."""
    for beyond, least, most in ((-1e-2, 0.0, 1e-5), (3e-3, 5e-4, 1e-2)):
        sim = Simulator(stack_on(ground_scene(friction=0.09), 1.0), settings=Settings(dt=1 / 60), device=device)
        sim.step(30)
        sim.set("gravity", tilted(0.09 * (1.0 + beyond)))
        assert least <= moved(sim, 1.0) <= most


def test_a_stack_moves_with_its_ground_however_slowly(device):
    scene, speed = Scene(), 2e-5
    scene.add_kinematic(Box((1.0, 1.0, 0.1)), position=(0, 0, -0.1), linear_velocity=(speed, 0, 0), friction=0.5)
    sim = Simulator(stack_on(scene, 0.5), settings=Settings(dt=1 / 60), device=device)
    sim.step(60)
    assert moved(sim, 5.0) == pytest.approx(5.0 * speed, rel=0.05)
