"""Balls, rods and cylinders against wide boxes and meshes: found where they touch, and nowhere else."""

import itertools

import numpy as np
import pytest

from tests.geometry_oracles import cube
from tests.oracles import contact_list, find_contacts, opened, rotate_about
from tests.test_narrowphase import touch, touches
from warp_rigid.engine.simulator import Simulator
from warp_rigid.scene.scene import Scene
from warp_rigid.scene.shapes import Box, Capsule, Cylinder, Mesh, Sphere
from warp_rigid.scenes.builders import meshes

SLAB = Box((5.0, 5.0, 0.25))


@pytest.mark.parametrize("degrees", [0.5, 3.0, 45.0, 87.0, 89.9, 90.0])
def test_a_tilted_cylinder_touches_only_the_top_of_a_slab(device, degrees):
    """Its lowest point's radial direction may be level: that must not make it touch a side metres away."""
    slant = np.radians(degrees)
    lowest = 0.3 * np.cos(slant) + 0.2 * np.sin(slant)
    depths = np.tile([-1e-5, 1e-4, 2e-3], 3)
    turns = [rotate_about((np.cos(a), np.sin(a), 0), degrees) for a in np.radians(np.repeat([0.0, 45.0, 200.0], 3))]
    places = [(1.0, 0.5, 0.25 + lowest - depth) for depth in depths]
    for depth, found in zip(depths, touches(device, SLAB, Cylinder(0.2, 0.3), places, turns), strict=True):
        assert len(found["gap"]) >= 1
        np.testing.assert_allclose(found["normal"], np.tile([0, 0, 1], (len(found["gap"]), 1)), atol=1e-6)
        assert found["gap"].min() == pytest.approx(-depth, abs=1e-5)


@pytest.mark.parametrize("solid", [meshes.tetrahedron, meshes.octahedron, meshes.icosahedron, meshes.dodecahedron])
@pytest.mark.parametrize("radius", [0.05, 0.2, 3.0])
def test_a_ball_touches_a_polyhedron_where_it_does(device, solid, radius):
    """Pressed a little into a face, an edge or a corner, whatever the ball's size, the depth is right."""
    mesh = solid(0.2, 48)
    corners, faces = mesh.surface()
    first, second, third = corners[faces[0]]
    normal = np.cross(second - first, third - first)
    middle, edge = (first + second + third) / 3.0, 0.5 * (first + second)
    # A grid of 48 cells rounds edges and corners by a part of its cell of 4 to 8 mm.
    cases = [(middle + share * (first - middle), normal, 1e-3, 4e-4) for share in (0.0, 0.4, 0.8)]
    cases += [(place, place, 5e-3, 2.6e-3) for place in (edge, first)]
    cases = [(place, outward / np.linalg.norm(outward), *rest) for place, outward, *rest in cases]
    centers = [place + (radius - depth) * outward for place, outward, depth, _ in cases]
    all_found = touches(device, mesh, Sphere(radius), centers)
    for (place, outward, depth, tolerance), found in zip(cases, all_found, strict=True):
        assert len(found["gap"]) >= 1, (place, outward)
        assert found["gap"].min() == pytest.approx(-depth, abs=tolerance)
        deepest = np.argmin(found["gap"])
        assert found["normal"][deepest] @ outward > (0.98 if depth == 1e-3 else 0.5)


