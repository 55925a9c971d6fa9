"""Metrics: what a sweep measures of every run."""

import inspect
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from warp_rigid.engine.quantities import counts_of_environments
from warp_rigid.engine.simulator import Simulator
from warp_rigid.runs.runner import module_of_file
from warp_rigid.scene.scene import Motion
from warp_rigid.scenes.demo import AT_REST

__all__ = ["DEFAULT", "METRICS", "OUTCOME", "Watch", "check_metrics", "measure", "metric_name"]


class Watch:
    """Looks at a batch while it runs, and measures each environment.

    Args:
        sim: the simulator, before its first step.
        metrics: names of built-in metrics.
    """

    def __init__(self, sim: Simulator, metrics: Sequence[str]) -> None:
        """Note the start."""
        self.sim, self.metrics = sim, metrics
        self.dynamic = np.array([body.motion == Motion.DYNAMIC for body in sim.scene.bodies])
        self.start = self.centers()
        self.moving_until = np.zeros(sim.num_envs)
        self.deepest = np.zeros(sim.num_envs)
        self.box = _box(sim)

    def centers(self) -> np.ndarray:
        """Centres of mass of the dynamic bodies, (envs, bodies, 3) [m]."""
        return self.sim.get("center_of_mass")[:, self.dynamic].astype(np.float64)

    def observe(self) -> None:
        """Look at the state now; called after the same steps whatever the batch."""
        if "settle_time" in self.metrics and self.dynamic.any():
            velocity = self.sim.get("linear_velocity")[:, self.dynamic].astype(np.float64)
            speed = np.linalg.norm(velocity, axis=-1).max(axis=1)
            self.moving_until[~(speed < AT_REST)] = self.sim.time
        if "deepest_overlap" in self.metrics:
            self.deepest = np.maximum(self.deepest, self.sim.penetration())

    def values(self) -> dict[str, np.ndarray]:
        """Every metric at the end, (envs, ...); NaN where a run has none."""
        found: dict[str, np.ndarray] = {}
        for name in self.metrics:
            values = METRICS[name](self)
            found |= values if isinstance(values, dict) else {name: values}
        return found


def _top_height(watch: Watch) -> np.ndarray:
    """Height of the highest dynamic body's centre of mass [m]."""
    return _highest(watch.centers())


def _deepest_overlap(watch: Watch) -> np.ndarray:
    """Deepest overlap of two bodies at any look [m]."""
    return watch.deepest


def _drift(watch: Watch) -> np.ndarray:
    """Largest distance of a dynamic body's centre of mass from where it started [m]."""
    if not watch.dynamic.any():
        return np.zeros(watch.sim.num_envs)
    return np.linalg.norm(watch.centers() - watch.start, axis=-1).max(axis=1)


def _settle_time(watch: Watch) -> np.ndarray:
    """Time from which on no dynamic body was faster than AT_REST [s]; none where one still is."""
    return np.where(watch.moving_until < watch.sim.time, watch.moving_until, np.nan)


def _kinetic_energy(watch: Watch) -> np.ndarray:
    """Kinetic energy of all bodies at the end [J]."""
    return watch.sim.get("kinetic_energy").sum(axis=1)


def _toppled(watch: Watch) -> np.ndarray:
    """Whether the top came down to less than half its height above the lowest body, as both were at first.

    Bodies that are all at one height at first cannot topple.
    """
    foot = watch.start[..., 2].min(axis=1, initial=np.inf)
    height = _highest(watch.start) - foot
    return (height > 0.0) & (_highest(watch.centers()) < foot + 0.5 * height)


def _escaped(watch: Watch) -> np.ndarray:
    """Dynamic bodies whose centre of mass ended farther outside the start's box than that box is wide."""
    lower, upper = watch.box
    reach = np.linalg.norm(upper - lower, axis=-1, keepdims=True)
    centers = watch.centers()
    # What is not a number has escaped too: the comparison must be false for it.
    inside = (centers > lower - reach) & (centers < upper + reach)
    return (~inside.all(axis=-1)).sum(axis=1)


def _contacts(watch: Watch) -> np.ndarray:
    """Contacts of the last step."""
    return counts_of_environments(watch.sim)[1]


