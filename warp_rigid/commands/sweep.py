"""`warp-rigid sweep`: simulate a scene over a range of parameters and tabulate the metrics."""

import json
import time
from dataclasses import dataclass
from typing import Annotated, Any

import typer

from warp_rigid.commands.options import AsJson, SimulatedScene, takes
from warp_rigid.commands.terminal import check_writable, continued, note, say, say_written, told_if_interrupted
from warp_rigid.runs.assignments import join_vector, parse_assignment, split_at_commas
from warp_rigid.runs.user_code import column_name
from warp_rigid.sweep import sweep
from warp_rigid.sweep.axes import parse_axis
from warp_rigid.sweep.metrics import OUTCOME, check_metrics
from warp_rigid.sweep.result_plots import check_plot
from warp_rigid.sweep.workers import cluster_of_file

FAILED_RUNS = 5


@dataclass(frozen=True)
class SweepOptions:
    """Options of `warp-rigid sweep`."""

    context: typer.Context
    scene: SimulatedScene
    vary: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=VALUES",
            help="Axis, repeatable: scene parameter, setting or property. VALUES: 0.1:1.0:10 (first, last, "
            "count), A,B,C, 0.1:1.0 (uniform), or uniform(..), log_uniform(..), normal(..), integers(..), choice(..).",
        ),
    ] = None
    assignments: Annotated[
        list[str] | None, typer.Option("--set", metavar="NAME=VALUE", help="Fixed value for all runs; repeatable.")
    ] = None
    metrics: Annotated[
        str | None,
        typer.Option(help="Names of metrics, outcome, or .py files with functions of the simulator: A,B,my.py."),
    ] = None
    observe: Annotated[
        str | None,
        typer.Option(
            help="Observers, read at every sample: peak_impulse, first_contact[BODY], .. or .py files: A,B,my.py."
        ),
    ] = None
    series: Annotated[
        str | None,
        typer.Option(help="Observers whose time series are kept in the folder TABLE.series: A,B[BODY]."),
    ] = None
    series_output: Annotated[
        str | None, typer.Option(help="Folder of the time series, .zarr. Default: Parquet files in TABLE.series.")
    ] = None
    design: Annotated[str, typer.Option(help="Design: grid, zip, random or lhs.")] = "grid"
    samples: Annotated[int | None, typer.Option(help="Number of points of the designs random and lhs.")] = None
    repeats: Annotated[int, typer.Option(help="Runs per point, with consecutive seeds.")] = 1
    seed: Annotated[int | None, typer.Option(help="Seed of the design and of the random numbers of the scene.")] = None
    duration: Annotated[float | None, typer.Option(help="Simulated seconds. Default: duration of the scene.")] = None
    fps: Annotated[float, typer.Option(help="State samples per simulated second.")] = 4.0
    batch: Annotated[str, typer.Option(help="Maximum number of environments per batch, or auto.")] = "auto"
    device: Annotated[
        str | None, typer.Option(help="Device, such as cpu or cuda:0, or all for every GPU of this machine.")
    ] = None
    output: Annotated[str | None, typer.Option("-o", "--output", help="Table, .parquet.")] = None
    resume: Annotated[bool, typer.Option("--resume", help="Keep the finished rows of an existing table.")] = False
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an existing table.")] = False
    trajectories: Annotated[str | None, typer.Option(help="Trajectories of all runs, .zarr.")] = None
    plot: Annotated[str | None, typer.Option(help="Plot, .png or .svg.")] = None
    plot_x: Annotated[str | None, typer.Option(help="Axis on the x axis of the plot.")] = None
    plot_y: Annotated[str | None, typer.Option(help="Metric on the y axis of the plot.")] = None
    plot_kind: Annotated[str | None, typer.Option(help="Kind of plot: line, heatmap or scatter.")] = None
    shard: Annotated[
        str | None, typer.Option(metavar="I/N", help="Run only every N-th run, starting with the I-th.")
    ] = None
    cluster: Annotated[
        str | None,
        typer.Option(help="local, the address of a Dask scheduler, or a .py file with a function cluster()."),
    ] = None
    workers: Annotated[int | None, typer.Option(help="Worker processes of --cluster local.")] = None
    as_json: AsJson = False

    def arguments(self, axes: dict[str, Any], measured: tuple) -> dict[str, Any]:
        """The arguments of `sweep` by name, but for the scene and the progress."""
        plain = ("design", "samples", "repeats", "seed", "duration", "fps", "device", "output", "resume", "overwrite")
        return {
            **{name: getattr(self, name) for name in (*plain, "trajectories", "series_output", "workers")},
            "axes": axes,
            "fixed": _fixed(self.assignments or ()),
            "metrics": measured,
            "batch": int(self.batch) if self.batch.isdigit() else self.batch,
            "observe": split_at_commas(self.observe) if self.observe else None,
            "series": split_at_commas(self.series) if self.series else None,
            "shard": _shard(self.shard),
            "cluster": cluster_of_file(self.cluster) if self.cluster and self.cluster.endswith(".py") else self.cluster,
            "command": self.context.obj,
        }


