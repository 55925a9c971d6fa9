"""Scenes scaled by a power of four, with time steps scaled by its root, agree, with overlaps or joints too."""

import numpy as np
import pytest

from tests.oracles import rotate_about
from warp_rigid.engine.settings import Settings
from warp_rigid.engine.simulator import Simulator
from warp_rigid.scene.joints import FixedJoint, PrismaticJoint, RevoluteJoint, SphericalJoint
from warp_rigid.scene.scene import Scene
from warp_rigid.scene.shapes import Box, Capsule, Plane, Sphere

DT, STEPS = 1 / 240, 60


def places(scale, gravity):
    """Positions over the scale after some steps, of bodies that overlap by up to a quarter of their size at the start.

    The time step and its root are exact in float32, so that only the scale of rounding errors changes.
    """
    scene = Scene(gravity=(0, 0, -gravity))
    scene.add_static(Plane())
    scene.add_body(Box((0.1 * scale,) * 3), position=(0, 0, 0.1 * scale))
    scene.add_body(Box((0.1 * scale,) * 3), position=scale * np.array([0.03, 0.02, 0.22]))
    scene.add_body(Sphere(0.1 * scale), position=scale * np.array([0.12, 0.02, 0.12]))
    turned = rotate_about((1, 2, 3), 40)
    scene.add_body(Capsule(0.06 * scale, 0.1 * scale), position=scale * np.array([-0.1, 0.05, 0.1]), orientation=turned)
    sim = Simulator(scene, settings=Settings(dt=DT * np.sqrt(scale)), device="cpu")
    found = []
    for _ in range(STEPS):
        sim.step(1)
        found.append(sim.get("position")[0, 1:] / scale)
    return np.array(found)


@pytest.mark.parametrize("gravity", [0.0, 9.81])
@pytest.mark.parametrize("scale", [1 / 256, 1 / 16, 1 / 4, 4, 16])
def test_overlapping_bodies_part_alike_at_every_scale(scale, gravity):
    """Solvers end at velocity changes in proportion to what gravity adds in a step, and at absolute ones without it.

    Measured: up to 4e-6 of 0.2 m with gravity, 1.3e-5 without.
    """
    atol = 1e-5 if gravity > 0 else 3e-5
    np.testing.assert_allclose(places(scale, gravity), places(1, gravity), atol=atol)


def mechanism(scale, joint):
    """Positions over the scale of a box, a bar and a ball in a row that fall, land and stay joined."""
    scene = Scene()
    scene.add_static(Plane())
    box = scene.add_body(Box((0.1 * scale,) * 3), position=(0, 0, 0.5 * scale))
    bar = scene.add_body(Box(scale * np.array([0.1, 0.05, 0.05])), position=(0.3 * scale, 0, 0.5 * scale))
    ball = scene.add_body(Sphere(0.05 * scale), position=scale * np.array([0.45, 0.01, 0.5]))
    scene.add_joint(joint, bar, box, anchor=(0.2 * scale, 0, 0.5 * scale))
    scene.add_joint(SphericalJoint(), ball, bar, anchor=(0.4 * scale, 0, 0.5 * scale))
    sim = Simulator(scene, settings=Settings(dt=DT * np.sqrt(scale)), device="cpu")
    found = []
    for _ in range(2 * STEPS):
        sim.step(1)
        found.append(sim.get("position")[0, 1:] / scale)
    return np.array(found)


@pytest.mark.parametrize(
    "joint",
    [SphericalJoint(), RevoluteJoint((0, 1, 0)), FixedJoint(), PrismaticJoint((1, 0, 0))],
    ids=lambda joint: type(joint).__name__,
)
@pytest.mark.parametrize("scale", [1 / 64, 1 / 16, 1 / 4, 4, 16])
def test_bodies_with_joints_land_alike_at_every_scale(scale, joint):
    """Measured: up to 3e-6 of 0.4 m."""
    np.testing.assert_allclose(mechanism(scale, joint), mechanism(1, joint), atol=6e-6)
