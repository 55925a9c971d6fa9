"""Command line: `warp-rigid run`, `scenes` and `inspect`.

Results go to stdout, everything else to stderr. Exit status: 0 done, 2 usage or bad input,
3 capacity, 4 non-finite state, 130 interrupted.
"""

import contextlib
import json
import logging
import os
import sys
import tempfile
import warnings
from typing import Annotated, Any

import typer
import warp as wp
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

import warp_rigid
from warp_rigid import meshes, runner, scenes
from warp_rigid.inspect_mesh import inspect_mesh, parse_slice, save_slice
from warp_rigid.shapes import Mesh
from warp_rigid.usd_export import export_usd

__all__ = ["main"]

USAGE, CAPACITY, NON_FINITE = 2, 3, 4
UsageError = typer.BadParameter.__bases__[0]
PLAIN_WIDTH = 120
"""Width of tables where there is no terminal."""
MOST_RECORDED = 16
"""So many environments go into a film unless told otherwise."""
MOST_COLUMNS = 8
"""Up to so many environments have a column each in the table of verdicts."""

app = typer.Typer(
    help="Batched simulation of nonconvex rigid bodies with stacking.",
    pretty_exceptions_enable=False,
    invoke_without_command=True,
)


def main(argv: list[str] | None = None) -> int:
    """Run a command line and return its exit status.

    Args:
        argv: the arguments; None takes those of the process.
    """
    try:
        with _messages_on_stderr():
            _start_warp()
            return app(args=argv, prog_name="warp-rigid", standalone_mode=False) or 0
    except UsageError as error:
        return _fail(USAGE, error.format_message())
    except (ValueError, FileNotFoundError, ModuleNotFoundError, OSError) as error:
        return _fail(USAGE, _explain(error))


@app.callback()
def common(
    context: typer.Context,
    version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False,
) -> None:
    """Options without a command."""
    if version:
        print(f"warp-rigid {warp_rigid.__version__}")
    elif context.invoked_subcommand is None:
        print(context.get_help())


@app.command("scenes")
def list_scenes(
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object.")] = False,
) -> None:
    """List the built-in scenes, their parameters and the variants of --compare."""
    demos = [scenes.get(name) for name in scenes.names()]
    if as_json:
        print(
            json.dumps(
                {
                    demo.name: {
                        "summary": demo.summary,
                        "parameters": demo.parameters,
                        "variants": list(demo.variants),
                        "duration": demo.duration,
                    }
                    for demo in demos
                }
            )
        )
        return
    table = Table("scene", "shows", "parameters", "variants", box=None, pad_edge=False)
    for demo in demos:
        parameters = "\n".join(f"{name}={value}" for name, value in demo.parameters.items())
        table.add_row(demo.name, demo.summary, parameters, "\n".join(demo.variants))
    _console().print(table)


