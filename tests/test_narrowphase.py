"""Narrow phase: which samples touch, the exact contact points, and contact reduction."""

import numpy as np
import pytest

from tests.geometry_oracles import cube
from tests.oracles import (
    GROUND,
    add_uneven_stack,
    clip_polygon,
    contact_list,
    distance_outside,
    find_contacts,
    ground_scene,
    hull_polygon,
    opened,
    polygon_area,
    random_quaternion,
    rotate_about,
    rotation_matrix,
    tangent_basis,
)
from warp_rigid.engine.settings import Settings
from warp_rigid.engine.simulator import Simulator
from warp_rigid.kernels.tuning import CONTACT_DISTANCE
from warp_rigid.scene.scene import Scene
from warp_rigid.scene.shapes import Box, Capsule, Compound, Cylinder, Mesh, Sphere
from warp_rigid.scenes.builders import assortment, meshes


def touch(device, lower, upper, settings=None, **pose):
    """Contacts of a body with a static one, without gravity."""
    scene = Scene(gravity=(0, 0, 0))
    scene.add_static(lower)
    scene.add_body(upper, **pose)
    _, stages = opened(scene, device, settings=settings)
    find_contacts(stages)
    return contact_list(stages)


def touches(device, lower, upper, positions, orientations=None):
    """The same for several poses of the body: one environment each."""
    scene, count = Scene(gravity=(0, 0, 0)), len(positions)
    scene.add_static(lower)
    scene.add_body(upper)
    sim, stages = opened(scene, device, num_envs=count)
    sim.set("position", np.reshape(positions, (count, 1, 3)), bodies=[1])
    if orientations is not None:
        sim.set("orientation", np.reshape(orientations, (count, 1, 4)), bodies=[1])
    find_contacts(stages)
    found = contact_list(stages)
    env = np.maximum(found["body_a"], found["body_b"]) // 2
    return [{name: rows[env == e] for name, rows in found.items()} for e in range(count)]


HALF = 0.1
FLUSH = pytest.mark.parametrize("degrees", [0.0, 1e-4, 1.0, 45.0])


def flush_cubes(device, degrees, offset, overlap):
    """Contacts of two equal cubes, one turned and shifted on the other, and their true overlap polygon."""
    turn = rotate_about((0, 0, 1), degrees)
    cubes = Box((HALF, HALF, HALF))
    found = touch(device, cubes, cubes, position=(*offset, 2 * HALF - overlap), orientation=turn)
    corners = HALF * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) @ rotation_matrix(turn).T
    return found, clip_polygon(corners[:, :2] + offset, (HALF, HALF))


@FLUSH
@pytest.mark.parametrize("overlap", [0.0, 1e-5, -1e-5, 1e-3])
def test_flush_cubes_push_straight_up(device, degrees, overlap):
    for offset in ((0.0, 0.0), (0.03, 0.05), (HALF, 0.0), (-0.06, 0.02)):
        found, overlapped = flush_cubes(device, degrees, offset, overlap)
        assert len(found["gap"]) >= 3
        assert found["normal"][:, 2].min() > 1.0 - 1e-6
        np.testing.assert_allclose(found["gap"], -overlap, atol=0.02 * CONTACT_DISTANCE * 2 * HALF)
        np.testing.assert_allclose(found["position"][:, 2], HALF - 0.5 * overlap, atol=1e-6)
        # A corner may stand out by the border of the box's face, 0.5 % of the half-extent.
        assert distance_outside(found["position"][:, :2], hull_polygon(overlapped)).max() < 0.0051 * HALF


def coverage(device, degrees, offset):
    """How far the overlap polygon reaches beyond the contacts' hull [half-extents], and the share of area covered."""
    found, overlapped = flush_cubes(device, degrees, offset, 0.0)
    hull = hull_polygon(found["position"][:, :2].astype(np.float64))
    return distance_outside(overlapped, hull).max() / HALF, polygon_area(hull) / polygon_area(overlapped)


