"""A prescribed motion: poses at some times."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np

from warp_rigid.checks import LARGEST, brief, instance_of, numbers_of
from warp_rigid.rotations import about_axis, continuous_signs, inverse, multiply

SAME_PLACE, SAME_ORIENTATION = 1e-6, 1e-6
"""Distance [m] and angle [rad] of the first and the last pose of a path that is repeated."""


@dataclass(frozen=True, eq=False)
class PosePath:
    """Keyframes of a kinematic body, between which it moves and turns at constant velocity; see `Scene.add_kinematic`.

    Before the first time the body has the first pose, after the last time the last one. Between two keyframes it turns
    the shorter way: a turn of more than 180 degrees needs further keyframes.

    Args:
        times: (n,) increasing, from 0 on [s]; at least two.
        positions: (n, 3) of the shape's frame in the world [m].
        orientations: (n, 4) quaternions (x, y, z, w), scaled to unit length; None for no rotation.
        loop: whether the path starts again at its end; its first and last pose must then be the same.

    Attributes:
        times: (n,) float64, as given.
        positions: (n, 3) float64, as given.
        orientations: (n, 4) float64, unit quaternions, neighbours with continuous signs.
        loop: as given.

    Raises:
        ValueError: A value has the wrong shape or is out of its range.
    """

    times: Any
    positions: Any
    orientations: Any = None
    loop: bool = False

    def __post_init__(self) -> None:
        """Check and convert the keyframes."""
        times = _rows("times", self.times, ())
        if len(times) < 2 or times[0] < 0.0 or (np.diff(times) <= 0.0).any():
            raise ValueError("times: must be at least two increasing numbers >= 0")
        positions = _rows("positions", self.positions, (3,), len(times))
        orientations = (
            np.tile([0.0, 0.0, 0.0, 1.0], (len(times), 1)) if self.orientations is None else self.orientations
        )
        orientations = _rows("orientations", orientations, (4,), len(times))
        length = np.linalg.norm(orientations, axis=1, keepdims=True)
        if (length < 1e-6).any():
            raise ValueError("orientations: must be quaternions (x, y, z, w) of length > 0")
        orientations = np.where(np.abs(length - 1.0) <= 1e-15, orientations, orientations / length)
        orientations = continuous_signs(orientations)
        instance_of("loop", self.loop, bool, "True or False")
        apart = np.abs(positions[-1] - positions[0]).max() > SAME_PLACE * max(1.0, np.abs(positions).max())
        if self.loop and (apart or 1.0 - abs(orientations[0] @ orientations[-1]) > SAME_ORIENTATION**2 / 8):
            raise ValueError("loop: the last pose must be the first one, from which a repeated path goes on")
        for name, values in (("times", times), ("positions", positions), ("orientations", orientations)):
            values.flags.writeable = False
            object.__setattr__(self, name, values)

    @cached_property
    def key(self) -> bytes:
        """Bytes that are equal for equal paths."""
        return b"".join(
            np.asarray(rows).tobytes() for rows in (self.times, self.positions, self.orientations, self.loop)
        )

    @cached_property
    def turned(self) -> np.ndarray:
        """(n, 3) sums of the rotation vectors from the first keyframe to each [rad]."""
        turns = [_turn(start, end) for start, end in pairwise(self.orientations)]
        return np.cumsum([np.zeros(3), *turns], axis=0)

    def __eq__(self, other: object) -> bool:
        """Whether all keyframes are equal."""
        return isinstance(other, PosePath) and self.key == other.key

    def __hash__(self) -> int:
        """That of the keyframes."""
        return hash(self.key)

    def __repr__(self) -> str:
        """Show the size."""
        loop = ", repeated" if self.loop else ""
        return f"PosePath({len(self.times)} keyframes from {self.times[0]:g} to {self.times[-1]:g} s{loop})"

    def at(self, time: float) -> tuple[np.ndarray, np.ndarray]:
        """Position (3,) [m] and orientation (4,) at a time [s]."""
        first, last = self.times[0], self.times[-1]
        if self.loop and time > first:
            time = first + (time - first) % (last - first)
        time = min(max(time, first), last)
        i = min(int(np.searchsorted(self.times, time, side="right")) - 1, len(self.times) - 2)
        fraction = (time - self.times[i]) / (self.times[i + 1] - self.times[i])
        position = self.positions[i] + fraction * (self.positions[i + 1] - self.positions[i])
        return position, _interpolated(self.orientations[i], self.orientations[i + 1], fraction)


def _interpolated(start: np.ndarray, end: np.ndarray, fraction: float) -> np.ndarray:
    """The orientation at a fraction of the way from one to another."""
    turn = _turn(start, end)
    angle = np.linalg.norm(turn)
    return multiply(about_axis(turn, fraction * angle), start) if angle else start.copy()


def _turn(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Rotation vector from an orientation to the next one of a path [rad]."""
    rotation = multiply(end, inverse(start))
    sine = np.linalg.norm(rotation[:3])
    return rotation[:3] * (2.0 * np.arctan2(sine, rotation[3]) / sine if sine else 0.0)


def _rows(name: str, value: Sequence | np.ndarray, tail: tuple[int, ...], count: int | None = None) -> np.ndarray:
    """A new array (count, *tail) of finite float64 numbers; any count if none is given."""
    array = numbers_of(value)
    if array is None or array.ndim != 1 + len(tail) or array.shape[1:] != tail or len(array) != (count or len(array)):
        shape = ("n" if count is None else str(count), *map(str, tail))
        raise ValueError(
            f"{name}: must be numbers of the shape ({', '.join(shape)}{',' * (not tail)}), got {brief(value)}"
        )
    if not (np.abs(array) <= LARGEST).all():
        raise ValueError(f"{name}: must be finite numbers")
    return np.array(array)
