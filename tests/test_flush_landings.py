"""Boxes that land flush on a box of equal, half or double width touch it at four corners, and do not turn."""

import itertools

import numpy as np
import pytest

from warp_rigid.engine.settings import Settings
from warp_rigid.engine.simulator import Simulator
from warp_rigid.scene.joints import RevoluteJoint
from warp_rigid.scene.scene import Scene
from warp_rigid.scene.shapes import Box, Plane


def land(half, ratio, drop, free, friction, restitution, dt):
    """A box dropped onto the middle of another one: largest angular velocity, drift, and contacts at rest."""
    scene = Scene()
    below = half * ratio
    material = {"friction": friction, "restitution": restitution}
    if free:
        scene.add_static(Plane(), **material)
        scene.add_body(Box((below,) * 3), position=(0, 0, below), **material)
    else:
        scene.add_static(Box((below,) * 3), position=(0, 0, below), **material)
    body = scene.add_body(Box((half,) * 3), position=(0, 0, 2 * below + half + drop), **material)
    sim = Simulator(scene, settings=Settings(dt=dt), device="cpu")
    spin = drift = 0.0
    for _ in range(round((2.5 if restitution else 1.0) / dt)):
        sim.step(1)
        spin = max(spin, np.abs(sim.get("angular_velocity")[0, body]).max())
        drift = max(drift, np.abs(sim.get("position")[0, body, :2]).max())
    found = sim.contacts()
    return spin, drift, np.sum((found["body_a"] == body) | (found["body_b"] == body))


@pytest.mark.parametrize("free", [False, True], ids=["static", "dynamic"])
def test_an_equal_box_lands_on_four_contacts(free):
    spin, drift, contacts = land(0.1, 1, 0.05, free, 0.6, 0.0, 1 / 240)
    assert (spin < 1e-4, drift < 1e-4, contacts) == (True, True, 4), (spin, drift)


@pytest.mark.parametrize("restitution", [0.3, 0.6])
def test_an_equal_box_bounces_without_turning(restitution):
    spin, drift, contacts = land(0.1, 1, 0.15, False, 0.0, restitution, 1 / 240)
    assert (spin < 1e-4, drift < 1e-4, contacts) == (True, True, 4), (spin, drift)


@pytest.mark.parametrize("joined", [False, True], ids=["body", "mechanism"])
@pytest.mark.parametrize("friction", [0.0, 0.5])
@pytest.mark.parametrize("overhang", [2, 5, 10])
def test_an_elastic_box_bounces_off_a_narrow_base_without_turning(device, overhang, friction, joined):
    """It spun with 0.07 rad/s at 10 : 1, and where joints hold a second box on it, with 2.4 rad/s.

    Two boxes bounce, over the middle of their bases and 1 cm beside it. The contacts of the first get equal impulses.
    """
    offsets = (0.0, 0.01)
    scene = Scene()
    surface = {"restitution": 1.0, "friction": friction}
    boxes = []
    for k, offset in enumerate(offsets):
        scene.add_static(Box((0.5 / overhang, 0.5 / overhang, 0.5)), position=(5 * k, 0, 0.5), **surface)
        boxes.append(scene.add_body(Box((0.5,) * 3), position=(5 * k + offset, 0, 4), **surface))
        if joined:
            top = scene.add_body(Box((0.2,) * 3), position=(5 * k + offset, 0, 4.8), **surface)
            scene.add_joint(RevoluteJoint((0, 0, 1)), top, boxes[k], anchor=(5 * k + offset, 0, 4.6))
    sim = Simulator(scene, device=device)
    sim.step(200)
    assert np.all(sim.get("linear_velocity")[0, boxes, 2] > 5.5)
    spin = np.abs(sim.get("angular_velocity")[0, boxes]).max(axis=1)
    assert spin[0] < 1e-6
    assert spin[1] < (4e-2 if overhang == 10 else 3e-5)


@pytest.mark.long
@pytest.mark.parametrize("dt", [1 / 60, 1 / 240])
@pytest.mark.parametrize("drop", [0.05, 0.5])
@pytest.mark.parametrize("ratio", [1, 2])
@pytest.mark.parametrize("half", [0.05, 0.2])
def test_boxes_of_all_sizes_land_flush(half, ratio, drop, dt):
    """A bouncing box may turn by the rounding of its impulses: by 5e-4 rad/s from 0.5 m."""
    for free, friction in itertools.product((False, True), (0.0, 0.6)):
        spin, drift, contacts = land(half, ratio, drop, free, friction, 0.0, dt)
        assert (spin < 1e-4, drift < 1e-4, contacts) == (True, True, 4), (free, friction, spin, drift)
    spin, drift, contacts = land(half, ratio, drop, False, 0.0, 0.6, dt)
    assert (spin < 5e-4, drift < 1e-4, contacts) == (True, True, 4), (spin, drift)
