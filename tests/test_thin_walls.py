"""Meshes with walls thinner than a cell of their distance grid: nothing passes through them."""

import numpy as np
import pytest
import trimesh

import warp_rigid as wr
from warp_rigid import rotations
from warp_rigid.scenes.builders import meshes

SIZE = 0.3
DEEPEST = 1e-3
"""Overlap that is allowed [m]."""


def tray(wall, height=0.06):
    """A square tray, open at the top, 0.3 m wide; its lower side is at z = 0."""
    outside = 0.5 * SIZE * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    inside = outside * (1 - 2 * wall / SIZE)
    rings = [(outside, 0.0), (outside, height), (inside, height), (inside, wall)]
    vertices = np.concatenate([np.column_stack([ring, np.full(4, z)]) for ring, z in rings])
    return wr.Mesh(vertices, np.concatenate([[(0, 2, 1), (0, 3, 2), (12, 13, 14), (12, 14, 15)], strips(3, 4)]))


def cup(wall, height=0.2, around=32):
    """A round cup; its lower side is at z = 0."""
    angle = 2 * np.pi * np.arange(around) / around
    circle = np.column_stack([np.cos(angle), np.sin(angle)])
    outer, inner = 0.5 * SIZE, 0.5 * SIZE - wall
    rings = [(outer, 0.0), (outer, height), (inner, height), (inner, wall)]
    rows = [np.column_stack([radius * circle, np.full(around, z)]) for radius, z in rings]
    last = 4 * around
    next_place = (np.arange(around) + 1) % around
    floor = np.column_stack([np.full(around, last), next_place, np.arange(around)])
    top = np.column_stack([np.full(around, last + 1), 3 * around + np.arange(around), 3 * around + next_place])
    vertices = np.concatenate([*rows, [[0, 0, 0], [0, 0, wall]]])
    return wr.Mesh(vertices, np.concatenate([floor, top, strips(3, around)]))


def strips(count, around):
    """Triangles between consecutive rings of vertices."""
    faces = []
    for ring in range(count):
        for k in range(around):
            a, b = ring * around + k, ring * around + (k + 1) % around
            faces += [(a, b, b + around), (a, b + around, a + around)]
    return faces


VESSELS = {"tray": tray, "cup": cup}
BODIES = {"ball": wr.Sphere(0.02), "box": wr.Box((0.02, 0.02, 0.02)), "rod": wr.Capsule(0.01, 0.03)}


