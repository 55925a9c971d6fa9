"""Small conversions between this package's frames and USD's."""

import numpy as np
from pxr import Gf

from warp_rigid.scene.shapes import Plane

__all__ = ["MARK", "frame_of_plane", "gf_quaternion", "precise_quaternions", "quaternion_of_matrix"]

MARK = "warp_rigid"
"""Key of the custom data that say what USD has no words for."""


def gf_quaternion(orientation) -> Gf.Quatf:
    """A quaternion (x, y, z, w) as USD's, which begins with the real part."""
    x, y, z, w = (float(component) for component in orientation)
    return Gf.Quatf(w, x, y, z)


def precise_quaternions(orientation) -> np.ndarray:
    """Unit quaternions (..., 4) in float64.

    OpenUSD takes the angle from the real part alone, where the rounding of a float quaternion weighs most.
    """
    quaternion = np.asarray(orientation, dtype=np.float64)
    return quaternion / np.linalg.norm(quaternion, axis=-1, keepdims=True)


def quaternion_of_matrix(rotation: np.ndarray) -> np.ndarray:
    """Unit quaternion (x, y, z, w) of a rotation matrix with `matrix @ local = world`."""
    real_first = Gf.Matrix3d(*np.asarray(rotation, dtype=np.float64).T.ravel().tolist()).ExtractRotation().GetQuat()
    found = np.array([*real_first.GetImaginary(), real_first.GetReal()])
    return found / np.linalg.norm(found)


def frame_of_plane(plane: Plane) -> tuple[np.ndarray, np.ndarray]:
    """Where USD's plane, which lies at z = 0 of its prim, must stand: position and quaternion."""
    turn = Gf.Rotation(Gf.Vec3d(0.0, 0.0, 1.0), Gf.Vec3d(*plane.normal.tolist())).GetQuat()
    return plane.offset * plane.normal, np.array([*turn.GetImaginary(), turn.GetReal()])
