"""Conversions between the frames of this package and of USD."""

import numpy as np
from pxr import Gf, Usd

from warp_rigid.scene.shapes import Plane

MARK = "warp_rigid"
"""Key of the custom data for content without a USD schema."""

FOLLOWS_PATH = "followsPath"
"""Name in it: the animation of a kinematic body is its path, and not only a film of it."""


def custom_data(prim: Usd.Prim) -> dict:
    """Custom data that this package writes for content without a USD schema."""
    found = prim.GetCustomDataByKey(MARK)
    return found if isinstance(found, dict) else {}


def gf_quaternion(orientation) -> Gf.Quatf:
    """Convert a quaternion (x, y, z, w) to a USD quaternion, which has the real part first."""
    x, y, z, w = (float(component) for component in orientation)
    return Gf.Quatf(w, x, y, z)


def precise_quaternions(orientation) -> np.ndarray:
    """Unit quaternions (..., 4) in float64.

    OpenUSD computes the angle from the real part alone, which amplifies the rounding error of float32.
    """
    quaternion = np.asarray(orientation, dtype=np.float64)
    return quaternion / np.linalg.norm(quaternion, axis=-1, keepdims=True)


def quaternion_of_matrix(rotation: np.ndarray) -> np.ndarray:
    """Unit quaternion (x, y, z, w) of a rotation matrix with `matrix @ local = world`."""
    real_first = Gf.Matrix3d(*np.asarray(rotation, dtype=np.float64).T.ravel().tolist()).ExtractRotation().GetQuat()
    found = np.array([*real_first.GetImaginary(), real_first.GetReal()])
    return found / np.linalg.norm(found)


def transform(rotation: np.ndarray, position: np.ndarray | float = 0.0) -> np.ndarray:
    """Transforms (..., 4, 4) of a rotation or stretch (..., 3, 3) and a position (..., 3), `matrix @ local = world`."""
    matrix = np.zeros((*rotation.shape[:-2], 4, 4))
    matrix[..., :3, :3], matrix[..., :3, 3], matrix[..., 3, 3] = rotation, position, 1.0
    return matrix


def polar(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotation and symmetric stretch (3, 3) with `rotation @ stretch = matrix`; a reflection is in the stretch."""
    left, sizes, right = np.linalg.svd(matrix)
    rotation, stretch = left @ right, right.T @ np.diag(sizes) @ right
    return (rotation, stretch) if np.linalg.det(rotation) > 0.0 else (-rotation, -stretch)


def frame_of_plane(plane: Plane) -> tuple[np.ndarray, np.ndarray]:
    """Pose of a USD plane, which is z = 0 in the frame of its prim: position and quaternion."""
    rotation = Gf.Rotation(Gf.Vec3d(0.0, 0.0, 1.0), Gf.Vec3d(*plane.normal.tolist())).GetQuat()
    return plane.offset * plane.normal, np.array([*rotation.GetImaginary(), rotation.GetReal()])
