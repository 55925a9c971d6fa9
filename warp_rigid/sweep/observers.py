"""Observers: quantities that are read at every sample of a sweep, as columns of the table and as time series.

A built-in observer is a name, such as "peak_impulse", optionally with one or two bodies: "peak_impulse[ball]",
"peak_impulse[ball,ground]". Names of WATCHED are recorded on the device in every step. A user's observer is a function
of the simulator that returns (envs,) or (envs, n) values, or a class that is instantiated with the simulator and whose
instance is called with it. It gets all environments of the batch at once and may work on their device arrays
(`Simulator.array`).
"""

import re
from collections.abc import Callable, Sequence
from typing import Any

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

NAMED = ("bodies", "joints")
"""What the quantities of observers may belong to."""

PATTERN = re.compile(r"(\w+)(?:\[(.+)\])?")


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
        self._named = {name: _parsed(name) for name in observers if isinstance(name, str)}
        self._watched = list(dict.fromkeys(names for quantity, names in self._named.values() if quantity in WATCHED))
        if self._watched:
            sim.watch([bodies or None for bodies in self._watched])
        self._functions: dict[str, Callable] = {}
        self._shapes: dict[str, tuple[int, ...]] = {}
        self._places: dict[tuple[str, str], np.ndarray] = {}
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
        for name, values in self._looks.items():
            like = values[-1] if values else now["time"]
            values.append(now[name] if name in now else np.full_like(like, np.nan, float))

    def series(self) -> dict[str, np.ndarray]:
        """The values of the series at every sample, and "time" [s], (envs, samples, ...)."""
        return {name: np.stack(values, 1) for name, values in self._looks.items()}

    def _ready_made(self) -> dict[str, np.ndarray]:
        """Values of the observers that are names."""
        watched = self.sim.watched() if self._watched else {}
        found = {}
        for name, (quantity, names) in self._named.items():
            if quantity in WATCHED:
                found[name] = watched[quantity][:, self._watched.index(names)]
                continue
            parts = [self.sim.get(part) for part in ENERGIES.get(quantity, (quantity,))]
            values = np.sum(parts, axis=0) if quantity in ENERGIES else parts[0]
            found[name] = self._of_row(values, names[0], _owner(quantity)) if names else sum_of_bodies(self.sim, values)
        return found

    def _of_row(self, values: np.ndarray, name: str, owner: str) -> np.ndarray:
        """The rows of a body or joint, (envs, ...); NaN where an environment has no such body or joint."""
        sim = self.sim
        if (owner, name) not in self._places:
            rows = [names_of(scene, owner).get(name, -1) for scene in sim.scenes]
            self._places[owner, name] = np.array(rows)[sim.scene_of]
        place = self._places[owner, name]
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

    return check_columns(name, observers, _is_ready_made, expected, classes=True)


def check_bodies(observers: Sequence[str | Callable], scenes: Sequence[Scene]) -> None:
    """Check that at least one scene has the bodies of each observer.

    Raises:
        ValueError: no scene has the bodies.
    """
    for name in observers:
        if isinstance(name, str):
            quantity, names = _parsed(name)
            owner = _owner(quantity)
            if not any(names_of(scene, owner).keys() >= set(names) for scene in scenes):
                raise ValueError(f"{name}: no scene has the {owner} {', '.join(names)}")


def _parsed(name: str) -> tuple[str, tuple[str, ...]]:
    """The quantity of a built-in observer, and the names of the bodies or joints in brackets."""
    quantity, _, inside = name.partition("[")
    inside = inside.removesuffix("]")
    return quantity, tuple(part.strip() for part in inside.split(",")) if inside else ()


def _owner(quantity: str) -> str:
    """Whether the names in the brackets of a quantity are those of "bodies" or of "joints"."""
    return "joints" if owner_of(quantity) == "joints" else "bodies"


def _is_ready_made(name: str) -> bool:
    """Whether a name with its bodies is that of a built-in observer."""
    if not PATTERN.fullmatch(name):
        return False
    quantity, names = _parsed(name)
    if quantity in WATCHED:
        return len(names) <= 2
    if quantity in ENERGIES:
        return len(names) <= 1
    return len(names) == 1 and quantity in READABLE and owner_of(quantity) in NAMED


def _suggestion(observer: Any) -> str:
    """The end of the message about an observer that is not one; "" if only its bodies or joints are wrong."""
    ready = (*WATCHED, *ENERGIES)
    quantity = _parsed(observer)[0] if isinstance(observer, str) else observer
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
