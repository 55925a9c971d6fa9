"""Simple shapes and compounds: distances, gradients, bounds, surfaces, refusals."""

import math

import numpy as np
import pytest
import trimesh

from tests.geometry_oracles import (
    cube,
    random_rotation,
)
from warp_rigid import rotations
from warp_rigid.scene.shapes import Box, Capsule, Compound, Cylinder, Heightfield, Mesh, PartKind, Plane, Shape, Sphere

IDENTITY = (0.0, 0.0, 0.0, 1.0)


def turned_pair():
    """An L of two boxes that touch without overlapping, the second one turned."""
    quarter = (0.0, 0.0, math.sin(math.pi / 4), math.cos(math.pi / 4))
    return Compound([(Box((0.4, 0.1, 0.1)), (0.4, 0, 0), IDENTITY), (Box((0.3, 0.1, 0.1)), (0, 0.2, 0), quarter)])


SOLIDS = {
    "sphere": Sphere(0.4),
    "box": Box((0.5, 0.3, 0.2)),
    "capsule": Capsule(0.2, 0.5),
    "cylinder": Cylinder(0.3, 0.5),
    "disc": Cylinder(0.5, 0.1),
    "compound": turned_pair(),
}


@pytest.mark.parametrize("name", SOLIDS)
def test_inner_balls_touch_the_surface_from_inside(name):
    balls = SOLIDS[name].inner_balls
    assert -SOLIDS[name].signed_distance(balls[:, :3])[0] == pytest.approx(balls[:, 3], rel=1e-12)
    assert balls[0, 3] == balls[:, 3].max()


def test_inner_balls_are_in_every_arm_of_a_mesh():
    """All points on the axes of a jack's arms, up to the last ball's radius, are in a ball or nearly so."""
    size, arm = 0.3, 0.06
    boxes = [trimesh.creation.box(np.roll((size, arm, arm), k)) for k in range(3)]
    balls = Mesh.from_trimesh(trimesh.boolean.union(boxes, engine="manifold")).inner_balls
    assert (balls[:, 3] > 0.7 * balls[0, 3]).all()
    along = np.linspace(-0.5 * (size - arm), 0.5 * (size - arm), 50)
    for axis in np.eye(3):
        away = np.linalg.norm(along[:, None, None] * axis - balls[:, :3], axis=2)
        assert (away - balls[:, 3]).min(axis=1).max() < 0.1 * arm


@pytest.mark.parametrize("name", SOLIDS)
def test_gradient_is_a_unit_vector_even_at_symmetric_points(name):
    shape = SOLIDS[name]
    axis = np.concatenate([np.zeros((1, 3)), np.eye(3) * 0.05, -np.eye(3) * 0.05])
    distance, gradient = shape.signed_distance(axis)
    assert np.isfinite(distance).all()
    np.testing.assert_allclose(np.linalg.norm(gradient, axis=1), 1.0, atol=1e-12)


@pytest.mark.parametrize("name", SOLIDS)
def test_surface_is_closed_outward_and_on_the_shape(name):
    shape = SOLIDS[name]
    vertices, faces = shape.surface()
    drawn = trimesh.Trimesh(vertices, faces, process=False)
    assert drawn.is_watertight and drawn.is_winding_consistent
    assert drawn.volume == pytest.approx(shape.volume, rel=0.03)
    distance, _ = shape.signed_distance(vertices)
    assert distance.max() < 1e-12
    lower, upper = shape.bounds
    assert (vertices >= lower - 1e-12).all() and (vertices <= upper + 1e-12).all()
    if name in ("box", "compound"):
        np.testing.assert_allclose([vertices.min(axis=0), vertices.max(axis=0)], [lower, upper])


def test_bounds_are_the_tightest_for_turned_children():
    generator = np.random.default_rng(4)
    for shape in SOLIDS.values():
        quaternion, rotation = random_rotation(generator)
        place = generator.normal(size=3)
        lower, upper = Compound([(shape, place, quaternion)]).bounds
        direction = np.concatenate([-rotation, rotation])  # rows: world axes in the shape's frame
        points = generator.normal(size=(200_000, 3))
        distance, gradient = shape.signed_distance(points * 0.3)
        on_surface = points * 0.3 - distance[:, None] * gradient
        reach = (on_surface @ direction.T).max(axis=0)
        np.testing.assert_allclose(place - lower, reach[:3], atol=0.01)
        np.testing.assert_allclose(upper - place, reach[3:], atol=0.01)
        assert (place - lower >= reach[:3] - 1e-9).all()
        assert (upper - place >= reach[3:] - 1e-9).all()


def test_size_is_the_smallest_extent():
    assert Box((0.5, 0.1, 0.3)).size == pytest.approx(0.2)
    assert Cylinder(0.5, 0.1).size == pytest.approx(0.2)
    assert Capsule(0.2, 3.0).size == pytest.approx(0.4)
    assert turned_pair().size == pytest.approx(0.2)
    assert Plane().size == math.inf
    assert Heightfield(np.zeros((2, 2)), (1, 1)).size == math.inf


