"""`wr.sweep`: run the batches of a design locally or on a cluster, and write the results as they arrive."""

import functools
import logging
import platform
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from warp_rigid import progress_bar
from warp_rigid.checks import number_in, shown, whole_in
from warp_rigid.diagnostics.machine import git
from warp_rigid.engine.simulator import choose_device
from warp_rigid.progress_bar import Advance
from warp_rigid.runs.user_code import column_name
from warp_rigid.sweep.axes import clean_axes, plain
from warp_rigid.sweep.batch_run import Batch, run_batch
from warp_rigid.sweep.batch_size import SizedRun, free_memory, max_environments, split_into_batches
from warp_rigid.sweep.columns import COLUMNS
from warp_rigid.sweep.design import MAX_RUNS, Run, make_points, shard_of, stable_hash
from warp_rigid.sweep.job import Job, group_runs, make_runs, resolve_scene
from warp_rigid.sweep.metrics import check_metrics, check_observers
from warp_rigid.sweep.series import Series, Trajectories, ZarrSeries
from warp_rigid.sweep.stopwatch import Stopwatch
from warp_rigid.sweep.table import ResultFile, SweepResult
from warp_rigid.sweep.workers import MAX_WORKERS, WorkerProcesses, run_on_cluster
from warp_rigid.version import __version__
from warp_rigid.warp_start import start_warp

log = logging.getLogger("warp_rigid")

MAX_REPORTED = 10
"""Maximum number of different errors that are logged while a sweep runs."""


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
    observe: Sequence[str | Callable] | None = None,
    series: Sequence[str] | None = None,
    series_output: Any = None,
    shard: tuple[int, int] | None = None,
    cluster: Any = None,
    workers: int | None = None,
    on_progress: Callable[[int, int], None] | None = None,
    progress: bool = True,
    command: Sequence[str] | None = None,
) -> SweepResult:
    """Simulate a scene over a range of parameters; one row per run.

    Runs with the same time step share a simulator, one environment per run, even if their scenes differ in shapes or
    numbers of bodies. Runs with different time steps are in separate batches. A row depends only on its parameters,
    not on the batch, the batch index, the shard or the worker.

    Args:
        scene: a built-in name, the path of a .py file with a function scene() or of a USD, MJCF or URDF file, a
            Scene, or a function that returns one.
        axes: values or a distribution (Uniform, LogUniform, Normal, Integers, Choice) by name: a scene parameter, a
            setting, or a property accepted by Simulator.set. A property may select bodies: "mass[box_3]",
            "friction[box_*]".
        duration: simulated time of each run [s]; None uses the duration of the scene.
        fixed: values shared by all runs, by name.
        design: "grid" (every combination), "zip" (element by element), "random" or "lhs" (Latin hypercube).
        samples: number of points of the designs "random" and "lhs".
        repeats: number of runs per point, with consecutive seeds.
        seed: seed of the design and of the random numbers of the scene; None uses 0 for the design and the default of
            the scene.
        metrics: names of built-in metrics (see warp_rigid.sweep.metrics.METRICS), "outcome" for the verdicts of the
            scene, paths of .py files with functions, or functions of the final simulator that return (envs,) values.
            None uses all built-in metrics with one number per run.
        fps: state samples per simulated second.
        batch: maximum number of environments per batch, or "auto" to derive it from the available memory.
        device: as in Simulator, or "all" for every GPU of this machine, each in a process of its own.
        output: a .parquet file that is updated while the sweep runs; PATH.json beside it contains scene, design,
            versions and commit.
        resume: keep the finished rows of `output` and run only the others.
        overwrite: replace `output`.
        trajectories: a .zarr folder for the poses of every sample.
        observe: names of built-in observers, functions of the simulator, classes, or .py files of these, called at
            every sample; their values at the end are columns. See warp_rigid.sweep.metrics.
        series: names of built-in observers, or of functions of `observe`, whose values at every sample are kept in the
            folder TABLE.series beside `output`, or in memory. `SweepResult.series` reads them.
        series_output: a .zarr folder for the series instead.
        shard: (i, n) runs every n-th run of the design, starting with the i-th, 1 <= i <= n.
        cluster: "local" for worker processes on this machine, each with a GPU or its share of the cores; for more
            machines the address of a Dask scheduler, a Dask cluster or client, or a function that returns one; None
            runs in this process.
        workers: number of worker processes for "local"; None uses one per GPU, or two without a GPU.
        on_progress: called after each batch with the number of finished runs and of all runs.
        progress: whether to show a bar in terminals and notebooks, which advances within batches (with Dask after each
            batch).
        command: the command line, stored in PATH.json.

    Returns:
        The rows, including those kept from a resumed `output`.

    Raises:
        ValueError: A name is unknown, a value is out of range or `output` exists; raised before any run.
    """
    device, cluster, workers = _machines(device, cluster, workers)
    demo, scene_id = resolve_scene(scene)
    observers, names, kept = _observers(observe, series)
    job = Job(
        demo=demo,
        scene_id=scene_id,
        fixed={name: plain(value) for name, value in (fixed or {}).items()},
        duration=number_in("duration", demo.duration if duration is None else duration, above=0.0),
        fps=number_in("fps", fps, above=0.0),
        metrics=check_metrics(metrics),
        trajectories=trajectories is not None,
        observers=observers,
        observe=names,
        series=kept,
        device=device,
    )
    if series_output is not None and not kept:
        raise ValueError("series_output: requires series")
    if (resume or overwrite) and output is None and trajectories is None and series_output is None:
        raise ValueError(f"{'resume' if resume else 'overwrite'}: requires output, trajectories or series_output")
    if batch != "auto":
        whole_in("batch", batch, 1, MAX_RUNS)
    clean = clean_axes(axes)
    both = [name for name in clean if name in job.fixed]
    if both:
        raise ValueError(f"{both[0]}: must be either fixed or an axis, not both")
    watch = Stopwatch()
    with WorkerProcesses(workers) if cluster == "local" else nullcontext(cluster) as runner:
        with watch.of("plan"):
            all_runs = make_runs(job, make_points(clean, design, samples, repeats, seed or 0), seed)
            runs = shard_of(all_runs, shard)
            _check_names(job, all_runs)
            axis_values = {name: axis if isinstance(axis, list) else repr(axis) for name, axis in clean.items()}
            about = _about(job, scene, axis_values, all_runs) | {
                "design": {"kind": design, "samples": samples, "repeats": repeats, "seed": seed, "axes": axis_values},
                "design_id": stable_hash([run.id for run in all_runs]),
                "runs": len(all_runs),
                "shard": shard,
                "command": list(command) if command is not None else None,
            }
        with watch.of("write"):
            book = ResultFile(output, about, resume, overwrite, source=scene)
            missing = book.missing(runs)
        with watch.of("plan"):
            groups = group_runs(job, missing)
        if trajectories is not None:
            book.trajectories = Trajectories(trajectories, about, resume, overwrite)
        if job.series:
            book.series = (
                Series(output, resume) if series_output is None else ZarrSeries(series_output, about, resume, overwrite)
            )
        with progress_bar.progress(job.demo.name, len(runs), progress) as advance:
            batches = partial(_results, job, groups, batch, runner, watch)
            _run_all(batches, book, watch, len(runs), on_progress, advance)
    return book.result()