@app.command()
def run(
    scene: Annotated[str, typer.Argument(help="A built-in scene, or a .py file with scene().")],
    envs: Annotated[int | None, typer.Option(help="Environments.")] = None,
    frames: Annotated[int | None, typer.Option(help="Frames; the scene's own if left out.")] = None,
    fps: Annotated[float, typer.Option(help="Frames per simulated second.")] = 60.0,
    substeps: Annotated[int | None, typer.Option(help="Steps a frame; sets dt.")] = None,
    device: Annotated[str | None, typer.Option(help="Such as cpu or cuda:0.")] = None,
    seed: Annotated[int | None, typer.Option(help="Of the scene's random numbers.")] = None,
    assignments: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="NAME=VALUE",
            help="A scene's parameter, a setting or a property of the bodies; repeatable. "
            "A list NAME=A,B,C gives one value to each environment.",
        ),
    ] = None,
    compare: Annotated[bool, typer.Option("--compare", help="One environment for each variant of the scene.")] = False,
    output: Annotated[str | None, typer.Option("-o", "--output", help="Film: .usdc, .usda or .usdz.")] = None,
    usd_envs: Annotated[str | None, typer.Option(help="Environments in films and pictures: 0,5,7 or all.")] = None,
    picture: Annotated[str | None, typer.Option(help="The last frame, .png.")] = None,
    film: Annotated[str | None, typer.Option(help="The film, .gif.")] = None,
    contact_sheet: Annotated[str | None, typer.Option(help="Eight frames, .png.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object.")] = False,
) -> int:
    """Run a scene, measure its outcome, and write films and pictures of it."""
    pictures = {picture: ".png", film: ".gif", contact_sheet: ".png"}
    _check_outputs(output, {path: suffix for path, suffix in pictures.items() if path})
    plan = runner.plan_run(
        runner.find_scene(scene),
        assignments or (),
        num_envs=envs,
        compare=compare,
        frames=frames,
        fps=fps,
        substeps=substeps,
        device=device,
        seed=seed,
    )
    written = [path for path in (output, picture, film, contact_sheet) if path]
    chosen = _recorded_envs(usd_envs, plan.sim.num_envs) if written else []
    with _progress(plan.demo.name, plan.frames) as advance:
        result = runner.execute(plan, chosen, advance)
    if output:
        export_usd(result.recording, output)
    if picture or film or contact_sheet:
        _draw(result.recording, output, picture, film, contact_sheet)
    summary = {**result.summary, "files": written}
    if as_json:
        print(json.dumps(summary))
    else:
        _print_summary(summary)
    return _status(summary["failed"])


@app.command("inspect")
def inspect_command(
    mesh: Annotated[str, typer.Argument(help="A mesh file, or a shape such as bunny or torus.")],
    output: Annotated[str | None, typer.Option("-o", "--output", help="Picture of a slice, .png.")] = None,
    cut: Annotated[str | None, typer.Option("--slice", help="Where, such as z=0.05; else through the middle.")] = None,
    sdf_resolution: Annotated[int, typer.Option(help="Cells along the longest side.")] = 64,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object.")] = False,
) -> None:
    """Tell how the simulator sees a mesh: solid, repairs, samples, error of its distances."""
    if cut and not output:
        raise ValueError("--slice: needs -o FILE.png for the picture")
    _check_outputs(None, {output: ".png"} if output else {})
    solid = _find_mesh(mesh, sdf_resolution)
    if output:
        lower, upper = solid.bounds
        axis, place = parse_slice(cut) if cut else (2, float(lower[2] + upper[2]) / 2.0)
        save_slice(solid, output, axis, place)
    figures = inspect_mesh(solid)
    if as_json:
        print(json.dumps(figures))
    else:
        _print_mesh(mesh, figures)


def _find_mesh(name: str, sdf_resolution: int) -> Mesh:
    """A mesh file, or one of the ready-made meshes."""
    ready = getattr(meshes, name, None)
    if getattr(ready, "__module__", None) == meshes.__name__ and not name.startswith("_"):
        return ready(sdf_resolution=sdf_resolution)
    if not os.path.isfile(name):
        raise FileNotFoundError(f"{name}: no such file")
    return Mesh.from_file(name, sdf_resolution=sdf_resolution)


def _check_outputs(usd: str | None, pictures: dict[str, str]) -> None:
    """Refuse names and missing libraries before the simulation runs, not after it."""
    if usd and not usd.endswith((".usdc", ".usda", ".usdz", ".usd")):
        raise ValueError(f"-o: must end in .usdc, .usda, .usdz or .usd, got {usd}")
    for path, suffix in pictures.items():
        if not path.endswith(suffix):
            raise ValueError(f"{path}: must end in {suffix}")
    if pictures:
        import matplotlib  # noqa: F401
        import PIL  # noqa: F401


def _recorded_envs(text: str | None, num_envs: int) -> list[int] | None:
    """Which environments films and pictures show; None for all."""
    if text == "all" or (text is None and num_envs <= MOST_RECORDED):
        return None
    if text is None:
        _note(f"recording the first {MOST_RECORDED} environments; --usd-envs chooses others")
        return list(range(MOST_RECORDED))
    try:
        return [int(part) for part in text.split(",")]
    except ValueError:
        raise ValueError(f"--usd-envs: must be numbers such as 0,5,7 or all, got {text}") from None