@pytest.mark.parametrize("offset", [(0.0, 0.0), (0.03, 0.05), (HALF, 0.0), (-0.06, 0.02)])
@FLUSH
def test_flush_cubes_are_carried_on_their_whole_overlap(device, degrees, offset):
    """The contacts' hull is the overlap polygon, so a load anywhere above it is carried."""
    beyond, covered = coverage(device, degrees, offset)
    assert beyond < 0.01
    assert covered > 0.99


@pytest.mark.long
def test_edges_that_leave_a_face_push_along_it(device):
    """Where an edge leaves a face, the side that it crosses is as near as the face, and no way out."""
    generator, cube = np.random.default_rng(11), Box((HALF, HALF, HALF))
    for _ in range(40):
        nearly_up = (*generator.uniform(-3e-3, 3e-3, 2), 1.0)
        place = (*generator.uniform(-0.08, 0.08, 2), 2 * HALF - 1e-3)
        found = touch(device, cube, cube, position=place, orientation=rotate_about(nearly_up, generator.uniform(5, 85)))
        assert len(found["gap"]) >= 3
        assert found["normal"][:, 2].min() > 0.999


def test_ball_on_plane(device):
    for gap in (0.0, 5e-5, -1e-3, -0.05):
        found = touch(
            device, GROUND, Sphere(0.2), position=(0.3, -0.7, 0.2 + gap), orientation=rotate_about((1, 2, 3), 40)
        )
        assert len(found["gap"]) == 1
        np.testing.assert_allclose(found["gap"], [gap], atol=1e-7)
        np.testing.assert_allclose(found["position"], [[0.3, -0.7, 0.5 * gap]], atol=1e-7)
        np.testing.assert_allclose(found["normal"], [[0, 0, 1]], atol=1e-7)


def test_ball_on_ball(device):
    direction = np.array([2.0, -3.0, 6.0]) / 7.0
    for gap in (0.0, 5e-5, -0.01):
        found = touch(device, Sphere(0.5), Sphere(0.2), position=(0.7 + gap) * direction)
        position, normal = found["position"], found["normal"]
        sign = 1.0 if found["body_a"][0] == 1 else -1.0
        np.testing.assert_allclose(found["gap"], gap, atol=1e-7)
        np.testing.assert_allclose(normal, np.tile(sign * direction, (len(normal), 1)), atol=1e-6)
        np.testing.assert_allclose(position, np.tile((0.5 + 0.5 * gap) * direction, (len(normal), 1)), atol=1e-6)


@pytest.mark.parametrize(("radius", "cells"), [(0.01, 32), (0.1, 32), (0.1, 128), (0.3, 32)])
def test_ball_on_mesh(device, radius, cells):
    """A ball touches the flat face of a mesh where it touches the face, however large it is."""
    found = touch(device, Mesh(*cube(0.1), sdf_resolution=cells), Sphere(radius), position=(0, 0, 0.1 + radius))
    of_ball = found["key"] % 2 == (found["body_a"] == 0)
    assert of_ball.sum() == 1
    assert found["gap"][of_ball] == pytest.approx(0.0, abs=1e-3 * radius)


def test_capsule_on_plane(device):
    """Lying: below both ends. Standing or tilted: below the lower end."""
    lying = touch(device, GROUND, Capsule(0.1, 0.3), position=(0, 0, 0.1), orientation=rotate_about((0, 1, 0), 90))
    ends = lying["position"][np.argsort(lying["position"][:, 0])]
    np.testing.assert_allclose(ends[[0, -1]], [[-0.3, 0, 0], [0.3, 0, 0]], atol=1e-6)
    for degrees in (0.0, 20.0, 60.0):
        slant = np.radians(degrees)
        height = 0.1 + 0.3 * np.cos(slant)
        turn = rotate_about((0, 1, 0), degrees)
        found = touch(device, GROUND, Capsule(0.1, 0.3), position=(1, 0, height), orientation=turn)
        np.testing.assert_allclose(found["position"], [[1 - 0.3 * np.sin(slant), 0, 0]], atol=1e-6)
        np.testing.assert_allclose(found["gap"], [0.0], atol=1e-6)


