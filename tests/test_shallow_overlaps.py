"""Bodies that overlap slightly, in random poses: one of their contacts shows the overlap."""

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

import warp_rigid as wr
from tests.geometry_oracles import cube
from tests.oracles import rotation_matrix
from tests.test_deep_starts import SHAPES
from tests.test_rolling_floors import field, mesh
from warp_rigid.scene.shapes import topology
from warp_rigid.scenes.builders import meshes


def slightly_overlapping(device, first, second, count):
    """Pairs in random poses that overlap by 0.2 to 4 mm, by a measure apart from contacts, and these overlaps [m].

    The second body comes from a random direction, at a random distance from the middle, until it overlaps enough.
    """
    scene = wr.Scene(gravity=(0, 0, 0))
    scene.add_body(first)
    scene.add_body(second)
    sim = wr.Simulator(scene, count, device=device)
    generator = np.random.default_rng(0)
    turns = generator.normal(size=(count, 2, 4))
    sim.set("orientation", turns / np.linalg.norm(turns, axis=2, keepdims=True))
    way = generator.normal(size=(count, 3))
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    aside = 0.3 * min(first.size, second.size) * generator.normal(size=(count, 3))
    aside -= np.sum(aside * way, axis=1, keepdims=True) * way
    wanted = generator.uniform(3e-4, 3e-3, count)
    near, far = np.zeros(count), np.full(count, 1.2 * (first.size + second.size))
    for _ in range(14):
        middle = 0.5 * (near + far)
        sim.set("position", np.stack([np.zeros((count, 3)), aside + middle[:, None] * way], axis=1))
        deep = sim.penetration() > wanted
        near, far = np.where(deep, middle, near), np.where(deep, far, middle)
    sim.set("position", np.stack([np.zeros((count, 3)), aside + far[:, None] * way], axis=1))
    return sim, sim.penetration()


def depths_of_contacts(sim, count):
    """The deepest contact of each environment, 0 without any [m]."""
    sim.step()
    contacts = sim.contacts()
    deepest = np.zeros(count)
    np.maximum.at(deepest, contacts["env"], contacts["depth"])
    return deepest


NONE_MISSED = [("box", "open ring"), ("boxes", "ball"), ("boxes", "corner"), ("cube", "bunny"), ("disc", "boxes")]
SELDOM_MISSED = [("disc", "torus", 4), ("disc", "bunny", 4), ("box", "bunny", 12)]
SLOWER = [("box", "box"), ("box", "boxes"), ("rod", "tray"), ("corner", "corner"), ("tray", "cube"), ("disc", "ball")]


@pytest.mark.parametrize(
    ("first", "second", "missed"),
    [(*names, 0) for names in NONE_MISSED]
    + SELDOM_MISSED
    + [pytest.param(*names, 0, marks=pytest.mark.long) for names in SLOWER],
)
def test_a_contact_shows_the_overlap_of_two_bodies(device, first, second, missed):
    """Edges and rims that cross a curved or bumpy surface, and each other, included.

    A segment of an edge or a rim has one contact: of several bumps below it, one may be missed.
    """
    count = 400
    sim, overlaps = slightly_overlapping(device, SHAPES[first], SHAPES[second], count)
    measured = (overlaps > 2e-4) & (overlaps < 4e-3)
    assert measured.sum() > 0.3 * count
    shown = depths_of_contacts(sim, count)
    assert np.sum(shown[measured] < 0.5 * overlaps[measured]) <= missed


def test_an_edge_that_is_flat_at_one_end_touches_a_bump_before_the_other(device):
    """The tangents at both ends met on the edge, where it was taken to leave a face; the bump is 0.03 mm deep."""
    scene = wr.Scene(gravity=(0, 0, 0))
    scene.add_body(meshes.cranium(), orientation=(-0.1558927, 0.649003, -0.6626697, 0.3396491))
    place = (-0.1055746, -0.0133242, 0.0229242)
    scene.add_body(meshes.torus(), position=place, orientation=(0.4554402, 0.7678988, 0.3616577, 0.2685321))
    sim = wr.Simulator(scene, device=device)
    overlap = sim.penetration()[0]
    assert 2.5e-5 < overlap < 3.5e-5
    assert depths_of_contacts(sim, 1)[0] == pytest.approx(overlap, rel=0.1)


