"""One batch: runs that share a simulator, from their parameters to their rows."""

import logging
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from warp_rigid.engine.quantities import counts_of_environments
from warp_rigid.engine.settings import Settings
from warp_rigid.engine.simulator import Simulator
from warp_rigid.engine.variation import start_each, structure
from warp_rigid.errors import CapacityError
from warp_rigid.runs.runner import set_each, step_frame
from warp_rigid.scene.scene import Scene
from warp_rigid.sweep.columns import FINISHED, told
from warp_rigid.sweep.design import Run, address
from warp_rigid.sweep.job import Job, Needs, build_scene, needs_of, resolve_scene
from warp_rigid.sweep.metrics import OUTCOME, Watch, measure, metric_name
from warp_rigid.sweep.view import View

__all__ = ["Batch", "failed_batch", "prepare", "replay", "run_batch"]

log = logging.getLogger("warp_rigid")

MOST_REASON = 300
"""Characters of an error that go into a row."""


@dataclass(frozen=True, eq=False)
class Batch:
    """What a batch gave.

    Attributes:
        rows: one for each run.
        trajectories: what Trajectories.add takes, if poses are kept.
    """

    rows: list[dict[str, Any]]
    trajectories: dict[str, Any] | None = None


@dataclass(frozen=True, eq=False)
class Prepared:
    """A simulator at the start of some runs.

    Attributes:
        sim: the simulator, an environment a run.
        views: its environments by their scenes.
    """

    sim: Simulator
    views: list[View]


def prepare(job: Job, runs: Sequence[Run]) -> Prepared:
    """Build the simulator of some runs of one group (see `group_runs`), each at its start."""
    needs = needs_of(job, runs)
    keys = [need.scene_key for need in needs]
    first = dict(reversed([(key, need) for key, need in zip(keys, needs, strict=True)]))
    place = {key: index for index, key in enumerate(first)}
    scenes: list[Scene] = [build_scene(job, need) for need in first.values()]
    which = np.array([place[key] for key in keys])
    settings = Settings(**needs[0].settings)
    sim = Simulator(scenes[0], num_envs=len(runs), settings=settings, device=job.device, seed=runs[0].seed)
    if len(scenes) > 1:
        start_each(sim, scenes, which)
    _set_all(sim, needs)
    return Prepared(sim, [View(sim, scene, np.flatnonzero(which == i)) for i, scene in enumerate(scenes)])


def replay(result: Any, row: dict[str, Any], scene: Any = None, device: Any = None) -> Simulator:
    """A simulator of one row at its start; see SweepResult.replay."""
    source = result.source if scene is None else scene
    if source is None:
        raise ValueError("scene: must be given, the table does not tell where its scene is")
    demo, scene_id = resolve_scene(source)
    if scene_id != result.about.get("scene"):
        raise ValueError(f"scene: must be that of the rows, {result.about.get('scene')}, got {scene_id}")
    job = Job(demo, scene_id, told(result.about, "fixed"), demo.duration, 1.0, (), device=device)
    parameters = {name: row[name] for name in told(result.about, "parameters")}
    return prepare(job, [Run(0, row["id"], parameters, row["seed"])]).sim


def run_batch(job: Job, runs: Sequence[Run]) -> Batch:
    """Run a batch to its end. A run that fails is a row with its reason, and so is every run if all fail together.

    A batch that does not fit into the memory is halved.
    """
    start = time.perf_counter()
    try:
        return _run(job, runs, start)
    except Exception as error:
        if len(runs) > 1 and _is_of_memory(error):
            reason = error
        else:
            return failed_batch(runs, error, (time.perf_counter() - start) / len(runs))
    log.info("a batch of %d does not fit into the memory (%s); it is halved", len(runs), reason)
    middle = len(runs) // 2
    first, second = run_batch(job, runs[:middle]), run_batch(job, runs[middle:])
    for row in second.rows:
        row["environment"] += middle
    if first.trajectories is None or second.trajectories is None:
        return Batch(first.rows + second.rows)
    parts = (first.trajectories, second.trajectories)
    joined = {name: np.concatenate([part[name] for part in parts]) for name in ("position", "orientation")}
    return Batch(first.rows + second.rows, first.trajectories | joined)


def _is_of_memory(error: Exception) -> bool:
    """Whether a smaller batch might do."""
    return isinstance(error, MemoryError | CapacityError) or "alloc" in str(error).lower()


def failed_batch(runs: Sequence[Run], error: BaseException, seconds: float | None = None) -> Batch:
    """Rows of runs that an error kept from their results."""
    reason = " ".join(f"{type(error).__name__}: {error}".split())[:MOST_REASON]
    status = "capacity" if isinstance(error, CapacityError) else "error"
    return Batch([_row(run, env, status, reason) | {"wall_time": seconds} for env, run in enumerate(runs)])