def test_capsule_across_an_edge(device):
    """A capsule lies across the upright edge of a bar: the crossing is between its two ends."""
    edge_up = Compound([(Box((0.2, 0.2, 1.0)), (0, 0, 0), rotate_about((0, 0, 1), 45))])
    lay = rotate_about((0, 1, 0), 90)
    height = 0.2 * np.sqrt(2) + 0.1
    scene = Scene(gravity=(0, 0, 0))
    scene.add_static(edge_up, orientation=rotate_about((1, 0, 0), 90))
    scene.add_body(Capsule(0.1, 0.5), position=(0.123, 0, height - 1e-5), orientation=lay)
    _, stages = opened(scene, device)
    find_contacts(stages)
    found = contact_list(stages)
    assert len(found["gap"]) >= 1
    # The place on the axis is found to a few millimetres of a metre; the gap is of second order in that.
    assert found["gap"].min() == pytest.approx(-1e-5, abs=0.2 * CONTACT_DISTANCE * 0.2)
    np.testing.assert_allclose(found["position"], np.tile([0, 0, 0.2 * np.sqrt(2)], (len(found["gap"]), 1)), atol=4e-3)
    assert found["normal"][:, 2].min() > 0.999


@pytest.mark.parametrize("height", [0.05, 0.4])
def test_cylinder_on_plane(device, height):
    """Standing: on its rim. Lying: below the rims of both caps. Tilted: on the rim's lowest point."""
    radius = 0.2
    standing = touch(device, GROUND, Cylinder(radius, height), position=(0, 0, height))
    corners = standing["position"][:, :2].astype(np.float64)
    assert distance_outside(corners, hull_polygon(1.0001 * corners)).max() < 1e-6
    assert polygon_area(hull_polygon(corners)) > 0.89 * np.pi * radius**2
    np.testing.assert_allclose(np.linalg.norm(hull_polygon(corners), axis=1), radius, atol=1e-6)
    lying = touch(
        device, GROUND, Cylinder(radius, height), position=(0, 0, radius), orientation=rotate_about((0, 1, 0), 90)
    )
    along = np.sort(lying["position"][:, 0])
    np.testing.assert_allclose(along[[0, -1]], [-height, height], atol=1e-5)
    np.testing.assert_allclose(lying["position"][:, 1:], 0.0, atol=1e-5)
    for degrees, azimuth in ((3.0, 11.0), (30.0, 100.0), (63.0, 222.0)):
        slant = np.radians(degrees)
        lowest = height * np.cos(slant) + radius * np.sin(slant)
        turn = rotate_about((np.cos(np.radians(azimuth)), np.sin(np.radians(azimuth)), 0), degrees)
        found = touch(device, GROUND, Cylinder(radius, height), position=(0, 0, lowest), orientation=turn)
        axis = rotation_matrix(turn) @ [0, 0, 1]
        outward = -np.array([-axis[0] * axis[2], -axis[1] * axis[2], 1 - axis[2] ** 2]) / np.sin(slant)
        expected = np.array([0, 0, lowest]) - height * axis + radius * outward
        assert expected[2] == pytest.approx(0.0, abs=1e-12)
        deepest = np.argmin(found["gap"])
        np.testing.assert_allclose(found["position"][deepest], expected, atol=2e-6)


def crossing_bars(device, degrees, gap, edge_samples=True):
    """Contacts of two bars that cross edge on edge, the upper one turned against the lower about the vertical."""
    half = 0.1
    upright = rotate_about((1, 0, 0), 45)
    spin = rotation_matrix(rotate_about((0, 0, 1), degrees))
    matrix = spin @ rotation_matrix(upright)
    w = 0.5 * np.sqrt(1.0 + np.trace(matrix))
    axis = np.array([matrix[2, 1] - matrix[1, 2], matrix[0, 2] - matrix[2, 0], matrix[1, 0] - matrix[0, 1]]) / (4 * w)
    bar = Box((0.6, half, half))
    scene = Scene(gravity=(0, 0, 0))
    scene.add_static(bar, orientation=upright)
    scene.add_body(bar, position=(0.07, 0.0, 2 * half * np.sqrt(2) + gap), orientation=(*axis, w))
    _, stages = opened(scene, device, settings=Settings(edge_samples=edge_samples))
    find_contacts(stages)
    return contact_list(stages)


