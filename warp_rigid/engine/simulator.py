"""Simulator: many environments of one scene that are stepped together on one device."""

import logging
from collections.abc import Mapping
from typing import Any

import numpy as np
import warp as wp

from warp_rigid.checks import whole_in
from warp_rigid.engine import checkpoint, quantities
from warp_rigid.engine.pools import CHUNK
from warp_rigid.engine.settings import Settings
from warp_rigid.engine.world import World
from warp_rigid.errors import NonFiniteError
from warp_rigid.scene.scene import Scene

log = logging.getLogger("warp_rigid")


class Simulator:
    """`num_envs` environments of one scene, each with its own state, parameters and settings.

    Args:
        scene: the scene.
        num_envs: number of environments.
        settings: initial settings of all environments; `set` changes them per environment.
        device: a Warp device or its name. None selects the first CUDA device, or else the CPU, and logs which. On a CPU
            the environments are distributed over all cores that the process may use.
        seed: stored for scenes and metrics that draw random numbers; the simulation itself draws none.
        on_overflow: what happens when a step finds more pairs or contacts than the capacity. "grow" undoes the step,
            increases the capacity and repeats the step, with the same bits as with that capacity from the start.
            "raise" undoes the step and raises a CapacityError.
        on_nonfinite: what happens when a state becomes non-finite. "quarantine" halts that environment and reports it
            in `status`; "raise" also raises a NonFiniteError.
        memory_limit: largest amount of device memory: bytes (int), a fraction of the device's memory (float), or None
            for all free memory.
        capacity: initial capacity for "pairs" and "contacts" of all environments; None estimates both.

    Attributes:
        scene: as given.
        num_envs: number of environments.
        num_bodies: number of bodies in each environment, in the order of the scene.
        settings: as given.
        device: the Warp device.
        seed: as given.
        on_overflow: as given.
        on_nonfinite: as given.

    Raises:
        ValueError: an argument is out of its range, or the device does not exist.
        CapacityError: the simulation does not fit into memory.
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
        """Device memory that the simulator occupies [bytes]."""
        return self._world.shards.memory

    def step(self, count: int = 1) -> None:
        """Advance all environments by `count` steps of dt.

        Raises:
            CapacityError: the capacity is exceeded and must not grow; the state is that of the last step within it.
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
        """Return a copy of a quantity, (envs, bodies, ...), or (envs, ...) for gravity and settings.

        Quantities of joints are (envs, joints, ...): "joint_position", "joint_velocity", "joint_force" (force [N] and
        torque [N m] on the first body in the last step, 6 numbers), "joint_broken" and what `set` changes.
        """
        return quantities.read(self._world, name)

    def set(self, name: str, value: Any, envs: Any = None, bodies: Any = None, joints: Any = None) -> None:
        """Change a quantity; the value broadcasts to (envs, bodies, ...), or (envs, ...) for gravity and settings.

        For quantities of joints it broadcasts to (envs, joints): "joint_target_position", "joint_target_velocity",
        "joint_stiffness", "joint_damping", "joint_max_force", "joint_friction", "joint_lower", "joint_upper",
        "joint_break_force", "joint_break_torque" and "joint_broken".

        Args:
            name: the quantity.
            value: number, array, mode name, or list of mode names.
            envs: indices of the environments; None for all.
            bodies: indices of the bodies; None for all.
            joints: indices of the joints, for quantities of joints; None for all.

        Raises:
            ValueError: unknown name, wrong shape, or a value out of range.
        """
        quantities.write(self._world, name, value, envs, bodies, joints)

    def array(self, name: str) -> wp.array:
        """Return the device array of a state or body quantity, (envs * bodies, ...), without a copy."""
        return quantities.live_array(self._world, name)

    def reset(self, envs: Any = None) -> None:
        """Reset environments to the initial state of the scene, bit for bit; parameters and settings are kept.

        Args:
            envs: indices of the environments; None for all, which also resets the time.
        """
        quantities.reset(self._world, envs)

    def save(self, path: Any) -> None:
        """Write a checkpoint, a file from which `load` continues bit for bit.

        An existing file is replaced atomically: an interruption leaves it unchanged.

        Raises:
            OSError: the file cannot be written.
            ValueError: the scene contains something that cannot be saved.
        """
        checkpoint.save(self._world, path)

    @staticmethod
    def load(path: Any, device: Any = None) -> "Simulator":
        """Return the simulator that `save` wrote, at the step at which it was saved.

        Args:
            path: the file. It contains data only; nothing in it is executed.
            device: None selects the device on which it was saved. Results on another kind of device differ by rounding.

        Raises:
            FileNotFoundError: there is no such file.
            ValueError: the file is not a complete checkpoint of this version, or the device does not exist.
            CapacityError: the simulation does not fit into memory.
        """
        return checkpoint.load(path, device, Simulator)

    def apply_impulse(self, impulse: Any, point: Any, body: int, envs: Any = None) -> None:
        """Apply an impulse [N s] to a body at a world point [m], immediately; the body and its island wake up."""
        quantities.apply_impulse(self._world, impulse, point, body, envs)

    def contacts(self) -> np.ndarray:
        """Return the contacts of the last step as records: env, body_a, body_b, position, normal, depth, impulse.

        The normal points from body_b to body_a, the impulse [N s] acts on body_a, and the depth [m] is positive inside.
        """
        return quantities.contact_records(self._world)

    def penetration(self) -> np.ndarray:
        """Return the current deepest overlap of each environment over all surface samples, (envs,) [m]."""
        return self._world.shards.deepest_overlap()

    def status(self) -> np.ndarray:
        """Return records (envs,): the status, and the step, time [s] and body at which it began (-1 if ok).

            device: None selects the device on which it was saved. Results on another kind of device differ by rounding.
        left `Scene.bounds`).
        """
        return quantities.status_records(self._world)

    def counts(self) -> dict[str, int]:
        """Return the numbers of pairs, contacts and levels of the last step, the capacities and their largest use."""
        return quantities.counts(self._world)

    def stats(self) -> dict[str, np.ndarray]:
        """Return what the solver did in the last step: arrays (envs,) by name.

        - "pairs", "contacts": numbers of pairs and contacts.
        - "islands": number of groups of dynamic bodies that contacts and other constraints connect. Of these,
          "islands_shock" were solved with shock propagation and "islands_sweeps" by sweeps alone, because shock
          propagation is off, was not needed, or has been ineffective for the island. "islands_asleep" sleep.
        - "sweeps": sweeps over the constraints; "shock_sweeps", "push_out_sweeps": sweeps of shock propagation and of
          the push-out.
        - "residual": largest change of a velocity by a constraint row in the last sweep [m/s].
        - "pair_capacity_used", "contact_capacity_used": used fraction of the pool to which the environment belongs.
        """
        return quantities.solver_stats(self._world)

    def swept_boxes(self) -> np.ndarray:
        """Return the boxes of the last broad phase, (envs, bodies, 2, 3): lower and upper corners [m].

        After a step they bound the motion of each body within it, after `penetration` its current extent. The boxes of
        planes, which are infinite, extend to 2e9 m.
        """
        return quantities.swept_boxes(self._world)

    @property
    def grid_cell(self) -> float:
        """Cell width of the hash grid [m]; environments of few bodies test all pairs instead."""
        return self._world.model.grid_radius

    def _raise_if_nonfinite(self) -> None:
        failed = np.flatnonzero(self._world.envs.failed.numpy())
        if len(failed):
            record = self.status()[failed[0]]
            raise NonFiniteError(int(failed[0]), int(record["step"]), float(record["time"]), int(record["body"]))


def choose_device(device: Any) -> Any:
    """Return a Warp device; None selects the first CUDA device, or else the CPU, and logs which.

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
