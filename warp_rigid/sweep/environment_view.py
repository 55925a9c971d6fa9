"""View of some environments of a simulator whose scenes have the same bodies, as if they were all environments."""

from collections.abc import Callable
from typing import Any

import numpy as np

from warp_rigid.engine.quantities import check_owner, owner_of, write
from warp_rigid.engine.selection import Indices, Members, env_indices, indices_in
from warp_rigid.engine.simulator import Simulator
from warp_rigid.scene.scene import Scene


class EnvironmentView:
    """A subset of the environments of a simulator, with part of the interface of `Simulator`.

    Args:
        sim: the simulator.
        scene: the scene of these environments, or of the first of them.
        envs: their indices in the simulator.
        reads: what the views of a simulator have read since it last changed: each is read once for all views that share
            this dictionary.

    Attributes:
        scene: as given.
        envs: as given.
        num_envs: their number.
    """

    def __init__(self, sim: Simulator, scene: Scene, envs: np.ndarray, reads: dict[str, Any]) -> None:
        """Store the indices of the environments."""
        self._reads, self._sim, self.scene, self.envs = reads, sim, scene, envs
        self.num_envs, self.num_bodies = len(envs), len(scene.bodies)
        self.settings, self.device = sim.settings, sim.device

    @property
    def time(self) -> float:
        """Simulated time [s]."""
        return self._sim.time

    def _read(self, key: str, read: Callable[[], np.ndarray]) -> np.ndarray:
        """The result of `read`, called once after each change; it must not be modified."""
        if self._reads.get("time") != self._sim.time:
            self._reads.clear()
            self._reads["time"] = self._sim.time
        if key not in self._reads:
            self._reads[key] = read()
        return self._reads[key]

    def get(self, name: str, envs: Indices = None, bodies: Members = None, joints: Members = None) -> np.ndarray:
        """See Simulator.get."""
        values = self._read(f"get({name})", lambda: self._sim.get(name))[self._chosen(envs)]
        check_owner(name, bodies, joints)
        owner, wanted = owner_of(name), bodies if joints is None else joints
        if owner not in ("bodies", "joints"):
            return values
        return values[:, indices_in(self.scene, slice(None) if wanted is None else wanted, owner, owner)]

    def _chosen(self, envs: Any) -> np.ndarray:
        """Indices in the simulator of environments of the view."""
        return self.envs[env_indices(self.num_envs, envs)]

    def contacts(self) -> np.ndarray:
        """See Simulator.contacts."""
        records = self._read("contacts()", self._sim.contacts)
        place = np.full(self._sim.num_envs, -1, np.int32)
        place[self.envs] = np.arange(self.num_envs)
        own = records[place[records["env"]] >= 0]
        own["env"] = place[own["env"]]
        return own

    def set(self, name: str, value: Any, envs: Indices = None, bodies: Members = None, joints: Members = None) -> None:
        """See Simulator.set."""
        of_all = bodies is None and joints is None
        if of_all and owner_of(name) == "bodies":
            bodies = np.arange(self.num_bodies)
        if of_all and owner_of(name) == "joints":
            joints = np.arange(len(self.scene.joints))
        with self._sim.in_use():
            write(self._sim.internals, name, value, self._chosen(envs), bodies, joints, of_all)
        self._reads.clear()

    def spawn(self, pool: str, position: Any, envs: Any = None, **state: Any) -> np.ndarray:
        """See Simulator.spawn; all but the pool and the position are given by name."""
        self._reads.clear()
        return self._sim.spawn(pool, position, envs=self._chosen(envs), **state)

    def despawn(self, bodies: Any, envs: Any = None) -> None:
        """See Simulator.despawn."""
        self._sim.despawn(bodies, self._chosen(envs))
        self._reads.clear()

    def apply_impulse(self, impulse: Any, point: Any = None, body: int | str | None = None, envs: Any = None) -> None:
        """See Simulator.apply_impulse."""
        self._sim.apply_impulse(impulse, point, body, self._chosen(envs))
        self._reads.clear()

    def penetration(self) -> np.ndarray:
        """See Simulator.penetration."""
        return self._read("penetration()", self._sim.penetration)[self.envs]

    def status(self) -> np.ndarray:
        """See Simulator.status."""
        return self._read("status()", self._sim.status)[self.envs]
