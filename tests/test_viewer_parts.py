"""Rays to surfaces, slices, boxes' edges, meshes with creases: what the page shows, without a page."""

import numpy as np
import pytest
import trimesh

import warp_rigid as wr
from warp_rigid.render.appearance import corner_normals
from warp_rigid.render.film import DrawnMesh, film_from_recording
from warp_rigid.viewer.instances import creased
from warp_rigid.viewer.overlays import joint_lines
from warp_rigid.viewer.picking import first_hit
from warp_rigid.viewer.slicing import cut


def test_a_ray_hits_a_turned_ball_and_a_mesh_with_a_hole_where_it_enters():
    """A ball of 1280 triangles, which lie up to 1 % inside it; a ray through the hole of the torus hits nothing."""
    scene = wr.Scene(gravity=(0, 0, 0))
    turned = np.array([0.3, -0.2, 0.5, 0.7]) / np.linalg.norm([0.3, -0.2, 0.5, 0.7])
    scene.add_body(wr.Sphere(0.5), position=(1, -2, 0.5), orientation=turned)
    ring = wr.Mesh.from_trimesh(trimesh.creation.torus(0.4, 0.15), sdf_resolution=16)
    scene.add_body(ring, position=(4, 0, 1), orientation=(2**-0.5, 0, 0, 2**-0.5))
    film = film_from_recording(wr.record(wr.Simulator(scene, device="cpu"), frames=0))
    generator = np.random.default_rng(4)
    for _ in range(40):
        outward = generator.normal(size=3)
        outward /= np.linalg.norm(outward)
        index, point = first_hit(film, np.array([1, 0]), np.array((1, -2, 0.5)) + 3.0 * outward, -2.0 * outward)
        assert index == 0 and np.allclose(point, np.array((1, -2, 0.5)) + 0.5 * outward, atol=0.005)
    assert first_hit(film, np.array([0, 1]), np.array((4.0, -3, 1)), np.array((0, 1.0, 0))) is None
    index, point = first_hit(film, np.array([0, 1]), np.array((4.4, -3, 1)), np.array((0, 1.0, 0)))
    assert index == 1 and np.allclose(point, (4.4, -0.15, 1), atol=0.01)


def test_slice_of_a_sphere_is_its_circle():
    found = cut(wr.Sphere(0.5), axis=2, part=0.7)
    assert found.place == pytest.approx(0.2)
    assert found.axes == (0, 1, 2)
    dark = (found.image == 15).all(axis=-1)
    height, width = dark.shape
    rows, columns = np.nonzero(dark)
    x = found.lower[0] + (columns + 0.5) / width * (found.upper - found.lower)[0]
    y = found.upper[1] - (rows + 0.5) / height * (found.upper - found.lower)[1]
    assert len(rows) > 200
    # The zero line is drawn within 0.9 of a point's width of distance, which is 7 mm.
    slope = np.sqrt(0.5**2 - 0.2**2) / 0.5
    assert np.hypot(x, y) == pytest.approx(np.sqrt(0.5**2 - 0.2**2), abs=0.0075 / slope)
    red = found.image[height // 2, width // 2].astype(int)
    blue = found.image[0, 0].astype(int)
    assert red[0] > red[2] and blue[2] > blue[0]


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_arrows_lie_in_the_plane_and_point_away(axis):
    found = cut(wr.Sphere(0.5), axis, 0.5)
    start, along = found.arrows[:, 0], found.arrows[:, 1] - found.arrows[:, 0]
    assert np.abs(start[:, axis] - found.place).max() < 1e-12 and np.abs(along[:, axis]).max() < 1e-12
    outward = np.einsum("ij,ij->i", start, along)
    assert (outward[np.linalg.norm(start, axis=1) > 0.05] > 0.0).all()


def test_creases_get_vertices_of_their_own():
    vertices, faces = wr.Box((1, 1, 1)).surface()
    mesh = DrawnMesh(np.asarray(vertices, np.float32), np.asarray(faces), corner_normals(vertices, faces))
    split, corners = creased(mesh)
    assert len(split) == 24
    assert np.array_equal(split[corners], mesh.vertices[mesh.faces])
    ball, ball_faces = wr.Sphere(1.0).surface()
    smooth = DrawnMesh(np.asarray(ball, np.float32), np.asarray(ball_faces), corner_normals(ball, ball_faces))
    assert len(creased(smooth)[0]) == len(ball)


def test_swept_boxes_hold_the_bodies_and_their_way():
    scene = wr.Scene(gravity=(0, 0, 0))
    scene.add_body(wr.Box((0.1, 0.2, 0.3)), position=(1, 2, 3), linear_velocity=(24.0, 0, 0))
    sim = wr.Simulator(scene, num_envs=2, device="cpu")
    sim.step()
    lower, upper = np.moveaxis(sim.swept_boxes(), 2, 0)
    assert sim.swept_boxes().shape == (2, 1, 2, 3)
    # In its first step of 1/240 s the body goes 0.1 m.
    assert (lower[0, 0] <= [0.9, 1.8, 2.7]).all() and (upper[0, 0] >= [1.2, 2.2, 3.3]).all()
    # Struck from the side it may go elsewhere, as far as half its size.
    assert (upper[0, 0] < [1.25, 2.35, 3.45]).all()
    sim.penetration()
    assert sim.swept_boxes()[1, 0, 0] == pytest.approx([1.0, 1.8, 2.7], abs=0.02)


def test_joints_are_drawn_at_their_anchors_and_along_their_axes():
    """A string between two points, and a hinge whose body has turned by a right angle about z."""
    scene = wr.Scene(gravity=(0, 0, 0))
    ball = scene.add_body(wr.Sphere(0.1), position=(0, 0, -1))
    box = scene.add_body(wr.Box((0.1, 0.1, 0.1)), position=(1, 0, 0))
    scene.add_joint(wr.DistanceJoint(maximum=2.0), ball, anchor=(0, 0, -0.9), anchor_b=(0, 0, 1))
    scene.add_joint(wr.RevoluteJoint((0, 1, 0)), ball, box, anchor=(0, 0, -1), anchor_b=(0, 0, -1))
    sim = wr.Simulator(scene, num_envs=2, device="cpu")
    sim.set("position", (3, 0, 0), envs=[1], bodies=[1])
    sim.set("orientation", (0, 0, 2**-0.5, 2**-0.5), envs=[1], bodies=[1])
    points, axes = joint_lines(sim, np.array([1, 0]), 0.4)
    np.testing.assert_allclose(points[:, 0], [[[0, 0, -0.9], [0, 0, 1]]] * 2, atol=1e-6)
    np.testing.assert_allclose(axes[:, 0], points[:, 0])
    np.testing.assert_allclose(points[:, 1, 1], [[3, -1, -1], [0, 0, -1]], atol=1e-6)
    np.testing.assert_allclose(axes[1, 1], [[0, -0.2, -1], [0, 0.2, -1]], atol=1e-6)
    np.testing.assert_allclose(axes[0, 1], [[0.2, 0, -1], [-0.2, 0, -1]], atol=1e-6)
