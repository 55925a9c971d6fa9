"""Rotations as unit quaternions (x, y, z, w), batched over all leading axes."""

import numpy as np


def matrix_rows(quaternion) -> tuple[tuple[np.ndarray, ...], ...]:
    """The nine entries of rotation matrices, row by row, each shaped (...); in the quaternions' precision."""
    x, y, z, w = np.moveaxis(np.asarray(quaternion), -1, 0)
    return (
        (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)),
        (2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w)),
        (2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)),
    )


def matrix(quaternion) -> np.ndarray:
    """Rotation matrices (..., 3, 3) with `matrix @ local = world`, in the precision of the quaternions (..., 4)."""
    return np.stack([np.stack(row, axis=-1) for row in matrix_rows(quaternion)], axis=-2)


def rotate(quaternion, vector) -> np.ndarray:
    """Rotate vectors (..., 3) by quaternions (..., 4), broadcasting."""
    return np.einsum("...ij,...j->...i", matrix(quaternion), np.asarray(vector))


def multiply(first, second) -> np.ndarray:
    """Quaternions (..., 4) of the rotation by `second` followed by the rotation by `first`, broadcasting."""
    ax, ay, az, aw = np.moveaxis(np.asarray(first), -1, 0)
    bx, by, bz, bw = np.moveaxis(np.asarray(second), -1, 0)
    return np.stack(
        [
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
            aw * bw - ax * bx - ay * by - az * bz,
        ],
        axis=-1,
    )


def inverse(quaternion) -> np.ndarray:
    """Quaternions (..., 4) of the inverse rotations, in their precision."""
    quaternion = np.asarray(quaternion)
    return quaternion * np.array([-1.0, -1.0, -1.0, 1.0], dtype=quaternion.dtype)


def about_axis(axis, angle) -> np.ndarray:
    """Quaternions (..., 4) of rotations about one axis (3,) of any length by angles (...) [rad]."""
    axis = np.asarray(axis, np.float64) / np.linalg.norm(axis)
    half = 0.5 * np.asarray(angle, np.float64)[..., None]
    return np.concatenate([np.sin(half) * axis, np.cos(half)], axis=-1)


def random(generator: np.random.Generator, *shape: int) -> np.ndarray:
    """Uniformly distributed rotations: unit quaternions (*shape, 4)."""
    quaternion = generator.normal(size=(*shape, 4))
    return quaternion / np.linalg.norm(quaternion, axis=-1, keepdims=True)


def continuous_signs(quaternion) -> np.ndarray:
    """Quaternions (frames, ..., 4) with signs such that consecutive frames are connected by the shorter arc.

    q and -q are the same rotation, but interpolation between frames depends on the sign.
    """
    quaternion = np.asarray(quaternion)
    dots = np.sum(quaternion[1:] * quaternion[:-1], axis=-1, keepdims=True)
    flips = np.where(dots < 0.0, -1.0, 1.0)
    signs = np.concatenate([np.ones_like(quaternion[:1, ..., :1]), np.cumprod(flips, axis=0)])
    return (quaternion * signs).astype(quaternion.dtype)
