"""Bodies that a turning or curving kinematic body carries stay where they are on it."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from warp_rigid.engine.settings import Settings
from warp_rigid.engine.simulator import Simulator
from warp_rigid.scene.scene import Scene
from warp_rigid.scene.shapes import Box, Cylinder, Sphere

HALF, FRICTION, SPIN = 0.05, 0.5, 2.0
TABLE = Cylinder(1.0, 0.05)
STEPS = pytest.mark.parametrize("dt", [1 / 60, 1 / 240, 1 / 480])


def places_on(sim):
    """Positions of all bodies but the first, in the frame of the first one [m]."""
    position = sim.get("position")[0].astype(float)
    return Rotation.from_quat(sim.get("orientation")[0, 0]).inv().apply(position[1:] - position[0])


def drift(scene, dt, move=None, settle=0.0, time=10.0):
    """Largest motion of a carried body in the frame of its carrier [m]; `move` sets velocities before each step."""
    sim = Simulator(scene, settings=Settings(dt=dt), device="cpu")
    start = places_on(sim)
    for k in range(round(time / dt)):
        if move:
            sim.set(*move(k * dt), bodies=[0])
        sim.step(1)
        if k == round(settle / dt):
            start = places_on(sim)
    return np.abs(places_on(sim) - start).max()


def add_riders(scene, radii, spin, stack=1, friction=FRICTION, center=(0, 0, 0)):
    """Boxes, or stacks of them, that move with a table."""
    for k, radius in enumerate(radii):
        way = np.array([np.cos(k), np.sin(k), 0])
        for level in range(stack):
            scene.add_body(
                Box((HALF,) * 3),
                position=radius * way + center + (0, 0, HALF * (1 + 2 * level)),
                linear_velocity=spin * radius * np.array([-way[1], way[0], 0]),
                angular_velocity=(0, 0, spin),
                friction=friction,
            )


@STEPS
def test_boxes_stay_on_a_turntable(dt):
    """All are below their friction limit of 1.23 m."""
    scene = Scene()
    scene.add_kinematic(TABLE, position=(0, 0, -0.05), angular_velocity=(0, 0, SPIN), friction=FRICTION)
    add_riders(scene, (0.2, 0.4, 0.6, 0.9), SPIN)
    assert drift(scene, dt) < 1e-4


@STEPS
def test_boxes_stay_on_a_surface_that_turns(dt):
    """Two boxes go round on a turntable at rest whose surface turns, about a place that its velocity determines."""
    scene, middle = Scene(), np.array([0.1, 0, 0])
    scene.add_static(
        TABLE,
        position=(0, 0, -0.05),
        surface_velocity=(0, -SPIN * middle[0], 0),
        surface_angular_velocity=(0, 0, SPIN),
        friction=FRICTION,
    )
    add_riders(scene, (0.3, 0.7), SPIN, center=middle)
    sim = Simulator(scene, settings=Settings(dt=dt), device="cpu")
    sim.step(round(10.0 / dt))
    radii = np.linalg.norm(sim.get("position")[0, 1:, :2] - middle[:2], axis=1)
    np.testing.assert_allclose(radii, (0.3, 0.7), atol=2e-4)
    assert sim.get("angular_velocity")[0, 1:, 2] == pytest.approx(SPIN, rel=1e-3)


@pytest.mark.parametrize("dt", [1 / 60, 1 / 240])
@pytest.mark.parametrize("kind", ["round", "square", "running"])
def test_a_ball_on_a_turntable_rolls_on_a_circle(dt, kind):
    """With 2/7 of its angular velocity, and constant speed."""
    scene, spin = Scene(), (0, 0, 3.0)
    if kind == "running":
        scene.add_static(Cylinder(20, 0.05), position=(0, 0, -0.05), surface_angular_velocity=spin, friction=1.0)
    else:
        table = Cylinder(20, 0.05) if kind == "round" else Box((20, 20, 0.05))
        scene.add_kinematic(table, position=(0, 0, -0.05), angular_velocity=spin, friction=1.0)
    scene.add_body(
        Sphere(0.1), position=(0, 0, 0.1), linear_velocity=(0.5, 0, 0), angular_velocity=(0, 5, 0), friction=1.0
    )
    sim = Simulator(scene, settings=Settings(dt=dt), device="cpu")
    sim.step(round(5 * 7 / 2 * 2 * np.pi / 3.0 / dt))
    assert np.linalg.norm(sim.get("linear_velocity")[0, 1]) == pytest.approx(0.5, rel=1e-3)
    np.testing.assert_allclose(sim.get("position")[0, 1], (0, 0, 0.1), atol=0.02)


def test_stacks_of_three_stay_on_a_turntable():
    """They topple where omega^2 r exceeds g / 3, 0.82 m from the axis."""
    scene = Scene()
    scene.add_kinematic(TABLE, position=(0, 0, -0.05), angular_velocity=(0, 0, SPIN), friction=FRICTION)
    add_riders(scene, (0.2, 0.6), SPIN, stack=3)
    assert drift(scene, 1 / 240) < 1e-4


def test_a_box_beyond_its_friction_limit_slides_off():
    scene = Scene()
    scene.add_kinematic(TABLE, position=(0, 0, -0.05), angular_velocity=(0, 0, SPIN), friction=0.3)
    add_riders(scene, (0.8,), SPIN, friction=0.3)
    assert drift(scene, 1 / 240, time=2.0) > 0.1


@pytest.mark.parametrize("dt", [1 / 60, 1 / 240])
def test_boxes_stay_on_a_platform_that_moves_on_a_circle(dt):
    """It does not turn. Its velocity in a step is that along the chord."""
    radius = 0.5

    def move(time):
        angles = SPIN * np.array([time, time + dt])
        return "linear_velocity", (*radius * np.diff([np.cos(angles), np.sin(angles)], axis=1)[:, 0] / dt, 0)

    scene = Scene()
    scene.add_kinematic(Box((0.3, 0.3, 0.02)), position=(radius, 0, -0.02), friction=FRICTION)
    for x in (0.3, 0.5, 0.7):
        scene.add_body(
            Box((HALF,) * 3), position=(x, 0, HALF), linear_velocity=(0, SPIN * radius, 0), friction=FRICTION
        )
    assert drift(scene, dt, move) < 1e-4


@pytest.mark.parametrize("dt", [1 / 60, 1 / 240])
def test_boxes_stay_on_a_rocking_seesaw(dt):
    """It tilts by 0.15 rad to either side, once in two seconds; without the chord the boxes creep by 2 and 7 mm."""

    def move(time):
        angle = 0.15 * np.sin(np.pi * np.array([time, time + dt]))
        return "angular_velocity", (0, (angle[1] - angle[0]) / dt, 0)

    scene = Scene()
    scene.add_kinematic(Box((1.0, 0.2, 0.02)), position=(0, 0, -0.02), friction=FRICTION)
    for x in (-0.8, -0.3, 0.3, 0.8):
        scene.add_body(Box((HALF,) * 3), position=(x, 0, HALF), friction=FRICTION)
    assert drift(scene, dt, move, settle=0.5) < 1e-4


def test_a_ball_without_friction_goes_straight_on_over_a_turntable():
    """Nothing but friction carries."""
    scene = Scene()
    scene.add_kinematic(TABLE, position=(0, 0, -0.05), angular_velocity=(0, 0, 5.0), friction=0.0)
    scene.add_body(Sphere(HALF), position=(-0.5, 0.2, HALF), linear_velocity=(1, 0, 0), friction=0.0)
    sim = Simulator(scene, device="cpu")
    sim.step(240)
    np.testing.assert_allclose(sim.get("position")[0, 1], (0.5, 0.2, HALF), atol=1e-5)
