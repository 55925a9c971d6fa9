"""Samples that come close to an edge of an immovable body, but miss it, are not stopped there."""

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from tests.oracles import rotate_about
from warp_rigid.engine.settings import Settings
from warp_rigid.engine.simulator import Simulator
from warp_rigid.scene.scene import Scene
from warp_rigid.scene.shapes import Box, Capsule, Compound, Cylinder, Mesh, Sphere

STEPS = pytest.mark.parametrize("dt", [1 / 60, 1 / 240])
HALF = 0.05
TILE = 0.5
LYING = rotate_about((0, 1, 0), 90)
SLIDERS = {
    "box": (Box((HALF,) * 3), rotate_about((0, 0, 1), 0)),
    "turned box": (Box((HALF,) * 3), rotate_about((0, 0, 1), 17)),
    "mesh": (Mesh.from_trimesh(trimesh.creation.box(extents=(2 * HALF,) * 3)), rotate_about((0, 0, 1), 45)),
    "sphere": (Sphere(HALF), rotate_about((0, 0, 1), 0)),
    "cylinder": (Cylinder(HALF, HALF), rotate_about((0, 0, 1), 0)),
    "capsule": (Capsule(HALF, 0.1), LYING),
}


def slide(scene, slider, speed, dt, device):
    """Slide over 4 m of a floor without friction; velocity at the end, and largest deviation from the height."""
    shape, orientation = SLIDERS[slider]
    body = scene.add_body(
        shape, position=(-0.2, 0.013, HALF), orientation=orientation, linear_velocity=(speed, 0, 0), friction=0.0
    )
    sim = Simulator(scene, settings=Settings(dt=dt), device=device)
    jump = 0.0
    for _ in range(round(4 / speed / dt)):
        sim.step(1)
        jump = max(jump, abs(sim.get("position")[0, body, 2] - HALF))
    return sim.get("linear_velocity")[0, body], jump


@STEPS
@pytest.mark.parametrize("speed", [1.0, 3.0])
@pytest.mark.parametrize("slider", list(SLIDERS))
def test_bodies_slide_over_the_tiles_of_a_floor(slider, speed, dt, device):
    scene = Scene()
    for k in range(12):
        scene.add_static(Box((TILE / 2, 0.2, 0.05)), position=(TILE * (k - 0.5), 0, -0.05))
    velocity, jump = slide(scene, slider, speed, dt, device)
    np.testing.assert_allclose(velocity, (speed, 0, 0), atol=1e-3 * speed)
    assert jump < 1e-4


@STEPS
@pytest.mark.parametrize("slider", ["turned box", "sphere"])
def test_bodies_slide_over_the_tiles_of_a_compound(slider, dt, device):
    scene = Scene()
    tile = Box((TILE / 2, 0.2, 0.05))
    scene.add_static(Compound([(tile, (TILE * (k - 0.5), 0, -0.05), (0, 0, 0, 1)) for k in range(12)]))
    velocity, jump = slide(scene, slider, 3.0, dt, device)
    np.testing.assert_allclose(velocity, (3.0, 0, 0), atol=3e-3)
    assert jump < 1e-4


@pytest.mark.parametrize("clearance", [3e-4, 3e-3])
@pytest.mark.parametrize("slider", ["box", "sphere", "turned box"])
def test_a_body_flies_past_a_shelf(slider, clearance, device):
    """A step covers as much as the body's size, so that the edge is within reach of several contacts."""
    shape, orientation = SLIDERS[slider]
    reach = shape.support(np.array([[-1.0, 0.0, 0.0]]) @ trimesh_rotation(orientation))[0]
    for phase in range(8):
        scene = Scene(gravity=(0, 0, 0))
        scene.add_static(Box((0.1, 0.1, 0.01)), position=(-0.1 - clearance, 0, 0))
        place = (reach, 0, 0.2 + 0.05 * phase / 8)
        scene.add_body(shape, position=place, orientation=orientation, linear_velocity=(0, 0, -3))
        sim = Simulator(scene, settings=Settings(dt=1 / 60), device=device)
        sim.step(24)
        np.testing.assert_allclose(sim.get("linear_velocity")[0, 1], (0, 0, -3), atol=1e-6)