def _run_all(
    batches: Callable[[Callable[[float], object]], Iterator[tuple[list[Run], Batch]]],
    book: ResultFile,
    watch: Stopwatch,
    total: int,
    on_progress: Callable[[int, int], None] | None,
    advance: Advance,
) -> None:
    """Run all batches, and store their results while the next ones run."""
    if book.rows:
        log.info("%d of %d runs are already finished", len(book.rows), total)
    book.write(state="running")
    reported: set[str] = set()
    stored: Future | None = None

    def settle() -> None:
        """Wait until the last results are stored, and report the progress."""
        if stored is not None:
            with watch.of("write"):
                stored.result()
            if on_progress is not None:
                on_progress(len(book.rows), total)

    done = len(book.rows)

    def on_done(running: float) -> None:
        """Show the progress within the running batches."""
        advance(done + running)

    try:
        with ThreadPoolExecutor(1) as writer:
            for runs, result in batches(on_done):
                done += len(runs)
                on_done(0.0)
                watch.add(result.seconds)
                settle()
                stored = writer.submit(book.store, result)
                _report_errors(result.rows, reported)
            settle()
    finally:
        complete = len(book.rows) == total
        finished = {"state": "finished", "finished": _now()} if complete else {"state": "interrupted"}
        with watch.of("write"):
            book.write(**finished, seconds=dict(watch.seconds))
        log.info("time: %s", watch)


def _report_errors(rows: list[dict[str, Any]], reported: set[str]) -> None:
    """Log each reason of an error when it first occurs, at most MAX_REPORTED of them."""
    for row in rows:
        if row["status"] == "error" and row["reason"] not in reported and len(reported) < MAX_REPORTED:
            reported.add(row["reason"])
            log.error("run %d: %s", row["run"], row["reason"])


