"""Points of meshes slide along edges without samples, to where these cross the edges of another mesh."""

import numpy as np
import pytest

from tests.oracles import contact_list, find_contacts, opened
from warp_rigid.scene.scene import Scene
from warp_rigid.scene.shapes import Mesh

RADIUS, LENGTH, SIDES = 0.05, 0.1, 20


def rod() -> Mesh:
    """A prism along z with a ridge at +x, whose edges bend by 18 degrees and have points 0.1 m apart only."""
    angle = 2.0 * np.pi * np.arange(SIDES) / SIDES
    ring = RADIUS * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    section = [np.column_stack([ring, np.full(SIDES, z)]) for z in (-LENGTH, 0.0, LENGTH)]
    vertices = np.concatenate([*section, [(0, 0, -LENGTH), (0, 0, LENGTH)]])
    faces = []
    for level in range(2):
        for k in range(SIDES):
            a, b = SIDES * level + k, SIDES * level + (k + 1) % SIDES
            faces += [(a, b, b + SIDES), (a, b + SIDES, a + SIDES)]
    for k in range(SIDES):
        b = (k + 1) % SIDES
        faces += [(3 * SIDES, b, k), (3 * SIDES + 1, 2 * SIDES + k, 2 * SIDES + b)]
    return Mesh(vertices, np.array(faces))


def deepest_contact(device, first, second, positions, orientations):
    """Gap of the deepest contact of two bodies for several poses of the second, and all contacts."""
    scene, count = Scene(gravity=(0, 0, 0)), len(positions)
    scene.add_body(first)
    scene.add_body(second)
    sim, stages = opened(scene, device, num_envs=count)
    sim.set("position", np.reshape(positions, (count, 1, 3)), bodies=[1])
    sim.set("orientation", np.reshape(orientations, (count, 1, 4)), bodies=[1])
    find_contacts(stages)
    found = contact_list(stages)
    env = np.maximum(found["body_a"], found["body_b"]) // 2
    return sim, [{name: rows[env == e] for name, rows in found.items()} for e in range(count)]


@pytest.mark.parametrize("overlap", [1e-4, 1e-3])
@pytest.mark.parametrize("along", [0.0, 0.013, 0.031])
@pytest.mark.parametrize("degrees", [90.0, 3.0])
def test_ridges_that_cross_touch_where_they_cross(device, overlap, along, degrees):
    """Two rods, ridge on ridge: the slope along a ridge is 0.16, or 0.008 if they are almost parallel."""
    angle = np.radians(degrees)
    turned = (np.sin(0.5 * angle), 0.0, 0.0, np.cos(0.5 * angle))  # z towards -y
    flipped = (0.0, 0.0, 1.0, 0.0)  # the ridge to -x
    both = quaternion_product(turned, flipped)
    axis = np.array([0.0, -np.sin(angle), np.cos(angle)])
    place = (np.array([2 * RADIUS - overlap, 0.0, along]) - 0.02 * axis)[None]
    _, (found,) = deepest_contact(device, rod(), rod(), place, [both])
    deepest = int(np.argmin(found["gap"]))
    assert found["gap"][deepest] == pytest.approx(-overlap, abs=2e-6)
    np.testing.assert_allclose(found["position"][deepest], (RADIUS - 0.5 * overlap, 0.0, along), atol=2e-5)
    np.testing.assert_allclose(np.abs(found["normal"][deepest]), (1, 0, 0), atol=1e-3)


def quaternion_product(p, q):
    """The rotation q and then p, (x, y, z, w)."""
    a, b = np.asarray(p[:3]), np.asarray(q[:3])
    return np.append(p[3] * b + q[3] * a + np.cross(a, b), p[3] * q[3] - a @ b)
