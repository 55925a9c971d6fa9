"""What a sweep measures: metrics at the end of every run, and observers.

Observers are quantities that are read at every sample, as columns of the table and as time series.

A built-in observer is a name, such as "peak_impulse", optionally with one or two bodies: "peak_impulse[ball]",
"peak_impulse[ball,ground]". Names of WATCHED are recorded on the device in every step. A user's observer is a function
of the simulator that returns (envs,) or (envs, n) values, or a class that is instantiated with the simulator and whose
instance is called with it. It gets all environments of the batch at once and may work on their device arrays
(`Simulator.array`).
"""

import re
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from warp_rigid.checks import shown, suggestion
from warp_rigid.engine.quantities import READABLE, owner_of
from warp_rigid.engine.selection import names_of
from warp_rigid.engine.simulator import Simulator
from warp_rigid.runs.user_code import Failures, check_columns, column_name
from warp_rigid.scene.scene import Scene
from warp_rigid.scenes.demo import AT_REST

WATCHED = ("peak_impulse", "summed_impulse", "first_contact", "impacts", "rest_time", "largest_overlap")
"""Observers that watch an environment, a body or a pair of bodies in every step; see Simulator.watched."""

ENERGIES = {
    "kinetic_energy": ("kinetic_energy",),
    "potential_energy": ("potential_energy",),
    "energy": ("kinetic_energy", "potential_energy"),
}
"""Energies of an environment, or of a body, at the sample."""

PATTERN = re.compile(r"(\w+)(?:\[(.+)\])?")


class MetricRecorder:
    """Samples the state of a batch while it runs, and evaluates the metrics of each environment.

    Args:
        sim: the simulator, before its first step.
        metrics: names of built-in metrics.
    """

    def __init__(self, sim: Simulator, metrics: Sequence[str]) -> None:
        """Store the initial state."""
        self.sim, self.metrics = sim, metrics
        self.dynamic = sim.get("mass") > 0.0
        self.start = self.centers()
        self.present_at_start = self.present()
        self.slow_from = np.zeros(sim.num_envs)
        self.note_speed()
        self.deepest = np.zeros(sim.num_envs)
        self.box = _initial_bounds(sim)

    def centers(self) -> np.ndarray:
        """Centres of mass, (envs, bodies, 3) [m]."""
        return self.sim.get("center_of_mass").astype(np.float64)

    def present(self) -> np.ndarray:
        """Mask of the dynamic bodies that are active, (envs, bodies): others are not simulated, and keep velocities."""
        return self.dynamic & self.sim.get("active")

    def observe(self) -> None:
        """Sample the current state. The sampling times do not depend on the batch."""
        self.note_speed()
        if "deepest_overlap" in self.metrics:
            self.deepest = np.maximum(self.deepest, self.sim.penetration())

    def note_speed(self) -> None:
        """Note since when each environment has been slow."""
        if "settle_time" in self.metrics and self.dynamic.any():
            velocity = self.sim.get("linear_velocity").astype(np.float64)
            speed = np.where(self.present(), np.linalg.norm(velocity, axis=-1), 0.0).max(axis=1)
            self.slow_from[np.isnan(self.slow_from)] = self.sim.time
            self.slow_from[~(speed < AT_REST)] = np.nan

    def values(self) -> dict[str, np.ndarray]:
        """Final value of every metric, (envs, ...); NaN if undefined for a run."""
        found: dict[str, np.ndarray] = {}
        for name in self.metrics:
            values = getattr(self, name)()
            found |= values if isinstance(values, dict) else {name: values}
        return found

    def top_height(self) -> np.ndarray:
        """Height of the highest centre of mass of an active dynamic body [m]; -infinity if there is none."""
        return _highest(self.centers(), self.present())

    def deepest_overlap(self) -> np.ndarray:
        """Maximum penetration between two bodies over all samples [m]."""
        return self.deepest

    def drift(self) -> np.ndarray:
        """Maximum displacement of the centre of mass of a dynamic body from its initial position [m]."""
        moved = np.linalg.norm(self.centers() - self.start, axis=-1)
        return np.where(self.dynamic, moved, 0.0).max(axis=1)

    def settle_time(self) -> np.ndarray:
        """Time of the first sample from which on no active body is faster than AT_REST [s]; NaN if one still is."""
        return self.slow_from

    def kinetic_energy(self) -> np.ndarray:
        """Final kinetic energy of all bodies [J]."""
        return sum_of_bodies(self.sim, self.sim.get("kinetic_energy"))

    def toppled(self) -> np.ndarray:
        """Whether the highest body ended below half the initial height difference between highest and lowest body.

        False if all bodies start at the same height. Bodies count that are active, at the start and at the end; False
        if there are none at one of these times.
        """
        foot = np.where(self.present_at_start, self.start[..., 2], np.inf).min(axis=1)
        height = _highest(self.start, self.present_at_start) - foot
        rose, now = height > 0.0, self.present()
        middle = np.where(rose, foot, 0.0) + 0.5 * np.where(rose, height, 0.0)
        return rose & now.any(axis=1) & (_highest(self.centers(), now) < middle)

    def escaped(self) -> np.ndarray:
        """Number of dynamic bodies that ended outside the initial bounding box by more than its diagonal."""
        lower, upper = self.box
        reach = np.linalg.norm(upper - lower, axis=-1, keepdims=True)
        centers = self.centers()
        # NaN positions count as escaped, since the comparison is false for them.
        inside = (centers > lower - reach) & (centers < upper + reach)
        return (self.dynamic & ~inside.all(axis=-1)).sum(axis=1)

    def contacts(self) -> np.ndarray:
        """Number of contacts in the last step."""
        return self.sim.pairs_and_contacts()[1]

    def final_pose(self) -> dict[str, np.ndarray]:
        """Final poses of all bodies, concatenated: positions x, y, z [m] and quaternions (x, y, z, w)."""
        found = {}
        for name in ("position", "orientation"):
            column = np.empty(self.sim.num_envs, object)
            for env, rows in enumerate(self.sim.get(name)):
                column[env] = rows[self.sim.exists[env]].reshape(-1).tolist()
            found[f"final_{name}"] = column
        return found


