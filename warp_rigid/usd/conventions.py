"""Conventions of USD and of this package: units, axes, time codes, frames, quaternions, and custom data."""

from collections.abc import Iterator

import numpy as np
from pxr import Gf, Usd, UsdGeom

from warp_rigid.checks import number_in, one_of

MARK = "warp_rigid"
"""Key of the custom data for content without a USD schema."""

FOLLOWS_PATH = "followsPath"
"""Name in it: the animation of a kinematic body is its path, and not only a film of it."""

FROM_Y_UP = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])
"""Rotation from a stage with y up to the scene, `matrix @ vector`."""

MAX_FRAMES = 100_000
"""Maximum number of time codes of a film."""
UNITS = 1e-12, 1e12
"""Range of the units of length [m] and mass [kg]."""


def custom_data(prim: Usd.Prim) -> dict:
    """Custom data that this package writes for content without a USD schema."""
    found = prim.GetCustomDataByKey(MARK)
    return found if isinstance(found, dict) else {}


def gf_quaternion(orientation) -> Gf.Quatf:
    """Convert a quaternion (x, y, z, w) to a USD quaternion, which has the real part first."""
    x, y, z, w = (float(component) for component in orientation)
    return Gf.Quatf(w, x, y, z)


def xyzw(quaternion) -> np.ndarray:
    """Convert a USD quaternion to an array (x, y, z, w)."""
    return np.array([*quaternion.GetImaginary(), quaternion.GetReal()], dtype=np.float64)


def precise_quaternions(orientation) -> np.ndarray:
    """Unit quaternions (..., 4) in float64.

    OpenUSD computes the angle from the real part alone, which amplifies the rounding error of float32.
    """
    quaternion = np.asarray(orientation, dtype=np.float64)
    return quaternion / np.linalg.norm(quaternion, axis=-1, keepdims=True)


def quaternion_of_matrix(rotation: np.ndarray) -> np.ndarray:
    """Unit quaternion (x, y, z, w) of a rotation matrix with `matrix @ local = world`."""
    matrix = Gf.Matrix3d(*np.asarray(rotation, dtype=np.float64).T.ravel().tolist())
    return precise_quaternions(xyzw(matrix.ExtractRotation().GetQuat()))


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


def lineage(prim: Usd.Prim | None) -> Iterator[Usd.Prim]:
    """A prim and those above it, the nearest first, without the root of the stage."""
    while prim and not prim.IsPseudoRoot():
        yield prim
        prim = prim.GetParent()


def time_codes(stage: Usd.Stage) -> tuple[float, float, float]:
    """First and last time code, and their rate [1/s].

    Raises:
        ValueError: It is not finite, too long or negative, or the rate is not positive.
    """
    first = number_in("startTimeCode", stage.GetStartTimeCode())
    last = number_in("endTimeCode", stage.GetEndTimeCode(), first, first + MAX_FRAMES)
    rate = number_in("timeCodesPerSecond", stage.GetTimeCodesPerSecond(), above=0.0)
    number_in("framesPerSecond", stage.GetFramesPerSecond(), above=0.0)
    return first, last, rate


def first_time(stage: Usd.Stage) -> Usd.TimeCode:
    """Time at which poses are read: an animated transform may have no value at the default time."""
    return Usd.TimeCode(stage.GetStartTimeCode()) if stage.HasAuthoredTimeCodeRange() else Usd.TimeCode.EarliestTime()


def animation_codes(stage: Usd.Stage, prim: Usd.Prim) -> list[float]:
    """Time codes at which the motion of a prim is read: every frame of the stage, or of its samples if it has no range.

    Raises:
        ValueError: The range is not that of a film.
    """
    if stage.HasAuthoredTimeCodeRange():
        first, last, _ = time_codes(stage)
    else:
        movable = filter(None, map(UsdGeom.Xformable, lineage(prim)))
        samples = [time for above in movable for time in above.GetTimeSamples()]
        first, last = min(samples), max(samples)
        number_in("time samples", last, first, first + MAX_FRAMES)
    return [*np.arange(first, last, 1.0).tolist(), last]


def meters_per_unit(stage: Usd.Stage) -> float:
    """Unit of length [m].

    Raises:
        ValueError: It is not a positive number.
    """
    return number_in("metersPerUnit", UsdGeom.GetStageMetersPerUnit(stage), *UNITS)


def is_y_up(stage: Usd.Stage) -> bool:
    """Whether y points up; if not, z does.

    Raises:
        ValueError: The up axis is neither.
    """
    return one_of("upAxis", str(UsdGeom.GetStageUpAxis(stage)), ("Y", "Z")) == "Y"
