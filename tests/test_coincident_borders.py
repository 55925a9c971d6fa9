"""Contacts where the edges and corners of two equal meshes coincide, as between the stones of an arch."""

import numpy as np
import pytest

from tests.oracles import contact_list, find_contacts, opened, random_quaternion, rotate_about, rotation_matrix
from warp_rigid import rotations
from warp_rigid.scene.scene import Scene
from warp_rigid.scenes.builders import stacks

STONES, RADIUS, THICKNESS = 15, 5.0, 0.625


def neighbours(rng, shift):
    """Two adjacent stones in a random orientation, the second displaced by `shift`; the normal and corners between."""
    scene = Scene(gravity=(0, 0, 0))
    stone = stacks.voussoir(STONES, RADIUS, THICKNESS, 1.0)
    world = random_quaternion(rng)
    turn = rotation_matrix(world)
    half = np.pi / STONES / 2
    for k, angle in enumerate((-half, half)):
        center = RADIUS * np.array([np.sin(angle), 0, np.cos(angle)]) + k * np.asarray(shift)
        own = rotate_about((0, 1, 0), np.degrees(angle))
        orientation = rotations.multiply(world, own)
        (scene.add_body if k else scene.add_static)(stone, position=turn @ center, orientation=orientation)
    radii = RADIUS + THICKNESS / 2 * np.array([-1, 1])
    corners = [(0.0, y, r) for r in radii for y in (-0.5, 0.5)]
    return scene, turn @ np.array([1.0, 0, 0]), np.array(corners) @ turn.T


@pytest.mark.parametrize("shift", [(0, 0, 0), (1e-6, 0, 0), (-1e-6, 1e-6, 0), (0, -1e-6, 1e-6), (0, 3e-4, -3e-4)])
def test_flush_stones_press_on_each_other_at_all_corners(device, shift):
    rng = np.random.default_rng(3)
    for _ in range(8):
        scene, normal, corners = neighbours(rng, shift)
        _, stages = opened(scene, device)
        find_contacts(stages)
        found = contact_list(stages)
        along = np.abs(found["normal"] @ normal)
        assert along.min() > 1.0 - 1e-5, along
        far = np.linalg.norm(found["position"][:, None] - corners[None], axis=2).min(axis=0)
        assert far.max() < 1e-3, far
        np.testing.assert_allclose(found["gap"], shift[0], atol=4e-6)
