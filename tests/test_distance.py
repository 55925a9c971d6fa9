"""Signed distances of every kind of part against independent float64 computations, and the border rule."""

import numpy as np
import pytest
import warp as wp

from tests.geometry_oracles import exact_distance
from tests.oracles import random_quaternion
from warp_rigid.engine.layout import layout_of
from warp_rigid.engine.model import build_model
from warp_rigid.kernels.collide import deepest_point, distance
from warp_rigid.kernels.schema import Shapes
from warp_rigid.scene.scene import Scene
from warp_rigid.scene.shapes import Box, Capsule, Compound, Cylinder, Heightfield, Mesh, Plane, Sphere
from warp_rigid.scene.shapes.distance_grid import interpolate
from warp_rigid.scenes.builders import meshes

wp.set_module_options({"enable_backward": False})


@wp.kernel
def evaluate(
    shapes: Shapes,
    shape: int,
    near: float,
    for_overlap: int,
    points: wp.array[wp.vec3],
    normals: wp.array[wp.vec3],
    found: wp.array[wp.vec4],
):
    """One thread a point: the distance and its gradient; with `for_overlap`, those with which overlaps are measured."""
    i = wp.tid()
    if for_overlap == 1:
        found[i] = deepest_point.true_distance(shapes, shape, points[i], near)
    else:
        found[i] = distance.contact_distance(shapes, shape, points[i], normals[i], near)


@wp.kernel
def evaluate_bound(shapes: Shapes, shape: int, points: wp.array[wp.vec3], bounds: wp.array[float]):
    """One thread a point: the lower bound of the distance by the grid of a mesh."""
    i = wp.tid()
    _d, bound = distance.grid_distance(shapes, shapes.shapes[shape].part_start, points[i])
    bounds[i] = bound


def measure(shape, points, device, normals=None, near=1e10, for_overlap=False):
    """Distances (n,) and directions (n, 3) by the kernels; without normals the plain signed distance.

    Those to meshes are exact below `near`, but for points more than a cell inside.
    """
    scene = Scene()
    # Another shape before it, so that its parts and grids do not begin at the pool's first row.
    scene.add_static(Compound([(meshes.tetrahedron(sdf_resolution=8), (0, 0, 0), (0, 0, 0, 1))]))
    scene.add_static(shape)
    model = build_model(layout_of(scene, 1), wp.get_device(device))
    points = wp.array(np.asarray(points, np.float32), dtype=wp.vec3, device=device)
    plain = np.zeros((len(points), 3))
    normals = wp.array(np.asarray(plain if normals is None else normals, np.float32), dtype=wp.vec3, device=device)
    found = wp.zeros(len(points), dtype=wp.vec4, device=device)
    inputs = [model.shapes, 1, near, int(for_overlap), points, normals]
    wp.launch(evaluate, len(points), inputs=inputs, outputs=[found], device=device)
    found = found.numpy().astype(np.float64)
    return found[:, 3], found[:, :3]


def wavy_ground():
    x, y = np.meshgrid(np.linspace(-1, 1, 9), np.linspace(-1, 1, 13), indexing="ij")
    return Heightfield(0.3 * np.sin(2 * x) * np.cos(3 * y), size=(2.0, 3.0))


def lopsided():
    """Overlapping children of all kinds, at poses of their own."""
    generator = np.random.default_rng(3)
    children = (Sphere(0.3), Box((0.5, 0.1, 0.2)), Capsule(0.1, 0.4), Cylinder(0.2, 0.15), meshes.torus(0.3, 0.1))
    return Compound([(child, generator.uniform(-0.5, 0.5, 3), random_quaternion(generator)) for child in children])


SHAPES = {
    "sphere": Sphere(0.3),
    "box": Box((0.5, 0.3, 0.2)),
    "needle": Box((1.0, 0.02, 0.02)),
    "capsule": Capsule(0.2, 0.4),
    "cylinder": Cylinder(0.3, 0.2),
    "rod": Cylinder(0.05, 0.5),
    "plane": Plane(normal=(1, 2, 3), offset=0.4),
    "heightfield": wavy_ground(),
    "torus": meshes.torus(0.3, 0.1),
    "compound": lopsided(),
}
CELL = {"torus": 0.8 / 64, "compound": 0.8 / 64}
"""Of the grid of a mesh in the shape [m]."""
CLOSED_FORMS = [name for name in SHAPES if name not in ("torus", "compound")]


def probe(shape, count=4000, seed=0):
    """Points in a box twice as large as the shape."""
    lower, upper = (np.clip(corner, -1.0, 1.0) for corner in shape.bounds)
    middle, half = 0.5 * (lower + upper), upper - lower + 0.05
    return (middle + np.random.default_rng(seed).uniform(-1, 1, (count, 3)) * half).astype(np.float32)


