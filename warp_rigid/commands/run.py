"""`warp-rigid run`: a scene, its outcome, films and pictures of it."""

import json
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.table import Table

from warp_rigid.checks import one_of, whole_in
from warp_rigid.commands.terminal import check_outputs, console, note, progress
from warp_rigid.render.appearance import COLORINGS
from warp_rigid.runs import runner
from warp_rigid.runs.progress import Checkpoints
from warp_rigid.usd import ImportReport, UsdStream, export_usd
from warp_rigid.usd.options import UsdOptions

CAPACITY, NON_FINITE = 3, 4
MOST_RECORDED = 16
"""So many environments go into a film unless told otherwise."""
MOST_COLUMNS = 8
"""Up to so many environments have a column each in the table of verdicts."""


def run_command(
    scene: Annotated[str, typer.Argument(help="A built-in scene, a USD file, or a .py file with scene().")],
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
    output: Annotated[str | None, typer.Option("-o", "--output", help="Film: .usdc, .usda, .usdz or .glb.")] = None,
    usd_envs: Annotated[str | None, typer.Option(help="Environments in films and pictures: 0,5,7 or all.")] = None,
    usd_profile: Annotated[
        str, typer.Option(help="animation (instances), scene (with physics) or auto (a scene up to 2000 bodies).")
    ] = "auto",
    usd_layout: Annotated[
        str, typer.Option(help="single (one file), payloads (one an environment) or clips (one for each 24 frames).")
    ] = "single",
    usd_contacts: Annotated[bool, typer.Option("--usd-contacts", help="Draw contacts and impulses.")] = False,
    picture: Annotated[str | None, typer.Option(help="The last frame, .png.")] = None,
    film: Annotated[str | None, typer.Option(help="The film, .gif or .mp4.")] = None,
    contact_sheet: Annotated[str | None, typer.Option(help="Eight frames, .png.")] = None,
    html: Annotated[str | None, typer.Option(help="A page that plays the film without a server, .html.")] = None,
    color: Annotated[str, typer.Option(help="What colours tell: body, environment, level, speed or asleep.")] = "body",
    checkpoint: Annotated[str | None, typer.Option(help="Checkpoint file; SCENE.ckpt if left out.")] = None,
    checkpoint_every: Annotated[int | None, typer.Option(help="Write it whenever so many frames are done.")] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on from the checkpoint, if there is one.")] = False,
    memory_limit: Annotated[
        str | None, typer.Option(help="Bytes such as 8000000000, or a fraction such as 0.5 of the device's memory.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object.")] = False,
) -> int:
    """Run a scene, measure its outcome, and write films and pictures of it."""
    pictures = {picture: (".png",), film: (".gif", ".mp4"), contact_sheet: (".png",), html: (".html",)}
    check_outputs(output, {path: endings for path, endings in pictures.items() if path})
    one_of("--color", color, COLORINGS)
    usd = UsdOptions(usd_profile, color, usd_layout, usd_contacts)
    to_usd = output is not None and not output.endswith(".glb")
    if output and to_usd:
        usd.check_path(Path(output))
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
        memory_limit=_memory_limit(memory_limit),
    )
    if checkpoint_every is not None:
        whole_in("--checkpoint-every", checkpoint_every, 1, 10**9)
    checkpoints = Checkpoints(Path(checkpoint or f"{plan.demo.name}.ckpt"), checkpoint_every, resume)
    if resume and not checkpoints.path.exists():
        note(f"{checkpoints.path}: no checkpoint yet, starting from the beginning")
    written = [path for path in (output, picture, film, contact_sheet, html) if path]
    chosen = _recorded_envs(usd_envs, plan.sim.num_envs) if written else []
    _tell_import(plan.scene.import_report)
    # A resumed run writes its film from the beginning, so a run with checkpoints keeps the frames in them.
    if output and to_usd and checkpoint_every is None and not resume:
        result = _execute_to_usd(plan, output, chosen, usd)
    else:
        with progress(plan.demo.name, plan.frames) as advance:
            result = runner.execute(
                plan, chosen, advance, checkpoints, velocities=color == "speed", contacts=usd_contacts
            )
        if output:
            _export(result.recording, output, usd)
    if picture or film or contact_sheet or html:
        _draw(_film(result.recording, output if to_usd else None, color), picture, film, contact_sheet, html)
    summary = {**result.summary, "files": written}
    if as_json:
        print(json.dumps(summary))
    else:
        _print_summary(summary)
    return _status(summary["failed"])


