"""Simulator: many environments of one scene, stepped together on one device."""

import logging
from typing import Any

import numpy as np
import warp as wp

from warp_rigid import access
from warp_rigid.checks import whole_in
from warp_rigid.kernels import data
from warp_rigid.model import build_model, initial_environments, initial_state
from warp_rigid.pools import Pools, copy_arrays
from warp_rigid.scene import Scene
from warp_rigid.settings import Settings
from warp_rigid.shapes import Compound, Mesh
from warp_rigid.stages import Stages, load_kernels

log = logging.getLogger("warp_rigid")

CHUNK = 16
"""Most steps between two looks at the pools; as many are repeated if one was too small."""


class Simulator:
    """`num_envs` environments of one scene, each with its own state, parameters and settings.

    Args:
        scene: the scene; later changes to it have no effect.
        num_envs: environments.
        settings: of all environments at first; `set` changes them one by one.
        device: a Warp device or its name; None takes the first CUDA device, else the CPU, and says which.
        seed: kept for scenes and metrics that draw random numbers; the simulation itself draws none.

    Attributes:
        scene: as given.
        num_envs: environments.
        num_bodies: bodies in each, in the scene's order.
        settings: as given.
        device: the Warp device.
        seed: as given.

    Raises:
        ValueError: an argument is out of its range, or the device does not exist.
    """

    def __init__(
        self,
        scene: Scene,
        num_envs: int = 1,
        settings: Settings | None = None,
        device: Any = None,
        seed: int = 0,
    ) -> None:
        """Upload the scene and compile the step."""
        if not scene.bodies:
            raise ValueError("scene.bodies: must hold at least one body")
        self.scene = scene
        self.num_envs = whole_in("num_envs", num_envs, 1, 10_000_000)
        self.num_bodies = len(scene.bodies)
        self.settings = settings or Settings()
        self.device = choose_device(device)
        self.seed = whole_in("seed", seed, 0, 2**63 - 1)
        load_kernels(self.device, baking=any(isinstance(b.shape, Mesh | Compound) for b in scene.bodies))
        self._model = build_model(scene, num_envs, self.device)
        self._state = initial_state(scene, num_envs, self.device)
        self._start = initial_state(scene, num_envs, self.device)
        self._saved = data.allocate(data.State, {"bodies": num_envs * self.num_bodies}, self.device)
        self._envs = initial_environments(scene, self.settings, num_envs, self.device)
        self._pools = self._estimated_pools()
        self._saved_history = self._room_for_history()
        self._stages = self._new_stages()
        self._steps = 0

    @property
    def time(self) -> float:
        """Simulated time since the start or the last reset of all environments [s]."""
        return self._steps * self.settings.dt

    def step(self, count: int = 1) -> None:
        """Advance all environments by `count` steps of dt."""
        left = whole_in("count", count, 0, 2**31)
        while left > 0:
            chunk = min(left, CHUNK)
            self._save()
            for _ in range(chunk):
                self._stages.replay()
            shortage = self._pools.shortage()
            if shortage:
                self._restore(chunk)
                self._grow(shortage)
            else:
                left -= chunk
                self._steps += chunk

    def get(self, name: str) -> np.ndarray:
        """A copy of a quantity, shaped (envs, bodies, ...), or (envs, ...) for gravity and settings."""
        return access.read(self, name)

    def set(self, name: str, value: Any, envs: Any = None, bodies: Any = None) -> None:
        """Change a quantity; the value broadcasts to (envs, bodies, ...), or (envs, ...) for gravity and settings.

        Args:
            name: what to change.
            value: number, array, mode name, or list of mode names.
            envs: indices of the environments; None for all.
            bodies: indices of the bodies; None for all.

        Raises:
            ValueError: unknown name, wrong shape, or a value out of range.
        """
        access.write(self, name, value, envs, bodies)

    def array(self, name: str) -> wp.array:
        """The live device array of a state or body quantity, shaped (envs * bodies, ...), without a copy."""
        return access.live_array(self, name)

    def reset(self, envs: Any = None) -> None:
        """Put environments back to the scene's start, bit for bit; parameters and settings stay as they were set.

        Args:
            envs: indices of the environments; None for all, which also resets the time.
        """
        chosen = access.env_indices(self, envs)
        for name in data.field_names(data.State):
            rows = getattr(self._state, name).numpy().reshape(self.num_envs, self.num_bodies, -1)
            start = getattr(self._start, name).numpy().reshape(rows.shape)
            rows[chosen] = start[chosen]
            getattr(self._state, name).assign(rows.reshape(getattr(self._state, name).numpy().shape))
        for name in ("failed", "failed_step", "failed_body", "step"):
            values = getattr(self._envs, name).numpy()
            values[chosen] = 0
            getattr(self._envs, name).assign(values)
        access.forget_history(self, chosen)
        if envs is None:
            self._steps = 0

    def apply_impulse(self, impulse: Any, point: Any, body: int, envs: Any = None) -> None:
        """Apply an impulse [N s] at a world point [m] to a body, at once."""
        access.apply_impulse(self, impulse, point, body, envs)

    def contacts(self) -> np.ndarray:
        """Contacts of the last step as records: env, body_a, body_b, position, normal, depth, impulse.

        The normal points from body_b to body_a, the impulse [N s] is the one on body_a, depth [m] is positive inside.
        """
        return access.contact_records(self)

    def penetration(self) -> np.ndarray:
        """Deepest overlap now in each environment, over all surface samples, (envs,) [m]."""
        while True:
            deepest = self._stages.deepest_overlap()
            shortage = self._pools.shortage()
            if not shortage:
                return deepest.numpy()
            self._grow(shortage)

    def status(self) -> np.ndarray:
        """Records (envs,): status "ok" or "non-finite", and the step and body where it began (-1 if ok)."""
        return access.status_records(self)

    def counts(self) -> dict[str, int]:
        """Pairs, contacts and levels of the last step, and the pools' sizes and high-water marks."""
        return access.counts(self)

    def swept_boxes(self) -> np.ndarray:
        """Boxes by which pairs were last looked for, (envs, bodies, 2, 3): lower and upper corners [m].

        After a step they hold what each body may reach within it, after `penetration` what it fills now. Planes have
        no end: their boxes reach 2e9 m.
        """
        return access.swept_boxes(self)

    @property
    def grid_cell(self) -> float:
        """Width of the cells in which bodies look for each other [m]; environments of few bodies try all pairs."""
        return self._model.grid_radius

    def _new_stages(self) -> Stages:
        return Stages(
            self._model, self._state, self._envs, self._pools, self.settings.dt, access.largest_repetition(self)
        )

    def _estimated_pools(self) -> Pools:
        """Pools for six pairs a dynamic body and six contacts a pair; they grow if that is not enough."""
        dynamic = sum(body.mass > 0.0 for body in self.scene.bodies)
        pairs = self.num_envs * max(8, 6 * dynamic)
        return Pools.allocate(self.num_envs, self.num_bodies, pairs, 6 * pairs, self.device)

    def _room_for_history(self) -> Any:
        return data.allocate(data.History, self._pools.sizes, self.device)

    def _save(self) -> None:
        """Keep what a step changes, so that steps can be undone."""
        copy_arrays(self._state, self._saved, data.State)
        copy_arrays(self._pools.history, self._saved_history, data.History)

    def _restore(self, steps: int) -> None:
        """Undo the steps since `_save`."""
        copy_arrays(self._saved, self._state, data.State)
        copy_arrays(self._saved_history, self._pools.history, data.History)
        self._stages.count_back(steps)

    def _grow(self, shortage: dict[str, int]) -> None:
        """Enlarge the pools and record the step anew."""
        self._pools = self._pools.grown(shortage, self.num_envs, self.num_bodies)
        self._saved_history = self._room_for_history()
        self._stages = self._new_stages()


def choose_device(device: Any) -> Any:
    """The Warp device asked for; None takes the first CUDA device, else the CPU, and says which once.

    Raises:
        ValueError: there is no such device.
    """
    if device is None:
        chosen = wp.get_cuda_device() if wp.is_cuda_available() else wp.get_device("cpu")
        log.info("simulating on %s", chosen)
        return chosen
    try:
        return wp.get_device(device)
    except Exception as error:
        names = ", ".join(str(d) for d in wp.get_devices())
        raise ValueError(f"device: must be one of {names}, got {device!r}") from error
