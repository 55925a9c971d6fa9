"""Devices agree in motions that are not chaotic. They round differently, so that those of piles diverge."""

import numpy as np
import pytest

import warp_rigid as wr
from tests.oracles import add_uneven_stack
from warp_rigid.scenes.builders import stacks
from warp_rigid.scenes.builders.grounds import level_scene

LIMIT = 1e-4
"""Largest difference of a position from that on the CPU [m]."""


def thrown():
    """Boxes with three different edges, thrown with spin; one spins about its middle axis, which is unstable."""
    scene = level_scene()
    for k, spin in enumerate(((3, -5, 7), (0.01, 8, 0.01), (0, 0, 20))):
        scene.add_body(wr.Box((0.05, 0.1, 0.2)), position=(0, k, 2), linear_velocity=(2, 1, 3), angular_velocity=spin)
    return scene


def sliding():
    """Boxes at different angles about z that slide to rest."""
    scene = level_scene(friction=0.4)
    for k in range(6):
        half = np.radians(5 * k)
        turn = (0, 0, np.sin(half), np.cos(half))
        scene.add_body(stacks.CUBE, position=(0, k, 0.1), orientation=turn, linear_velocity=(1 + 0.2 * k, 0, 0))
    return scene


def stack():
    """Five boxes, each rotated by 0.2 rad relative to the one below."""
    scene = level_scene()
    add_uneven_stack(scene, 5, twist=0.2)
    return scene


def slope():
    """Boxes on a slope of 25 degrees: two slide, one just slips and one just sticks."""
    tilt = np.radians(25)
    scene = level_scene(gravity=(9.81 * np.sin(tilt), 0, -9.81 * np.cos(tilt)))
    for k, friction in enumerate((0.1, 0.3, 0.45, 0.48)):
        scene.add_body(stacks.CUBE, position=(0, k, 0.1), friction=friction)
    return scene


def rolling():
    """Balls and a cylinder that first slide and then roll; some roll to a stop."""
    scene, start = level_scene(friction=0.3), {"linear_velocity": (2, 0, 0)}
    for k, resistance in enumerate((0.0, 0.001, 0.005)):
        scene.add_body(wr.Sphere(0.1), position=(0, k, 0.1), rolling_friction=resistance, **start)
    on_its_side = (np.sqrt(0.5), 0, 0, np.sqrt(0.5))
    scene.add_body(wr.Cylinder(0.1, 0.1), position=(0, 3, 0.1), orientation=on_its_side, **start)
    return scene


def bouncing():
    """Thrown balls with different restitution that bounce."""
    scene, start = level_scene(restitution=1.0), {"linear_velocity": (1, 0, 0), "angular_velocity": (0, 9, 3)}
    for k in range(5):
        scene.add_body(wr.Sphere(0.1), position=(0, k, 1), restitution=0.2 * k, **start)
    return scene


@pytest.mark.parametrize(
    ("build", "steps"), [(thrown, 225), (sliding, 240), (stack, 480), (slope, 240), (rolling, 480), (bouncing, 480)]
)
def test_devices_agree_as_long_as_nothing_is_chaotic(device, build, steps):
    """On the CPU a second simulator passes the same bits."""
    one, other = (wr.Simulator(build(), device=where) for where in ("cpu", device))
    apart = 0.0
    for _ in range(0, steps, 15):
        one.step(15)
        other.step(15)
        apart = max(apart, np.linalg.norm(one.get("position") - other.get("position"), axis=-1).max())
    assert apart <= (0.0 if device == "cpu" else LIMIT)
