"""Helpers of several sections: gravity on an incline, rotations, and measurements of a trace."""

from collections.abc import Callable

import numpy as np

from warp_rigid import rotations
from warp_rigid.validation.case import Check, at_most, measured, relative
from warp_rigid.validation.experiment import Trace

COULOMB = "Coulomb's law, closed form"
G = 9.81
NO_GRAVITY = (0.0, 0.0, 0.0)
Series = Callable[[Trace], np.ndarray]
RESTING = 1e-3
"""Speed below which a body counts as stopped [m/s]."""


def downhill(degrees: float, gravity: float = G) -> tuple[float, float, float]:
    """Gravity in the frame of an incline that descends along x [m/s^2]."""
    slope = np.radians(degrees)
    return gravity * np.sin(slope), 0.0, -gravity * np.cos(slope)


def orientation_about(axis, degrees) -> np.ndarray:
    """Quaternion (..., 4) of rotations about an axis by one angle or several [degrees]."""
    return rotations.about_axis(axis, np.radians(degrees))


def first_time(trace: Trace, happened: np.ndarray) -> np.ndarray:
    """Time of the first record in which a condition holds, (envs,); infinite if there is none."""
    return np.where(happened.any(axis=0), trace.time[happened.argmax(axis=0)], np.inf)


def time_at_rest(trace: Trace, speed: np.ndarray) -> np.ndarray:
    """Time at which a speed (records, envs) has fallen below RESTING, (envs,) [s]."""
    return first_time(trace, (speed < RESTING) & (trace.time > 0.0)[:, None])


def at_time(trace: Trace, series: np.ndarray, time: np.ndarray) -> np.ndarray:
    """A series (records, envs) at a time of each environment, (envs,); NaN where the time is infinite."""
    known = np.isfinite(time)
    row = np.searchsorted(trace.time, np.where(known, time, 0.0) - 1e-9)
    return np.where(known, series[row, np.arange(series.shape[1])], np.nan)


def stop_checks(speed: Series, way: Series, time, distance, limit: float, creep: float, **options) -> list[Check]:
    """Checks of the time and the way until a body stops, and of its motion after that.

    Args:
        speed: function of a trace that returns the speed of the body, (records, envs) [m/s].
        way: function of a trace that returns its way, (records, envs) [m].
        time: exact time of each environment [s].
        distance: exact way of each environment [m].
        limit: relative tolerance of both.
        creep: largest motion after the stop [m].
        options: of the checks.
    """

    def stopped(trace):
        return time_at_rest(trace, speed(trace))

    def way_to_stop(trace):
        return at_time(trace, way(trace), stopped(trace))

    return [
        measured("time to stop", "s", stopped, relative(limit), time, **options),
        measured("distance to stop", "m", way_to_stop, relative(limit), distance, **options),
        measured(
            "motion after the stop", "m", lambda t: np.abs(way(t)[-1] - way_to_stop(t)), at_most(creep), **options
        ),
    ]


def complete_elliptic(parameter: float) -> float:
    """Complete elliptic integral of the first kind K(m), by the arithmetic-geometric mean."""
    a, b = 1.0, np.sqrt(1.0 - parameter)
    while abs(a - b) > 1e-15 * a:
        a, b = 0.5 * (a + b), np.sqrt(a * b)
    return 0.5 * np.pi / a


def gain_of_energy(series, limit: float) -> Check:
    """Check of the largest gain of an energy (records, envs) relative to the kinetic energy at the start."""
    name = "energy gained, relative to the start"
    return measured(name, "", lambda t: largest_rise(series(t)) / t.kinetic_energy[0], at_most(limit))


def largest_rise(series: np.ndarray) -> np.ndarray:
    """Largest increase of a series (records, envs) above its running minimum, (envs,)."""
    return (series - np.minimum.accumulate(series, axis=0)).max(axis=0)