@pytest.mark.parametrize("degrees", [90.0, 60.0, 37.0, 10.0])
@pytest.mark.parametrize("gap", [5e-5, 0.0, -1e-4])
def test_crossing_edges_are_found(device, degrees, gap):
    found = crossing_bars(device, degrees, gap)
    crossing = [0.07, 0.0, 0.1 * np.sqrt(2) + 0.5 * gap]
    assert len(found["gap"]) >= 1
    np.testing.assert_allclose(found["position"], np.tile(crossing, (len(found["gap"]), 1)), atol=1e-4)


@pytest.mark.parametrize("degrees", [90.0, 37.0])
def test_crossing_edges_part_along_their_common_perpendicular(device, degrees):
    found = crossing_bars(device, degrees, 5e-5)
    np.testing.assert_allclose(found["gap"], 5e-5, atol=2e-6)
    assert found["normal"][:, 2].min() > 0.999


@pytest.mark.parametrize("degrees", [90.0, 37.0])
def test_crossing_edges_are_missed_without_edge_samples(device, degrees):
    for gap in (5e-5, -1e-3):
        assert len(crossing_bars(device, degrees, gap, edge_samples=False)["gap"]) == 0
        assert len(crossing_bars(device, degrees, gap)["gap"]) >= 1


def eight_directions():
    """The directions of a patch with an upward normal: an eighth of a turn apart, none along a tangent."""
    (u,), (v,) = tangent_basis([[0.0, 0.0, 1.0]])
    angle = np.arccos(0.9) + np.pi / 4 * np.arange(8)
    return np.cos(angle)[:, None] * u[:2] + np.sin(angle)[:, None] * v[:2]


def check_thinning(found, points, gap, size, way=0.0):
    """The deepest of the touching points is kept, and in each direction the furthest.

    A gap counts twenty times in every other direction; in the others up to two hundred times, less for bodies that go
    a long `way` in the step. Gaps beyond a fiftieth of the size count as equal.
    """
    kept = found["position"][:, :2].astype(np.float64), found["gap"].astype(np.float64)
    assert len(kept[1]) <= 9
    assert kept[1].min() == pytest.approx(gap.min(), abs=1e-6)
    weight = np.tile([np.clip(0.5 * size / max(way, 1e-9), 20.0, 200.0), 20.0], 4)
    best = (points[:, :2] @ eight_directions().T - weight * np.minimum(gap, 0.02 * size)[:, None]).max(axis=0)
    reached = (kept[0] @ eight_directions().T - weight * np.minimum(kept[1], 0.02 * size)[:, None]).max(axis=0)
    np.testing.assert_allclose(reached, best, atol=1e-5)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("depth", [2e-3, 0.01])
def test_thinning_keeps_the_deepest_and_the_outermost(device, seed, depth):
    """Against brute force over all vertices of a bunny pressed into the ground."""
    bunny = meshes.bunny(0.2, sdf_resolution=16)
    turn = random_quaternion(np.random.default_rng(seed))
    world = bunny.vertices @ rotation_matrix(turn).T
    world[:, 2] -= world[:, 2].min() + depth
    lift = world[0, 2] - (bunny.vertices @ rotation_matrix(turn).T)[0, 2]
    found = touch(device, GROUND, bunny, position=(0, 0, lift), orientation=turn)
    touching = world[:, 2] < CONTACT_DISTANCE * bunny.size
    assert touching.sum() > len(found["gap"])
    check_thinning(found, world[touching], world[touching, 2], bunny.size)