def dropped(device, vessel, body, height, steps=480):
    """Pose, speed and deepest overlap of a body dropped into a vessel, at several places above its floor."""
    scene = wr.Scene()
    scene.add_static(vessel)
    scene.add_body(body)
    generator = np.random.default_rng(2)
    sim = wr.Simulator(scene, num_envs=6, device=device)
    sim.set("position", (generator.uniform((-0.05, -0.05, height), (0.05, 0.05, height), (6, 3)))[:, None], bodies=[1])
    turns = generator.normal(size=(6, 1, 4))
    sim.set("orientation", turns / np.linalg.norm(turns, axis=2, keepdims=True), bodies=[1])
    deepest = np.zeros(6)
    for _ in range(steps // 10):
        sim.step(10)
        deepest = np.maximum(deepest, sim.penetration())
    return sim.get("position")[:, 1], sim.get("linear_velocity")[:, 1], deepest


@pytest.mark.parametrize("share", [200, 100, 50])
@pytest.mark.parametrize("body", BODIES)
@pytest.mark.parametrize("vessel", VESSELS)
def test_bodies_stay_in_a_vessel_with_thin_walls(device, vessel, body, share):
    """Walls of 1/200, 1/100 and 1/50 of the width, where a cell is 1/64: a body dropped from one width stays inside."""
    place, speed, deepest = dropped(device, VESSELS[vessel](SIZE / share), BODIES[body], SIZE)
    assert (place[:, 2] > 0.0).all()
    assert (np.abs(place[:, :2]) < 0.5 * SIZE).all()
    assert deepest.max() < DEEPEST
    assert np.abs(speed).max() < 0.5


@pytest.mark.parametrize(
    ("body", "speed"),
    [
        *((body, speed) for body in BODIES for speed in (5.0, 20.0)),
        ("bunny", 20.0),
        pytest.param("bunny", 5.0, marks=pytest.mark.long),
    ],
)
def test_a_wall_of_a_thousandth_stops_what_moves_twice_its_size_in_a_step(device, body, speed):
    """0.3 mm, at 1/240 s. The walls are high, as what lands on a corner jumps out of a low tray."""
    count = 24
    scene = wr.Scene()
    scene.add_static(tray(SIZE / 1000, height=0.3))
    scene.add_body(BODIES.get(body) or meshes.bunny(0.05, sdf_resolution=32))
    generator = np.random.default_rng(1)
    sim = wr.Simulator(scene, num_envs=count, device=device)
    sim.set("position", generator.uniform((-0.05, -0.05, 0.06), (0.05, 0.05, 0.12), (count, 3))[:, None], bodies=[1])
    turns = generator.normal(size=(count, 1, 4))
    sim.set("orientation", turns / np.linalg.norm(turns, axis=2, keepdims=True), bodies=[1])
    sim.set("linear_velocity", (0, 0, -speed), bodies=[1])
    sim.set("angular_velocity", generator.normal(scale=5.0, size=(count, 1, 3)), bodies=[1])
    sim.step(120)
    assert (sim.get("center_of_mass")[:, 1, 2] > 0.0).all()


@pytest.mark.parametrize("thickness", [0.05, 0.02, 0.005])
@pytest.mark.parametrize("body", ["ball", "box", "rod"])
def test_a_plate_thinner_than_a_cell_carries(device, body, thickness):
    """A plate of 4 m has cells of 62.5 mm: what falls on it comes to rest on its upper face."""
    plate = wr.Mesh.from_trimesh(trimesh.creation.box((4, 4, thickness)))
    lowest = {"ball": 0.02, "box": 0.02, "rod": 0.01}[body]
    place, speed, deepest = dropped(device, plate, BODIES[body], 0.5)
    np.testing.assert_allclose(place[:, 2], 0.5 * thickness + lowest, atol=2e-4)
    assert deepest.max() < DEEPEST and np.abs(speed[:, 2]).max() < 1e-3


@pytest.mark.parametrize("speed", [0.5, 2.0, 10.0])
def test_two_thin_plates_do_not_pass_each_other(device, speed):
    """A plate of 1 mm thrown onto another, flat and slightly tilted: it stays on its side of the held one."""
    plate = wr.Mesh.from_trimesh(trimesh.creation.box((0.3, 0.3, 1e-3)))
    scene = wr.Scene(gravity=(0, 0, 0))
    scene.add_static(plate)
    scene.add_body(plate, linear_velocity=(0, 0, -speed))
    sim = wr.Simulator(scene, num_envs=4, device=device)
    generator = np.random.default_rng(5)
    tilt = np.array([[0, 0, 0], [0.01, 0, 0], [0.02, 0.01, 0.3], [0.05, -0.05, 0.8]])
    turns = np.column_stack([tilt, np.ones(4)])
    sim.set("orientation", (turns / np.linalg.norm(turns, axis=1, keepdims=True))[:, None], bodies=[1])
    sim.set("position", (generator.uniform((-0.05, -0.05, 0.05), (0.05, 0.05, 0.06), (4, 3)))[:, None], bodies=[1])
    for _ in range(120):
        sim.step()
        assert (sim.get("position")[:, 1, 2] > 0.0).all()
        assert sim.penetration().max() < 5e-4


def test_thin_walls_with_a_hole_hold(device):
    """The triangles decide with one of them missing, too: the surface with its caps bounds the solid."""
    whole = tray(SIZE / 100)
    holed = wr.Mesh(whole.vertices, whole.faces[1:])
    assert not holed.watertight and not holed.fault
    place, _, deepest = dropped(device, holed, BODIES["box"], 0.1)
    assert (place[:, 2] > 0.0).all() and deepest.max() < DEEPEST


def test_thin_walls_are_refused_until_the_grid_resolves_them():
    """The lower side of a plate crosses the cap of its upper side: only the grid tells inside from outside."""
    plate = trimesh.creation.box((0.3, 0.3, 0.003)).subdivide()
    faces = plate.faces[plate.face_normals[:, 2] < 0.5]
    vertices = plate.vertices.copy()
    vertices[np.argmin(np.linalg.norm(vertices - (0, 0, -0.0015), axis=1)), 2] = 0.003
    with pytest.raises(ValueError, match="^sdf_resolution: must be at least [0-9]+ for walls about") as refusal:
        wr.Mesh(vertices, faces)
    assert "\n" not in str(refusal.value) and "with their caps it crosses itself" in str(refusal.value)
    least = int(str(refusal.value).split("least ")[1].split()[0])
    assert 64 < least < 512
    assert wr.Mesh(vertices, faces, sdf_resolution=least).fault.startswith("the mesh has holes")


@pytest.mark.parametrize("share", [200, 100, 50])
def test_an_ear_that_turns_into_a_floor_stays_above_its_middle(device, share):
    """A bunny that lands beside its contacts turns back onto them within the step: its ears reach the floor, too.

    A sample beyond the middle of a wall is nearer to the far side, and the bunny then stays in the wall.
    """
    scene = wr.Scene()
    wall = SIZE / share
    scene.add_static(tray(wall))
    scene.add_body(meshes.bunny(0.05, sdf_resolution=32))
    sim = wr.Simulator(scene, num_envs=6, device=device)
    draw = np.random.default_rng(72)
    sim.set("position", draw.uniform((-0.05, -0.05, SIZE), (0.05, 0.05, SIZE), (6, 3))[:, None], bodies=[1])
    sim.set("orientation", rotations.random(draw, 6)[:, None], bodies=[1])
    worst = 0.0
    for _ in range(120):
        sim.step(1)
        worst = max(worst, sim.penetration().max())
    assert worst < 0.2 * wall
