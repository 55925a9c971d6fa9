"""Quaternions against scipy's rotations."""

import numpy as np
from scipy.spatial.transform import Rotation

from warp_rigid import rotations

TURNS = Rotation.random(50, random_state=3)
QUATERNIONS = TURNS.as_quat()
VECTORS = np.random.default_rng(4).normal(size=(50, 3))


def assert_same_rotation(quaternions, expected):
    np.testing.assert_allclose(Rotation.from_quat(quaternions).as_matrix(), expected.as_matrix(), atol=1e-12)


def test_matrices_and_rotated_vectors():
    np.testing.assert_allclose(rotations.matrix(QUATERNIONS), TURNS.as_matrix(), atol=1e-12)
    np.testing.assert_allclose(rotations.rotate(QUATERNIONS, VECTORS), TURNS.apply(VECTORS), atol=1e-12)
    every = rotations.rotate(QUATERNIONS[:, None], VECTORS[None])
    np.testing.assert_allclose(every[7], TURNS[7].apply(VECTORS), atol=1e-12)


def test_precision_is_kept():
    for kind in (np.float32, np.float64):
        quaternions = QUATERNIONS.astype(kind)
        for result in (rotations.matrix(quaternions), rotations.inverse(quaternions)):
            assert result.dtype == kind


def test_products_and_inverses():
    assert_same_rotation(rotations.multiply(QUATERNIONS[:25], QUATERNIONS[25:]), TURNS[:25] * TURNS[25:])
    assert_same_rotation(rotations.multiply(QUATERNIONS[0], QUATERNIONS), TURNS[0] * TURNS)
    assert_same_rotation(rotations.inverse(QUATERNIONS), TURNS.inv())


def test_rotations_about_an_axis():
    angles = np.linspace(-7.0, 7.0, 20)
    axis = np.array([1.0, 2.0, -2.0])
    assert_same_rotation(rotations.about_axis(axis, angles), Rotation.from_rotvec(angles[:, None] * axis / 3.0))
    assert rotations.about_axis(axis, 0.3).shape == (4,)


def test_random_rotations_are_uniform():
    quaternions = rotations.random(np.random.default_rng(1), 100, 200)
    np.testing.assert_allclose(np.linalg.norm(quaternions, axis=-1), 1.0)
    # For uniform rotations every rotated vector has mean 0 and covariance 1/3.
    images = rotations.rotate(quaternions, [0.0, 0.6, 0.8]).reshape(-1, 3)
    np.testing.assert_allclose(images.mean(axis=0), 0.0, atol=0.01)
    np.testing.assert_allclose(images.T @ images / len(images), np.eye(3) / 3.0, atol=0.01)
