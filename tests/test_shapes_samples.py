"""Samples and their clusters: coverage, kinds, normals, bounding spheres (V09; capabilities 7, 8)."""

import math

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from tests.geometry_oracles import cube, l_prism, random_surface_points, star_prism
from warp_rigid.scene.shapes import Box, Capsule, Compound, Cylinder, Heightfield, Mesh, Plane, SampleKind, Sphere
from warp_rigid.scene.shapes.tessellation import geodesic
from warp_rigid.scenes.builders import meshes

IDENTITY = (0.0, 0.0, 0.0, 1.0)
POINT, EDGE, RIM, FACE, CAP, CORNER, ARC, SIDE = SampleKind
PLACES = 4


def prism_mesh(build):
    return Mesh(*build())


SHAPES = {
    "sphere": lambda: Sphere(0.4),
    "box": lambda: Box((0.5, 0.3, 0.2)),
    "capsule": lambda: Capsule(0.2, 0.5),
    "cylinder": lambda: Cylinder(0.3, 0.5),
    "disc": lambda: Cylinder(0.5, 0.1),
    "heightfield": lambda: Heightfield(np.random.default_rng(0).normal(size=(12, 9)), (3, 2)),
    "compound": lambda: Compound([(Box((1, 1, 1)), (0, 0, 0), IDENTITY), (Cylinder(0.3, 1), (0, 0, 1.5), IDENTITY)]),
    "bunny": meshes.bunny,
    "torus": meshes.torus,
    "ring": meshes.ring,
    "l_prism": lambda: prism_mesh(l_prism),
    "star": lambda: prism_mesh(star_prism),
    "cube_mesh": lambda: prism_mesh(cube),
    "skull": meshes.skull_like,
    "brain": meshes.brain_like,
}
MESHES = ["bunny", "torus", "ring", "l_prism", "star", "cube_mesh", "skull", "brain"]


def end_points(samples, spacing):
    """All sample points, EDGE segments replaced by points no farther apart than the spacing / 20."""
    fractions = np.linspace(-1.0, 1.0, 41)
    edge = samples.kind == EDGE
    along = samples.point[edge, None] + fractions[:, None] * samples.slide[edge, None]
    assert np.linalg.norm(samples.slide, axis=1).max(initial=0.0) <= 0.5 * spacing * (1 + 1e-5)
    return np.concatenate([samples.point[~edge], along.reshape(-1, 3)])


