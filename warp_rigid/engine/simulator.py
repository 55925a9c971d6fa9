"""Simulator: many environments of one scene, stepped together on one device."""

import logging
from collections.abc import Mapping
from typing import Any

import numpy as np
import warp as wp

from warp_rigid.checks import one_of, whole_in
from warp_rigid.engine import checkpoint, pools, quantities
from warp_rigid.engine.batch import Shards, plan
from warp_rigid.engine.loading import GRIDS, STEP, load_kernels
from warp_rigid.engine.memory import MemoryLimit, body_bytes, pool_bytes, shape_bytes
from warp_rigid.engine.model import build_model, initial_environments, initial_state
from warp_rigid.engine.pools import CHUNK
from warp_rigid.engine.settings import Settings
from warp_rigid.engine.shard import WATCHED
from warp_rigid.engine.teams import team_sizes
from warp_rigid.errors import NonFiniteError
from warp_rigid.kernels import declare, schema
from warp_rigid.scene.scene import Scene
from warp_rigid.scene.shapes import Compound, Mesh

log = logging.getLogger("warp_rigid")


class Simulator:
    """`num_envs` environments of one scene, each with its own state, parameters and settings.

    Args:
        scene: the scene; later changes to it have no effect.
        num_envs: environments.
        settings: of all environments at first; `set` changes them one by one.
        device: a Warp device or its name; None takes the first CUDA device, else the CPU, and says which. A CPU
            spreads the environments over all cores that the process may use.
        seed: kept for scenes and metrics that draw random numbers; the simulation itself draws none.
        on_overflow: when more pairs or contacts are wanted than there is room for: "grow" undoes the step, makes room
            and repeats it, to the same bits as with room from the start; "raise" raises a CapacityError before it.
        on_nonfinite: when a state becomes non-finite: "quarantine" halts its environment alone and notes it in
            `status`; "raise" raises a NonFiniteError too.
        memory_limit: what the simulator may take on its device: bytes (int), a fraction of the device's memory (float),
            or None for all that is free.
        capacity: room for "pairs" and "contacts" of all environments at the start; None estimates both.

    Attributes:
        scene: as given.
        num_envs: environments.
        num_bodies: bodies in each, in the scene's order.
        settings: as given.
        device: the Warp device.
        seed: as given.
        on_overflow: as given.
        on_nonfinite: as given.

    Raises:
        ValueError: an argument is out of its range, or the device does not exist.
        CapacityError: the simulation does not fit into the memory.
    """

    def __init__(
        self,
        scene: Scene,
        num_envs: int = 1,
        settings: Settings | None = None,
        device: Any = None,
        seed: int = 0,
        on_overflow: str = "grow",
        on_nonfinite: str = "quarantine",
        memory_limit: int | float | None = None,
        capacity: Mapping[str, int] | None = None,
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
        self.on_overflow = one_of("on_overflow", on_overflow, ("grow", "raise"))
        self.on_nonfinite = one_of("on_nonfinite", on_nonfinite, ("quarantine", "raise"))
        self._memory_limit = MemoryLimit(self.device, memory_limit)
        room = self._initial_capacity(capacity or {})
        ranges = plan(scene, self.num_envs, room, self.device)
        other_bytes = body_bytes(scene, self.num_envs) + shape_bytes(scene)
        needed = other_bytes + sum(pool_bytes(some.sizes) for some in ranges)
        self._memory_limit.check(0, needed, f"simulating {num_envs} environment(s)")
        baking = any(isinstance(body.shape, Mesh | Compound) for body in scene.bodies)
        modules = [*STEP, *(GRIDS if baking else ())]
        load_kernels(self.device, modules, team_sizes(self.device, num_envs, self.num_bodies))
        self._model = build_model(scene, num_envs, self.device)
        self._state = initial_state(scene, num_envs, self.device)
        self._start = initial_state(scene, num_envs, self.device)
        self._sleep_state = declare.allocate(schema.SleepState, {"bodies": num_envs * self.num_bodies}, self.device)
        self._envs = initial_environments(scene, self.settings, num_envs, self.device)
        self._shards = Shards(
            ranges,
            self._model,
            self._state,
            self._sleep_state,
            self._envs,
            room if on_overflow == "raise" else None,
            self._memory_limit,
            other_bytes,
        )
        quantities.renew_stages(self)

    @property
    def time(self) -> float:
        """Simulated time since the start or the last reset of all environments [s]."""
        return self._shards.steps * self.settings.dt

    @property
    def memory(self) -> int:
        """Bytes that the simulator holds on its device."""
        return self._shards.memory

    def step(self, count: int = 1) -> None:
        """Advance all environments by `count` steps of dt.

        Raises:
            CapacityError: there is not enough room, and it may not grow; the last step that fitted stands.
            NonFiniteError: a state became non-finite, and on_nonfinite is "raise".
        """
        left = whole_in("count", count, 0, 2**31)
        while left > 0:
            chunk = min(left, CHUNK)
            self._shards.step(chunk)
            left -= chunk
            if self.on_nonfinite == "raise":
                self._raise_if_nonfinite()

    def get(self, name: str) -> np.ndarray:
        """A copy of a quantity, shaped (envs, bodies, ...), or (envs, ...) for gravity and settings."""
        return quantities.read(self, name)

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
        quantities.write(self, name, value, envs, bodies)

    def array(self, name: str) -> wp.array:
        """The live device array of a state or body quantity, shaped (envs * bodies, ...), without a copy."""
        return quantities.live_array(self, name)

    def reset(self, envs: Any = None) -> None:
        """Put environments back to the scene's start, bit for bit; parameters and settings stay as they were set.

        Args:
            envs: indices of the environments; None for all, which also resets the time.
        """
        chosen = quantities.env_indices(self, envs)
        for name in declare.field_names(schema.State):
            rows = getattr(self._state, name).numpy().reshape(self.num_envs, self.num_bodies, -1)
            start = getattr(self._start, name).numpy().reshape(rows.shape)
            rows[chosen] = start[chosen]
            getattr(self._state, name).assign(rows.reshape(getattr(self._state, name).numpy().shape))
        for name in declare.field_names(schema.SleepState):
            values = getattr(self._sleep_state, name).numpy()
            values.reshape(self.num_envs, self.num_bodies, -1)[chosen] = 0
            getattr(self._sleep_state, name).assign(values)
        for name in WATCHED:
            values = getattr(self._envs, name).numpy()
            values[chosen] = 0
            getattr(self._envs, name).assign(values)
        quantities.forget_history(self, chosen)
        if envs is None:
            self._shards.steps = 0

    def save(self, path: Any) -> None:
        """Write a checkpoint: one file from which `load` goes on bit for bit.

        It replaces an older one in one go; whatever interrupts it leaves the older one whole.

        Raises:
            OSError: it cannot be written.
            ValueError: the scene has a shape of a kind of its own.
        """
        checkpoint.save(self, path)

    @staticmethod
    def load(path: Any, device: Any = None) -> "Simulator":
        """The simulator that `save` wrote, at the step where it was.

        Args:
            path: the file; nothing in it is ever run.
            device: None takes the device it was saved on. Another kind of device goes on, but with other roundings.

        Raises:
            FileNotFoundError: there is no such file.
            ValueError: it is no whole checkpoint of this version, or the device does not exist.
            CapacityError: it does not fit into the memory.
        """
        return checkpoint.load(path, device)

    def apply_impulse(self, impulse: Any, point: Any, body: int, envs: Any = None) -> None:
        """Apply an impulse [N s] at a world point [m] to a body, at once; it wakes the body and its island."""
        quantities.apply_impulse(self, impulse, point, body, envs)

    def contacts(self) -> np.ndarray:
        """Contacts of the last step as records: env, body_a, body_b, position, normal, depth, impulse.

        The normal points from body_b to body_a, the impulse [N s] is the one on body_a, depth [m] is positive inside.
        """
        return quantities.contact_records(self)

    def penetration(self) -> np.ndarray:
        """Deepest overlap now in each environment, over all surface samples, (envs,) [m]."""
        return self._shards.deepest_overlap()

    def status(self) -> np.ndarray:
        """Records (envs,): status, and the step, time [s] and body where it began (-1 if ok).

        "ok"; "non-finite": the environment is halted; "out of bounds": a body's centre has left `Scene.bounds`.
        """
        return quantities.status_records(self)

    def counts(self) -> dict[str, int]:
        """Pairs, contacts and levels of the last step, and the pools' sizes and high-water marks."""
        return quantities.counts(self)

    def swept_boxes(self) -> np.ndarray:
        """Boxes by which pairs were last looked for, (envs, bodies, 2, 3): lower and upper corners [m].

        After a step they hold what each body may reach within it, after `penetration` what it fills now. Planes have
        no end: their boxes reach 2e9 m.
        """
        return quantities.swept_boxes(self)

    @property
    def grid_cell(self) -> float:
        """Width of the cells in which bodies look for each other [m]; environments of few bodies try all pairs."""
        return self._model.grid_radius

    def _initial_capacity(self, given: Mapping[str, int]) -> dict[str, int]:
        """Room for six pairs a dynamic body and six contacts a pair, unless told otherwise."""
        for name in given:
            one_of("capacity", name, pools.NAMES)
        dynamic = sum(body.mass > 0.0 for body in self.scene.bodies)
        estimate, _ = pools.expected_capacity(self.num_envs, dynamic)
        pairs = whole_in("capacity pairs", given.get("pairs", estimate), 1, pools.LARGEST)
        contacts = whole_in("capacity contacts", given.get("contacts", min(6 * pairs, pools.LARGEST)), 1, pools.LARGEST)
        return {"pairs": pairs, "contacts": contacts}

    def _raise_if_nonfinite(self) -> None:
        failed = np.flatnonzero(self._envs.failed.numpy())
        if len(failed):
            record = self.status()[failed[0]]
            raise NonFiniteError(int(failed[0]), int(record["step"]), float(record["time"]), int(record["body"]))


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