def trimesh_rotation(orientation):
    """Rotation matrix of a quaternion (x, y, z, w)."""
    x, y, z, w = orientation
    return trimesh.transformations.quaternion_matrix((w, x, y, z))[:3, :3]


@STEPS
@pytest.mark.parametrize("pin", [Cylinder(0.0098, 0.03), Sphere(0.0098)], ids=["cylinder", "sphere"])
def test_a_pin_falls_through_its_hole(pin, dt, device):
    """The play is 2 % of the radius."""
    scene = Scene()
    plate = trimesh.creation.annulus(r_min=0.01, r_max=0.04, height=0.02, sections=96)
    scene.add_static(Mesh.from_trimesh(plate))
    scene.add_body(pin, position=(0, 0, 0.05))
    sim = Simulator(scene, settings=Settings(dt=dt), device=device)
    sim.step(round(0.25 / dt))
    np.testing.assert_allclose(sim.get("linear_velocity")[0, 1], (0, 0, -9.81 * 0.25), rtol=1e-5, atol=1e-5)


@STEPS
@pytest.mark.parametrize("shape", [SLIDERS["box"][0], SLIDERS["mesh"][0]], ids=["box", "mesh"])
@pytest.mark.parametrize("height", [0.001, 0.01])
def test_a_step_of_the_floor_stops_a_box(shape, height, dt, device):
    """It is as high as 1 % or 10 % of the box, which overlaps it by at most 2 % while it tips over."""
    scene = Scene()
    scene.add_static(Box((1.0, 0.2, 0.05)), position=(-1.0, 0, -0.05))
    scene.add_static(Box((1.0, 0.2, 0.05)), position=(1.0, 0, -0.05 + height))
    scene.add_body(shape, position=(-0.3, 0, HALF), linear_velocity=(1.0, 0, 0), friction=0.0)
    sim = Simulator(scene, settings=Settings(dt=dt), device=device)
    deepest = 0.0
    for _ in range(round(0.5 / dt)):
        sim.step(1)
        deepest = max(deepest, sim.penetration()[0])
    assert sim.get("linear_velocity")[0, 2, 0] < 0.5
    assert deepest < 0.02 * 2 * HALF


def test_boxes_that_slide_over_an_edge_stay_on_it(device):
    """They land at the end of a table while they slide and turn.

    If only the nearest point of an edge is tested, half of them lose contacts and sink in by 20 um.
    """
    scene = Scene()
    scene.add_static(Box((0.5, 0.5, 0.25)), position=(0, 0, -0.25), friction=0.3)
    box = scene.add_body(Box((0.1,) * 3), position=(0.44, 0, 0.104), friction=0.3)
    sim = Simulator(scene, num_envs=128, settings=Settings(dt=1 / 240), device=device)
    generator = np.random.default_rng(1)
    turns = Rotation.from_rotvec(generator.uniform((-0.02, -0.02, -0.7), (0.02, 0.02, 0.7), (128, 3)))
    sim.set("orientation", turns.as_quat()[:, None], bodies=[box])
    sim.set("linear_velocity", generator.uniform((0, -0.3, 0), (0.4, 0.3, 0), (128, 1, 3)), bodies=[box])
    sim.set("angular_velocity", generator.uniform((0, 0, -1), (0, 0, 1), (128, 1, 3)), bodies=[box])
    sim.step(40)
    deepest = np.zeros(128)
    for _ in range(80):
        sim.step()
        deepest = np.maximum(deepest, sim.penetration())
    assert (deepest > 5e-6).sum() <= 3
    assert deepest.max() < 5e-5
