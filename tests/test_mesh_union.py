"""Meshes of several closed shells: those that overlap or touch become their union."""

import warnings

import numpy as np
import pytest
import trimesh
from trimesh.transformations import random_rotation_matrix, rotation_matrix, translation_matrix

import warp_rigid as wr
from tests.geometry_oracles import points_around, winding


def box(size, at=(0, 0, 0), inverted=False):
    made = trimesh.creation.box(size)
    made.apply_translation(at)
    if inverted:
        made.invert()
    return made


def ball(radius):
    return trimesh.creation.icosphere(radius=radius)


def joined(*parts, **options):
    """The mesh of some closed parts in one file."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return wr.Mesh.from_trimesh(trimesh.util.concatenate(parts), **options)


def random_parts(seed):
    generator = np.random.default_rng(seed)
    parts = []
    for _ in range(5):
        size = generator.uniform(0.2, 1, 3) if generator.random() < 0.5 else generator.uniform(0.2, 0.5)
        part = box(size) if np.ndim(size) else trimesh.creation.icosphere(subdivisions=2, radius=size)
        part.apply_transform(random_rotation_matrix(generator.random(3)))
        part.apply_translation(generator.uniform(-0.4, 0.4, 3))
        parts.append(part)
    return parts


def walls_on_a_floor(wall=0.002):
    """A tray of five boxes: the walls stand on the floor and overlap at the corners."""
    parts = [box((0.3, 0.3, wall))]
    for k in range(4):
        upright = box((0.3, wall, 0.06))
        turn = rotation_matrix(k * np.pi / 2, (0, 0, 1))
        upright.apply_transform(turn @ translation_matrix((0, 0.15 - wall / 2, 0.03 + wall / 2)))
        parts.append(upright)
    return parts


UNIT = box((1, 1, 1))
HOLLOW = [UNIT, box((0.5, 0.5, 0.5), inverted=True)]
CLOSED_FORMS = {
    "face to face": ([UNIT, box((1, 1, 1), (1, 0, 0))], 2.0),
    "faces that overlap in part": ([UNIT, box((1, 1, 1), (1, 0.5, 0))], 2.0),
    "edge to edge": ([UNIT, box((1, 1, 1), (1, 1, 0))], 2.0),
    "half inside": ([UNIT, box((1, 1, 1), (0.5, 0, 0))], 1.5),
    "one inside the other": ([UNIT, box((0.5, 0.5, 0.5))], 1.0),
    "a cross": ([box((3, 1, 1)), box((1, 3, 1)), box((1, 1, 3))], 7.0),
    "a box in a hollow box": ([*HOLLOW, box((0.3, 0.3, 0.3))], 0.875 + 0.027),
    "a rod through a hollow box": ([*HOLLOW, box((0.2, 0.2, 2.0))], 0.875 + 0.04 * 1.5),
    "walls on a floor": (walls_on_a_floor(), 0.3 * 0.3 * 0.002 + 0.06 * (0.3**2 - 0.296**2)),
}


@pytest.mark.parametrize("name", CLOSED_FORMS)
def test_volume_of_the_union(name):
    parts, volume = CLOSED_FORMS[name]
    mesh = joined(*parts)
    assert mesh.volume == pytest.approx(volume, rel=1e-9)
    assert mesh.watertight and mesh.tree.signed


def test_a_ball_and_a_box_have_no_cavity_where_they_overlap():
    mesh = joined(ball(0.1), box((0.12, 0.12, 0.3)))
    distance, _ = mesh.signed_distance([(0.07, 0, 0), (0, 0, 0)])
    np.testing.assert_allclose(distance, (-0.03, -0.1), atol=2e-3)  # the ball is a polyhedron
    grid = mesh.grid
    node = np.rint((np.array([0.07, 0, 0]) - grid.origin) / grid.spacing).astype(int)
    assert grid.values[tuple(node)] < -0.02


@pytest.mark.parametrize("seed", [2, 3, *(pytest.param(seed, marks=pytest.mark.long) for seed in (0, 1))])
def test_mass_and_sign_are_those_of_the_points_with_a_winding_number_above_one_half(seed):
    parts = random_parts(seed)
    mesh = joined(*parts)
    points = points_around(*mesh.bounds, 1.0, 20_000, np.random.default_rng(seed))
    inside = np.any([winding(points, part.triangles) > 0.5 for part in parts], axis=0)
    arm = points - mesh.center_of_mass
    moment = np.einsum("ni,ni->n", arm, arm)[:, None, None] * np.eye(3) - arm[:, :, None] * arm[:, None, :]
    volume = np.prod(mesh.bounds[1] - mesh.bounds[0])
    for found, density in ((mesh.volume, 1.0), (0.0, arm), (mesh.inertia, moment)):
        shares = np.array((inside * np.transpose(density)).T) * volume
        error = 4.5 * shares.std(axis=0) / len(points) ** 0.5
        assert (np.abs(shares.mean(axis=0) - found) < error).all()
    distance, _ = mesh.signed_distance(points)
    clear = np.abs(distance) > 1e-5
    np.testing.assert_array_equal((distance < 0)[clear], inside[clear])


def test_the_change_is_reported():
    with pytest.warns(UserWarning, match="joined 2 shells that overlap or touch into their union"):
        wr.Mesh.from_trimesh(trimesh.util.concatenate([UNIT, box((1, 1, 1), (0.5, 0, 0))]))


def test_shells_that_are_apart_and_cavities_stay_as_they_are():
    """Bit for bit and in their order: nothing is computed anew."""
    for parts in (HOLLOW, [UNIT, box((1, 1, 1), (1.1, 0, 0))], [UNIT, ball(0.5).apply_translation((0.9, 0.9, 0.9))]):
        given = trimesh.util.concatenate(parts)
        mesh = wr.Mesh.from_trimesh(given)
        assert mesh.repairs == []
        np.testing.assert_array_equal(mesh.vertices, given.vertices)
        np.testing.assert_array_equal(mesh.faces, given.faces)


def test_nothing_is_caught_where_shells_overlap(device):
    """A ball on the seam of two boxes that overlap comes to rest on their common upper face."""
    scene = wr.Scene()
    scene.add_static(joined(UNIT, box((1, 1, 1), (0.5, 0, 0))))
    scene.add_body(wr.Sphere(0.1), position=(0.25, 0, 0.62), linear_velocity=(0.5, 0, 0))
    sim = wr.Simulator(scene, device=device)
    for _ in range(12):
        sim.step(10)
        assert sim.get("position")[0, 1, 2] > 0.5995
        assert sim.penetration()[0] < 5e-4