@pytest.mark.parametrize("speed", [0.5, 2.0])
def test_thinning_weighs_gaps(device, speed):
    """A falling slab with feet of unequal length: the deepest foot is an inner one, the outermost are not all kept."""
    generator = np.random.default_rng(5)
    x, y = np.meshgrid(np.linspace(-0.3, 0.3, 5), np.linspace(-0.2, 0.2, 5), indexing="ij")
    short = generator.uniform(0.0, 3e-3, 25)
    short[12] = -1e-3
    feet = [
        (Box((0.02, 0.02, 0.05 - 0.5 * s)), (a, b, 0.5 * s), (0, 0, 0, 1))
        for a, b, s in zip(x.ravel(), y.ravel(), short, strict=True)
    ]
    slab = Compound(feet)
    found = touch(device, GROUND, slab, position=(0, 0, 0.051), linear_velocity=(0, 0, -speed))
    corners = np.array(
        [
            (a + i, b + j)
            for a, b in zip(x.ravel(), y.ravel(), strict=True)
            for i in (-0.02, 0.02)
            for j in (-0.02, 0.02)
        ]
    )
    gap = np.repeat(1e-3 + short, 4)
    way = speed * Settings().dt
    touching = gap < way + CONTACT_DISTANCE * slab.size
    check_thinning(found, corners[touching], gap[touching], slab.size, way)
    assert len(np.unique(np.round(found["gap"], 6))) > 3


def test_thinning_keeps_the_hull_of_a_flat_face(device):
    """A slab of many flush vertices keeps exactly the corners of its rectangle."""
    x, y = np.meshgrid(np.linspace(-0.3, 0.3, 5), np.linspace(-0.2, 0.2, 4), indexing="ij")
    boxes = [
        (Box((0.02, 0.02, 0.05)), (px, py, 0.0), (0, 0, 0, 1)) for px, py in zip(x.ravel(), y.ravel(), strict=True)
    ]
    found = touch(device, GROUND, Compound(boxes), position=(0, 0, 0.05), orientation=rotate_about((0, 0, 1), 17))
    corners = np.array([[-0.32, -0.22], [0.32, -0.22], [0.32, 0.22], [-0.32, 0.22]])
    turned = np.column_stack([corners, np.zeros(4)]) @ rotation_matrix(rotate_about((0, 0, 1), 17)).T
    hull = hull_polygon(found["position"][:, :2].astype(np.float64))
    assert len(found["gap"]) <= 9
    assert distance_outside(turned[:, :2], hull).max() < 1e-6
    assert polygon_area(hull) == pytest.approx(0.64 * 0.44, rel=1e-5)


def test_identities_persist_in_a_resting_stack(device):
    scene = ground_scene()
    add_uneven_stack(scene, 4, Box((0.1, 0.12, 0.1)), zigzag=0.01, twist=np.radians(7))
    sim, stages = opened(scene, device)
    sim.step(60)
    searched = []
    for _ in range(30):
        sim.step()
        found = contact_list(stages)
        searched.append(
            list(zip(found["body_a"].tolist(), found["body_b"].tolist(), found["key"].tolist(), strict=True))
        )
    assert len(searched[0]) >= 16
    assert len(set(searched[0])) == len(searched[0])
    assert all(now == searched[0] for now in searched)


def test_identities_do_not_depend_on_rounding(device):
    """Corners of equal flush cubes coincide: of two samples as good as each other always the same one is kept."""
    scene = Scene(gravity=(0, 0, 0))
    scene.add_static(Box((HALF, HALF, HALF)))
    scene.add_body(Box((HALF, HALF, HALF)), position=(0, 0, 2 * HALF))
    sim, stages = opened(scene, device)
    generator = np.random.default_rng(0)
    searched = set()
    for _ in range(30):
        sim.set("position", [0, 0, 2 * HALF] + generator.normal(scale=1e-8, size=3), bodies=[1])
        sim.set("orientation", np.array([0, 0, 0, 1]) + generator.normal(scale=1e-8, size=4), bodies=[1])
        find_contacts(stages)
        searched.add(tuple(contact_list(stages)["key"].tolist()))
    assert len(searched) == 1


