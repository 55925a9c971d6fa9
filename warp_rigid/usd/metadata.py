"""Metadata of stages: units, the up axis, and the range of time codes, with checks; and the prims above a prim."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from pxr import Usd, UsdGeom, UsdPhysics

from warp_rigid.checks import number_in, one_of

FROM_Y_UP = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])
"""Rotation from a stage with y up to the scene, `matrix @ vector`."""

MAX_FRAMES = 100_000
"""Maximum number of time codes of a film."""
UNITS = 1e-12, 1e12
"""Range of the units of length [m] and mass [kg]."""


class TimeCodes(NamedTuple):
    """First and last time code, and their rate [1/s]."""

    first: float
    last: float
    rate: float


def lineage(prim: Usd.Prim | None) -> Iterator[Usd.Prim]:
    """A prim and those above it, the nearest first, without the root of the stage."""
    while prim and not prim.IsPseudoRoot():
        yield prim
        prim = prim.GetParent()


def time_codes(stage: Usd.Stage) -> TimeCodes:
    """The range of time codes.

    Raises:
        ValueError: It is not finite, too long or negative, or the rate is not positive.
    """
    first = number_in("startTimeCode", stage.GetStartTimeCode())
    last = number_in("endTimeCode", stage.GetEndTimeCode(), first, first + MAX_FRAMES)
    rate = number_in("timeCodesPerSecond", stage.GetTimeCodesPerSecond(), above=0.0)
    number_in("framesPerSecond", stage.GetFramesPerSecond(), above=0.0)
    return TimeCodes(first, last, rate)


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


def kilograms_per_unit(stage: Usd.Stage) -> float:
    """Unit of mass [kg].

    Raises:
        ValueError: It is not a positive number.
    """
    return number_in("kilogramsPerUnit", UsdPhysics.GetStageKilogramsPerUnit(stage), *UNITS)


def is_y_up(stage: Usd.Stage) -> bool:
    """Whether y points up; if not, z does.

    Raises:
        ValueError: The up axis is neither.
    """
    return one_of("upAxis", str(UsdGeom.GetStageUpAxis(stage)), ("Y", "Z")) == "Y"