@pytest.mark.parametrize("name", SHAPES)
def test_distance_is_that_of_the_shape(device, name):
    points = probe(SHAPES[name])
    expected, _ = exact_distance(SHAPES[name], points)
    found, _ = measure(SHAPES[name], points, device)
    beyond = np.isinf(expected)
    assert (found[beyond] == 1e10).all()
    assert 10 < (expected[~beyond] < 0.0).sum() < 3900
    cell = CELL.get(name, 1e10)
    exact = ~beyond & (expected > -0.13 * cell)  # A grid's value above -1 cell is off by up to 0.87 cells.
    np.testing.assert_allclose(found[exact], expected[exact], atol=2e-6)
    np.testing.assert_allclose(found[~beyond], expected[~beyond], atol=0.87 * cell)


@pytest.mark.parametrize("name", SHAPES)
def test_host_distance_has_double_precision(name):
    """Compared at points in general position: where the gradient is not unique, any unit vector is right."""
    points = probe(SHAPES[name], seed=6).astype(np.float64)
    expected, direction = exact_distance(SHAPES[name], points)
    found, gradient = SHAPES[name].signed_distance(points)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-14)
    np.testing.assert_allclose(gradient, direction, rtol=0, atol=1e-13)


def test_host_distance_of_no_points():
    distance, gradient = Sphere(0.3).signed_distance(np.zeros((0, 3)))
    assert distance.shape == (0,) and gradient.shape == (0, 3)


@pytest.mark.parametrize("name", SHAPES)
def test_direction_is_the_unit_gradient(device, name):
    points = probe(SHAPES[name], seed=1)
    distances, expected = exact_distance(SHAPES[name], points)
    found, direction = measure(SHAPES[name], points, device)
    np.testing.assert_allclose(np.linalg.norm(direction, axis=1), 1.0, atol=1e-5)
    expected = expected / np.maximum(np.linalg.norm(expected, axis=1, keepdims=True), 1e-12)
    aligned = np.einsum("ij,ij->i", direction, expected)
    exact = distances > -0.13 * CELL.get(name, 1e10)
    assert aligned[exact].min() > 1.0 - 1e-6
    if name == "torus":
        deep = distances < -1.87 * CELL[name]
        _, slope = interpolate(SHAPES[name].grid, points[deep].astype(np.float64))
        slope /= np.linalg.norm(slope, axis=1, keepdims=True)
        assert deep.sum() > 20 and np.einsum("ij,ij->i", direction[deep], slope).min() > 1.0 - 1e-5


@pytest.mark.parametrize("name", CLOSED_FORMS)
def test_following_the_direction_leads_to_the_surface(device, name):
    """x - d n lies on the surface: ties the distance, its sign and the direction together."""
    points = probe(SHAPES[name], seed=2)
    found, direction = measure(SHAPES[name], points, device)
    if name == "heightfield":
        inside = (np.abs(points[:, :2]) < 0.5 * SHAPES[name].extent).all(axis=1)
        points, found, direction = points[inside], found[inside], direction[inside]
    landed, _ = exact_distance(SHAPES[name], points - found[:, None] * direction)
    np.testing.assert_allclose(landed, 0.0, atol=1e-5)


def test_distance_outside_a_grid_is_a_lower_bound(device):
    """Culling relies on it: no distance may exceed the true one."""
    points = 3.0 * probe(SHAPES["torus"], seed=3)
    exact, _ = SHAPES["torus"].signed_distance(points)
    found, _ = measure(SHAPES["torus"], points, device, near=-1e10)
    spacing = SHAPES["torus"].grid.spacing
    assert (found <= exact + 0.5 * spacing).all()
    assert (found >= 0.5 * exact - spacing)[exact > 0].all()


@pytest.mark.parametrize("name", ["sphere", "box", "capsule", "cylinder", "torus"])
def test_centres_and_axes_give_finite_answers(device, name):
    """Where the gradient does not exist, some unit vector is given."""
    points = np.array([[0, 0, 0], [0, 0, 0.1], [0, 0, -0.1], [0, 0, 0.6], [0, 0.1, 0]], np.float32)
    expected, _ = exact_distance(SHAPES[name], points)
    found, direction = measure(SHAPES[name], points, device)
    np.testing.assert_allclose(found, expected, atol=2e-6)
    np.testing.assert_allclose(np.linalg.norm(direction, axis=1), 1.0, atol=1e-5)


HALF = np.array([0.5, 0.3, 0.2])
BORDER = 0.005 * 0.2
CORNER = np.array([1.0, 1.0, -1.0]) / np.sqrt(3.0)


