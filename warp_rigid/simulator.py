"""Simulator: many environments of one scene, stepped together on one device."""

import logging
from collections.abc import Mapping
from typing import Any

import numpy as np
import warp as wp

from warp_rigid import access, checkpoint, pools
from warp_rigid.checks import one_of, whole_in
from warp_rigid.errors import CapacityError, NonFiniteError
from warp_rigid.kernels import data
from warp_rigid.memory import MemoryLimit, body_bytes, pool_bytes, shape_bytes
from warp_rigid.model import build_model, initial_environments, initial_state
from warp_rigid.pools import Pools, copy_arrays
from warp_rigid.scene import Scene
from warp_rigid.settings import Settings
from warp_rigid.shapes import Compound, Mesh
from warp_rigid.stages import GRIDS, STEP, Stages, load_kernels, team_sizes

log = logging.getLogger("warp_rigid")

CHUNK = 16
"""Most steps between two looks at the pools; as many are repeated if one was too small."""

WATCHED = ("failed", "failed_step", "failed_body", "outside", "outside_step", "outside_body", "step")
"""What a step notes of an environment; undone with it, and cleared by a reset."""


class Simulator:
    """`num_envs` environments of one scene, each with its own state, parameters and settings.

    Args:
        scene: the scene; later changes to it have no effect.
        num_envs: environments.
        settings: of all environments at first; `set` changes them one by one.
        device: a Warp device or its name; None takes the first CUDA device, else the CPU, and says which.
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
        self._growth_told = False
        sizes = self._first_sizes(capacity or {})
        needed = self._bytes_without_pools() + pool_bytes(sizes)
        self._memory_limit.check(0, needed, f"simulating {num_envs} environment(s)")
        baking = any(isinstance(body.shape, Mesh | Compound) for body in scene.bodies)
        modules = [*STEP, *(GRIDS if baking else ())]
        load_kernels(self.device, modules, team_sizes(self.device, num_envs, self.num_bodies))
        self._model = build_model(scene, num_envs, self.device)
        self._state = initial_state(scene, num_envs, self.device)
        self._start = initial_state(scene, num_envs, self.device)
        self._saved = data.allocate(data.State, {"bodies": num_envs * self.num_bodies}, self.device)
        self._rest = data.allocate(data.Rest, {"bodies": num_envs * self.num_bodies}, self.device)
        self._saved_rest = data.allocate(data.Rest, {"bodies": num_envs * self.num_bodies}, self.device)
        self._envs = initial_environments(scene, self.settings, num_envs, self.device)
        self._saved_watch = {name: wp.clone(getattr(self._envs, name)) for name in WATCHED}
        self._pools = Pools.allocate(self.num_envs, self.num_bodies, sizes["pairs"], sizes["contacts"], self.device)
        self._saved_history = self._room_for_history()
        self._stages = self._new_stages()
        self._steps = 0

    @property
    def time(self) -> float:
        """Simulated time since the start or the last reset of all environments [s]."""
        return self._steps * self.settings.dt

    @property
    def memory(self) -> int:
        """Bytes that the simulator holds on its device."""
        return self._bytes_without_pools() + pool_bytes(self._pools.sizes)

    def step(self, count: int = 1) -> None:
        """Advance all environments by `count` steps of dt.

        Raises:
            CapacityError: there is not enough room, and it may not grow; the last step that fitted stands.
            NonFiniteError: a state became non-finite, and on_nonfinite is "raise".
        """
        left = whole_in("count", count, 0, 2**31)
        while left > 0:
            chunk = min(left, CHUNK)
            shortage = self._try(chunk)
            if shortage and not self._may_grow(shortage):
                self._step_up_to_overflow(chunk)
            elif shortage:
                self._grow(shortage)
            else:
                left -= chunk
            if self.on_nonfinite == "raise":
                self._raise_if_nonfinite()

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
        for name in data.field_names(data.Rest):
            values = getattr(self._rest, name).numpy()
            values.reshape(self.num_envs, self.num_bodies, -1)[chosen] = 0
            getattr(self._rest, name).assign(values)
        for name in WATCHED:
            values = getattr(self._envs, name).numpy()
            values[chosen] = 0
            getattr(self._envs, name).assign(values)
        access.forget_history(self, chosen)
        if envs is None:
            self._steps = 0

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
            if not self._may_grow(shortage):
                raise self._overflow(shortage)
            self._grow(shortage)

    def status(self) -> np.ndarray:
        """Records (envs,): status, and the step, time [s] and body where it began (-1 if ok).

        "ok"; "non-finite": the environment is halted; "out of bounds": a body's centre has left `Scene.bounds`.
        """
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
            self._model,
            self._state,
            self._rest,
            self._envs,
            self._pools,
            self.settings.dt,
            access.largest_repetition(self),
            access.any_sleeping(self),
        )

    def _first_sizes(self, given: Mapping[str, int]) -> dict[str, int]:
        """Room for six pairs a dynamic body and six contacts a pair, unless told otherwise."""
        for name in given:
            one_of("capacity", name, pools.NAMES)
        dynamic = sum(body.mass > 0.0 for body in self.scene.bodies)
        estimate, _ = pools.expected_room(self.num_envs, dynamic)
        pairs = whole_in("capacity pairs", given.get("pairs", estimate), 1, pools.LARGEST)
        contacts = whole_in("capacity contacts", given.get("contacts", min(6 * pairs, pools.LARGEST)), 1, pools.LARGEST)
        return Pools.sizes_for(self.num_envs, self.num_bodies, pairs, contacts)

    def _bytes_without_pools(self) -> int:
        return body_bytes(self.scene, self.num_envs) + shape_bytes(self.scene)

    def _room_for_history(self) -> Any:
        return data.allocate(data.History, self._pools.sizes, self.device)

    def _save(self) -> None:
        """Keep what a step changes, so that steps can be undone."""
        copy_arrays(self._state, self._saved, data.State)
        if self._stages.sleeping:
            copy_arrays(self._rest, self._saved_rest, data.Rest)
        for name, saved in self._saved_watch.items():
            wp.copy(saved, getattr(self._envs, name))
        copy_arrays(self._pools.history, self._saved_history, data.History)

    def _restore(self) -> None:
        """Undo the steps since `_save`."""
        copy_arrays(self._saved, self._state, data.State)
        if self._stages.sleeping:
            copy_arrays(self._saved_rest, self._rest, data.Rest)
        for name, saved in self._saved_watch.items():
            wp.copy(getattr(self._envs, name), saved)
        copy_arrays(self._saved_history, self._pools.history, data.History)

    def _try(self, steps: int) -> dict[str, int]:
        """Do steps, or undo them all where a pool was too small: then returns what was wanted of it."""
        self._save()
        for _ in range(steps):
            self._stages.replay()
        shortage = self._pools.shortage()
        if shortage:
            self._restore()
        else:
            self._steps += steps
        return shortage

    def _may_grow(self, shortage: dict[str, int]) -> bool:
        return self.on_overflow == "grow" and max(shortage.values()) <= pools.LARGEST

    def _grow(self, shortage: dict[str, int]) -> None:
        """Enlarge the pools and record the step anew."""
        old, new = self._pools.sizes, self._pools.larger_sizes(shortage)
        grown = ", ".join(f"{name} {old[name]} -> {new[name]}" for name in shortage)
        try:
            self._memory_limit.check(self.memory, pool_bytes(new), f"room for more ({grown})")
        except CapacityError:
            self._pools.forget_shortage()
            raise
        log.log(logging.DEBUG if self._growth_told else logging.INFO, "room grows: %s; the steps are repeated", grown)
        self._growth_told = True
        self._pools = self._pools.grown(new, self.num_envs, self.num_bodies)
        self._saved_history = self._room_for_history()
        self._stages = self._new_stages()

    def _step_up_to_overflow(self, steps: int) -> None:
        """Repeat undone steps one by one up to the one that does not fit."""
        self._pools.forget_shortage()
        for _ in range(steps):
            shortage = self._try(1)
            if shortage:
                raise self._overflow(shortage)

    def _overflow(self, shortage: dict[str, int]) -> CapacityError:
        """The error for a pool that was too small; what was wanted is forgotten, so that the next try counts anew."""
        name, wanted = next(iter(shortage.items()))
        had = self._pools.sizes[name]
        env = self._pools.environment_with_most(name, self.num_bodies)
        step = int(self._envs.step.numpy()[env])
        self._pools.forget_shortage()
        advice = f"give capacity={{'{name}': {wanted}}} or more, or on_overflow='grow'"
        if wanted > pools.LARGEST:
            advice = f"more than {pools.LARGEST} cannot be counted: simulate fewer environments at once"
        return CapacityError(
            f"{name}: {wanted} wanted, room for {had} (most wanted by environment {env} in step {step}); {advice}",
            name,
            wanted,
            had,
            env,
            step,
        )

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
