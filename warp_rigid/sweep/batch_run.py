"""Batches: runs that share a simulator, from their parameters to their result rows."""

import logging
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from warp_rigid.engine.settings import Settings
from warp_rigid.engine.simulator import Simulator
from warp_rigid.errors import CapacityError
from warp_rigid.runs.assignments import Assignments
from warp_rigid.runs.runner import set_each, step_frame
from warp_rigid.runs.user_code import Failures, column_name
from warp_rigid.scenes.demo import SI_UNITS
from warp_rigid.sweep.columns import FINISHED
from warp_rigid.sweep.design import Run, stable_hash
from warp_rigid.sweep.environment_view import EnvironmentView
from warp_rigid.sweep.job import Job, build_scene, run_inputs, structure
from warp_rigid.sweep.metrics import OUTCOME, MetricRecorder, Observers, measure
from warp_rigid.sweep.stopwatch import Stopwatch

log = logging.getLogger("warp_rigid")

MAX_REASON_LENGTH = 300
"""Maximum length of an error message in a row [characters]."""


@dataclass(frozen=True, eq=False)
class Batch:
    """Result of a batch.

    Attributes:
        rows: one row per run.
        trajectories: for each group of runs the arguments of Trajectories.add; empty if they are not recorded.
        series: the arguments of Series.add; empty if no series are kept.
        seconds: wall-clock time by phase, see Stopwatch.
        units: units of the outcomes by the names of their columns.
    """

    rows: list[dict[str, Any]]
    trajectories: list[tuple[list[Run], dict[str, Any]]] = field(default_factory=list)
    series: list[tuple[list[Run], dict[str, np.ndarray]]] = field(default_factory=list)
    seconds: Mapping[str, float] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Prepared:
    """A simulator in the initial state of some runs.

    Attributes:
        sim: the simulator, with one environment per run.
        runs: the runs in the order of the environments.
        views: the environments grouped by scene.
    """

    sim: Simulator
    runs: list[Run]
    views: list[EnvironmentView]

    def views_of_structures(self) -> list[EnvironmentView]:
        """The environments grouped by the structure of their scenes."""
        groups: dict[Any, list[EnvironmentView]] = {}
        for view in self.views:
            groups.setdefault(structure(view.scene), []).append(view)
        reads: dict[str, Any] = {}
        return [
            EnvironmentView(self.sim, views[0].scene, np.sort(np.concatenate([view.envs for view in views])), reads)
            for views in groups.values()
        ]


def prepare(job: Job, runs: Sequence[Run]) -> Prepared:
    """Build the simulator of some runs with the same time step in their initial states."""
    inputs = run_inputs(job, runs)
    first = dict(reversed([(run_input.scene_key, run_input) for run_input in inputs]))
    scene_of_key = {key: build_scene(job, run_input) for key, run_input in first.items()}
    order = _launch_order(inputs, [len(scene_of_key[run_input.scene_key].bodies) for run_input in inputs])
    inputs = [inputs[index] for index in order]
    place = {key: index for index, key in enumerate(scene_of_key)}
    scenes = list(scene_of_key.values())
    which = np.array([place[run_input.scene_key] for run_input in inputs])
    settings = Settings(**inputs[0].settings)
    sim = Simulator([scenes[index] for index in which], settings=settings, device=job.device, seed=runs[0].seed)
    _set_all(sim, inputs)
    reads: dict[str, Any] = {}
    views = [EnvironmentView(sim, scene, np.flatnonzero(which == i), reads) for i, scene in enumerate(scenes)]
    return Prepared(sim, [runs[index] for index in order], views)


def _launch_order(inputs: list[Assignments], bodies: list[int]) -> list[int]:
    """Order of the runs of a batch: those with many bodies first, those with equal settings together.

    On a GPU neighbouring environments share a warp, which takes as long as the slowest of them, and a kernel ends
    sooner if the environments that begin last are quick.
    """
    kinds: dict[Any, int] = {}
    kind = [kinds.setdefault(tuple(run_input.settings.items()), len(kinds)) for run_input in inputs]
    return sorted(range(len(inputs)), key=lambda index: (-bodies[index], kind[index]))


def run_batch(job: Job, runs: Sequence[Run], on_done: Callable[[float], object] = lambda done: None) -> Batch:
    """Run a batch. A failed run becomes a row with the reason; an exception fails all runs of the batch.

    A batch that does not fit into memory is split in half, and so is one in which a value is refused, so that only the
    runs with that value fail.

    Args:
        job: data shared by all runs.
        runs: the runs of the batch.
        on_done: called after each sample with the finished part, as a number of runs.
    """
    start = time.perf_counter()
    prepared = None
    try:
        prepared = prepare(job, runs)
        return _run(job, prepared, start, on_done)
    except Exception as error:
        refused = prepared is None and isinstance(error, ValueError)
        too_large = isinstance(error, MemoryError | CapacityError) or "alloc" in str(error).lower()
        if len(runs) == 1 or not (refused or too_large):
            return failed_batch(runs, error, (time.perf_counter() - start) / len(runs))
        problem = "contains a run with a bad value" if refused else "does not fit into memory"
        log.info("batch of %d runs %s (%s); splitting it in half", len(runs), problem, error)
    # The whole batch is freed before its halves are built.
    prepared = None
    middle = len(runs) // 2
    first = run_batch(job, runs[:middle], on_done)
    second = run_batch(job, runs[middle:], lambda done: on_done(middle + done))
    for row in second.rows:
        row["environment"] += middle
    watch = Stopwatch()
    watch.add(first.seconds)
    watch.add(second.seconds)
    trajectories, series = first.trajectories + second.trajectories, first.series + second.series
    units = {**first.units, **second.units}
    return Batch(first.rows + second.rows, trajectories, series, watch.seconds, units)


