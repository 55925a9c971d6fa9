"""What several sections share: scenes on level ground, gravity on an incline, and readings of a trace."""

import numpy as np

from warp_rigid import rotations
from warp_rigid.scene.scene import Scene
from warp_rigid.scene.shapes import Plane
from warp_rigid.validation.experiment import Start, Trace

G = 9.81
GROUND = Plane(normal=(0.0, 0.0, 1.0), offset=0.0)
NO_GRAVITY = (0.0, 0.0, 0.0)
RESTING = 1e-3
"""Below this speed a body counts as stopped [m/s]."""


def level_ground(gravity=(0.0, 0.0, -G), **material) -> Scene:
    """A scene with nothing but level ground, which is body 0."""
    scene = Scene(gravity=gravity)
    scene.add_static(GROUND, **material)
    return scene


def downhill(degrees: float, gravity: float = G) -> tuple[float, float, float]:
    """Gravity as seen on an incline that falls along x [m/s^2]."""
    slope = np.radians(degrees)
    return gravity * np.sin(slope), 0.0, -gravity * np.cos(slope)


def turn_about(axis, degrees) -> np.ndarray:
    """Quaternion (..., 4) of rotations about an axis by one angle or several [degrees]."""
    return rotations.about_axis(axis, np.radians(degrees))


def per_env(name: str, values) -> Start:
    """A coefficient that is the same for all bodies of an environment."""
    return Start(name, np.asarray(values, np.float64)[:, None])


def first_time(trace: Trace, happened: np.ndarray) -> np.ndarray:
    """Time of the first record from which on something has happened, (envs,); infinite if it never did."""
    return np.where(happened.any(axis=0), trace.time[happened.argmax(axis=0)], np.inf)


def at_time(trace: Trace, series: np.ndarray, time: np.ndarray) -> np.ndarray:
    """A series (records, envs) at a time of each environment, (envs,); NaN where the time is infinite."""
    known = np.isfinite(time)
    row = np.searchsorted(trace.time, np.where(known, time, 0.0) - 1e-9)
    return np.where(known, series[row, np.arange(series.shape[1])], np.nan)


def largest_rise(series: np.ndarray) -> np.ndarray:
    """How far a series (records, envs) ever climbs above its least value so far, (envs,)."""
    return (series - np.minimum.accumulate(series, axis=0)).max(axis=0)