def on_top(x, y, height):
    """A point above or below the box's top face."""
    return np.array([x, y, HALF[2] + height])


def test_box_border_keeps_a_flush_corner_above_the_face(device):
    """A downward corner at the rim of the top touches the top, from inside and up to BORDER beside it."""
    for inset in (1e-4, 1e-6, 0.0, -1e-6, -0.9 * BORDER):
        for height in (1e-4, 0.0, -1e-5, -1e-3, -0.15):
            point = on_top(HALF[0] - inset, 0.1, height)
            found, direction = measure(Box(HALF), [point], device, [CORNER])
            assert found[0] == pytest.approx(height, abs=1e-7), (inset, height)
            assert direction[0].tolist() == [0, 0, 1], (inset, height)


def test_box_beyond_the_border_has_left_the_face(device):
    for height in (-1e-5, -1e-3, -0.1):
        point = on_top(HALF[0] + 1.1 * BORDER, 0.1, height)
        found, direction = measure(Box(HALF), [point], device, [CORNER])
        assert found[0] == pytest.approx(1.1 * BORDER, abs=1e-7)
        assert direction[0].tolist() == [1, 0, 0]


def test_box_measures_to_the_face_that_opposes_the_sample(device):
    """Deep in the corner of three faces the sample's own normal decides."""
    point = HALF - [0.01, 0.02, 0.03]
    for axis, depth in enumerate((0.01, 0.02, 0.03)):
        found, direction = measure(Box(HALF), [point], device, [-np.eye(3)[axis]])
        assert found[0] == pytest.approx(-depth, abs=1e-7)
        assert direction[0].tolist() == np.eye(3)[axis].tolist()


def test_box_is_touched_on_the_side_that_a_sample_came_through(device):
    """A sample deep inside is held to the nearest face that opposes it, also when it has passed the box's middle."""
    for depth in (0.05, 0.15, 0.25, 0.35):
        found, direction = measure(Box(HALF), [on_top(0, 0, -depth)], device, [(0, 0, -1.0)])
        assert found[0] == pytest.approx(-depth, abs=1e-6)
        assert direction[0].tolist() == [0, 0, 1]


@pytest.mark.parametrize("shape", [Box(HALF), Cylinder(0.4, 0.25)], ids=["box", "cylinder"])
def test_border_rule_far_from_borders_is_the_plain_distance(device, shape):
    """Outside two faces at once, or above the inner part of one that opposes the sample, nothing changes."""
    points = probe(shape, seed=4)
    half = np.array(shape.bounds[1])
    if isinstance(shape, Box):
        excess = np.abs(points) - half
    else:
        excess = np.stack([np.linalg.norm(points[:, :2], axis=1) - half[0], np.abs(points[:, 2]) - half[2]], axis=1)
    border = 0.005 * half.min()
    expected, gradient = exact_distance(shape, points)
    opposing = -gradient + 0.3 * np.random.default_rng(5).normal(size=gradient.shape)
    opposing /= np.linalg.norm(opposing, axis=1, keepdims=True)
    several = (excess > border).sum(axis=1) > 1
    one = (excess > border).sum(axis=1) == 1
    alone = one & (np.sort(excess, axis=1)[:, -2] < -1.1 * border)
    facing = np.einsum("ij,ij->i", gradient, opposing) < -0.2
    found, direction = measure(shape, points, device, opposing)
    for chosen in (several, alone & facing):
        assert chosen.sum() > 200
        np.testing.assert_allclose(found[chosen], expected[chosen], atol=1e-6)
        np.testing.assert_allclose(direction[chosen], gradient[chosen], atol=1e-4)


def test_cylinder_border_keeps_a_flush_rim_above_the_cap(device):
    """A rim sample of an equal cylinder on top touches the cap, all around, up to BORDER beside it."""
    angle = np.linspace(0, 2 * np.pi, 33)[:-1]
    ring = np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])
    down = (ring + [0, 0, -1]) / np.sqrt(2)
    for inset in (1e-5, 0.0, -0.9 * 0.005 * 0.25):
        found, direction = measure(Cylinder(0.4, 0.25), (0.4 - inset) * ring + [0, 0, 0.25 - 1e-3], device, down)
        np.testing.assert_allclose(found, -1e-3, atol=1e-7)
        np.testing.assert_allclose(direction, np.tile([0, 0, 1.0], (32, 1)), atol=1e-6)