def _run(job: Job, runs: Sequence[Run], start: float) -> Batch:
    prepared = prepare(job, runs)
    sim = prepared.sim
    outcomes = [job.demo.outcome(view.scene) for view in prepared.views] if OUTCOME in job.metrics else []
    watch = Watch(sim, [metric for metric in job.metrics if isinstance(metric, str) and metric != OUTCOME])
    events = _events(job, prepared.views)
    high_water = np.zeros((2, sim.num_envs), np.int64)
    frames: dict[str, list] = {"time": [], "position": [], "orientation": []}
    left = round(job.duration / sim.settings.dt)
    each = max(1, round(1.0 / (job.fps * sim.settings.dt)))
    _keep(job, sim, frames)
    while left > 0:
        step_frame(sim, min(each, left), events)
        left -= each
        watch.observe()
        high_water = np.maximum(high_water, counts_of_environments(sim))
        for outcome, view in zip(outcomes, prepared.views, strict=False):
            outcome.observe(view)
        _keep(job, sim, frames)
    columns = watch.values()
    columns |= {metric_name(metric): measure(metric, sim) for metric in job.metrics if not isinstance(metric, str)}
    columns |= _verdicts(prepared, outcomes)
    rows = _rows(sim, runs, columns, high_water)
    seconds = (time.perf_counter() - start) / len(runs)
    kept = None
    if job.trajectories:
        group = f"bodies_{sim.num_bodies}_{address(repr(structure(sim.scene)), sim.settings.dt)[:6]}"
        kept = {"group": group, "time": np.array(frames["time"])}
        kept |= {name: np.stack(frames[name], axis=1) for name in ("position", "orientation")}
        rows = [row | {"trajectory": group} for row in rows]
    return Batch([row | {"wall_time": seconds} for row in rows], kept)


def _set_all(sim: Simulator, needs: list[Needs]) -> None:
    """Settings and properties of every environment; what all of them share is in the simulator's settings already."""
    for name in needs[0].settings:
        values = [need.settings[name] for need in needs]
        if any(value != values[0] for value in values):
            set_each(sim, name, values)
    for name in needs[0].properties:
        set_each(sim, name, [need.properties[name] for need in needs])


def _events(job: Job, views: list[View]) -> list:
    """What happens from outside, each scene's to its own environments, by time."""
    return sorted(
        (
            (when, lambda _, act=act, view=view: act(view))
            for view in views
            for when, act in job.demo.events(view.scene)
        ),
        key=lambda event: event[0],
    )


def _keep(job: Job, sim: Simulator, frames: dict[str, list]) -> None:
    """Add a frame to the trajectories, if they are asked for."""
    if job.trajectories:
        frames["time"].append(sim.time)
        for name in ("position", "orientation"):
            frames[name].append(sim.get(name))


def _verdicts(prepared: Prepared, outcomes: list) -> dict[str, np.ndarray]:
    """The scene's own verdicts: the measure as "outcome_NAME", and whether it is as it must be as "outcome_NAME_ok"."""
    count = prepared.sim.num_envs
    found: dict[str, np.ndarray] = {}
    for outcome, view in zip(outcomes, prepared.views, strict=False):
        for verdict in outcome.verdicts(view):
            for name, values in ((verdict.name, verdict.values), (f"{verdict.name}_ok", verdict.passed)):
                column = found.setdefault(f"outcome_{name}", np.full(count, None, object))
                column[view._envs] = np.asarray(values)
    return found


def _rows(sim: Simulator, runs: Sequence[Run], columns: dict, high_water: np.ndarray) -> list[dict[str, Any]]:
    """One row a run; a run that failed has no metrics."""
    lists = {name: _plain_list(values) for name, values in columns.items()}
    rows = []
    for env, (run, record) in enumerate(zip(runs, sim.status(), strict=True)):
        ok = record["status"] in FINISHED
        row = _row(run, env, str(record["status"]), None if record["status"] == "ok" else _reason(sim, record))
        row |= {"most_pairs": int(high_water[0, env]), "most_contacts": int(high_water[1, env])}
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


def _reason(sim: Simulator, record: Any) -> str:
    body = int(record["body"])
    name = sim.scene.bodies[body].name if body >= 0 else "none"
    return f"{record['status']} since step {record['step']}, body {body} ({name})"


def _plain_list(values: np.ndarray) -> list:
    """Values as plain Python; None for what is not finite."""
    listed = np.asarray(values).tolist()
    return [None if isinstance(value, float) and not np.isfinite(value) else value for value in listed]