def failed_batch(runs: Sequence[Run], error: BaseException, seconds: float | None = None) -> Batch:
    """Rows of runs that failed with an exception."""
    reason = " ".join(f"{type(error).__name__}: {error}".split())[:MAX_REASON_LENGTH]
    status = "capacity" if isinstance(error, CapacityError) else "error"
    return Batch([_row(run, env, status, reason) | {"wall_time": seconds} for env, run in enumerate(runs)])


def _run(job: Job, prepared: Prepared, start: float, on_done: Callable[[float], object]) -> Batch:
    sim = prepared.sim
    watch = Stopwatch()
    watch.add({"load": sim.load_seconds, "build": time.perf_counter() - start - sim.load_seconds})
    measuring = time.perf_counter()
    failures = Failures(sim.num_envs)
    outcomes = _Outcomes(job, prepared, failures)
    recorder = MetricRecorder(sim, [metric for metric in job.metrics if isinstance(metric, str) and metric != OUTCOME])
    observers = Observers(sim, job.observers, job.series, failures)
    with watch.of("record"):
        sim.prepare()
    events = _events(job, prepared.views, failures)
    peak_counts = np.zeros((2, sim.num_envs), np.int64)
    frames: dict[str, list] = {"time": [], "position": [], "orientation": []}
    steps = remaining = round(job.duration / sim.settings.dt)
    steps_per_sample = max(1, round(1.0 / (job.fps * sim.settings.dt)))
    _append_frame(job, sim, frames)
    while remaining > 0:
        with watch.of("step"):
            step_frame(sim, min(steps_per_sample, remaining), events)
        remaining -= steps_per_sample
        recorder.observe()
        peak_counts = np.maximum(peak_counts, sim.pairs_and_contacts())
        outcomes.observe()
        observers.observe()
        _append_frame(job, sim, frames)
        on_done(len(prepared.runs) * (1.0 - max(remaining, 0) / steps))
    columns = recorder.values()
    columns |= _measured(prepared, [metric for metric in job.metrics if not isinstance(metric, str)], failures)
    columns |= outcomes.values()
    missing = np.full(sim.num_envs, None, object)
    columns |= {name: observers.latest.get(name, missing) for name in job.observe}
    rows = _rows(sim, prepared.runs, columns, peak_counts, failures)
    seconds = (time.perf_counter() - start) / len(prepared.runs)
    watch.add({"measure": time.perf_counter() - measuring - watch.seconds["record"] - watch.seconds["step"]})
    kept = _trajectories(prepared, rows, frames) if job.trajectories else []
    series = [(prepared.runs, observers.series())] if job.series else []
    return Batch([row | {"wall_time": seconds} for row in rows], kept, series, watch.seconds, outcomes.units)


def _measured(prepared: Prepared, metrics: list[Callable], failures: Failures) -> dict[str, np.ndarray]:
    """The columns of metrics of the user, which get environments of the same structure at once."""
    if not metrics:
        return {}
    views: list[Any] = [prepared.sim] if len(prepared.sim.scenes) == 1 else prepared.views_of_structures()
    columns = {column_name(metric): np.full(prepared.sim.num_envs, None, object) for metric in metrics}
    for view in views:
        envs = view.envs if isinstance(view, EnvironmentView) else np.arange(view.num_envs)
        for metric in metrics:
            name = column_name(metric)
            with failures.of(metric, f"metric {name}", envs):
                for env, value in zip(envs, measure(metric, view).tolist(), strict=True):
                    columns[name][env] = value
    return columns