METRICS = (
    "top_height", "deepest_overlap", "drift", "settle_time", "kinetic_energy", "toppled", "escaped", "contacts",
    "final_pose",
)  # fmt: skip
"""Built-in metrics, methods of MetricRecorder. "outcome" also selects the verdicts of the scene."""

DEFAULT = tuple(name for name in METRICS if name != "final_pose")
"""Default metrics of a sweep."""

OUTCOME = "outcome"


def check_metrics(metrics: Any) -> tuple[str | Callable, ...]:
    """Validate a caller's metrics and resolve files to functions; None means DEFAULT.

    Args:
        metrics: names of built-in metrics, "outcome", functions of the simulator, and paths of .py files, of which
            each public function is a metric. A function returns (envs,) or (envs, n) numbers.

    Raises:
        ValueError: A metric is unknown, or two have the same name.
        FileNotFoundError: A file does not exist.
    """
    if metrics is None:
        return DEFAULT
    known = (*METRICS, OUTCOME)

    def expected(metric: Any) -> str:
        return f"functions, .py files or names, got {shown(metric)}{suggestion(metric, known)}"

    return check_columns("metrics", metrics, known.__contains__, expected)


def sum_of_bodies(sim: Simulator, values: np.ndarray) -> np.ndarray:
    """Sum of (envs, bodies) values over the bodies of each environment, (envs,)."""
    env = np.nonzero(sim.exists)[0]
    # Added one after another, so that the sum does not depend on the number of bodies of other environments.
    return np.bincount(env, weights=values[sim.exists], minlength=sim.num_envs)


def measure(function: Callable, sim: Any) -> np.ndarray:
    """Evaluate a user's metric, (envs, ...).

    Raises:
        ValueError: The result does not have one row per environment.
    """
    values = np.asarray(function(sim))
    if values.shape[:1] != (sim.num_envs,) or values.ndim > 2:
        raise ValueError(f"must return ({sim.num_envs},) or ({sim.num_envs}, n) values, got shape {values.shape}")
    return values


