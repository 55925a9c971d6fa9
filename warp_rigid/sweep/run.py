"""`wr.sweep`: the runs of a design, put into batches, run here or on a cluster, and written as they come."""

import functools
import logging
import platform
import subprocess
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from warp_rigid.checks import number_in, whole_in
from warp_rigid.engine.simulator import choose_device
from warp_rigid.scene.scene import Scene
from warp_rigid.sweep.axes import clean_axes, plain
from warp_rigid.sweep.batch import Batch, run_batch
from warp_rigid.sweep.cluster import run_on_cluster
from warp_rigid.sweep.columns import COLUMNS
from warp_rigid.sweep.design import Run, address, make_points, shard_of
from warp_rigid.sweep.job import Job, group_runs, make_runs, resolve_scene
from warp_rigid.sweep.memory import memory_at_hand, most_environments, split_into_batches
from warp_rigid.sweep.metrics import check_metrics, metric_name
from warp_rigid.sweep.table import Book, SweepResult
from warp_rigid.version import __version__

__all__ = ["sweep"]

log = logging.getLogger("warp_rigid")

MOST_BATCH = 10_000_000


def sweep(
    scene: Any,
    axes: Mapping[str, Any],
    *,
    duration: float | None = None,
    fixed: Mapping[str, Any] | None = None,
    design: str = "grid",
    samples: int | None = None,
    repeats: int = 1,
    seed: int | None = None,
    metrics: Sequence[str | Callable] | None = None,
    fps: float = 4.0,
    batch: int | str = "auto",
    device: Any = None,
    output: Any = None,
    resume: bool = False,
    overwrite: bool = False,
    trajectories: Any = None,
    shard: tuple[int, int] | None = None,
    cluster: Any = None,
    workers: int | None = None,
    on_progress: Callable[[int, int], None] | None = None,
    command: Sequence[str] | None = None,
) -> SweepResult:
    """Run a scene with many values of its parameters; one row a run.

    What can share a simulator does, an environment a run; different meshes, numbers of bodies or time steps are put
    into batches of their own. A row depends on its parameters alone: not on the batch, its place in it, the shard or
    the worker.

    Args:
        scene: a built-in name, the path of a .py file with a function scene(), a Scene, or a function that returns one.
        axes: values or a distribution (Uniform, LogUniform, Normal, Integers, Choice) by name: a parameter of the
            scene, a setting, or a property that Simulator.set takes. A property can choose bodies: "mass[box_3]",
            "friction[box_*]".
        duration: simulated time of each run [s]; None takes the scene's own.
        fixed: names and values for all runs.
        design: "grid" (every combination), "zip" (values side by side), "random" or "lhs" (Latin hypercube).
        samples: points of the designs "random" and "lhs".
        repeats: how often every point is run, each time with the next seed.
        seed: of the draws and of the scene's random numbers; None takes the scene's own and 0 for the draws.
        metrics: names of built-in metrics (see warp_rigid.sweep.metrics.METRICS), "outcome" for the scene's own, paths
            of .py files with functions, or functions of the simulator at the end that return (envs,) values. None takes
            all that are a number a run.
        fps: looks at the running state per simulated second.
        batch: most environments at once, or "auto": by the memory at hand.
        device: as in Simulator.
        output: a .parquet file that is written while the sweep runs, and PATH.json beside it, which tells scene,
            design, versions and commit.
        resume: keep the finished rows of `output` and run only the others.
        overwrite: replace `output`.
        trajectories: a .zarr folder for the poses at every look.
        shard: (i, n) runs every n-th of the design, from the i-th on, 1 <= i <= n.
        cluster: "local" for worker processes on this machine, the address of a Dask scheduler, a Dask cluster or
            client, or a function that returns one; None runs here.
        workers: processes of "local"; None takes one a GPU, or two without.
        on_progress: called with the runs done and all runs after each batch.
        command: the command line, for PATH.json.

    Returns:
        The rows, those of `output` included if it was resumed.

    Raises:
        ValueError: A name is unknown, a value out of range or `output` exists; nothing has run then.
    """
    demo, scene_id = resolve_scene(scene)
    job = Job(
        demo=demo,
        scene_id=scene_id,
        fixed={name: plain(value) for name, value in (fixed or {}).items()},
        duration=number_in("duration", demo.duration if duration is None else duration, above=0.0),
        fps=number_in("fps", fps, above=0.0),
        metrics=check_metrics(metrics),
        trajectories=trajectories is not None,
        device=device,
    )
    if batch != "auto":
        whole_in("batch", batch, 1, MOST_BATCH)
    clean = clean_axes(axes)
    both = [name for name in clean if name in job.fixed]
    if both:
        raise ValueError(f"{both[0]}: is fixed and an axis; it can be one of them")
    points = make_points(clean, design, samples, repeats, seed or 0)
    all_runs = make_runs(job, points, seed)
    runs = shard_of(all_runs, shard)
    _refuse_taken_names(all_runs)
    told = {name: axis if isinstance(axis, list) else repr(axis) for name, axis in clean.items()}
    about = _about(job, scene, told, all_runs) | {
        "design": {"kind": design, "samples": samples, "repeats": repeats, "seed": seed, "axes": told},
        "design_id": address([run.id for run in all_runs]),
        "runs": len(all_runs),
        "shard": shard,
        "command": list(command) if command is not None else None,
    }
    book = Book(output, about, resume, overwrite, source=scene)
    book.keep(run.id for run in runs)
    for run in runs:
        if run.id in book.rows:
            book.rows[run.id]["run"] = run.index
    missing = [run for run in runs if run.id not in book.rows]
    groups = group_runs(job, missing)
    tracks = None
    if trajectories is not None:
        from warp_rigid.sweep.trajectories import Trajectories

        tracks = Trajectories(trajectories, len(all_runs), about, resume, overwrite)
    if len(missing) < len(runs):
        log.info("%d of %d runs are finished already", len(runs) - len(missing), len(runs))
    book.write(state="running")
    done = len(runs) - len(missing)
    try:
        for part, result in _results(job, groups, batch, cluster, workers):
            if tracks is not None and result.trajectories is not None:
                tracks.add(part, result.trajectories)
            book.add(result.rows)
            done += len(part)
            if on_progress is not None:
                on_progress(done, len(runs))
    finally:
        finished = {"state": "finished", "finished": _now()} if done == len(runs) else {"state": "interrupted"}
        book.write(**finished)
    return book.result()