ROUND = {
    "torus beside a cap": (
        (meshes.torus(), wr.Cylinder(0.08, 0.1)),
        (0.0061122, 0.0054502, 0.1099498),
        ((2.4e-6, 8e-7, -0.0118314, 0.99993), (-0.3230109, -0.6291019, 0.0798995, 0.7025033)),
    ),
    "disc beside a cap": (
        (wr.Cylinder(0.08, 0.1), wr.Cylinder(0.1, 0.02)),
        (-0.025049, -0.0505944, -0.1000451),
        ((-0.5249908, -0.4724387, 0.4662446, 0.5327311), (-0.8651205, 0.5015641, 3.9e-6, 4.7e-6)),
    ),
    "axes at a small angle": (
        (wr.Cylinder(0.08, 0.1), wr.Capsule(0.05, 0.1)),
        (-0.1118044, -0.0415651, -0.0568823),
        ((0.7250968, 0.1839068, 0.1016352, -0.6558074), (0.4976535, -0.5023249, 0.5753515, 0.4110734)),
    ),
    "end of a capsule": (
        (wr.Box((0.1, 0.1, 0.1)), wr.Capsule(0.05, 0.1)),
        (-0.0338104, -0.0596948, 0.1491653),
        ((0.9338534, -0.3572612, -0.0143451, -0.0087357), (0.1994814, -0.6679886, -0.4273458, 0.5756509)),
    ),
}
"""Poses of bodies that kept an overlap of 0.05 to 0.11 mm at rest."""


@pytest.mark.parametrize("name", ROUND)
def test_a_contact_shows_the_overlap_with_the_side_of_a_round_body(device, name):
    """Next to caps, along surfaces that are almost parallel to the axis, and where a distance bends unevenly.

    An axis is taken to leave a face at a slope of 0.02, where it is further away by 2e-4 radii, a sixth of the overlap.
    """
    shapes, place, turns = ROUND[name]
    scene = wr.Scene(gravity=(0, 0, 0))
    scene.add_body(shapes[0], orientation=turns[0])
    scene.add_body(shapes[1], position=place, orientation=turns[1])
    sim = wr.Simulator(scene, device=device)
    overlap = sim.penetration()[0]
    assert 4e-5 < overlap < 1.2e-4
    assert depths_of_contacts(sim, 1)[0] == pytest.approx(overlap, rel=0.2)


CROSSINGS = {
    "pelvis on pelvis": (
        (meshes.pelvis, meshes.pelvis),
        (-0.1514573, 0.0000978, 0.0531344),
        ((0.6673026, -0.3590126, -0.6507881, 0.0478761), (-0.5285958, 0.6615018, -0.0161839, 0.5317329)),
    ),
    "femur on skull": (
        (meshes.femur, meshes.skull_like),
        (-0.2834844, 0.0253948, 0.0017817),
        ((-0.0490696, -0.5966750, -0.3256635, 0.7317884), (0.7421861, 0.0176822, -0.6567398, 0.1324382)),
    ),
    "femur on femur": (
        (meshes.femur, meshes.femur),
        (-0.0111486, 0.0625698, 0.0014273),
        ((-0.5511206, -0.3159404, -0.49132, -0.5958627), (-0.7789559, 0.120739, -0.5964733, 0.1512263)),
    ),
    "box on bunny": (
        (lambda: wr.Box((0.1, 0.08, 0.06)), lambda: meshes.bunny(0.2)),
        (0.1846294, 0.0087189, -0.0154643),
        ((-0.2274098, 0.7724514, 0.3065824, 0.5075537), (-0.3605087, -0.0714665, 0.4322692, 0.8234496)),
    ),
    "capsule on pelvis": (
        (lambda: wr.Capsule(0.05, 0.1), meshes.pelvis),
        (0.0401034, -0.1148319, 0.0420036),
        ((-0.1359513, 0.2200981, -0.5425837, 0.7991727), (-0.586915, 0.4022584, -0.4902994, 0.503315)),
    ),
}
"""Poses of two bodies that overlap, the first three from piles at rest: place of the second beside the first [m]."""


@pytest.mark.parametrize("crossing", CROSSINGS)
def test_edges_touch_meshes_where_the_distance_is_least(device, crossing):
    """The distance along the edge has a kink before or beyond the crossing, bumps, or bends little at its minimum."""
    kinds, place, turns = CROSSINGS[crossing]
    scene = wr.Scene(gravity=(0, 0, 0))
    scene.add_body(kinds[0](), orientation=turns[0])
    scene.add_body(kinds[1](), position=place, orientation=turns[1])
    sim = wr.Simulator(scene, device=device)
    overlap = sim.penetration()[0]
    assert 5e-5 < overlap < 3e-4
    assert depths_of_contacts(sim, 1)[0] == pytest.approx(overlap, rel=0.02)


def test_an_open_mesh_touches_as_the_solid_with_its_holes_capped(device):
    """Contacts with a coarse ball without its top, and overlaps, were those of its grid: off by a millimetre."""
    ball = trimesh.creation.icosphere(1, 0.1)
    top = np.argmax(ball.vertices[:, 2])
    opened = wr.Mesh(ball.vertices, ball.faces[(ball.faces != top).all(axis=1)], sdf_resolution=16)
    capped = wr.Mesh(*topology.close_boundaries(opened.vertices, opened.faces), sdf_resolution=64)
    assert not opened.watertight and capped.watertight
    count, cube = 200, wr.Box((0.02,) * 3)
    sim, overlaps = slightly_overlapping(device, capped, cube, count)
    scene = wr.Scene(gravity=(0, 0, 0))
    scene.add_body(opened)
    scene.add_body(cube)
    other = wr.Simulator(scene, count, device=device)
    shift = capped.center_of_mass - opened.center_of_mass
    assert np.abs(shift).max() < 1e-12
    for name in ("position", "orientation"):
        other.set(name, sim.get(name))
    np.testing.assert_allclose(other.penetration(), overlaps, atol=1e-6)
    np.testing.assert_allclose(depths_of_contacts(other, count), depths_of_contacts(sim, count), atol=1e-6)


