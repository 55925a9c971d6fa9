"""Observers: quantities that are read at every sample of a sweep, as columns of the table and as time series.

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
from warp_rigid.runs.user_code import check_columns, column_name
from warp_rigid.scene.scene import Scene
from warp_rigid.sweep.failures import Failures
from warp_rigid.sweep.metrics import sum_of_bodies

WATCHED = ("peak_impulse", "summed_impulse", "first_contact", "impacts", "rest_time", "largest_overlap")
"""Observers that watch an environment, a body or a pair of bodies in every step; see Simulator.watched."""

ENERGIES = {
    "kinetic_energy": ("kinetic_energy",),
    "potential_energy": ("potential_energy",),
    "energy": ("kinetic_energy", "potential_energy"),
}
"""Energies of an environment, or of a body, at the sample."""

PATTERN = re.compile(r"(\w+)(?:\[(.+)\])?")


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