def _final_pose(watch: Watch) -> dict[str, np.ndarray]:
    """Pose of every body at the end, one after another: x, y, z [m] and quaternions (x, y, z, w)."""
    envs = watch.sim.num_envs
    position, orientation = (watch.sim.get(name).reshape(envs, -1) for name in ("position", "orientation"))
    return {"final_position": position, "final_orientation": orientation}


METRICS: dict[str, Callable[[Watch], Any]] = {
    "top_height": _top_height,
    "deepest_overlap": _deepest_overlap,
    "drift": _drift,
    "settle_time": _settle_time,
    "kinetic_energy": _kinetic_energy,
    "toppled": _toppled,
    "escaped": _escaped,
    "contacts": _contacts,
    "final_pose": _final_pose,
}
"""Built-in metrics. The outcome of the scene itself is one more, "outcome"."""

DEFAULT = tuple(name for name in METRICS if name != "final_pose")
"""Metrics of a sweep that names none."""

OUTCOME = "outcome"


def check_metrics(metrics: Any) -> tuple[str | Callable, ...]:
    """Names and functions of a caller's metrics; None stands for DEFAULT.

    Args:
        metrics: names of built-in metrics, "outcome", functions of the simulator, and paths of .py files, of which
            every public function that the file defines is one. A function returns (envs,) or (envs, n) numbers.

    Raises:
        ValueError: There is no such metric, or two have the same name.
        FileNotFoundError: There is no such file.
    """
    if metrics is None:
        return DEFAULT
    found: list[str | Callable] = []
    for metric in [metrics] if isinstance(metrics, str) or callable(metrics) else metrics:
        if isinstance(metric, str) and metric.endswith(".py"):
            found += _functions_of(Path(metric))
        elif callable(metric) or metric in METRICS or metric == OUTCOME:
            found.append(metric)
        else:
            known = ", ".join((*METRICS, OUTCOME))
            raise ValueError(f"metrics: must be functions, .py files or of {known}; got {metric!r}")
    names = [metric_name(metric) for metric in found]
    if len(set(names)) < len(names):
        raise ValueError(f"metrics: {max(names, key=names.count)} is given twice")
    return tuple(found)


def metric_name(metric: str | Callable) -> str:
    """What a metric's column is called."""
    return metric if isinstance(metric, str) else getattr(metric, "__name__", type(metric).__name__)


def measure(function: Callable, sim: Simulator) -> np.ndarray:
    """Values of a user's metric, (envs, ...).

    Raises:
        ValueError: They are not as many as there are environments.
    """
    values = np.asarray(function(sim))
    if values.shape[:1] != (sim.num_envs,) or values.ndim > 2:
        raise ValueError(
            f"metric {metric_name(function)}: must return ({sim.num_envs},) or ({sim.num_envs}, n) values, "
            f"got shape {values.shape}"
        )
    return values


def _functions_of(path: Path) -> list[Callable]:
    """The public functions that a .py file defines."""
    module = module_of_file(path)
    found: list[Callable] = [
        function
        for name, function in vars(module).items()
        if inspect.isfunction(function) and function.__module__ == module.__name__ and not name.startswith("_")
    ]
    if not found:
        raise ValueError(f"{path}: defines no function to measure with")
    return found


def _highest(centers: np.ndarray) -> np.ndarray:
    return centers[..., 2].max(axis=1, initial=-np.inf)


def _box(sim: Simulator) -> tuple[np.ndarray, np.ndarray]:
    """Corners of the box about all bodies of finite size, as spheres, at the start, each (envs, 1, 3) [m]."""
    bounds = [np.asarray(body.shape.bounds, np.float64) for body in sim.scene.bodies]
    radius = np.array([np.linalg.norm(np.abs(b).max(axis=0)) if np.isfinite(b).all() else np.nan for b in bounds])
    finite = np.isfinite(radius)
    position, radius = sim.get("position")[:, finite].astype(np.float64), radius[finite, None]
    lower = (position - radius).min(axis=1, keepdims=True, initial=np.inf)
    return lower, (position + radius).max(axis=1, keepdims=True, initial=-np.inf)
