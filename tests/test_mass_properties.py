"""Mass properties against closed forms and against trimesh (V01 and V02 themselves are in the validation)."""

import math

import numpy as np
import pytest
import trimesh

import warp_rigid as wr
from tests.geometry_oracles import cube, random_rotation, star_prism
from warp_rigid.scene.shapes import Box, Capsule, Compound, Cylinder, Mesh, Sphere, mass_properties
from warp_rigid.validation.mass_and_distance import exact_solids

SOLIDS = exact_solids()


@pytest.mark.parametrize("name", SOLIDS)
def test_mass_properties_move_with_the_mesh(name):
    (vertices, faces), volume, center, inertia = SOLIDS[name]
    generator = np.random.default_rng(3)
    for _ in range(5):
        _, rotation = random_rotation(generator)
        shift = generator.normal(scale=10.0, size=3)
        moved = Mesh(vertices @ rotation.T + shift, faces)
        assert moved.volume == pytest.approx(volume, rel=1e-10)
        np.testing.assert_allclose(moved.center_of_mass, rotation @ center + shift, atol=1e-9)
        np.testing.assert_allclose(moved.inertia, rotation @ inertia @ rotation.T, atol=1e-9 * np.abs(inertia).max())


@pytest.mark.parametrize(
    "tessellation",
    [
        lambda: trimesh.creation.icosphere(subdivisions=3),
        lambda: trimesh.creation.torus(1.0, 0.3, major_sections=64, minor_sections=32),
        lambda: trimesh.Trimesh(*star_prism(), process=False),
    ],
)
def test_mesh_integrals_agree_with_trimesh(tessellation):
    reference = tessellation()
    reference.apply_translation([0.3, -0.2, 0.7])
    mesh = Mesh.from_trimesh(reference)
    assert mesh.volume == pytest.approx(reference.volume, rel=1e-12)
    np.testing.assert_allclose(mesh.center_of_mass, reference.center_mass, atol=1e-12)
    np.testing.assert_allclose(mesh.inertia, reference.moment_inertia, atol=1e-12)


def test_cylinder_and_sphere_have_their_closed_forms():
    cylinder = Cylinder(0.5, 1.0)
    assert cylinder.volume == pytest.approx(1.5707963, abs=1e-7)
    np.testing.assert_allclose(np.diag(cylinder.inertia), [0.6217736, 0.6217736, 0.1963495], atol=1e-7)
    sphere = Sphere(2.0)
    assert sphere.volume == pytest.approx(4 / 3 * math.pi * 8)
    np.testing.assert_allclose(sphere.inertia, np.eye(3) * 0.4 * sphere.volume * 4)


@pytest.mark.parametrize("shape", [Sphere(0.3), Box((0.1, 0.2, 0.3)), Capsule(0.2, 0.35), Cylinder(0.2, 0.35)])
def test_closed_forms_agree_with_random_points_of_the_solid(shape):
    generator = np.random.default_rng(1)
    lower, upper = shape.bounds
    points = lower + generator.random((2_000_000, 3)) * (upper - lower)
    distance, _ = shape.signed_distance(points)
    inside = points[distance < 0.0]
    volume = np.prod(upper - lower) * len(inside) / len(points)
    second = inside.T @ inside / len(inside) * volume
    inertia = np.trace(second) * np.eye(3) - second
    assert shape.volume == pytest.approx(volume, rel=3e-3)
    np.testing.assert_allclose(shape.inertia, inertia, atol=5e-3 * np.abs(inertia).max())


def test_two_halves_make_a_whole():
    generator = np.random.default_rng(5)
    quaternion, rotation = random_rotation(generator)
    shift = np.array([0.3, -1.0, 2.0])
    half = Box((0.5, 0.3, 0.2))
    places = [shift + rotation @ np.array([x, 0, 0]) for x in (-0.5, 0.5)]
    joined = Compound([(half, place, quaternion) for place in places])
    whole = Box((1.0, 0.3, 0.2))
    assert joined.volume == pytest.approx(whole.volume, rel=1e-12)
    np.testing.assert_allclose(joined.center_of_mass, shift, atol=1e-12)
    np.testing.assert_allclose(joined.inertia, rotation @ whole.inertia @ rotation.T, atol=1e-12)


def test_open_mesh_has_the_mass_of_its_lidded_solid():
    vertices, faces = cube()
    with_lid = Mesh(vertices, faces)
    open_box = Mesh(vertices, faces[2:])  # one side is missing: a square hole
    assert not open_box.watertight
    assert open_box.volume == pytest.approx(with_lid.volume, rel=1e-12)
    np.testing.assert_allclose(open_box.inertia, with_lid.inertia, atol=1e-12)


def test_far_from_the_origin_nothing_is_lost():
    vertices, faces = star_prism()
    near, far = (mass_properties.polyhedron(vertices + shift, faces) for shift in (0.0, 1e4))
    assert far.volume == pytest.approx(near.volume, rel=1e-9)
    np.testing.assert_allclose(far.inertia, near.inertia, atol=1e-9)


def test_a_distribution_that_is_given_replaces_that_of_the_children():
    """Also where there are no children; it is saved, and distinguishes shapes."""
    per_mass = np.array([[2.0, 0.1, 0.0], [0.1, 3.0, 0.2], [0.0, 0.2, 4.0]])
    ball = (Sphere(0.5), (1, 0, 0), (0, 0, 0, 1))
    for children in ([ball], []):
        shape = Compound(children, (0.1, 0.2, 0.3), per_mass)
        scene = wr.Scene()
        index = scene.add_body(shape, mass=3.0, orientation=(0.5, 0.5, 0.5, 0.5))
        sim = wr.Simulator(scene, device="cpu")
        turn = np.roll(np.eye(3), 1, axis=0)
        np.testing.assert_allclose(sim.get("inertia")[0, index], 3.0 * turn @ per_mass @ turn.T, rtol=1e-6)
        np.testing.assert_allclose(sim.get("center_of_mass")[0, index], (0.3, 0.1, 0.2), rtol=1e-6)
        data, _ = shape.to_data(lambda child: 0)
        assert Compound.from_data(data, lambda *_: np.zeros(0), [Sphere(0.5)]) == shape
        assert shape != Compound([ball])


@pytest.mark.parametrize(
    ("center", "per_mass", "told"),
    [
        (None, np.eye(3), "center_of_mass: must be given together"),
        ((0, 0, 0), np.eye(2), "inertia_per_mass: must be a symmetric matrix"),
        ((0, 0, 0), np.diag([1.0, 1.0, 0.0]), "inertia_per_mass: must have principal moments > 0"),
    ],
)
def test_a_distribution_is_checked(center, per_mass, told):
    with pytest.raises(ValueError, match=told):
        Compound([], center, per_mass)
