"""Round kinematic bodies that spin: their surface stays in place, and moves others along it by friction alone."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from warp_rigid.engine.settings import Settings
from warp_rigid.engine.simulator import Simulator
from warp_rigid.scene.scene import Scene
from warp_rigid.scene.shapes import Box, Capsule, Cylinder, Sphere

ACROSS = Rotation.from_euler("x", np.pi / 2).as_quat()
RADIUS, THICKNESS = 0.1, 0.04
ROLLER = Cylinder(RADIUS, 0.3)


def add_rollers(scene, places, speeds, friction, roller=ROLLER):
    """Kinematic rollers about the y axis, whose tops are at z = 0 [m, rad/s]."""
    for x, speed in zip(places, speeds, strict=True):
        scene.add_kinematic(
            roller, position=(x, 0, -RADIUS), orientation=ACROSS, angular_velocity=(0, speed, 0), friction=friction
        )


def add_plank(scene, x, friction):
    """A plank of 1 m on rollers."""
    half = 0.5 * THICKNESS
    scene.add_body(Box((0.5, 0.2, half)), position=(x, 0, half), friction=friction, mass=10.0)


@pytest.mark.parametrize("shape", [Cylinder(0.2, 0.2), Sphere(0.2)], ids=["cylinder", "sphere"])
@pytest.mark.parametrize(("spin", "speed", "dt"), [(30, 0.3, 1 / 240), (100, 2.0, 1 / 240), (5, 0.5, 1 / 60)])
def test_a_ball_bounces_off_a_spinning_body_as_off_one_at_rest(shape, spin, speed, dt, device):
    """Without friction, it leaves with e times its speed; such balls lost half of it, or flew through the body."""
    scene = Scene(gravity=(0, 0, 0))
    scene.add_kinematic(shape, angular_velocity=(0, 0, spin), friction=0.0, restitution=0.8)
    scene.add_body(Sphere(0.05), position=(0.27, 0, 0), linear_velocity=(-speed, 0, 0), friction=0.0, restitution=0.8)
    sim = Simulator(scene, settings=Settings(dt=dt), device=device)
    sim.step(round((0.02 / speed + 0.1) / dt))
    np.testing.assert_allclose(sim.get("linear_velocity")[0, 1], (0.8 * speed, 0, 0), atol=1e-4 * speed)


@pytest.mark.parametrize(
    ("spin", "dt", "roller"),
    [
        (10, 1 / 60, ROLLER),
        (10, 1 / 240, ROLLER),
        (40, 1 / 240, ROLLER),
        pytest.param(15, 1 / 480, ROLLER, marks=pytest.mark.long),
        (20, 1 / 240, Capsule(RADIUS, 0.3)),
    ],
)
def test_a_plank_without_friction_lies_still_on_rollers_that_spin(spin, dt, roller, device):
    """They turn in opposite directions. It was thrown up, or fell through; its ends come up by 0.04 mm."""
    scene = Scene()
    add_rollers(scene, (-0.3, 0.3), (spin, -spin), 0.0, roller)
    add_plank(scene, 0.0, 0.0)
    sim = Simulator(scene, settings=Settings(dt=dt), device=device)
    heights = []
    for _ in range(round(1 / dt)):
        sim.step(1)
        heights.append(sim.get("position")[0, 2, 2])
    assert np.abs(np.array(heights) - 0.5 * THICKNESS).max() < 1e-4


def test_rollers_convey_a_plank_at_the_speed_of_their_surface(device):
    """It starts with the acceleration of sliding friction, and stays down."""
    friction, speed, dt = 0.5, 2.0, 1 / 240
    scene = Scene()
    places = np.arange(-2.5, 2.6, 0.25)
    add_rollers(scene, places, np.full(len(places), speed / RADIUS), friction)
    add_plank(scene, -1.9, friction)
    sim = Simulator(scene, settings=Settings(dt=dt), device=device)
    sim.step(60)
    assert abs(sim.get("linear_velocity")[0, -1, 0] - 9.81 * friction * 60 * dt) < 0.01
    sim.step(180)
    np.testing.assert_allclose(sim.get("linear_velocity")[0, -1], (speed, 0, 0), atol=0.01)
    assert abs(sim.get("position")[0, -1, 2] - 0.5 * THICKNESS) < 1e-4


@pytest.mark.parametrize("shape", [Capsule(0.01, 1.0), Cylinder(0.01, 1.0)], ids=["capsule", "cylinder"])
def test_a_rod_that_tumbles_and_spins_hits_all_balls_in_its_way(shape, device):
    """Its end moves by 83 mm a step, on a cone; it overlaps the balls of 10 mm by up to 1.2 mm."""
    num_envs, dt, angular = 64, 1 / 240, np.array([0.0, 20.0, 300.0])
    scene = Scene(gravity=(0, 0, 0))
    scene.add_kinematic(shape, angular_velocity=angular, friction=0.0, restitution=0.0)
    scene.add_body(Sphere(0.01), friction=0.0, restitution=0.0)
    sim = Simulator(scene, num_envs, Settings(dt=dt), device=device)
    generator = np.random.default_rng(0)
    turns = Rotation.from_rotvec(generator.uniform(0.5, 3.9, (num_envs, 1)) * dt * angular)
    places = turns.apply((0, 0, 1)) * generator.uniform(0.7, 0.95, (num_envs, 1))
    sim.set("position", places[:, None], bodies=[1])
    deepest = np.zeros(num_envs)
    for _ in range(6):
        sim.step(1)
        deepest = np.maximum(deepest, sim.penetration())
    met = np.linalg.norm(places[:, :2], axis=1) > 0.021
    assert met.sum() > 50 and (np.linalg.norm(sim.get("linear_velocity")[met, 1], axis=-1) > 0.1).all()
    assert deepest[met].max() < 2.5e-3