@takes(SweepOptions)
def sweep_command(options: SweepOptions) -> int:
    """Simulate a scene over a range of parameters and write one table row per run."""
    axes, plot, output = _by_name(map(parse_axis, options.vary or ()), "--vary"), options.plot, options.output
    measured = check_metrics(options.metrics.split(",") if options.metrics else None)
    if plot:
        check_plot(plot, options.plot_kind)
        check_writable(plot)
        _check_columns(options.plot_x, options.plot_y, axes, measured)
    start = time.perf_counter()
    finished = [0, 0]

    def on_progress(done: int, total: int) -> None:
        finished[:] = done, total

    def kept() -> str:
        if output is None:
            return "nothing was kept; to be able to continue, use -o FILE.parquet"
        return f"{output} has the runs finished so far; to continue: {continued(options.context)}"

    with told_if_interrupted(kept, lambda: finished[0] > 0):
        result = sweep(options.scene, **options.arguments(axes, measured), on_progress=on_progress)
    seconds = time.perf_counter() - start
    if plot:
        result.plot(plot, options.plot_x, options.plot_y, options.plot_kind)
    files = [path for path in (output, options.trajectories, options.series_output, plot) if path]
    print_result(result, files, options.as_json, seconds)
    return FAILED_RUNS if result.failed else 0


def print_result(result: Any, files: list[str], as_json: bool, seconds: float | None = None) -> None:
    """Print a summary of a result table, or the whole table as JSON."""
    failed = result.failed
    if as_json:
        summary = {"runs": len(result), "failed": len(failed), "seconds": seconds, "files": files}
        print(json.dumps({**summary, "about": result.about, "rows": result.rows}, default=str))
    else:
        took = f" in {seconds:.3g} s" if seconds is not None else ""
        lines = [f"{result.about['scene'].partition(':')[0]}: {len(result)} runs, {len(failed)} failed{took}"]
        for name in result.metrics:
            values = result.column(name)
            if values.dtype == bool:
                lines.append(f"{name}: yes in {values.sum()} of {len(values)} runs")
            elif values.dtype.kind in "iuf" and len(values):
                finite = [value for value in values.astype(float).tolist() if value == value]
                if finite:
                    unit = f" {result.units[name]}" if name in result.units else ""
                    lines.append(f"{name}: {min(finite):.4g} to {max(finite):.4g}{unit}")
        say(*lines)
        say_written(files)
    if failed:
        first = failed[0]
        note(f"{len(failed)} run(s) failed, first run {first['run']}: {first['status']}: {first['reason']}")


def _check_columns(x: str | None, y: str | None, axes: dict[str, Any], measured: tuple) -> None:
    """Check that the table will have the columns to plot."""
    if x is not None and x not in axes:
        raise ValueError(f"--plot-x: must be an axis ({', '.join(axes)}), got {x}")
    names = [column_name(metric) for metric in measured]
    # The columns of the scene's outcome are known only after the runs.
    if y is not None and y not in names and not (OUTCOME in names and y.startswith("outcome_")):
        raise ValueError(f"--plot-y: must be a metric ({', '.join(names)}), got {y}")


def _by_name(pairs: Any, flag: str) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name, values in pairs:
        if name in found:
            raise ValueError(f"{flag} {name}: given twice")
        found[name] = values
    return found


def _fixed(texts: Any) -> dict[str, Any]:
    """Values shared by all runs, by name."""
    given = _by_name(map(parse_assignment, texts), "--set")
    given = {name: join_vector(name, values) for name, values in given.items()}
    for name, values in given.items():
        if len(values) > 1:
            raise ValueError(f"--set {name}: takes one value; use --vary for several")
    return {name: values[0] for name, values in given.items()}


def _shard(text: str | None) -> tuple[int, int] | None:
    """Parse I/N."""
    if text is None:
        return None
    number, slash, count = text.partition("/")
    if not (slash and number.isdigit() and count.isdigit() and 1 <= int(number) <= int(count)):
        raise ValueError(f"--shard: must be I/N with 1 <= I <= N, got {text}")
    return int(number), int(count)