class _Outcomes:
    """The outcomes of the scenes of a batch; one that fails has no columns.

    Attributes:
        units: units by the names of the columns that `values` has returned.
    """

    def __init__(self, job: Job, prepared: Prepared, failures: Failures) -> None:
        """Make the outcome of each scene."""
        self._num_envs, self._failures = prepared.sim.num_envs, failures
        self._outcomes: list[tuple[Any, EnvironmentView]] = []
        self.units: dict[str, str] = {}
        for view in prepared.views if OUTCOME in job.metrics else []:
            with failures.of(job.demo.outcome, "outcome", view.envs):
                self._outcomes.append((job.demo.outcome(view.scene), view))

    def observe(self) -> None:
        """Let each outcome record the present state."""
        working = []
        for outcome, view in self._outcomes:
            with self._failures.of(outcome, "outcome", view.envs):
                outcome.observe(view)
                working.append((outcome, view))
        self._outcomes = working

    def values(self) -> dict[str, np.ndarray]:
        """The measured value of each verdict as "outcome_NAME", and whether a condition holds as "outcome_NAME_ok"."""
        found: dict[str, np.ndarray] = {}
        for outcome, view in self._outcomes:
            with self._failures.of(outcome, "outcome", view.envs):
                for verdict in outcome.verdicts(view):
                    columns = {verdict.name: verdict.values, f"{verdict.name}_ok": verdict.passed}
                    if unit := SI_UNITS.get(verdict.unit, verdict.unit):
                        self.units[f"outcome_{verdict.name}"] = unit
                    for name, values in columns.items():
                        if values is None:
                            continue
                        column = found.setdefault(f"outcome_{name}", np.full(self._num_envs, None, object))
                        column[view.envs] = np.asarray(values)
        return found


def _trajectories(prepared: Prepared, rows: list[dict], frames: dict[str, list]) -> list:
    """Arguments of Trajectories.add, one for each structure; the name of its group is added to the rows."""
    found = []
    for view in prepared.views_of_structures():
        group = f"bodies_{view.num_bodies}_{stable_hash(repr(structure(view.scene)), view.settings.dt)[:6]}"
        kept: dict[str, Any] = {"group": group, "time": np.array(frames["time"])}
        for name in ("position", "orientation"):
            kept[name] = np.stack([values[view.envs, : view.num_bodies] for values in frames[name]], axis=1)
        for env in view.envs:
            rows[env]["trajectory"] = group
        found.append(([prepared.runs[env] for env in view.envs], kept))
    return found


def _set_all(sim: Simulator, inputs: list[Assignments]) -> None:
    """Set the settings that differ between environments, and all properties."""
    for name in inputs[0].settings:
        values = [run_input.settings[name] for run_input in inputs]
        if any(value != values[0] for value in values):
            set_each(sim, name, values)
    for name in inputs[0].properties:
        set_each(sim, name, [run_input.properties[name] for run_input in inputs])


def _events(job: Job, views: list[EnvironmentView], failures: Failures) -> list:
    """Events of all scenes, each applied to the environments of its scene, sorted by time."""
    events = []
    for view in views:
        with failures.of(job.demo.events, "events", view.envs, void=True):
            events += [_on_view(event, view, failures) for event in job.demo.events(view.scene)]
    return sorted(events, key=lambda event: event[0])


def _on_view(event: tuple[float, Callable], view: EnvironmentView, failures: Failures) -> tuple[float, Callable]:
    """An event, and those that follow it, applied to a view instead of the simulator; an error ends them."""
    when, act = event

    def act_on_view(_: Simulator) -> tuple[float, Callable] | None:
        following = None
        with failures.of(act, "events", view.envs, void=True):
            following = act(view)
        return None if following is None else _on_view(following, view, failures)

    return when, act_on_view


def _append_frame(job: Job, sim: Simulator, frames: dict[str, list]) -> None:
    """Append a frame to the trajectories if they are recorded."""
    if job.trajectories:
        frames["time"].append(sim.time)
        for name in ("position", "orientation"):
            frames[name].append(sim.get(name))


def _rows(
    sim: Simulator, runs: Sequence[Run], columns: dict, peak_counts: np.ndarray, failures: Failures
) -> list[dict[str, Any]]:
    """One row per run; the metrics of a failed simulation are None."""
    lists = {
        name: [None if isinstance(x, float) and not np.isfinite(x) else x for x in np.asarray(values).tolist()]
        for name, values in columns.items()
    }
    rows = []
    for env, (run, record) in enumerate(zip(runs, sim.status(), strict=True)):
        status, raised = str(record["status"]), failures.reasons[env]
        ok = status in FINISHED and not failures.void[env]
        reason = _reason(sim, env, record)
        if raised is not None and status in FINISHED:
            status, reason = "error", raised[:MAX_REASON_LENGTH]
        row = _row(run, env, status, reason)
        row |= {"most_pairs": int(peak_counts[0, env]), "most_contacts": int(peak_counts[1, env])}
        rows.append(row | {name: values[env] if ok else None for name, values in lists.items()})
    return rows


def _row(run: Run, env: int, status: str, reason: str | None) -> dict[str, Any]:
    return {
        "run": run.index,
        "id": run.id,
        "seed": run.seed,
        **run.parameters,
        "environment": env,
        "status": status,
        "reason": reason,
    }


def _reason(sim: Simulator, env: int, record: Any) -> str | None:
    """Why the status is not ok, or else what the warnings are of; None if there is neither."""
    if record["status"] == "ok":
        return f"warning: {record['warning']}" if record["warning"] else None
    body = int(record["body"])
    name = sim.scenes[sim.scene_of[env]].bodies[body].name if body >= 0 else "none"
    return f"{record['status']} since step {record['step']}, body {body} ({name})"