def test_a_point_inside_a_cylinder_is_held_to_its_side_or_caps(device):
    """Whatever way a sample points: no face is nearer than the nearest one, and none points around the axis."""
    cylinder = Cylinder(0.4, 0.25)
    points = probe(cylinder, seed=6)
    expected, _ = exact_distance(cylinder, points)
    points, expected = points[expected < -0.01], expected[expected < -0.01]
    normals = np.random.default_rng(7).normal(size=points.shape)
    found, direction = measure(cylinder, points, device, normals / np.linalg.norm(normals, axis=1, keepdims=True))
    held = found < 0.5 * distance.FAR
    assert held.sum() > 200
    assert (found[held] < expected[held] + 1e-6).all()
    around = np.cross(points[held], [0, 0, 1])
    np.testing.assert_allclose(np.einsum("ij,ij->i", direction[held], around), 0.0, atol=1e-6)


def test_border_rule_holds_for_parts_at_their_own_pose(device):
    """The sample's normal is turned into the part's frame too."""
    turn = (0.0, np.sqrt(0.5), 0.0, np.sqrt(0.5))
    turned = Compound([(Box((0.2, 0.3, 0.5)), (1.0, 0.0, 0.0), turn)])
    point = np.array([1.0 + 0.5, 0.1, 0.2 - 1e-3])
    found, direction = measure(turned, [point], device, [CORNER])
    assert found[0] == pytest.approx(-1e-3, abs=1e-6)
    np.testing.assert_allclose(direction[0], [0, 0, 1], atol=1e-6)


@pytest.mark.parametrize(
    "mesh", [meshes.torus(), meshes.bunny(0.2), meshes.tetrahedron()], ids=["torus", "bunny", "tip"]
)
def test_the_nodes_of_a_grid_bound_the_distance_to_its_mesh(mesh, device):
    """No point is nearer than its bound; near the surface it is 0.24 cells below the distance, in the mean.

    More than a cell inside, the distance is that of the grid, too.
    """
    generator = np.random.default_rng(0)
    lower, upper = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    points = generator.uniform(lower - 0.3 * (upper - lower), upper + 0.3 * (upper - lower), (20_000, 3))
    exact, _ = measure(mesh, points, device)
    model = build_model(layout_of(scene_of(mesh), 1), wp.get_device(device))
    bounds = wp.zeros(len(points), dtype=float, device=device)
    at = wp.array(points.astype(np.float32), dtype=wp.vec3, device=device)
    wp.launch(evaluate_bound, len(points), inputs=[model.shapes, 0, at], outputs=[bounds], device=device)
    exact /= mesh.parts()[0].grid.spacing
    loss = exact - bounds.numpy() / mesh.parts()[0].grid.spacing
    assert loss[exact > -1.0].min() > -1e-3
    near = (exact > 0.0) & (exact < 2.0)
    assert near.sum() > 100 and loss[near].mean() < 0.3


@pytest.mark.parametrize("near", [0.0, 0.002, 0.01])
def test_distances_to_a_mesh_are_exact_below_the_one_that_is_asked_for(near, device):
    mesh = meshes.bunny(0.2)
    points = np.random.default_rng(1).uniform(-0.12, 0.12, (20_000, 3))
    exact, direction = measure(mesh, points, device)
    found, found_direction = measure(mesh, points, device, near=near)
    asked = (exact < near) & (exact > -mesh.parts()[0].grid.spacing)
    np.testing.assert_array_equal(found[asked], exact[asked])
    np.testing.assert_array_equal(found_direction[asked], direction[asked])
    assert (found[exact >= near] >= near).all()
    true = measure(mesh, points, device, near=near, for_overlap=True)[0]
    np.testing.assert_allclose(true[asked], exact[asked], atol=1e-6)
    assert (true[exact >= near] >= near - 1e-6).all()


def test_points_above_the_border_of_a_face_of_a_mesh_are_found(device):
    """Those up to 0.25 % of the smallest extent beyond it are as near as its plane, also below small distances."""
    cube, near = Mesh(*Box((0.1, 0.1, 0.1)).surface()), 1e-4
    generator = np.random.default_rng(0)
    points = np.stack([0.1 + generator.uniform(0, 4.9e-4, 5000), *generator.uniform(-0.09, 0.09, (2, 5000))], axis=1)
    points[:, 2] = 0.1 + generator.uniform(-0.9e-4, 0.9e-4, 5000)
    down = np.tile((0.0, 0.0, -1.0), (5000, 1))
    exact, _ = measure(cube, points, device, down)
    found, _ = measure(cube, points, device, down, near=near)
    assert (np.abs(exact) < near).mean() > 0.5
    np.testing.assert_array_equal(found[exact < near], exact[exact < near])


def scene_of(shape):
    scene = Scene()
    scene.add_static(shape)
    return scene
