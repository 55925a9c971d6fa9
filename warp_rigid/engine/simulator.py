"""Simulator: many environments of one scene, stepped together on one device."""

import logging
from collections.abc import Mapping
from typing import Any

import numpy as np
import warp as wp

from warp_rigid.checks import whole_in
from warp_rigid.engine import checkpoint, quantities
from warp_rigid.engine.pools import CHUNK
from warp_rigid.engine.settings import Settings
from warp_rigid.engine.shard import WATCHED
from warp_rigid.engine.world import World
from warp_rigid.errors import NonFiniteError
from warp_rigid.kernels import declare, schema
from warp_rigid.scene.scene import Scene

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
        self._world = World(
            scene,
            num_envs,
            settings or Settings(),
            choose_device(device),
            seed,
            on_overflow,
            on_nonfinite,
            memory_limit,
            capacity or {},
        )
        self.scene, self.settings, self.device = scene, self._world.settings, self._world.device
        self.num_envs, self.num_bodies = self._world.num_envs, self._world.num_bodies
        self.seed, self.on_overflow, self.on_nonfinite = seed, on_overflow, on_nonfinite

    @property
    def time(self) -> float:
        """Simulated time since the start or the last reset of all environments [s]."""
        return self._world.shards.steps * self.settings.dt

    @property
    def memory(self) -> int:
        """Bytes that the simulator holds on its device."""
        return self._world.shards.memory

    def step(self, count: int = 1) -> None:
        """Advance all environments by `count` steps of dt.

        Raises:
            CapacityError: there is not enough room, and it may not grow; the last step that fitted stands.
            NonFiniteError: a state became non-finite, and on_nonfinite is "raise".
        """
        left = whole_in("count", count, 0, 2**31)
        while left > 0:
            chunk = min(left, CHUNK)
            self._world.shards.step(chunk)
            left -= chunk
            if self.on_nonfinite == "raise":
                self._raise_if_nonfinite()

    def get(self, name: str) -> np.ndarray:
        """A copy of a quantity, shaped (envs, bodies, ...), or (envs, ...) for gravity and settings."""
        return quantities.read(self._world, name)

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
        quantities.write(self._world, name, value, envs, bodies)

    def array(self, name: str) -> wp.array:
        """The live device array of a state or body quantity, shaped (envs * bodies, ...), without a copy."""
        return quantities.live_array(self._world, name)

    def reset(self, envs: Any = None) -> None:
        """Put environments back to the scene's start, bit for bit; parameters and settings stay as they were set.

        Args:
            envs: indices of the environments; None for all, which also resets the time.
        """
        chosen = quantities.env_indices(self._world, envs)
        for name in declare.field_names(schema.State):
            rows = getattr(self._world.state, name).numpy().reshape(self.num_envs, self.num_bodies, -1)
            start = getattr(self._world.start, name).numpy().reshape(rows.shape)
            rows[chosen] = start[chosen]
            getattr(self._world.state, name).assign(rows.reshape(getattr(self._world.state, name).numpy().shape))
        for name in declare.field_names(schema.SleepState):
            values = getattr(self._world.sleep_state, name).numpy()
            values.reshape(self.num_envs, self.num_bodies, -1)[chosen] = 0
            getattr(self._world.sleep_state, name).assign(values)
        for name in WATCHED:
            values = getattr(self._world.envs, name).numpy()
            values[chosen] = 0
            getattr(self._world.envs, name).assign(values)
        quantities.forget_history(self._world, chosen)
        if envs is None:
            self._world.shards.steps = 0

    def save(self, path: Any) -> None:
        """Write a checkpoint: one file from which `load` goes on bit for bit.

        It replaces an older one in one go; whatever interrupts it leaves the older one whole.

        Raises:
            OSError: it cannot be written.
            ValueError: the scene has a shape of a kind of its own.
        """
        checkpoint.save(self._world, path)

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
        return checkpoint.load(path, device, Simulator)

    def apply_impulse(self, impulse: Any, point: Any, body: int, envs: Any = None) -> None:
        """Apply an impulse [N s] at a world point [m] to a body, at once; it wakes the body and its island."""
        quantities.apply_impulse(self._world, impulse, point, body, envs)

    def contacts(self) -> np.ndarray:
        """Contacts of the last step as records: env, body_a, body_b, position, normal, depth, impulse.

        The normal points from body_b to body_a, the impulse [N s] is the one on body_a, depth [m] is positive inside.
        """
        return quantities.contact_records(self._world)

    def penetration(self) -> np.ndarray:
        """Deepest overlap now in each environment, over all surface samples, (envs,) [m]."""
        return self._world.shards.deepest_overlap()

    def status(self) -> np.ndarray:
        """Records (envs,): status, and the step, time [s] and body where it began (-1 if ok).

        "ok"; "non-finite": the environment is halted; "out of bounds": a body's centre has left `Scene.bounds`.
        """
        return quantities.status_records(self._world)

    def counts(self) -> dict[str, int]:
        """Pairs, contacts and levels of the last step, and the pools' sizes and high-water marks."""
        return quantities.counts(self._world)

    def stats(self) -> dict[str, np.ndarray]:
        """What the solver did in the last step, by name; arrays are (envs,).

        "pairs", "contacts": numbers found. "islands": groups of dynamic bodies connected by contacts and other
        constraints; of these, "islands_shock" were solved with shock propagation, "islands_sweeps" by sweeps alone
        (shock propagation is off, was not needed, or has been ineffective for the island), and "islands_asleep" were
        not solved. "sweeps": sweeps over the
        constraints; "shock_sweeps", "push_out_sweeps": those of shock propagation and of the push-out. "residual": the
        largest change of a velocity by a constraint row in the last sweep [m/s]. "pair_capacity_used",
        "contact_capacity_used": fractions of the capacity of the environment's pool.
        """
        return quantities.solver_stats(self._world)

    def swept_boxes(self) -> np.ndarray:
        """Boxes by which pairs were last looked for, (envs, bodies, 2, 3): lower and upper corners [m].

        After a step they hold what each body may reach within it, after `penetration` what it fills now. Planes have
        no end: their boxes reach 2e9 m.
        """
        return quantities.swept_boxes(self._world)

    @property
    def grid_cell(self) -> float:
        """Width of the cells in which bodies look for each other [m]; environments of few bodies try all pairs."""
        return self._world.model.grid_radius

    def _raise_if_nonfinite(self) -> None:
        failed = np.flatnonzero(self._world.envs.failed.numpy())
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