@pytest.mark.parametrize("name", SHAPES)
def test_arrays_fit_together_and_clusters_hold_their_samples(name):
    samples = SHAPES[name]().samples()
    count, clusters = len(samples), len(samples.cluster_radius)
    for array in (samples.point, samples.normal, samples.slide):
        assert array.shape == (count, 3) and array.dtype == np.float32
    assert samples.radius.shape == (count,) and samples.radius.dtype == np.float32
    assert samples.kind.shape == (count,) and samples.kind.dtype == np.int32
    assert samples.cluster_start.dtype == np.int32
    assert samples.cluster_start[0] == 0 and samples.cluster_start[-1] == count
    sizes = np.diff(samples.cluster_start)
    assert clusters == len(sizes) and 1 <= sizes.min() and sizes.max() <= 32
    further = np.where(samples.choice > 1, CORNER, samples.kind)  # places of balls on meshes, apart
    first = further[samples.cluster_start[:-1]]
    for family in ((POINT, RIM, CAP), (EDGE,), (FACE,), (ARC,), (CORNER,)):
        members = np.isin(further, family)
        assert np.isin(first, family).sum() == -(-members.sum() // 32)
        assert (np.isin(np.repeat(first, sizes), family) == members).all()
    length = np.linalg.norm(samples.normal, axis=1)
    assert (np.isclose(length, 1.0, atol=1e-5) | (length == 0.0)).all()
    owner = np.repeat(np.arange(clusters), sizes)
    for sign in (-1.0, 1.0):
        end = samples.point.astype(np.float64) + sign * samples.slide
        reach = np.linalg.norm(end - samples.cluster_center[owner], axis=1) + samples.radius
        assert (reach <= samples.cluster_radius[owner]).all()


@pytest.mark.parametrize("name", MESHES)
def test_every_surface_point_is_near_a_sample(name):
    mesh = SHAPES[name]()
    spacing = mesh.sample_spacing
    assert spacing == pytest.approx(np.ptp(mesh.vertices, axis=0).max() / 16)
    points = random_surface_points(mesh.vertices, mesh.faces, 20_000, np.random.default_rng(0))
    gap, _ = cKDTree(end_points(mesh.samples(), spacing)).query(points)
    assert gap.max() <= spacing


@pytest.mark.parametrize("name", MESHES)
def test_all_vertices_are_samples(name):
    mesh = SHAPES[name]()
    samples = mesh.samples()
    gap, _ = cKDTree(samples.point[samples.kind == POINT]).query(mesh.vertices)
    assert gap.max() < 1e-6


@pytest.mark.parametrize("name", MESHES)
def test_samples_lie_on_the_surface_with_outward_normals(name):
    mesh = SHAPES[name]()
    samples = mesh.samples()
    if name in ("bunny", "torus"):
        # on curved surfaces normals are means; on the others every step outward must leave the solid
        np.testing.assert_allclose(np.linalg.norm(samples.normal, axis=1), 1.0, atol=1e-5)
    step = 1e-3 * mesh.size
    distance, _ = mesh.signed_distance(samples.point)
    assert np.abs(distance).max() < 1e-5 * mesh.size
    outside, _ = mesh.signed_distance(samples.point + step * samples.normal)
    inside, _ = mesh.signed_distance(samples.point - step * samples.normal)
    # at saddles of a skull or a brain a mean normal may graze; an opening's rim has no inside
    share = {"skull": 0.95, "brain": 0.97}.get(name, 1.0)
    assert (outside > 0.0).mean() >= share and (inside < 0.0).mean() >= share


def test_feature_edges_of_a_mesh_are_covered_by_segments():
    mesh = Mesh(*l_prism())
    samples = mesh.samples()
    edge = samples.kind == EDGE
    length = 2.0 * np.linalg.norm(samples.slide[edge], axis=1)
    sides = [3, 1, 2, 2, 1, 3]  # around the L, twice; six uprights, one of them in the notch
    assert length.sum() == pytest.approx(2 * sum(sides) + 6 - 1, rel=1e-5)
    assert length.max() <= mesh.sample_spacing * (1 + 1e-5)
    np.testing.assert_allclose(np.sort(np.abs(samples.normal[edge]), axis=1)[:, 1:], 0.5**0.5, atol=1e-5)


def test_both_ends_of_an_edge_that_bends_little_know_it():
    """At the top of a flat cone of 16 sides, these edges were cut to eight."""
    turn = np.arange(16) * math.pi / 8
    rim = np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=1)
    hull = trimesh.convex.convex_hull(np.concatenate([rim, [[0, 0, 0.5], [0, 0, -0.5]]]))
    cone = Mesh(hull.vertices, hull.faces, sdf_resolution=16)
    samples = cone.samples()
    count = np.diff(samples.edges, axis=1)[:, 0]
    for point, (first, last) in zip(samples.point, samples.edges, strict=True):
        for along in samples.unsampled_edges[first:last]:
            other = np.linalg.norm(samples.point - point - along, axis=1).argmin()
            assert np.linalg.norm(samples.point[other] - point - along) < 1e-6
            back = samples.unsampled_edges[slice(*samples.edges[other])]
            assert np.linalg.norm(back + along, axis=1).min() < 1e-6
    assert count.max() == 16
    assert len(samples.unsampled_edges) == count.sum()


def test_the_boundary_of_an_open_mesh_is_covered_by_segments():
    vertices, faces = cube()
    open_box = Mesh(vertices, faces[2:])
    closed = Mesh(vertices, faces)
    length = [
        np.linalg.norm(mesh.samples().slide[mesh.samples().kind == EDGE], axis=1).sum() * 2
        for mesh in (open_box, closed)
    ]
    np.testing.assert_allclose(length, 12.0, rtol=1e-5)


def test_long_edges_of_a_box_have_short_segments():
    """A face as wide as the beam spans more than one segment, so that both places where an edge leaves it are found."""
    samples = Box((1.0, 0.1, 0.1)).samples()
    length = 2.0 * np.linalg.norm(samples.slide[samples.kind == EDGE], axis=1)
    assert length.max() < 0.2 and len(length) == 4 * 16 + 8 * 4


@pytest.mark.parametrize("shape", [Cylinder(0.3, 0.5), Cylinder(0.5, 0.1)])
def test_cylinder_rims_points_and_sides(shape):
    samples = shape.samples()
    rim = samples.kind == RIM
    assert rim.sum() == 2
    np.testing.assert_allclose(samples.radius[rim], shape.radius)
    np.testing.assert_allclose(samples.point[rim], samples.normal[rim] * shape.half_height, atol=1e-6)
    from_axis = np.linalg.norm(samples.point[:, :2], axis=1)
    corner = (samples.kind == CAP) & np.isclose(from_axis, shape.radius)
    assert corner.sum() == 32
    expected = samples.point[corner] * [0.0, 0.0, 1 / shape.half_height]
    np.testing.assert_allclose(samples.normal[corner], expected, atol=1e-5)
    # arcs about these points, all around, as long as a sixteenth of the circle
    arc = samples.kind == ARC
    points = samples.point[arc]
    np.testing.assert_array_equal(np.unique(points, axis=0), np.unique(samples.point[corner], axis=0))
    outward = points * [1.0 / shape.radius, 1.0 / shape.radius, 0.0]
    cap = points * [0.0, 0.0, 1.0 / shape.half_height]
    np.testing.assert_allclose(samples.normal[arc], np.sqrt(0.5) * (outward + cap), atol=1e-6)
    np.testing.assert_allclose(samples.slide[arc], np.pi / 16 * shape.radius * np.cross(outward, cap), atol=1e-6)
    # the side is reached all around: from its lines, and from all of the axis, the ends of which point to the caps
    side = samples.kind == SIDE
    edge = (samples.kind == EDGE) | side
    for sign in (-1.0, 0.0, 1.0):
        end = samples.point[edge] + sign * samples.slide[edge]
        reached = np.linalg.norm(end[:, :2], axis=1) + samples.radius[edge]
        np.testing.assert_allclose(reached, shape.radius, atol=1e-6)
    cap = samples.point[side] + np.linalg.norm(samples.slide[side], axis=1, keepdims=True) * samples.normal[side]
    np.testing.assert_allclose(cap, np.outer([-shape.half_height, shape.half_height], [0, 0, 1]), atol=1e-6)
    axis = edge & (samples.radius > 0)
    assert 2.0 * np.abs(samples.slide[axis, 2]).sum() == pytest.approx(2.0 * shape.half_height)
    # the axis of a long one ends in balls that touch the side, not the caps
    ball = samples.kind == POINT
    assert ball.sum() == (2 * PLACES if shape.half_height > shape.radius else 0)
    np.testing.assert_array_equal(samples.radius[ball], np.float32(shape.radius))
    assert not from_axis[ball].any()
    assert (np.abs(samples.point[ball, 2]) + 1.01 * shape.radius < shape.half_height).all()


