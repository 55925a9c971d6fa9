"""Experiments: a scene simulated with one environment per variant, and the record of the motion."""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from warp_rigid import rotations
from warp_rigid.engine.settings import Settings
from warp_rigid.engine.simulator import Simulator
from warp_rigid.scene.scene import Scene

DT = 1.0 / 240.0
"""Default time step of an experiment [s]."""


@dataclass(frozen=True)
class Start:
    """A quantity that is set before the first step; arguments as in `Simulator.set`."""

    name: str
    value: Any
    bodies: Any = None


def per_env(name: str, values) -> Start:
    """A coefficient that is the same for all bodies of an environment."""
    return Start(name, np.asarray(values, np.float64)[:, None])


def of_body(body: int = 1, **values: Any) -> tuple[Start, ...]:
    """Quantities of a body: one value for all environments, (k,), or one for each of them, (envs, k)."""
    arrays = {name: np.asarray(value, np.float64) for name, value in values.items()}
    return tuple(Start(name, v[:, None] if v.ndim == 2 else v, bodies=[body]) for name, v in arrays.items())


@dataclass(frozen=True)
class Experiment:
    """One batch: a scene, the differences between its environments, and its duration.

    Attributes:
        scene: function that builds the scene.
        duration: simulated time [s].
        variants: a label for each environment.
        starts: quantities that are set before the first step, by environment.
        dt: time step [s].
        every: steps between records.
        settings: differences from the default settings, the same in all environments.
        label: distinguishes this experiment from others of its case.
        watch_overlap: whether the deepest overlap is measured at each record.
    """

    scene: Callable[[], Scene]
    duration: float
    variants: tuple[str, ...] = ("",)
    starts: tuple[Start, ...] = ()
    dt: float = DT
    every: int = 1
    settings: Mapping[str, Any] = field(default_factory=dict)
    label: str = ""
    watch_overlap: bool = False

    def run(self, device: str) -> "Trace":
        """Simulate on a device and record."""
        settings = Settings(dt=self.dt, **self.settings)
        sim = Simulator(self.scene(), num_envs=len(self.variants), settings=settings, device=device)
        for start in self.starts:
            sim.set(start.name, start.value, bodies=start.bodies)
        records = [self._record(sim)]
        begun = time.perf_counter()
        for _ in range(max(1, round(self.duration / self.dt / self.every))):
            sim.step(self.every)
            records.append(self._record(sim))
        seconds = time.perf_counter() - begun
        if not self.watch_overlap:
            records[-1]["overlap"] = sim.penetration()
        return Trace(
            experiment=self,
            scene=sim.scene,
            time=self.dt * self.every * np.arange(len(records)),
            mass=sim.get("mass").astype(np.float64),
            gravity=sim.get("gravity").astype(np.float64),
            contacts=sim.contacts(),
            residual=float(sim.stats()["residual"].max()),
            failed=sim.status()["status"] != "ok",
            seconds=seconds,
            **{name: np.array([one[name] for one in records if name in one], np.float64) for name in records[-1]},
        )

    def _record(self, sim: Simulator) -> dict[str, np.ndarray]:
        measured = {"overlap": sim.penetration()} if self.watch_overlap else {}
        return {name: sim.get(name) for name in STATES} | measured


STATES = ("position", "orientation", "linear_velocity", "angular_velocity")