def _draw(recording, usd, picture, film, contact_sheet) -> None:
    """Pictures of the exported file where there is one, so that they show what was written."""
    from warp_rigid.film import film_from_recording, film_from_usd
    from warp_rigid.picture import save_contact_sheet, save_gif, save_picture

    drawn = film_from_usd(usd) if usd else film_from_recording(recording)
    for save, path in ((save_picture, picture), (save_gif, film), (save_contact_sheet, contact_sheet)):
        if path:
            save(drawn, path)


def _print_summary(summary: dict[str, Any]) -> None:
    console = _console()
    deepest = max(summary["deepest_penetration"], default=0.0)
    at_end = max(summary["penetration"], default=0.0)
    lines = [
        f"{summary['scene']}: {summary['envs']} environment(s) of {summary['bodies']} bodies, "
        f"{summary['frames']} frames ({summary['time']:.4g} s) on {summary['device']}",
        f"{summary['contacts']} contacts, {summary['levels']} levels; deepest overlap "
        f"{1e3 * deepest:.3g} mm, at the end {1e3 * at_end:.3g} mm",
        f"{summary['env_frames_per_second']:.4g} env-frames/s (set-up {summary['setup_seconds']:.2g} s)",
    ]
    lines += [
        f"environment {record['env']}: {record['status']} since step {record['step']}, body {record['body']}"
        for record in summary["failed"]
    ]
    for line in lines:
        console.print(line, highlight=False, markup=False)
    if summary["verdicts"]:
        console.print(_verdict_table(summary), highlight=False)
        console.print(_conclusion(summary["verdicts"]), highlight=False, markup=False)
    for path in summary["files"]:
        console.print(f"wrote {path}", highlight=False, markup=False)


def _verdict_table(summary: dict[str, Any]) -> Table:
    """A row for each verdict; a column for each environment, if they are few."""
    table = Table("verdict", "condition", box=None, pad_edge=False)
    few = summary["envs"] <= MOST_COLUMNS
    if few:
        for env, label in enumerate(summary["labels"]):
            table.add_column(label or (f"env {env}" if summary["envs"] > 1 else "measured"))
    else:
        table.add_column("holds in")
        table.add_column("from")
        table.add_column("to")
    for verdict in summary["verdicts"]:
        rows = list(zip(verdict["values"], verdict["passed"], verdict["expected"], strict=True))
        if few:
            cells = [_cell(*row) for row in rows]
        else:
            passed = sum(verdict["passed"])
            color = "green" if passed == len(rows) else "red"
            cells = [f"[{color}]{passed} of {len(rows)}[/]"]
            cells += [f"{pick(verdict['values']):.3g}" for pick in (min, max)]
        table.add_row(verdict["name"], verdict["limit"], *cells)
    return table


def _cell(value: float, passed: bool, expected: bool | None) -> str:
    answer = "yes" if passed else "no"
    if expected is None:
        return f"{value:.3g} {answer}"
    if passed == expected:
        return f"{value:.3g} [green]{answer}{'' if passed else ', as expected'}[/]"
    return f"{value:.3g} [red]{answer}, NOT AS EXPECTED[/]"


def _conclusion(verdicts: list[dict[str, Any]]) -> str:
    """How many verdicts are as the scene expects them."""
    judged = [
        passed == expected
        for verdict in verdicts
        for passed, expected in zip(verdict["passed"], verdict["expected"], strict=True)
        if expected is not None
    ]
    if not judged:
        return "nothing is expected of changed settings or a shortened run"
    return f"{sum(judged)} of {len(judged)} verdicts as expected"