def _highest(centers: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Height of the highest centre of some bodies, (envs,) [m]; -infinity if there is none."""
    return np.where(mask, centers[..., 2], -np.inf).max(axis=1)


def _initial_bounds(sim: Simulator) -> tuple[np.ndarray, np.ndarray]:
    """Corners of the box around the bounding spheres of all finite bodies, each (envs, 1, 3) [m]."""
    radius = np.full((len(sim.scenes), sim.num_bodies), np.nan)
    for index, scene in enumerate(sim.scenes):
        bounds = [np.asarray(body.shape.bounds, np.float64) for body in scene.bodies]
        radius[index, : len(bounds)] = [np.linalg.norm(np.abs(b).max(axis=0)) for b in bounds]
    spheres = radius[sim.scene_of][..., None]
    position = sim.get("position").astype(np.float64)
    finite = np.isfinite(spheres)
    lower = np.where(finite, position - spheres, np.inf).min(axis=1, keepdims=True)
    return lower, np.where(finite, position + spheres, -np.inf).max(axis=1, keepdims=True)


class Named(NamedTuple):
    """A built-in observer.

    Attributes:
        name: with the brackets.
        quantity: the name before the brackets.
        members: names of the bodies or joints in the brackets.
    """

    name: str
    quantity: str
    members: tuple[str, ...]

    @staticmethod
    def of(name: str) -> "Named":
        """The parts of a name."""
        quantity, _, inside = name.partition("[")
        inside = inside.removesuffix("]")
        return Named(name, quantity, tuple(part.strip() for part in inside.split(",")) if inside else ())

    @property
    def owner(self) -> str:
        """Whether its members are "bodies" or "joints"."""
        return "joints" if owner_of(self.quantity) == "joints" else "bodies"

    def is_known(self) -> bool:
        """Whether there is such an observer."""
        quantity, count = self.quantity, len(self.members)
        if not PATTERN.fullmatch(self.name):
            return False
        if quantity in WATCHED:
            return count <= 2 and len(set(self.members)) == count
        if quantity in ENERGIES:
            return count <= 1
        return count == 1 and quantity in READABLE and owner_of(quantity) in ("bodies", "joints")

    def is_in(self, scene: Scene) -> bool:
        """Whether a scene has its members."""
        return names_of(scene, self.owner).keys() >= set(self.members)


def named_observers(observers: Sequence[str | Callable]) -> list[Named]:
    """Those of the observers that are built in."""
    return [Named.of(observer) for observer in observers if isinstance(observer, str)]


class Observers:
    """The observers of a batch.

    Args:
        sim: the simulator, before its first step.
        observers: from check_observers.
        series: names of the observers whose values at every sample are kept.
        failures: where errors of the user's observers are stored.

    Attributes:
        latest: values of every observer at the last sample, (envs, ...), except of observers that failed.
    """

    def __init__(self, sim: Simulator, observers: Sequence[str | Callable], series: Sequence[str], failures: Failures):
        """Start to watch, create the user's observers, and read all once."""
        self.sim, self.latest, self._failures = sim, {}, failures
        self._named = named_observers(observers)
        self._watched = list(dict.fromkeys(one.members for one in self._named if one.quantity in WATCHED))
        if self._watched:
            sim.watch([bodies or None for bodies in self._watched])
        self._functions: dict[str, Callable] = {}
        self._shapes: dict[str, tuple[int, ...]] = {}
        self._places: dict[Named, np.ndarray] = {}
        for observer in observers:
            if not isinstance(observer, str):
                name = column_name(observer)
                with failures.of(observer, f"observer {name}"):
                    self._functions[name] = observer(sim) if isinstance(observer, type) else observer
        self._looks: dict[str, list[np.ndarray]] = {name: [] for name in ("time", *series)}
        self.observe()

    def observe(self) -> None:
        """Read the current values. An observer that fails is left out from now on, and is NaN in the series."""
        self.latest = self._ready_made()
        for name, function in list(self._functions.items()):
            with self._failures.of(function, f"observer {name}"):
                values = _values(function(self.sim), self.sim.num_envs)
                shape = self._shapes.setdefault(name, values.shape)
                if values.shape != shape:
                    raise ValueError(f"must return shape {shape} at every sample, as at the first, got {values.shape}")
                self.latest[name] = values
            if name not in self.latest:
                del self._functions[name]
        now = {**self.latest, "time": np.full(self.sim.num_envs, self.sim.time)}
        for name, looks in self._looks.items():
            like = looks[-1] if looks else now["time"]
            looks.append(now[name] if name in now else np.full_like(like, np.nan, float))

    def series(self) -> dict[str, np.ndarray]:
        """The values of the series at every sample, and "time" [s], (envs, samples, ...)."""
        return {name: np.stack(values, 1) for name, values in self._looks.items()}

    def _ready_made(self) -> dict[str, np.ndarray]:
        """Values of the observers that are names."""
        watched = self.sim.watched() if self._watched else {}
        found = {}
        for observer in self._named:
            quantity, members = observer.quantity, observer.members
            if quantity in WATCHED:
                found[observer.name] = watched[quantity][:, self._watched.index(members)]
                continue
            parts = [self.sim.get(part) for part in ENERGIES.get(quantity, (quantity,))]
            values = np.sum(parts, axis=0) if quantity in ENERGIES else parts[0]
            found[observer.name] = self._of_row(values, observer) if members else sum_of_bodies(self.sim, values)
        return found

    def _of_row(self, values: np.ndarray, observer: Named) -> np.ndarray:
        """The rows of a body or joint, (envs, ...); NaN where an environment has no such body or joint."""
        sim = self.sim
        if observer not in self._places:
            rows = [names_of(scene, observer.owner).get(observer.members[0], -1) for scene in sim.scenes]
            self._places[observer] = np.array(rows)[sim.scene_of]
        place = self._places[observer]
        found = values[np.arange(sim.num_envs), np.maximum(place, 0)].astype(np.float64)
        found[place < 0] = np.nan
        return found


def check_observers(observers: Any, name: str = "observe") -> tuple[str | Callable, ...]:
    """Check observers and resolve files to functions.

    Args:
        observers: names, functions, classes, and paths of .py files, of which each public function or class is an
            observer; None for no observers.
        name: of the argument, for the error message.

    Raises:
        ValueError: an observer is unknown, or two have the same name.
        FileNotFoundError: a file does not exist.
    """
    if observers is None:
        return ()

    def expected(observer: Any) -> str:
        kinds = "functions, .py files, names, or a quantity of a body or joint such as position[box]"
        return f"{kinds}, got {shown(observer)}{_suggestion(observer)}"

    return check_columns(name, observers, lambda text: Named.of(text).is_known(), expected, classes=True)


def _suggestion(observer: Any) -> str:
    """The end of the message about an observer that is not one; "" if only its bodies or joints are wrong."""
    ready = (*WATCHED, *ENERGIES)
    quantity = Named.of(observer).quantity if isinstance(observer, str) else observer
    if isinstance(quantity, str) and quantity in (*ready, *READABLE):
        return ""
    return suggestion(quantity, (*ready, *READABLE), f"{', '.join(ready)} and those in help(Simulator.get)")


def _values(result: Any, num_envs: int) -> np.ndarray:
    """The result of an observer of the user on the host: an array of NumPy, Warp, or a library with `__dlpack__`."""
    if hasattr(result, "numpy") and not isinstance(result, np.ndarray):
        result = (result.cpu() if hasattr(result, "cpu") else result).numpy()
    values = np.array(result)
    if values.shape[:1] != (num_envs,) or values.ndim > 2 or values.dtype.kind not in "biuf":
        raise ValueError(
            f"must return ({num_envs},) or ({num_envs}, n) numbers, got shape {values.shape} of {values.dtype}"
        )
    return values
