"""View of the environments of one scene in a simulator, passed to the events and the outcome of that scene."""

from typing import Any

import numpy as np

from warp_rigid.engine.simulator import Simulator
from warp_rigid.scene.scene import Scene

__all__ = ["EnvironmentView"]


class EnvironmentView:
    """A subset of the environments of a simulator, with part of the interface of `Simulator`.

    Attributes:
        scene: the scene of these environments.
        num_envs: their number.
    """

    def __init__(self, sim: Simulator, scene: Scene, envs: np.ndarray) -> None:
        """Store the indices of the environments."""
        self._sim, self.scene, self._envs = sim, scene, envs
        self.num_envs = len(envs)
        self.num_bodies, self.settings, self.device = sim.num_bodies, sim.settings, sim.device

    @property
    def time(self) -> float:
        """Simulated time [s]."""
        return self._sim.time

    def get(self, name: str) -> np.ndarray:
        """See Simulator.get."""
        return self._sim.get(name)[self._envs]

    def set(self, name: str, value: Any, envs: Any = None, bodies: Any = None) -> None:
        """See Simulator.set."""
        self._sim.set(name, value, self._envs if envs is None else self._envs[envs], bodies)

    def apply_impulse(self, impulse: Any, point: Any, body: int, envs: Any = None) -> None:
        """See Simulator.apply_impulse."""
        self._sim.apply_impulse(impulse, point, body, self._envs if envs is None else self._envs[envs])

    def penetration(self) -> np.ndarray:
        """See Simulator.penetration."""
        return self._sim.penetration()[self._envs]

    def status(self) -> np.ndarray:
        """See Simulator.status."""
        return self._sim.status()[self._envs]
