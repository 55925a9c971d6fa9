"""Simulator: many environments of one or several scenes that are stepped together on one device."""

import functools
import logging
import threading
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, Concatenate, NoReturn, ParamSpec, TypeVar

import numpy as np
import warp as wp

from warp_rigid.checks import whole_in
from warp_rigid.display import html_of
from warp_rigid.engine import (
    checkpoint,
    forgetting,
    health_checks,
    quantities,
    spawning,
    stage_times,
    step_reports,
    watching,
)
from warp_rigid.engine.hints import hints_on
from warp_rigid.engine.layout import LACKING, layout_of
from warp_rigid.engine.selection import Indices, Members
from warp_rigid.engine.settings import Settings, check_settings
from warp_rigid.engine.world import World
from warp_rigid.errors import NonFiniteError
from warp_rigid.scene.scene import Scene
from warp_rigid.threads import exclusive, on_stream
from warp_rigid.warp_start import start_warp

log = logging.getLogger("warp_rigid")

Given = ParamSpec("Given")
Result = TypeVar("Result")


def guarded(
    method: Callable[Concatenate["Simulator", Given], Result],
) -> Callable[Concatenate["Simulator", Given], Result]:
    """Let one thread at a time use a simulator, and none while another one records a step."""

    @functools.wraps(method)
    def run(self: "Simulator", *arguments: Given.args, **named: Given.kwargs) -> Result:
        with self.in_use():
            return method(self, *arguments, **named)

    return run