def test_edges_find_crossed_edges_that_vertices_miss():
    quarter = math.pi / 4
    lower = Box((1.0, 0.1, 0.1))
    turn = np.array([[1, 0, 0], [0, math.cos(quarter), -math.sin(quarter)],
                     [0, math.sin(quarter), math.cos(quarter)]])  # fmt: skip
    across = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]]) @ turn
    lift = 2 * 0.1 * 2**0.5 - 0.01  # the two edges overlap by 1 cm
    samples = lower.samples()

    def depth(points):
        upper_frame = (points @ across.T + [0, 0, lift]) @ turn
        return lower.signed_distance(upper_frame)[0]

    edge = samples.kind == EDGE
    assert depth(samples.point[~edge]).min() > 0.0
    along = np.linspace(-1.0, 1.0, 101)[:, None]
    swept = samples.point[edge, None] + along * samples.slide[edge, None]
    assert depth(swept.reshape(-1, 3)).min() == pytest.approx(-0.01 / 2**0.5, abs=1e-3)


def test_compound_drops_what_is_hidden_and_keeps_the_rest():
    box, offset = Box((0.5, 0.5, 0.5)), np.array([0.5, 0, 0])
    flush = Compound([(box, -offset, IDENTITY), (box, offset, IDENTITY)])
    samples = flush.samples()
    face_points = samples.kind == FACE
    assert face_points.sum() == 2 * 5 * 9  # the two faces that meet are gone
    overlap = Compound([(box, -0.9 * offset, IDENTITY), (box, 0.9 * offset, IDENTITY)])
    distance = [box.signed_distance(overlap.samples().point - sign * 0.9 * offset)[0] for sign in (-1, 1)]
    assert np.min(distance) >= -1e-6
    far = Compound([(box, -3 * offset, IDENTITY), (box, 3 * offset, IDENTITY)])
    assert len(far.samples()) == 2 * len(box.samples())
    swallowed = Compound([(box, (0, 0, 0), IDENTITY), (Cylinder(0.1, 0.2), (0, 0, 0), IDENTITY)])
    assert len(swallowed.samples()) == len(box.samples())
    with_ball = Compound([(box, (0, 0, 0), IDENTITY), (Sphere(0.3), (0.5, 0, 0), IDENTITY)])
    assert (with_ball.samples().radius > 0).sum() == PLACES


def test_compound_samples_turn_with_their_child():
    turn = (0.5, 0.5, 0.5, 0.5)  # x to y, y to z, z to x
    samples = Compound([(Cylinder(0.2, 0.5), (1, 2, 3), turn)]).samples()
    rim = samples.kind == RIM
    np.testing.assert_allclose(np.sort(samples.point[rim], axis=0), [[0.5, 2, 3], [1.5, 2, 3]])
    np.testing.assert_allclose(np.abs(samples.normal[rim]), [[1, 0, 0], [1, 0, 0]], atol=1e-6)


def test_clusters_save_nine_tenths_of_the_distance_queries():
    vertices, faces = geodesic(45)  # 20 252 vertices
    mesh = Mesh(0.5 * vertices, faces)
    assert len(mesh.vertices) > 20_000
    samples = mesh.samples()
    floor, margin = Plane(offset=-0.499), 0.002
    center_distance, _ = floor.signed_distance(samples.cluster_center)
    near = center_distance <= samples.cluster_radius + margin
    queries = len(near) + np.diff(samples.cluster_start)[near].sum()
    distance, _ = floor.signed_distance(samples.point)
    kept = np.repeat(near, np.diff(samples.cluster_start))
    assert queries * 10 <= len(samples)
    assert np.argmin(np.where(kept, distance, np.inf)) == np.argmin(distance)
    np.testing.assert_array_equal(distance[~kept] > margin, True)