def _results(
    job: Job, groups: list[tuple[Scene, list[Run]]], batch: int | str, cluster: Any, workers: int | None
) -> Iterator[tuple[list[Run], Batch]]:
    """Runs and what they gave, as they are done."""
    if not groups:
        return
    if cluster is not None:
        yield from run_on_cluster(job, groups, batch, cluster, workers)
        return
    device = choose_device(job.device)
    job = replace(job, device=device)
    limit = partial(most_environments, device=device)
    for part in split_into_batches(groups, batch, limit, memory_at_hand(device)):
        yield part, run_batch(job, part)


def _about(job: Job, source: Any, axes: dict[str, Any], runs: list[Run]) -> dict[str, Any]:
    """What the rows come from."""
    return {
        "scene": job.scene_id,
        "source": str(source) if isinstance(source, str | Path) else None,
        "fixed": job.fixed,
        "duration": job.duration,
        "fps": job.fps,
        "metrics": [metric_name(metric) for metric in job.metrics],
        "axes": list(axes),
        "parameters": list(runs[0].parameters) if runs else list(axes),
        "version": __version__,
        "versions": {"python": platform.python_version(), "warp": wp.config.version, "numpy": np.__version__},
        "commit": _commit(),
        "machine": platform.platform(),
        "device": None if job.device is None else str(job.device),
        "started": _now(),
    }


def _refuse_taken_names(runs: list[Run]) -> None:
    """A parameter must not be called like a column that every table has; "seed" means the same there."""
    taken = [name for name in (runs[0].parameters if runs else ()) if name in COLUMNS and name != "seed"]
    if taken:
        raise ValueError(f"axis {taken[0]}: is the name of a column of every table; rename the scene's parameter")


@functools.cache
def _commit() -> str | None:
    """The commit of the checkout that runs, None for an installed package."""
    folder = Path(__file__).resolve().parents[2]
    if not (folder / ".git").exists():
        return None
    try:
        asked = ["git", "-C", str(folder), "describe", "--always", "--abbrev=40", "--dirty"]
        return subprocess.run(asked, capture_output=True, text=True, timeout=5).stdout.strip() or None
    except (OSError, subprocess.TimeoutExpired):
        return None


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")
