"""A prescribed motion: poses at some times."""

from dataclasses import dataclass

import numpy as np

__all__ = ["PosePath"]


@dataclass(frozen=True, eq=False)
class PosePath:
    """Poses of a body at some times, between which it moves and turns evenly.

    Attributes:
        time: (n,) increasing, from 0 [s].
        position: (n, 3) of the shape's frame [m].
        orientation: (n, 4) unit quaternions (x, y, z, w), neighbours with continuous signs.
    """

    time: np.ndarray
    position: np.ndarray
    orientation: np.ndarray

    def at(self, time: float) -> tuple[np.ndarray, np.ndarray]:
        """Position (3,) [m] and orientation (4,) at a time [s]; the last pose after the end."""
        position = np.array([np.interp(time, self.time, column) for column in self.position.T])
        orientation = np.array([np.interp(time, self.time, column) for column in self.orientation.T])
        return position, orientation / np.linalg.norm(orientation)
