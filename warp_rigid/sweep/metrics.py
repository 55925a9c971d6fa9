"""Metrics evaluated for every run of a sweep."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from warp_rigid.checks import shown, suggestion
from warp_rigid.engine.simulator import Simulator
from warp_rigid.runs.user_code import check_columns
from warp_rigid.scenes.demo import AT_REST


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