@dataclass(frozen=True)
class Trace:
    """The record of an experiment, in float64: (records, environments, bodies, ...), including the start.

    Attributes:
        experiment: what was run.
        scene: its scene.
        time: (records,) [s].
        position: (records, envs, bodies, 3) [m].
        orientation: (records, envs, bodies, 4).
        linear_velocity: (records, envs, bodies, 3) [m/s].
        angular_velocity: (records, envs, bodies, 3) [rad/s].
        mass: (envs, bodies) [kg], 0 for bodies that are not dynamic.
        gravity: (envs, 3) [m/s^2].
        overlap: (records or 1, envs) deepest overlap [m]; only of the last record unless `watch_overlap` is set.
        contacts: contact records of the last step.
        residual: largest residual of the environments in the last step, as in `Simulator.stats` [m/s].
        failed: (envs,) whether the environment stopped with a non-finite state.
        seconds: wall-clock time of the steps and their recording [s].
    """

    experiment: Experiment
    scene: Scene
    time: np.ndarray
    position: np.ndarray
    orientation: np.ndarray
    linear_velocity: np.ndarray
    angular_velocity: np.ndarray
    mass: np.ndarray
    gravity: np.ndarray
    overlap: np.ndarray
    contacts: np.ndarray
    residual: float
    failed: np.ndarray
    seconds: float

    @property
    def labels(self) -> list[str]:
        """A label for each environment, including the experiment's label."""
        return [", ".join(filter(None, (self.experiment.label, name))) for name in self.experiment.variants]

    @property
    def dynamic(self) -> np.ndarray:
        """Indices of the dynamic bodies."""
        return np.flatnonzero(self.mass[0] > 0.0)

    @cached_property
    def rotation(self) -> np.ndarray:
        """Rotation matrices, (records, envs, bodies, 3, 3)."""
        return rotations.matrix(self.orientation / np.linalg.norm(self.orientation, axis=-1, keepdims=True))

    @cached_property
    def inertia(self) -> np.ndarray:
        """Inertia in the body's frame about its centre of mass, (envs, bodies, 3, 3) [kg m^2]."""
        per_mass = np.zeros((len(self.scene.bodies), 3, 3))
        for body in self.dynamic:
            shape = self.scene.bodies[body].shape
            per_mass[body] = np.asarray(shape.inertia) / shape.volume
        return self.mass[:, :, None, None] * per_mass

    @cached_property
    def body_spin(self) -> np.ndarray:
        """Angular velocity in the body's frame, (records, envs, bodies, 3) [rad/s]."""
        return np.einsum("nebji,nebj->nebi", self.rotation, self.angular_velocity)

    @cached_property
    def spin_momentum(self) -> np.ndarray:
        """Angular momentum about the centre of mass in the world's frame, (records, envs, bodies, 3)."""
        return np.einsum("nebij,ebjk,nebk->nebi", self.rotation, self.inertia, self.body_spin)

    @cached_property
    def center(self) -> np.ndarray:
        """Centres of mass in the world, (records, envs, bodies, 3) [m]."""
        local = np.zeros((len(self.scene.bodies), 3))
        for body in self.dynamic:
            local[body] = self.scene.bodies[body].shape.center_of_mass
        return self.position + np.einsum("nebij,bj->nebi", self.rotation, local)

    @cached_property
    def kinetic_energy(self) -> np.ndarray:
        """Kinetic energy of all dynamic bodies, (records, envs) [J]."""
        linear = np.einsum("eb,nebi,nebi->ne", self.mass, self.linear_velocity, self.linear_velocity)
        return 0.5 * (linear + np.einsum("nebi,ebij,nebj->ne", self.body_spin, self.inertia, self.body_spin))

    @cached_property
    def energy(self) -> np.ndarray:
        """Kinetic and potential energy of all dynamic bodies, (records, envs) [J]."""
        return self.kinetic_energy - np.einsum("eb,nebi,ei->ne", self.mass, self.center, self.gravity)

    @cached_property
    def work_free_energy(self) -> np.ndarray:
        """Kinetic energy less the work of gravity along the velocities, (records, envs) [J].

        Requires `every` = 1. Unlike `energy` it is independent of position changes by push-out: dissipative impulses
        can only lower it, and free flight lowers it by m g^2 dt^2 / 2 per step.
        """
        power = np.einsum("eb,nebi,ei->ne", self.mass, self.linear_velocity[1:], self.gravity)
        work = np.cumsum(power * self.experiment.dt, axis=0)
        return self.kinetic_energy - np.concatenate([np.zeros((1, len(self.labels))), work])

    @cached_property
    def momentum(self) -> np.ndarray:
        """Linear momentum, (records, envs, 3) [kg m/s]."""
        return np.einsum("eb,nebi->nei", self.mass, self.linear_velocity)

    @cached_property
    def speed(self) -> np.ndarray:
        """Largest speed of a body, linear [m/s] or angular [rad/s], (records, envs)."""
        moving = self.dynamic
        linear = np.linalg.norm(self.linear_velocity[:, :, moving], axis=-1)
        angular = np.linalg.norm(self.angular_velocity[:, :, moving], axis=-1)
        return np.maximum(linear, angular).max(axis=2)

    @cached_property
    def moved(self) -> np.ndarray:
        """Displacement of each dynamic body from its start, (records, envs, dynamic bodies, 3) [m]."""
        return (self.position - self.position[0])[:, :, self.dynamic]

    @cached_property
    def displacement(self) -> np.ndarray:
        """Largest distance of a body from its start, (records, envs) [m]."""
        return np.linalg.norm(self.moved, axis=-1).max(axis=2)