class Simulator:
    """Environments of one or several scenes, each with its own state, parameters and settings.

    The scenes may differ in everything that a Scene states: shapes, number of bodies, masses, force fields, filtered
    pairs, bounds, rules. The result of an environment does not depend on the others, bit for bit.

    Several threads can use simulators. On a CPU their steps run at the same time, on a GPU one after another. A
    simulator works on the stream that was current when it was created.

    The constructor issues a Python warning if limits of a hinge exceed a full turn, as they may be in degrees, and if a
    body moves by more than its size in the first step.

    Args:
        scene: the scene, or a list of scenes.
        num_envs: number of environments of each scene. With n scenes, environment e has scene e modulo n.
        settings: initial settings of all environments; `set` changes them per environment.
        device: a Warp device or its name. None selects the first CUDA device, or else the CPU, and logs which. On a CPU
            the environments are distributed over all cores that the process may use; a single environment uses one core
            per 128 bodies, at most 16.
        seed: stored for scenes and metrics that draw random numbers; the simulation itself draws none.
        on_overflow: what happens when a step finds more pairs or contacts than the capacity. "grow" increases the
            capacity between steps, as the numbers found in the last steps approach it. If a step exceeds it
            nevertheless, at most the last 16 steps are repeated. The results are the same, bit for bit, as with
            sufficient capacity from the start. "raise" undoes the step and raises a CapacityError.
        on_nonfinite: what happens when a state becomes non-finite. "quarantine" halts that environment and reports it
            in `status`; "raise" also raises a NonFiniteError.
        memory_limit: largest amount of device memory: bytes (int), a fraction of the device's memory (float), or None
            for all free memory.
        capacity: initial capacity for "pairs" and "contacts" of all environments; None estimates both.

    Attributes:
        scenes: copies of the distinct scenes given; later changes of either do not affect the simulation.
        scene_of: (envs,) index into `scenes` for each environment.
        num_envs: number of environments.
        num_bodies: number of bodies of the largest environment; bodies are in the order of the scene.
        first_body: (envs + 1,) row of the first body of each environment in the arrays of `array`; the last entry is
            the number of all bodies.
        exists: (envs, bodies) whether an environment has a body of that index.
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
        scene: Scene | Sequence[Scene],
        num_envs: int = 1,
        settings: Settings | None = None,
        device: Any = None,
        seed: int = 0,
        on_overflow: str = "grow",
        on_nonfinite: str = "quarantine",
        memory_limit: int | float | None = None,
        capacity: Mapping[str, int] | None = None,
    ) -> None:
        """Upload the scenes and compile the step."""
        layout, chosen, checked = layout_of(scene, num_envs), choose_device(device), check_settings(settings)
        for hint in hints_on(layout.scenes, checked.dt):  # before the errors to which wrong units lead
            warnings.warn(hint, stacklevel=2)
        self._lock = threading.RLock()
        self._stream = wp.get_stream(chosen) if chosen.is_cuda else None
        with exclusive():
            self._world = World(layout, checked, chosen, seed, on_overflow, on_nonfinite, memory_limit, capacity or {})
        self.scenes, self.scene_of = layout.scenes, layout.scene_of
        self.settings, self.device = self._world.settings, self._world.device
        self.num_envs, self.num_bodies = layout.num_envs, layout.most_bodies
        self.first_body, self.exists = layout.first_body, layout.rows != LACKING
        self.seed, self.on_overflow, self.on_nonfinite = seed, on_overflow, on_nonfinite

    def __repr__(self) -> str:
        """Show the size, the device and the time."""
        size = f"{self.num_envs} environments of {self.num_bodies} bodies"
        return f"Simulator({size} on {self.device}, dt {self.settings.dt:.6g} s, at {self.time:.6g} s)"

    def _repr_html_(self) -> str:
        return html_of(self)

    def __reduce__(self) -> NoReturn:
        """Refuse to be pickled or copied, as device memory and recorded steps cannot be.

        Raises:
            TypeError: always.
        """
        raise TypeError("a Simulator cannot be pickled or copied; write it with save and read it with Simulator.load")

    @property
    def scene(self) -> Scene:
        """The scene of all environments.

        Raises:
            ValueError: the environments have several scenes; see `scenes` and `scene_of`.
        """
        if len(self.scenes) > 1:
            raise ValueError(f"scene: the environments have {len(self.scenes)} scenes; see scenes and scene_of")
        return self.scenes[0]

    @property
    def time(self) -> float:
        """Simulated time since the start or the last reset of all environments [s]."""
        return self._world.shards.steps * self.settings.dt

    @property
    def times(self) -> np.ndarray:
        """(envs,) simulated time of each environment since its start or its last reset; halted ones stand still [s]."""
        with self.in_use():
            return self._world.envs.step.numpy() * self.settings.dt

    @property
    def memory(self) -> int:
        """Device memory that the simulator occupies [bytes]."""
        return self._world.shards.memory

    @property
    def load_seconds(self) -> float:
        """Wall-clock time to load the kernels, and to compile those that are not in the cache [s]."""
        return self._world.load_seconds

    @property
    def internals(self) -> World:
        """The device arrays and recorded steps, for measurements of the engine; they may change in every version."""
        return self._world

    @contextmanager
    def in_use(self) -> Iterator[None]:
        """Context in which this thread alone uses the simulator, and none records a step."""
        with self._lock, on_stream(self.device, self._stream):
            yield

    @guarded
    def prepare(self) -> None:
        """Record the step now, instead of in the first call of `step`, so that timings do not include it."""
        self._world.shards.record()

    @guarded
    def step(self, count: int = 1) -> None:
        """Advance all environments by `count` steps of dt.

        Raises:
            CapacityError: the capacity is exceeded and must not grow; the state is that of the last step within it.
            NonFiniteError: a state became non-finite, and on_nonfinite is "raise".
        """
        left = whole_in("count", count, 0, 2**31)
        while left > 0:
            chunk = min(left, self._world.shards.most_steps)
            self._world.shards.step(chunk)
            left -= chunk
            if self.on_nonfinite == "raise":
                self._raise_if_nonfinite()

    @guarded
    def get(self, name: str, envs: Indices = None, bodies: Members = None, joints: Members = None) -> np.ndarray:
        """Return a copy of a quantity, (envs, bodies, ...), or (envs, ...) for gravity and settings.

        Bodies and joints that an environment lacks (see `exists`) are NaN, False, or -1 for levels.

        Quantities are those that `set` changes; for bodies also "inertia" and "center_of_mass" in the world frame,
        "kinetic_energy", "potential_energy", "asleep" and "level"; for joints, (envs, joints, ...), also
        "joint_position", "joint_velocity" and "joint_force" (force [N] and torque [N m] on the first body in the last
        step, 6 numbers).

        Args:
            name: the quantity.
            envs: different indices of environments, a slice, or a mask (envs,) of booleans; None for all.
            bodies: indices, a slice, or names of bodies, in the order of the result; None for all. Each must exist in
                at least one of these environments.
            joints: the same of joints, for quantities of joints.

        Raises:
            ValueError: unknown name, an environment, body or joint that does not exist or is given twice, or a choice
                of bodies or joints for a quantity of something else.
        """
        return quantities.select(self._world, name, envs, bodies, joints)

    @guarded
    def set(self, name: str, value: Any, envs: Indices = None, bodies: Members = None, joints: Members = None) -> None:
        """Change a quantity; the value broadcasts to (envs, bodies, ...), or (envs, ...) for gravity and settings.

        Quantities of bodies are "position", "orientation", "linear_velocity", "angular_velocity", "force", "torque",
        "active", "friction", "restitution", "rolling_friction", "spinning_friction", "mass", "surface_velocity" and
        "surface_angular_velocity"; those of environments are "gravity" and "collision_iterations",
        "contact_iterations", "shock_iterations", "shock_propagation", "collision_first", "warm_starting",
        "edge_samples" and "sleeping"; those of force fields, (envs, fields, ...), are "field_acceleration",
        "field_center", "field_strength", "field_drag" and "field_velocity". For quantities of joints the value
        broadcasts to (envs, joints): "joint_target_position", "joint_target_velocity", "joint_stiffness",
        "joint_damping", "joint_max_force", "joint_friction", "joint_lower", "joint_upper", "joint_break_force",
        "joint_break_torque", "joint_armature" and "joint_broken".

        Args:
            name: the quantity.
            value: number, array, mode name, or list of mode names.
            envs: different indices of environments, a slice, or a mask (envs,) of booleans; None for all.
            bodies: indices, a slice or names of the bodies, which all these environments must have; None for all
                bodies. With None, values are ignored for bodies that an environment lacks or that cannot have them:
                static bodies have no velocity, dynamic ones no velocity of the surface, and only dynamic ones a mass,
                force and torque.
            joints: the same of joints, for quantities of joints. `joint_broken`, `joint_break_force` and
                `joint_break_torque` are of all joints, all others of revolute and prismatic ones; a spherical joint has
                `joint_upper` and `joint_damping`, too, a distance joint `joint_lower` and `joint_upper`.

        Raises:
            ValueError: unknown name, wrong shape, a value out of range, a body or joint that an environment lacks, a
                value that a chosen body or joint, or all of them, cannot have, or a pose or velocity for a body that
                follows a path.
        """
        quantities.write(self._world, name, value, envs, bodies, joints)

    def array(self, name: str) -> wp.array:
        """Return the device array of a state or body quantity, (bodies of all environments, ...), without a copy.

        The bodies of environment e are rows `first_body[e]` to `first_body[e + 1] - 1`.
        """
        return quantities.live_array(self._world, name)

    @guarded
    def reset(self, envs: Any = None) -> None:
        """Reset environments to the initial state of their scene, bit for bit; parameters and settings are kept.

        Args:
            envs: indices of the environments, or a mask, as for `set`; None for all, which also resets the time.
        """
        forgetting.reset(self._world, envs)

    @guarded
    def spawn(
        self,
        pool: str,
        position: Any,
        orientation: Any = (0.0, 0.0, 0.0, 1.0),
        linear_velocity: Any = (0.0, 0.0, 0.0),
        angular_velocity: Any = (0.0, 0.0, 0.0),
        envs: Any = None,
    ) -> np.ndarray:
        """Activate a body of a pool (see `Scene.add_pool`) in each environment, with a new state and no history.

        Args:
            pool: name of the pool.
            position: (3,) or (envs, 3) position of the body [m].
            orientation: (4,) or (envs, 4) quaternion (x, y, z, w).
            linear_velocity: (3,) or (envs, 3) velocity of the centre of mass [m/s].
            angular_velocity: (3,) or (envs, 3) in the world frame [rad/s].
            envs: indices of the environments, or a mask, as for `set`; None for all.

        Returns:
            (envs,) index of the body in each of these environments; -1 where all bodies of the pool are active.

        Raises:
            ValueError: there is no such pool, or a value has the wrong shape or is not finite.
        """
        names = ("position", "orientation", "linear_velocity", "angular_velocity")
        values = (position, orientation, linear_velocity, angular_velocity)
        return spawning.spawn(self._world, pool, dict(zip(names, values, strict=True)), envs)

    @guarded
    def despawn(self, bodies: Any, envs: Any = None) -> None:
        """Switch bodies off, by index or name, or all with None; bodies of a pool can then be spawned again.

        Raises:
            ValueError: an environment has no such body.
        """
        spawning.despawn(self._world, bodies, envs)

    @guarded
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

    @guarded
    def apply_impulse(self, impulse: Any, point: Any = None, body: int | str | None = None, envs: Any = None) -> None:
        """Apply an impulse to a body immediately; the body and its island wake up.

        Args:
            impulse: (3,) or (envs, 3) impulse [N s].
            point: (3,) or (envs, 3) point in the world at which it acts [m]; None for the centre of mass.
            body: index or name of the body, required.
            envs: indices of the environments, or a mask, as for `set`; None for all.

        Raises:
            ValueError: an environment has no such body, the body is static or kinematic, or a value has the wrong shape
                or is not finite.
        """
        quantities.apply_impulse(self._world, impulse, point, body, envs)

    @guarded
    def contacts(self) -> np.ndarray:
        """Return the contacts of the last step as records: env, body_a, body_b, position, normal, depth, impulse.

        The normal points from body_b to body_a, the impulse [N s] acts on body_a, and the depth [m] is positive inside.
        Contacts with a negative depth were gaps at the start of the step, which could close in it; their impulse is 0
        if they did not. Impulses of impacts, which act before those of contacts, are left out; `watched` includes them.
        """
        return self._world.shards.gather(step_reports.contacts_of_shard)

    @guarded
    def penetration(self) -> np.ndarray:
        """Return the current deepest overlap of each environment, (envs,) [m].

        It is the largest depth of a point of one body's surface inside another body, by the true distance to that
        body's surface. The search covers the whole surface, independently of contacts and their samples, and is
        accurate to 1 % or 2 um. If another body contains the centre of a large ball inside a body, the overlap is at
        least the distance by which that ball must move. In a compound the depth is that in the deepest child. The
        distance to a mesh with a `fault` is that of its grid.
        """
        return self._world.shards.deepest_overlap()

    @guarded
    def status(self) -> np.ndarray:
        """Return records (envs,): status, step, time, body, warning.

        The status is "ok", "non-finite" (the environment is halted) or "out of bounds" (a body left `Scene.bounds`),
        with the step, time [s] and body at which it began (-1 if ok). The warning lists the kinds that `warnings`
        returns for the environment, such as "overlap" or "overlap, energy"; it is "" if there are none.
        """
        return step_reports.status_records(self._world)

    @guarded
    def warnings(self) -> np.ndarray:
        """Return what the health checks have found since the last reset: records env, warning, step, time, body.

        An environment with a warning is simulated further, but its results are doubtful. Every 64 steps, each
        environment is checked for the following, and the first occurrence of each is recorded:

        - "overlap": a body overlaps another one by more than 5 % of the smaller one's size, and this has not shrunk
          by 5 % between checks, four times in a row.
        - "energy": the bodies gained more energy than the work of gravity, force fields, forces and torques, by 2 % of
          their kinetic energy and 1 % of the energy that lifts each by its size. The body is the one with the largest
          kinetic energy. Environments with kinematic bodies that move, moving ground, or joints with springs, motors or
          armature are not checked.
        - "precision": the spacing of float32 numbers at the position of a body is more than 0.5 % of its largest or
          100 % of its smallest extent, because it is far from the origin.
        - "load": the force of another body on a body is more than 100 000 times its weight, for example under a body
          that is so much heavier. Rounding errors of the force can then exceed the weight, and push the body away.
        - "residual": the last sweep or round of the solver changed a velocity by more than 10 % of what gravity adds to
          it in a step, in three checks in a row. An example is a light tray that slides under many boxes. The body is
          the fastest one in contact. Piles of fallen bodies are not checked: their impulses converge over several
          steps.
        """
        return health_checks.warning_records(self._world.envs, self.settings.dt)

    @guarded
    def watch(self, watched: Sequence[Any]) -> None:
        """Start to record contacts and motion of chosen bodies in every step; `watched` returns them.

        Args:
            watched: for each watch None for all bodies of an environment, a body, or a pair of bodies, by index or
                name. It replaces earlier watches. An environment that lacks a body records nothing for that watch.

        Raises:
            ValueError: no environment has a body of that index or name.
        """
        watching.watch(self._world, watched)

    @guarded
    def watched(self) -> dict[str, np.ndarray]:
        """Return what the watches have recorded since `watch` or the last reset: arrays (envs, watches) by name.

        The impulse of a pair of bodies in a step is the magnitude of the sum of the impulses at its contacts, those of
        impacts included; bodies that sleep press on each other as in their last step awake. Watches are not stored in
        checkpoints.

        - "peak_impulse": largest impulse of a pair in a step [N s].
        - "summed_impulse": sum of the impulses over pairs and steps [N s].
        - "first_contact": end of the first step with a contact [s]; NaN if there was none.
        - "impacts": number of steps with a contact after a step without.
        - "rest_time": end of the last step in which one of the bodies was faster than 0.05 m/s [s]; 0 if none was.
        - "largest_overlap": largest overlap at a contact at the start of a step [m].
        """
        return watching.watched(self._world)

    @guarded
    def counts(self) -> dict[str, int]:
        """Return the numbers of pairs, contacts and levels of the last step, the capacities and their largest use.

        "repeated_steps" is the number of steps that were simulated again because they exceeded the capacity.
        """
        return step_reports.counts(self._world)

    @guarded
    def pairs_and_contacts(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the numbers of pairs and of contacts of the last step in each environment, (envs,) each."""
        return step_reports.counts_of_environments(self._world)

    @guarded
    def stage_times(self, steps: int = 32) -> dict[str, float]:
        """Return the time that each stage of a step takes in the present state, which does not change [s].

        On a CPU it is processor time, which does not depend on other programs. An additional first step is not timed.
        `stats` then describes the last timed step.

        Args:
            steps: number of steps to average over.

        Returns:
            Stages by name, in their order.

        Raises:
            ValueError: steps is not a whole number from 1.
        """
        return stage_times.stage_times(self._world, whole_in("steps", steps, 1, 2**31))

    @guarded
    def stats(self) -> dict[str, np.ndarray]:
        """Return what the solver did in the last step: arrays (envs,) by name.

        After `load`, all but the numbers of pairs and contacts and the capacities are 0 until the next step.

        - "pairs", "contacts": numbers of pairs and contacts.
        - "islands": number of groups of dynamic bodies that contacts and joints connect. Of these, "islands_shock" were
          solved with shock propagation, "islands_sweeps" by sweeps alone, because shock propagation is off, was not
          needed, or is omitted as in piles that move, and "islands_rounds" in rounds, as in environments of more than
          128 bodies. "islands_asleep" sleep.
        - "sweeps", "rounds": sweeps and rounds of the contact solver. "impact_sweeps", "impact_rounds", "shock_sweeps",
          "push_out_sweeps", "push_out_rounds": those of impacts, shock propagation and push-out.
        - "accepted_share": share of shock propagation that the line search accepted, the smallest of all islands; 1 if
          there was none.
        - "residual": largest change of a velocity by a constraint row in the last sweep or round [m/s].
        - "pair_capacity_used", "contact_capacity_used": used fraction of the pool to which the environment belongs.
        """
        return step_reports.solver_stats(self._world)

    @guarded
    def swept_boxes(self) -> np.ndarray:
        """Return the boxes of the last broad phase, (envs, bodies, 2, 3): lower and upper corners [m].

        After a step they bound the motion of each body within it, after `penetration` its current extent. The boxes of
        planes, which are infinite, extend to 2e9 m.
        """
        return step_reports.swept_boxes(self._world)

    @property
    def grid_cell(self) -> float:
        """Cell width of the hash grid of the first scene [m]; environments of at most 256 bodies test all pairs."""
        return self._world.model.size_groups[self.scenes[0]].width

    def _raise_if_nonfinite(self) -> None:
        failed = np.flatnonzero(self._world.envs.failed.numpy())
        if len(failed):
            record = self.status()[failed[0]]
            raise NonFiniteError(int(failed[0]), int(record["step"]), float(record["time"]), int(record["body"]))


def choose_device(device: Any) -> Any:
    """Return a Warp device; None selects the first CUDA device, or else the CPU, and logs which.

    Raises:
        ValueError: there is no such device, or its driver is too old.
    """
    start_warp()
    too_old = wp.is_cuda_available() and not wp.is_conditional_graph_supported()
    if device is None:
        chosen = wp.get_cuda_device() if wp.is_cuda_available() and not too_old else wp.get_device("cpu")
        log.info("simulating on %s", chosen)
        if too_old:
            log.warning("the GPU is not used: its driver must support CUDA 12.4 or newer")
        return chosen
    try:
        chosen = wp.get_device(device)
    except Exception as error:
        names = ", ".join(str(d) for d in wp.get_devices())
        hint = "" if wp.is_cuda_available() else "; Warp finds no CUDA device, see warp-rigid doctor"
        raise ValueError(f"device: must be one of {names}, got {device!r}{hint}") from error
    if chosen.is_cuda and too_old:
        raise ValueError(f"device: the driver of {chosen} must support CUDA 12.4 or newer; update it, or use cpu")
    return chosen
