"""Round bodies in the inner corners of meshes touch several faces at once, and come to rest there."""

import numpy as np
import pytest
import trimesh

import warp_rigid as wr
from tests.oracles import contact_list, find_contacts, opened
from warp_rigid.kernels.collide.pair_contacts import ContactKey

HALF = 0.45
"""Half of the width of the closed room [m]; its walls are 50 mm thick."""


def room():
    outer, inner = trimesh.creation.box((1, 1, 1)), trimesh.creation.box((2 * HALF,) * 3)
    inner.invert()
    return wr.Mesh.from_trimesh(trimesh.util.concatenate([outer, inner]))


ROOM = room()
BODIES = {
    "ball": wr.Sphere(0.1),
    "capsule": wr.Capsule(0.08, 0.06),
    "cylinder": wr.Cylinder(0.08, 0.08),
    "disc": wr.Cylinder(0.1, 0.03),
    "box": wr.Box((0.1, 0.1, 0.1)),
}


def test_a_ball_in_a_corner_has_a_contact_with_each_face(device):
    """Three contacts at once, with the normals of the faces and the gaps to them."""
    scene = wr.Scene(gravity=(0, 0, 0))
    scene.add_static(ROOM)
    gaps = np.array([-2e-3, -1e-3, -5e-4])
    scene.add_body(wr.Sphere(0.1), position=gaps - HALF + 0.1)
    _, stages = opened(scene, device)
    find_contacts(stages)
    found = contact_list(stages)
    assert len(found["gap"]) == 3
    for axis in range(3):
        (mine,) = np.flatnonzero(np.abs(found["normal"][:, axis]) > 0.5)
        assert abs(found["normal"][mine, axis]) == pytest.approx(1.0, abs=1e-6)
        assert found["gap"][mine] == pytest.approx(gaps[axis], abs=1e-6)


def test_a_ball_on_a_flat_face_has_one_contact(device):
    """However its triangles are cut, and near their common side: a plane is one place."""
    plate = trimesh.creation.box((2, 2, 0.2)).subdivide().subdivide()
    for x in (0.0, 0.013, 0.25, 0.3):
        scene = wr.Scene(gravity=(0, 0, 0))
        scene.add_static(wr.Mesh.from_trimesh(plate))
        scene.add_body(wr.Sphere(0.3), position=(x, 0.1, 0.37))
        _, stages = opened(scene, device)
        find_contacts(stages)
        found = contact_list(stages)
        of_ball = found["key"] % 2 == (found["body_a"] == 0)
        assert of_ball.sum() == 1
        np.testing.assert_allclose(np.abs(found["normal"][of_ball]), [[0, 0, 1]], atol=1e-6)
        np.testing.assert_allclose(found["gap"][of_ball], -0.03, atol=1e-6)


def before_a_corner(body):
    """A body near a corner of the room, into which gravity pulls."""
    scene = wr.Scene(gravity=(-5, -5, -9.81))
    scene.add_static(ROOM)
    scene.add_body(BODIES[body], position=(-0.2, -0.2, -0.3))
    return scene


def throw(sim, speed):
    """Let the body of each environment start in a random direction towards the corner."""
    way = np.random.default_rng(1).uniform((0.5, 0.5, 0.1), (1.0, 1.0, 0.3), (sim.num_envs, 3))
    sim.set("linear_velocity", (-speed * way / np.linalg.norm(way, axis=1, keepdims=True))[:, None], bodies=[1])


@pytest.mark.parametrize("speed", [0.0, 5.0, 8.0, 12.0])
@pytest.mark.parametrize("body", BODIES)
def test_bodies_thrown_into_a_corner_stay_and_rest(device, body, speed):
    """Gravity pulls into the corner; at 12 m/s a body moves 0.05 m a step, as far as the wall is thick.

    Swept detection stops a body at a depth of 2 % of its size, here up to 4 mm.
    """
    sim = wr.Simulator(before_a_corner(body), num_envs=4, device=device)
    throw(sim, speed)
    deepest = np.zeros(4)
    for _ in range(48):
        sim.step(20)
        deepest = np.maximum(deepest, sim.penetration())
    assert deepest.max() < 5e-3
    assert (np.abs(sim.get("center_of_mass")[:, 1]) < HALF).all()
    assert np.abs(sim.get("linear_velocity")[:, 1]).max() < 1e-3
    assert sim.penetration().max() < 1e-4


def test_contacts_have_the_points_that_the_search_found(device):
    """A disc that tumbles in a corner: no sample loses its contact point between the search and the contact row."""
    sim, stages = opened(before_a_corner("disc"), device, num_envs=16)
    throw(sim, 5.0)
    contacts = 0
    for _ in range(40):
        sim.step()
        count = int(sim.stats()["contacts"].sum())
        assert (stages.pools.contacts.key.numpy()[:count] != ContactKey.GONE).all()
        contacts += count
    assert contacts > 100


CELLS = np.meshgrid(*2 * [np.linspace(-2, 2, 41)], indexing="ij")


def terrain(heights):
    return wr.Heightfield(heights, (4, 4))


def solid_below(heights):
    """The same surface as a mesh, closed by a box below."""
    nx, ny = heights.shape
    top = np.arange(nx * ny).reshape(nx, ny)
    a, b, c, d = (part.ravel() for part in (top[:-1, :-1], top[1:, :-1], top[1:, 1:], top[:-1, 1:]))
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    ring = np.concatenate([top[:-1, 0], top[-1, :-1], top[:0:-1, -1], top[0, :0:-1]])
    after, below = np.roll(ring, -1), nx * ny
    sides = [np.stack([after, ring, ring + below], 1), np.stack([after, ring + below, after + below], 1)]
    upper = np.stack([*(axis.ravel() for axis in CELLS), heights.ravel()], 1)
    vertices = np.concatenate([upper, upper * [1, 1, 0] - [0, 0, 1]])
    return wr.Mesh(vertices, np.concatenate([faces, faces[:, ::-1] + below, *sides]))


@pytest.mark.parametrize("ground", [terrain, solid_below])
@pytest.mark.parametrize("y", [0.0, 0.032], ids=["on a seam", "beside it"])
@pytest.mark.parametrize(("slope", "friction"), [(1.0, 0.5), (5.0, 0.0), (10.0, 0.5)])
def test_a_ball_rests_in_a_valley(device, ground, y, slope, friction):
    """Its centre is r sqrt(1 + s^2) above the bottom of a valley of slope s, and a contact may keep a gap of 1e-4 r.

    On a seam the foot of the centre lies on the side of two triangles of one plane.
    """
    scene, rise = wr.Scene(), np.sqrt(1.0 + slope * slope)
    scene.add_static(ground(slope * np.abs(CELLS[0])), friction=friction)
    scene.add_body(wr.Sphere(0.1), position=(0.01, y, 0.1 * rise + 0.1), friction=friction)
    sim = wr.Simulator(scene, device=device)
    sim.step(480)
    assert sim.get("position")[0, 1, 2] == pytest.approx(0.1 * rise, abs=4e-5 * rise)
    np.testing.assert_allclose(sim.get("linear_velocity")[0, 1], 0.0, atol=1e-4)
    assert sim.penetration()[0] < 4e-5 and len(sim.contacts()) >= 2