def _memory_limit(text: str | None) -> int | float | None:
    """Bytes, or a fraction where the number has a point; None where none is given."""
    if text is None:
        return None
    try:
        return float(text) if "." in text else int(text)
    except ValueError:
        raise ValueError(f"--memory-limit: must be bytes or a fraction such as 0.5, got {text}") from None


def _execute_to_usd(plan: runner.Plan, path: str, envs: list[int] | None, options: UsdOptions) -> runner.Result:
    """Run with each frame going into the file at once, so that a long run needs no memory and can be cut short."""
    labels = plan.labels if envs is None else [plan.labels[env] for env in envs]
    with UsdStream(plan.sim, path, plan.fps, envs, labels, **vars(options)) as stream:
        with progress(plan.demo.name, plan.frames) as advance:

            def on_frame(done: int) -> None:
                stream.capture(plan.sim)
                if advance is not None:
                    advance(done)

            return runner.execute(plan, [], on_frame)


def _tell_import(report: ImportReport | None) -> None:
    """Everything that the scene has not or has otherwise than its file."""
    for finding in report.findings if report is not None else ():
        note(str(finding))


def _recorded_envs(text: str | None, num_envs: int) -> list[int] | None:
    """Which environments films and pictures show; None for all."""
    if text == "all" or (text is None and num_envs <= MOST_RECORDED):
        return None
    if text is None:
        note(f"recording the first {MOST_RECORDED} environments; --usd-envs chooses others")
        return list(range(MOST_RECORDED))
    try:
        return [int(part) for part in text.split(",")]
    except ValueError:
        raise ValueError(f"--usd-envs: must be numbers such as 0,5,7 or all, got {text}") from None


def _export(recording, path: str, options: UsdOptions) -> None:
    """Write the film of a run that is done."""
    if path.endswith(".glb"):
        from warp_rigid.render.gltf import export_gltf

        export_gltf(recording, path)
    else:
        export_usd(recording, path, **vars(options))


def _film(recording, usd: str | None, color: str):
    """What is drawn: the exported file where there is one, so that pictures show what was written."""
    from warp_rigid.render.film import colored, film_from_recording, film_from_usd

    if usd:
        return film_from_usd(usd)
    return colored(film_from_recording(recording), recording, color)


def _draw(drawn, picture, film, contact_sheet, html) -> None:
    """Write the pictures, films and pages that were asked for."""
    from warp_rigid.render.picture import save_contact_sheet, save_film, save_picture

    for save, path in ((save_picture, picture), (save_film, film), (save_contact_sheet, contact_sheet)):
        if path:
            save(drawn, path)
    if html:
        from warp_rigid.viewer.playback import save_html

        save_html(drawn, html)


def _print_summary(summary: dict[str, Any]) -> None:
    out = console()
    deepest = max(summary["deepest_penetration"], default=0.0)
    at_end = max(summary["penetration"], default=0.0)
    lines = [
        f"{summary['scene']}: {summary['envs']} environment(s) of {summary['bodies']} bodies, "
        f"{summary['frames']} frames ({summary['time']:.4g} s) on {summary['device']}",
        f"{summary['contacts']} contacts, {summary['levels']} levels; deepest overlap "
        f"{1e3 * deepest:.3g} mm, at the end {1e3 * at_end:.3g} mm",
        f"{summary['env_frames_per_second']:.4g} env-frames/s, {_frame_seconds(summary):.3g} s a frame "
        f"(set-up {summary['setup_seconds']:.2g} s)",
    ]
    lines += [
        f"environment {record['env']}: {record['status']} since step {record['step']}, body {record['body']}"
        for record in summary["failed"] + summary["out_of_bounds"]
    ]
    for line in lines:
        out.print(line, highlight=False, markup=False)
    if summary["verdicts"]:
        out.print(_verdict_table(summary), highlight=False)
        out.print(_conclusion(summary["verdicts"]), highlight=False, markup=False)
    for path in summary["files"]:
        out.print(f"wrote {path}", highlight=False, markup=False)


def _frame_seconds(summary: dict[str, Any]) -> float:
    """What a frame of all environments takes [s]; 0 if there was none."""
    rate = summary["env_frames_per_second"]
    return summary["envs"] / rate if rate > 0.0 else 0.0


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


def _status(failed: list[dict[str, Any]]) -> int:
    if not failed:
        return 0
    first = failed[0]
    note(f"{len(failed)} environment(s) failed, first {first['env']}: {first['status']} since step {first['step']}")
    return CAPACITY if first["status"] == "capacity" else NON_FINITE