def test_approach_within_the_step_is_a_contact(device):
    """What closes within the step touches already, told with its gap of now; what does not, does not.

    What another body may push together within the step does, too: half of the way of the faster body, in any direction.
    """
    dt, gap = 1 / 240, 0.04
    for velocity, wanted in (
        ((0, 0, -1.1 * gap / dt), 1),
        ((0, 0, -0.9 * gap / dt), 0),
        ((0, 0, 1.9 * gap / dt), 0),
        ((0, 0, 2.1 * gap / dt), 1),
        ((1.9 * gap / dt, 0, 0), 0),
        ((2.1 * gap / dt, 0, 0), 1),
    ):
        found = touch(
            device, GROUND, Sphere(0.1), position=(0, 0, 0.1 + gap), linear_velocity=velocity, settings=Settings(dt=dt)
        )
        assert len(found["gap"]) == wanted
        np.testing.assert_allclose(found["gap"], [gap] * wanted, atol=1e-6)


@pytest.mark.parametrize("speed", [50.0, 400.0])
def test_balls_never_pass_a_thin_wall(device, speed):
    scene = Scene(gravity=(0, 0, 0))
    scene.add_static(Box((0.005, 1, 1)))
    scene.add_body(Sphere(0.02), position=(-1.0, 0.1, 0.1), linear_velocity=(speed, 0, 0), angular_velocity=(0, 9, 0))
    sim, _ = opened(scene, device)
    sim.step(30)
    assert sim.get("position")[0, 1, 0] < -0.02


@pytest.mark.parametrize("share", [0.05, 0.25, 0.5])
def test_boxes_do_not_pass_a_thin_wall(device, share):
    """A twentieth of their width in a step, the time step rule of 2003, and up to ten times that."""
    count, generator = 200, np.random.default_rng(0)
    travel = share * 0.04
    scene = Scene(gravity=(0, 0, 0))
    scene.add_static(Box((0.005, 1, 1)))
    box = scene.add_body(Box((0.02, 0.02, 0.02)))
    sim = Simulator(scene, num_envs=count, device=device)
    position = np.column_stack([-0.04 - generator.uniform(0, 10 * travel, count), np.full((count, 2), 0.1)])
    sim.set("position", position[:, None], bodies=[box])
    sim.set("orientation", random_quaternion(generator, count)[:, None], bodies=[box])
    sim.set("linear_velocity", (travel / sim.settings.dt, 0, 0), bodies=[box])
    sim.set("angular_velocity", 40.0 * share * generator.normal(size=(count, 1, 3)), bodies=[box])
    sim.step(60)
    assert sim.get("position")[:, box, 0].max() < -0.02


@pytest.mark.parametrize(
    "floor",
    [
        pytest.param(GROUND, id="plane"),
        pytest.param(Box((4, 2, 0.5)), id="box"),
        pytest.param(Mesh(cube(1.0)[0] * [4, 2, 0.5], cube(1.0)[1]), id="mesh"),
    ],
)
def test_sliding_over_a_flat_floor_does_not_snag(device, floor):
    """Without friction a slab keeps its speed, whatever samples lie in the floor's flat top."""
    scene = Scene()
    scene.add_static(floor, position=(0, 0, 0 if floor is GROUND else -0.5), friction=0.0)
    slab = scene.add_body(Box((0.2, 0.2, 0.05)), position=(-1, 0.03, 0.05), linear_velocity=(1, 0, 0), friction=0.0)
    sim, _ = opened(scene, device)
    sim.step(480)
    np.testing.assert_allclose(sim.get("linear_velocity")[0, slab], [1, 0, 0], atol=1e-4)