def test_plane():
    plane = Plane(normal=(0, 3, 4), offset=2.0)
    points = np.array([[0, 0, 0], [7, 1.2, 1.6], [0, 3, 4.0]])
    distance, gradient = plane.signed_distance(points)
    np.testing.assert_allclose(distance, [-2, 0, 3], atol=1e-12)
    np.testing.assert_allclose(gradient, [[0, 0.6, 0.8]] * 3, atol=1e-12)
    assert plane.static_only and plane.volume == 0.0 and len(plane.samples()) == 0
    vertices, faces = plane.surface()
    drawn = vertices[faces[0]]
    normal = np.cross(drawn[1] - drawn[0], drawn[2] - drawn[0])
    np.testing.assert_allclose(normal / np.linalg.norm(normal), plane.normal, atol=1e-12)
    np.testing.assert_allclose(plane.signed_distance(vertices)[0], 0.0, atol=1e-12)
    np.testing.assert_allclose(np.ptp(Plane().surface()[0], axis=0), [20, 20, 0])
    assert Plane().bounds[1][2] == 0.0 and Plane((0, 0, -1), 1.0).bounds[0][2] == -1.0
    assert np.isinf(Plane((1, 0, 1)).bounds).all()


def test_nested_compounds_are_flattened_at_the_right_places():
    generator = np.random.default_rng(8)
    inner_turn, _ = random_rotation(generator)
    outer_turn, _ = random_rotation(generator)
    inner = Compound([(Capsule(0.1, 0.3), (0.2, 0, 0.1), inner_turn), (Sphere(0.2), (0, 1, 0), IDENTITY)])
    outer = Compound([(inner, (1, 2, 3), outer_turn), (Box((0.1, 0.2, 0.3)), (0, 0, 0), IDENTITY)])
    parts = outer.parts()
    assert [part.kind for part in parts] == [PartKind.CAPSULE, PartKind.SPHERE, PartKind.BOX]
    points = generator.normal(scale=2.0, size=(200, 3))
    shapes = [Capsule(0.1, 0.3), Sphere(0.2), Box((0.1, 0.2, 0.3))]
    nearest = np.min(
        [
            shape.signed_distance((points - part.position) @ rotations.matrix(part.orientation))[0]
            for part, shape in zip(parts, shapes, strict=True)
        ],
        axis=0,
    )
    np.testing.assert_allclose(outer.signed_distance(points)[0], nearest, atol=1e-12)


def test_equal_shapes_share_a_key_and_shapes_cannot_be_changed():
    assert Sphere(1).key == Sphere(1.0).key != Sphere(2).key
    assert Box((1, 1, 1)) == Box([1, 1, 1]) != Sphere(1)
    assert Capsule(1, 2).key != Cylinder(1, 2).key
    assert turned_pair().key == turned_pair().key
    assert Mesh(*cube()).key == Mesh(*cube()).key != Mesh(*cube(), sdf_resolution=32).key
    assert Plane().key != Plane(offset=1).key
    with pytest.raises(AttributeError):
        Sphere(1).radius = 2.0
    with pytest.raises(ValueError):
        Box((1, 1, 1)).half_extents[0] = 2.0


def test_two_shapes_of_one_name_are_refused():
    """Saved scenes name shapes by their class."""
    with pytest.raises(TypeError, match="Sphere: warp_rigid.scene.shapes.analytic.Sphere already has this name"):
        type("Sphere", (Shape,), {})
    assert Shape.classes["sphere"] is Sphere


@pytest.mark.parametrize(
    ("make", "field"),
    [
        (lambda: Sphere(0), "radius"),
        (lambda: Sphere(math.nan), "radius"),
        (lambda: Sphere("wide"), "radius"),
        (lambda: Box((1, 2)), "half_extents"),
        (lambda: Box((1, -2, 3)), "half_extents"),
        (lambda: Capsule(1, -1), "half_height"),
        (lambda: Cylinder(math.inf, 1), "radius"),
        (lambda: Plane((0, 0, 0)), "normal"),
        (lambda: Plane(offset=math.inf), "offset"),
        (lambda: Heightfield([[1, 2]], (1, 1)), "heights"),
        (lambda: Heightfield([[1, 2], [3, math.nan]], (1, 1)), "heights"),
        (lambda: Heightfield(np.zeros((3, 3)), (1, 0)), "size"),
        (lambda: Compound([]), "children"),
        (lambda: Compound([Sphere(1)]), "children[0]"),
        (lambda: Compound([(Plane(), (0, 0, 0), IDENTITY)]), "children[0]"),
        (lambda: Compound([(Sphere(1), (0, 0, 0), (0, 0, 0, 0))]), "children[0]"),
        (lambda: Sphere(1).signed_distance([[1, 2]]), "points"),
    ],
)
def test_bad_input_is_refused_in_one_line_that_names_the_field(make, field):
    with pytest.raises(ValueError) as refusal:
        make()
    message = str(refusal.value)
    assert message.startswith(field) and "\n" not in message


def test_a_mesh_thinner_than_a_cell_of_its_grid_has_one_inner_ball_without_extent():
    vertices, faces = cube(1.0)
    balls = Mesh(vertices * [0.5, 0.5, 5e-4], faces).inner_balls
    assert balls.shape == (1, 4) and balls[0, 3] == 0.0