def _print_mesh(name: str, figures: dict[str, Any]) -> None:
    size = [upper - lower for lower, upper in zip(figures["lower"], figures["upper"], strict=True)]
    triple = "{:.4g} x {:.4g} x {:.4g}".format
    cell = figures["cell"]
    rows = {
        "mesh": f"{name}: {figures['vertices']} vertices, {figures['triangles']} triangles, "
        f"{'watertight' if figures['watertight'] else 'open'}",
        "repairs": "; ".join(figures["repairs"]) or "none",
        "size": f"{triple(*size)} m",
        "volume": f"{figures['volume']:.5g} m^3",
        "center of mass": "({:.4g}, {:.4g}, {:.4g}) m".format(*figures["center_of_mass"]),
        "inertia": "{:.4g}, {:.4g}, {:.4g} m^5 at unit density".format(*figures["principal_inertia"]),
        "samples": ", ".join(f"{n} {kind}" for kind, n in figures["samples"].items() if n),
        "distance grid": f"{triple(*figures['grid'])} nodes, cell {1e3 * cell:.3g} mm, {figures['grid_seconds']:.2g} s",
        "distance error": f"mean {figures['distance_error_mean'] / cell:.2g}, "
        f"largest {figures['distance_error_largest'] / cell:.2g} cells; "
        f"{figures['wrong_signs']} wrong signs",
    }
    table = Table(box=None, show_header=False, pad_edge=False)
    for label, text in rows.items():
        table.add_row(label, text)
    _console().print(table, highlight=False)


def _status(failed: list[dict[str, Any]]) -> int:
    if not failed:
        return 0
    first = failed[0]
    _note(f"{len(failed)} environment(s) failed, first {first['env']}: {first['status']} since step {first['step']}")
    return CAPACITY if first["status"] == "capacity" else NON_FINITE


@contextlib.contextmanager
def _progress(name: str, total: int):
    """A bar on stderr where that is a terminal; yields the function that moves it."""
    console = _console(stderr=True)
    if not console.is_terminal:
        yield None
        return
    with Progress(console=console, transient=True) as progress:
        task = progress.add_task(name, total=total)
        yield lambda done: progress.update(task, completed=done)


def _start_warp() -> None:
    """Start Warp without its greeting; other messages of its native part still come through."""
    wp.config.log_level = wp.LOG_WARNING
    with tempfile.TemporaryFile() as told:
        sys.stderr.flush()
        kept = os.dup(2)
        os.dup2(told.fileno(), 2)
        try:
            wp.init()
        finally:
            os.dup2(kept, 2)
            os.close(kept)
        told.seek(0)
        for line in told.read().decode(errors="replace").splitlines():
            if "Could not find or load the NVIDIA CUDA driver" not in line:
                _note(line)


def _explain(error: Exception) -> str:
    """One line on what went wrong."""
    if isinstance(error, ModuleNotFoundError):
        package = "'warp-rigid[picture]'" if error.name in ("PIL", "matplotlib") else "--force-reinstall warp-rigid"
        return f"{error.name} is not installed; pip install {package} brings it"
    if isinstance(error, OSError) and error.filename:
        return f"{error.filename}: {error.strerror}"
    return " ".join(str(error).split())


def _fail(status: int, text: str) -> int:
    _note(f"warp-rigid: {text}")
    return status


def _note(text: str) -> None:
    print(text, file=sys.stderr)


@contextlib.contextmanager
def _messages_on_stderr():
    """Show the package's messages, and warnings as one line each."""
    log = logging.getLogger("warp_rigid")
    handler = logging.StreamHandler(sys.stderr)
    level = log.level
    log.addHandler(handler)
    log.setLevel(logging.INFO)
    with warnings.catch_warnings():
        warnings.showwarning = lambda message, *_, **__: _note(f"warning: {message}")
        try:
            yield
        finally:
            log.removeHandler(handler)
            log.setLevel(level)


def _console(stderr: bool = False) -> Console:
    console = Console(stderr=stderr)
    return console if console.is_terminal else Console(stderr=stderr, width=PLAIN_WIDTH)


if __name__ == "__main__":
    sys.exit(main())