def _results(
    job: Job,
    groups: list[list[SizedRun]],
    batch: int | str,
    runner: Any,
    watch: Stopwatch,
    on_done: Callable[[float], object],
) -> Iterator[tuple[list[Run], Batch]]:
    """Yield the runs of each batch with their results, in order of completion.

    The runner is WorkerProcesses, a Dask cluster or what leads to one, or None for this process.
    """
    if not groups:
        return
    if isinstance(runner, WorkerProcesses):
        with watch.of("start"):
            most, memory = runner.start(job)
        yield from runner.run(split_into_batches(groups, batch, most, memory, runner.count), on_done)
        return
    if runner is not None:
        yield from run_on_cluster(job, groups, batch, runner)
        return
    device = choose_device(job.device)
    job = replace(job, device=device)
    for runs in split_into_batches(groups, batch, max_environments(device), free_memory(device)):
        yield runs, run_batch(job, runs, on_done)


def _machines(device: Any, cluster: Any, workers: int | None) -> tuple[Any, Any, int | None]:
    """Device, cluster and number of workers; the device "all" is a worker for each GPU if there are several.

    Raises:
        ValueError: "all" is combined with a cluster or workers, or there are workers without the cluster "local".
    """
    if device == "all":
        if cluster is not None or workers is not None:
            raise ValueError("device: all must not be combined with cluster or workers")
        start_warp()
        gpus = wp.get_cuda_device_count()
        return (None, "local", gpus) if gpus > 1 else (None, None, None)
    if workers is not None:
        whole_in("workers", workers, 1, MAX_WORKERS)
        if cluster != "local":
            raise ValueError("workers: applies to cluster local only")
    return device, cluster, workers


def _observers(observe: Any, series: Any) -> tuple[tuple[str | Callable, ...], tuple[str, ...], tuple[str, ...]]:
    """All observers, the names of those whose values are columns, and the names of the series.

    Raises:
        ValueError: An observer is unknown, or a series is neither built-in nor a function of `observe`.
    """
    columns = check_observers(observe)
    names = [column_name(observer) for observer in columns]
    kept = list(series) if isinstance(series, list | tuple) else [] if series is None else [series]
    more = check_observers([name for name in kept if name not in names], "series")
    if any(not isinstance(observer, str) for observer in more):
        raise ValueError(f"series: must be names, with their functions in observe, got {shown(kept)}")
    return (*columns, *more), tuple(names), tuple(kept)


def _about(job: Job, source: Any, axes: dict[str, Any], runs: list[Run]) -> dict[str, Any]:
    """Metadata of the table."""
    return {
        "scene": job.scene_id,
        "source": str(source) if isinstance(source, str | Path) else None,
        "fixed": job.fixed,
        "duration": job.duration,
        "fps": job.fps,
        "metrics": [column_name(metric) for metric in job.metrics],
        "observe": list(job.observe),
        "series": list(job.series),
        "axes": list(axes),
        "parameters": list(runs[0].parameters) if runs else list(axes),
        "version": __version__,
        "versions": {"python": platform.python_version(), "warp": wp.config.version, "numpy": np.__version__},
        "commit": _commit(),
        "machine": platform.platform(),
        "device": None if job.device is None else str(job.device),
        "started": _now(),
    }


def _check_names(job: Job, runs: list[Run]) -> None:
    """Check that no two columns have the same name.

    A parameter "seed" means the same as the standard column, and an observer the same as the built-in metric of its
    name.
    """
    names = [("axis", name) for name in (runs[0].parameters if runs else ()) if name != "seed"]
    names += [("metric", column_name(metric)) for metric in job.metrics]
    ready_made = [observer for observer in job.observers if observer in job.metrics]
    names += [("observer", name) for name in job.observe if name not in ready_made]
    taken = dict.fromkeys(COLUMNS, "standard column")
    for kind, name in names:
        if name in taken:
            raise ValueError(f"{kind} {name}: is also the name of a {taken[name]}; rename it")
        taken[name] = "parameter" if kind == "axis" else kind
    if any(name in ("run", "time") for name in job.series):
        raise ValueError("series: run and time are columns of every series; rename the observer")


@functools.cache
def _commit() -> str | None:
    """Commit of the source checkout; None for an installed package."""
    return git("describe", "--always", "--abbrev=40", "--dirty") or None


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")
