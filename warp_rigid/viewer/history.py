"""The last seconds of a session, to be shown again or continued from."""

from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np

QUANTITIES = ("position", "orientation", "linear_velocity", "angular_velocity", "active")
LENGTH = 20.0
"""Simulated time that is kept [s]."""
RATE = 30.0
"""Moments kept per simulated second, at most."""
MOST_NUMBERS = 50_000_000
"""Numbers kept at most; of large scenes a shorter time is kept."""


@dataclass(frozen=True)
class Moment:
    """The state of all environments at a time.

    Attributes:
        time: simulated time [s].
        state: by name, the quantities of all bodies.
        turned: coordinates of all joints on the device; those of hinges count full turns, which bodies do not tell.
    """

    time: float
    state: dict[str, np.ndarray]
    turned: np.ndarray


class History:
    """Keeps moments; the oldest are dropped.

    Attributes:
        moments: all of them, in their order.
    """

    def __init__(self) -> None:
        """Start empty."""
        self.moments: deque[Moment] = deque()

    def add(self, time: float, sim: Any) -> None:
        """Keep the present state, unless the last moment is too recent."""
        if self.moments and time - self.moments[-1].time < 1.0 / RATE - 1e-9:
            return
        turned = sim.internals.model.joints.position.numpy().copy()
        self.moments.append(Moment(time, {name: sim.get(name) for name in QUANTITIES}, turned))
        most = max(2, MOST_NUMBERS // max(1, 13 * sim.num_envs * sim.num_bodies))
        while time - self.moments[0].time > LENGTH or len(self.moments) > most:
            self.moments.popleft()

    @property
    def length(self) -> float:
        """Time between the first and the last moment [s]."""
        return self.moments[-1].time - self.moments[0].time if self.moments else 0.0

    def at(self, back: float) -> Moment | None:
        """The moment nearest to `back` seconds before the last one."""
        if not self.moments:
            return None
        wanted = self.moments[-1].time - back
        return min(self.moments, key=lambda moment: abs(moment.time - wanted))

    def forget_after(self, time: float) -> None:
        """Remove the frames after a time."""
        while self.moments and self.moments[-1].time > time:
            self.moments.pop()