def test_a_ball_near_a_polyhedron_touches_only_if_it_does(device):
    generator = np.random.default_rng(3)
    mesh = meshes.octahedron(0.2, 48)
    directions = generator.normal(size=(40, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    centers = (mesh.support(directions) + generator.uniform(-0.05, 0.25, 40))[:, None] * directions
    gaps = mesh.signed_distance(centers)[0] - 0.15
    assert (gaps > 1e-3).sum() > 5 and ((gaps > -0.05) & (gaps < -2e-3)).sum() > 5
    for gap, found in zip(gaps, touches(device, mesh, Sphere(0.15), centers), strict=True):
        if gap > 1e-3:
            assert len(found["gap"]) == 0, gap
        elif -0.05 < gap < -2e-3:
            assert len(found["gap"]) >= 1
            assert found["gap"].min() < 0.5 * gap


@pytest.mark.parametrize("shape", [Capsule(0.15, 0.3), Cylinder(0.15, 0.4)])
def test_a_rod_hovers_over_a_coarse_mesh_without_touching(device, shape):
    """Its middle line lies beyond the mesh's grid, where the distance is a lower bound only."""
    mesh = Mesh(*cube(0.2), sdf_resolution=16)
    turns = (rotate_about((1, 0, 0), 90.0), rotate_about((1, 1, 0), 90.0))
    poses = list(itertools.product(turns, (-0.1, 0.0, 0.05), (0.02, 0.003, -0.001)))
    places = [(side, side, 0.35 + gap) for _, side, gap in poses]
    all_found = touches(device, mesh, shape, places, [turn for turn, _, _ in poses])
    for (_, side, gap), found in zip(poses, all_found, strict=True):
        if gap > 0.0:
            assert len(found["gap"]) == 0, (side, gap, found["gap"])
        else:
            assert found["gap"].min() == pytest.approx(gap, abs=5e-4)


@pytest.mark.parametrize("cells", [16, 32])
def test_a_thick_capsule_lies_on_a_small_mesh_beyond_whose_grid_it_reaches(device, cells):
    """Wider than the mesh: it touches the top where that is, not deeper."""
    mesh = Mesh(*cube(0.1), sdf_resolution=cells)
    turn = rotate_about((0, 1, 0), 90.0)
    found = touch(device, mesh, Capsule(0.5, 0.5), position=(0.02, 0.01, 0.6), orientation=turn)
    assert len(found["gap"]) >= 2
    np.testing.assert_allclose(found["gap"], 0.0, atol=1e-4)


def test_a_cylinder_that_wobbles_on_a_slab_stays_on_it(device):
    """On its rim, nearly upright: it settles within a second instead of being thrown aside."""
    scene = Scene()
    scene.add_static(SLAB, friction=0.5)
    turn = rotate_about((1, 0, 0), 4.0)
    scene.add_body(Cylinder(0.2, 0.3), position=(1, 0.5, 0.58), orientation=turn, friction=0.5)
    sim = Simulator(scene, device=device)
    fastest = 0.0
    for _ in range(60):
        sim.step(4)
        fastest = max(fastest, float(np.linalg.norm(sim.get("linear_velocity")[0, 1])))
    assert fastest < 1.0
    np.testing.assert_allclose(sim.get("position")[0, 1], (1, 0.5, 0.55), atol=0.03)


@pytest.mark.parametrize("height", [0.45, 0.52, 1.0, 11.5])
def test_a_coarse_ring_that_lies_against_a_pole_touches_it(device, height):
    """The middle of a side of the ring, where it has no vertex, near the foot of the pole and further up."""
    ring, depth = meshes.torus(2.4, 0.45), 0.03
    apart = 0.5 + 2.85 * np.cos(np.pi / 32) - depth
    turn = rotate_about((0, 0, 1), 180 / 32)
    found = touch(device, Cylinder(0.5, 6.0), ring, position=(apart, 0, height - 6.0), orientation=turn)
    assert found["gap"].min() == pytest.approx(-depth, abs=0.012)  # a tenth of a cell of the ring's grid
    assert abs(found["normal"][found["gap"].argmin(), 0]) > 0.99


def test_a_tilted_ring_touches_a_pole_on_both_sides(device):
    """A piece of the pole's axis has one contact, at one side of the ring; the other side is 6 cm deep in the pole.

    It enters between two of its vertices.
    """
    scene = Scene(gravity=(0, 0, 0))
    scene.add_static(Cylinder(0.5, 6.0))
    turn = (-0.53631961, 0.74741411, -0.18381445, -0.34633178)
    ring = scene.add_body(meshes.torus(2.4, 0.45), position=(2.4175062, 1.284006, -3.229459), orientation=turn)
    sim, stages = opened(scene, device)
    depth = sim.penetration()[0]
    assert depth > 0.06
    find_contacts(stages)
    assert contact_list(stages)["gap"].min() == pytest.approx(-depth, rel=0.01)
    sim.step(60)
    assert sim.penetration()[0] < 1e-3
    assert np.abs(sim.get("position")[0, ring] - scene.bodies[ring].position).max() < 0.2


@pytest.mark.parametrize("half_length", [0.131, 0.15, 0.3, 0.5])
def test_a_rod_that_lies_across_a_disc_touches_it_where_it_leaves_the_face(device, half_length):
    """At both ends, and along the normal of the face, also if they overlap."""
    radius, cases = 0.12, list(itertools.product([0.0, 0.013, 0.061], [0.0, 2e-4, 1e-3]))
    across, along = np.array([np.cos(0.5), np.sin(0.5), 0.0]), np.array([np.sin(0.5), -np.cos(0.5), 0.0])
    places = [aside * across + (0.0, 0.0, 0.04 - depth) for aside, depth in cases]
    turns = [rotate_about(across, 90)] * len(cases)
    all_found = touches(device, Cylinder(radius, 0.02), Capsule(0.02, half_length), places, turns)
    for (aside, depth), found in zip(cases, all_found, strict=True):
        deepest = found["gap"] < 2e-5 - depth
        reach = found["position"][deepest] @ along
        edge = np.sqrt(radius**2 - aside**2)
        assert (reach.min(), reach.max()) == pytest.approx((-edge, edge), abs=1e-3)
        assert (np.abs(found["normal"][deepest, 2]) > 0.999).all()