@pytest.mark.parametrize("floor", [field, mesh])
def test_a_rim_touches_a_floor_of_triangles_at_its_lowest_point(device, floor):
    """The rim of a tilted cylinder, in random directions: the point and its depth in closed form."""
    count, radius, half_height, depth = 200, 0.15, 0.05, 1e-3
    scene = wr.Scene(gravity=(0, 0, 0))
    for shape, position in floor(0.1):
        scene.add_static(shape, position=position)
    scene.add_body(wr.Cylinder(radius, half_height))
    sim = wr.Simulator(scene, count, device=device)
    generator = np.random.default_rng(1)
    turns = generator.normal(size=(count, 1, 4))
    turns /= np.linalg.norm(turns, axis=2, keepdims=True)
    sim.set("orientation", turns, bodies=[1])
    axis = np.array([rotation_matrix(turn) @ (0, 0, 1) for turn in turns[:, 0]])
    axis *= -np.sign(axis[:, 2:])  # to the lower cap
    down = -np.array([0, 0, 1]) + axis * axis[:, 2:]
    lowest = half_height * axis + radius * down / np.linalg.norm(down, axis=1, keepdims=True)
    middle = np.column_stack([generator.uniform(-1, 1, (count, 2)), -lowest[:, 2] - depth])
    sim.set("position", middle[:, None], bodies=[1])
    sim.step()
    contacts = sim.contacts()
    for env in range(count):
        found = contacts[contacts["env"] == env]
        deepest = found[np.argmax(found["depth"])]
        assert deepest["depth"] == pytest.approx(depth, rel=1e-3)
        if np.abs(axis[env, 2]) < 0.999:
            assert np.linalg.norm((deepest["position"] - middle[env] - lowest[env])[:2]) < 1e-3 * radius


CUBES = {"boxes": (False, False), "box and mesh": (False, True), "meshes": (True, True)}


@pytest.mark.parametrize("kinds", CUBES)
def test_crossed_edges_overlap_by_the_distance_of_their_lines(device, kinds):
    """Edges of two cubes cross at random angles, each turned by 20 to 70 degrees about itself."""
    count, half, depth = 200, 0.1, 1e-3
    shapes = [wr.Mesh(*cube(half)) if mesh else wr.Box((half,) * 3) for mesh in CUBES[kinds]]
    generator = np.random.default_rng(2)
    lean, other_lean = np.radians(generator.uniform(20, 70, (2, count)))
    turn = np.radians(generator.uniform(30, 150, count))
    zero = np.zeros(count)
    normal = np.column_stack([np.cos(lean), zero, np.sin(lean)])
    along = np.column_stack([-np.sin(turn) * np.sin(lean), np.cos(turn), np.sin(turn) * np.cos(lean)])
    aside = np.cross(along, normal)
    first = -np.cos(other_lean)[:, None] * normal + np.sin(other_lean)[:, None] * aside
    second = -np.sin(other_lean)[:, None] * normal - np.cos(other_lean)[:, None] * aside
    scene = wr.Scene(gravity=(0, 0, 0))
    for shape in shapes:
        scene.add_body(shape)
    sim = wr.Simulator(scene, count, device=device)
    crossing = np.array([half, 0, half]) - depth * normal
    middle = crossing - half * (first + second) + 0.2 * half * along
    sim.set("position", middle[:, None], bodies=[1])
    turns = Rotation.from_matrix(np.stack([first, second, np.cross(first, second)], axis=2)).as_quat()
    sim.set("orientation", turns[:, None], bodies=[1])
    np.testing.assert_allclose(depths_of_contacts(sim, count), depth, rtol=0.01)


def test_a_point_of_a_mesh_does_not_slide_to_the_far_side_of_a_wall(device):
    """Where an edge enters a wall beside a face that its point does not oppose: the contact was 0.26 m deep."""
    scene = wr.Scene(gravity=(0, 0, 0))
    scene.add_static(wr.Box((0.05, 0.5, 0.706)), position=(-0.45, 0, 0.706))
    turn = np.array([0.387, -0.445, -0.663, 0.461])
    scene.add_body(
        meshes.bunny(0.2),
        position=(-0.315, -0.201, 0.110),
        orientation=turn / np.linalg.norm(turn),
        linear_velocity=(-0.745, 0.259, -0.571),
        angular_velocity=(-4.915, 1.524, 6.696),
    )
    sim = wr.Simulator(scene, settings=wr.Settings(dt=1 / 60), device=device)
    overlap = sim.penetration()
    assert 1.7e-3 < overlap < 1.9e-3
    assert depths_of_contacts(sim, 1) == pytest.approx(overlap, rel=0.01)
