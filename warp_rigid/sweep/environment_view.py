"""View of some environments of a simulator whose scenes have the same bodies, as if they were all environments."""

from typing import Any

import numpy as np

from warp_rigid.engine.quantities import is_of_bodies
from warp_rigid.engine.simulator import Simulator
from warp_rigid.scene.scene import Scene

__all__ = ["EnvironmentView"]


class EnvironmentView:
    """A subset of the environments of a simulator, with part of the interface of `Simulator`.

    Attributes:
        scene: the scene of these environments, or of the first of them.
        envs: their indices in the simulator.
        num_envs: their number.
    """

    def __init__(self, sim: Simulator, scene: Scene, envs: np.ndarray) -> None:
        """Store the indices of the environments."""
        self._sim, self.scene, self.envs = sim, scene, envs
        self.num_envs, self.num_bodies = len(envs), len(scene.bodies)
        self.settings, self.device = sim.settings, sim.device

    @property
    def time(self) -> float:
        """Simulated time [s]."""
        return self._sim.time

    def get(self, name: str) -> np.ndarray:
        """See Simulator.get."""
        values = self._sim.get(name)[self.envs]
        return values[:, : self.num_bodies] if is_of_bodies(name) else values

    def contacts(self) -> np.ndarray:
        """See Simulator.contacts."""
        records = self._sim.contacts()
        place = np.full(self._sim.num_envs, -1, np.int32)
        place[self.envs] = np.arange(self.num_envs)
        records["env"] = place[records["env"]]
        return records[records["env"] >= 0]

    def set(self, name: str, value: Any, envs: Any = None, bodies: Any = None) -> None:
        """See Simulator.set."""
        if bodies is None and is_of_bodies(name):
            bodies = np.arange(self.num_bodies)
        self._sim.set(name, value, self.envs if envs is None else self.envs[envs], bodies)

    def spawn(self, pool: str, position: Any, envs: Any = None, **state: Any) -> np.ndarray:
        """See Simulator.spawn; all but the pool and the position are given by name."""
        return self._sim.spawn(pool, position, envs=self.envs if envs is None else self.envs[envs], **state)

    def despawn(self, bodies: Any, envs: Any = None) -> None:
        """See Simulator.despawn."""
        self._sim.despawn(bodies, self.envs if envs is None else self.envs[envs])

    def apply_impulse(self, impulse: Any, point: Any, body: int, envs: Any = None) -> None:
        """See Simulator.apply_impulse."""
        self._sim.apply_impulse(impulse, point, body, self.envs if envs is None else self.envs[envs])

    def penetration(self) -> np.ndarray:
        """See Simulator.penetration."""
        return self._sim.penetration()[self.envs]

    def status(self) -> np.ndarray:
        """See Simulator.status."""
        return self._sim.status()[self.envs]