@pytest.mark.parametrize("degrees", [10.0, 25.0, 45.0])
@pytest.mark.parametrize("depth", [1e-4, 4e-4])
def test_a_long_edge_in_a_thin_rod_is_as_deep_as_it_is(device, degrees, depth):
    """An upright edge pokes into the side of a rod thinner than its segments: no contact is deeper than the edge is."""
    turn = rotate_about((0, 0, 1), degrees)
    normal = rotation_matrix(turn)[:, 1]
    post = Box((0.01, 0.2, 0.5))
    corner = np.array([0.01, -0.2, 0.0])
    place = corner - (0.01 - depth) * normal - 0.3 * rotation_matrix(turn)[:, 0]
    found = touch(device, post, Box((0.5, 0.01, 0.01)), position=place, orientation=turn)
    assert len(found["gap"]) >= 2
    assert found["gap"].min() == pytest.approx(-depth, abs=0.1 * depth)
    assert found["position"][:, 2].min() < -0.009
    assert found["position"][:, 2].max() > 0.009


WEDGED = {
    "one": ((0.04, 0.0138, 0.1932), (0.343, 0.6184, -0.3429, 0.6184), (-0.5324, -0.2756, 0.7905, -0.1252)),
    "other": ((0.0323, -0.0221, 0.1956), (0.6543, 0.2684, -0.6542, 0.2683), (-0.6967, -0.3579, -0.1404, -0.6057)),
}


@pytest.mark.parametrize("name", WEDGED)
def test_edges_deep_across_each_other_part(device, name):
    """Two cubes as a pile left them: an edge of each runs through the other, nearest to a face that it does not oppose.

    Seen from that face nothing touched, and the cubes stayed 20 to 30 mm inside each other for good.
    """
    shift, lower, upper = WEDGED[name]
    scene = Scene(gravity=(0, 0, 0))
    scene.add_body(Box((HALF, HALF, HALF)), orientation=lower)
    scene.add_body(Box((HALF, HALF, HALF)), position=shift, orientation=upper)
    sim = Simulator(scene, device=device, settings=Settings(dt=1 / 60))
    assert sim.penetration()[0] > 0.02
    sim.step(40)
    assert sim.penetration()[0] < 1e-4


def test_an_edge_that_reaches_beyond_a_grid_touches_where_it_crosses_it(device):
    """A box's edge crosses an edge of a prism of twelve sides, and ends outside the prism's grid.

    There the distance is a bound, whose slope does not show that the edge has come nearer.
    """
    scene = Scene(gravity=(0, 0, 0))
    turn = (0.851126, 0.52427, -0.017348, 0.020599)
    scene.add_body(Box((0.28867513,) * 3), position=(2.67181, -0.04052, 0.31312), orientation=turn)
    prism = assortment.convex_solid("cylinder", 0.4)
    turn = (0.634959, 0.127029, -0.633907, -0.42291)
    scene.add_body(prism, position=(2.580618, 0.572243, 0.265115), orientation=turn)
    sim, stages = opened(scene, device)
    find_contacts(stages)
    # by separating axes they overlap by 10.6 mm; the grid rounds the prism's edges
    assert contact_list(stages)["gap"].min() == pytest.approx(-0.0106, abs=1e-3)
    sim.step(60)
    assert sim.penetration()[0] < 1e-3


def test_a_pair_that_an_axis_separates_notes_no_search(device):
    """Otherwise it would keep what an earlier step has found for another pair at its place in the list."""
    scene = Scene(gravity=(0, 0, 0))
    scene.add_body(Box((HALF,) * 3))
    across = (HALF * 2**0.5 + HALF + 0.03) / 2**0.5
    scene.add_body(Box((HALF,) * 3), position=(across, across, 0), orientation=rotate_about((0, 0, 1), 45))
    sim = Simulator(scene, device=device)
    sim.step(1)
    (shard,) = sim._world.shards
    shard.pools.pairs.searched.fill_(7)
    shard.pools.pairs.searched_position.fill_(1.0)
    sim.step(1)
    history = shard.pools.history
    assert history.pair_start.numpy()[-1] == 1
    assert history.searched.numpy()[0] == 0 and not history.searched_position.numpy()[0].any()
