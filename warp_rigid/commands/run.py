"""`warp-rigid run`: simulate a scene, evaluate its outcome and write animations and images."""

import json
from collections.abc import Iterable
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.table import Table

from warp_rigid.checks import one_of, whole_in
from warp_rigid.commands.options import AsJson, Device, Envs, Seed, SimulatedScene, takes
from warp_rigid.commands.terminal import (
    CAMERA_HELP,
    check_outputs,
    check_writable,
    console,
    continued,
    note,
    say,
    say_written,
    told_if_interrupted,
)
from warp_rigid.engine.simulator import Simulator
from warp_rigid.files.atomic import check_unread
from warp_rigid.progress_bar import progress
from warp_rigid.render.appearance import COLORINGS
from warp_rigid.render.gltf import export_gltf
from warp_rigid.runs import runner
from warp_rigid.runs.progress import Checkpoints
from warp_rigid.runs.recording import Recording
from warp_rigid.runs.user_code import UserCodeError
from warp_rigid.scene.scene import Motion
from warp_rigid.scenes.demo import shown_settings, shown_value
from warp_rigid.usd import UsdStream, export_usd
from warp_rigid.usd.options import UsdOptions

CAPACITY, NON_FINITE, UNEXPECTED = 3, 4, 6
START_OVERLAP = 0.05
"""Overlap at the start that is reported, relative to the size of the smallest body."""
MAX_RECORDED = 16
"""Default maximum number of recorded environments."""
MAX_COLUMNS = 8
"""Maximum number of environments with a column of their own in the table of verdicts."""


@dataclass(frozen=True)
class RunOptions:
    """Options of `warp-rigid run`."""

    context: typer.Context
    scene: SimulatedScene
    envs: Envs = None
    frames: Annotated[int | None, typer.Option(help="Number of frames. Default: duration of the scene.")] = None
    fps: Annotated[float, typer.Option(help="Frames per simulated second.")] = 60.0
    substeps: Annotated[int | None, typer.Option(help="Time steps per frame; sets dt.")] = None
    device: Device = None
    seed: Seed = None
    assignments: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="NAME=VALUE",
            help="Scene parameter, setting, or property of bodies, joints or force fields; repeatable. "
            "A list NAME=A,B,C sets one value per environment.",
        ),
    ] = None
    compare: Annotated[bool, typer.Option("--compare", help="Simulate one environment per variant of the scene.")] = (
        False
    )
    output: Annotated[str | None, typer.Option("-o", "--output", help="Animation: .usdc, .usda, .usdz or .glb.")] = None
    usd_envs: Annotated[
        str | None, typer.Option(help="Environments in animations and images, such as 0,5,7, or all.")
    ] = None
    usd_profile: Annotated[
        str, typer.Option(help="animation (instances), scene (with physics) or auto (scene for up to 2000 bodies).")
    ] = "auto"
    usd_layout: Annotated[
        str,
        typer.Option(
            help="single (one file), payloads (one file per environment), clips (one file per 24 frames) or override "
            "(a layer over the imported stage that animates its own prims)."
        ),
    ] = "single"
    usd_contacts: Annotated[bool, typer.Option("--usd-contacts", help="Include contact points and impulses.")] = False
    picture: Annotated[str | None, typer.Option(help="Image of the last frame, .png.")] = None
    film: Annotated[str | None, typer.Option(help="Video that ends when the bodies are at rest, .gif or .mp4.")] = None
    contact_sheet: Annotated[str | None, typer.Option(help="Image of eight frames, .png.")] = None
    html: Annotated[str | None, typer.Option(help="Standalone page that plays the animation, .html.")] = None
    camera: Annotated[str | None, typer.Option(help=CAMERA_HELP)] = None
    color: Annotated[str, typer.Option(help="Colour bodies by body, environment, level, speed or asleep.")] = "body"
    checkpoint: Annotated[str | None, typer.Option(help="Checkpoint file. Default: SCENE.ckpt.")] = None
    checkpoint_every: Annotated[int | None, typer.Option(help="Number of frames between checkpoints.")] = None
    resume: Annotated[bool, typer.Option("--resume", help="Resume from the checkpoint if it exists.")] = False
    memory_limit: Annotated[
        str | None,
        typer.Option(help="Limit in bytes, such as 8000000000, or as a fraction of the device memory, such as 0.5."),
    ] = None
    as_json: AsJson = False

    @property
    def written(self) -> list[str]:
        """Paths of the animation and the images."""
        return [path for path in (self.output, self.picture, self.film, self.contact_sheet, self.html) if path]

    @property
    def usd(self) -> UsdOptions:
        """How USD files are written."""
        return UsdOptions(self.usd_profile, self.color, self.usd_layout, self.usd_contacts)

    @property
    def to_usd(self) -> str | None:
        """Path of the USD file."""
        return None if self.output is None or self.output.endswith(".glb") else self.output

    @property
    def overrides(self) -> bool:
        """Whether the USD file is a layer over the imported stage."""
        return self.usd_layout == "override"

    @property
    def streamed(self) -> str | None:
        """Path of the USD file to which frames are written as they are simulated.

        A resumed run writes the whole animation, so a run with checkpoints stores its frames in them.
        """
        return None if self.overrides or self.checkpoint_every is not None or self.resume else self.to_usd

    def check(self) -> None:
        """Check what can be checked without the scene.

        Raises:
            ValueError: An option is out of its range, or does not suit another one.
            OSError: A file cannot be written.
        """
        written = self.written
        if len(set(written)) < len(written):
            raise ValueError(f"{max(written, key=written.count)}: is given for two outputs")
        films = {self.picture: (".png",), self.film: (".gif", ".mp4"), self.contact_sheet: (".png",)}
        check_outputs(self.output, {**films, self.html: (".html",)})
        self.check_unread([self.scene])
        one_of("--color", self.color, COLORINGS)
        usd = self.usd
        if self.to_usd:
            usd.check_path(Path(self.to_usd))
        elif usd != UsdOptions(color=self.color):
            raise ValueError("--usd-profile, --usd-layout, --usd-contacts: require -o with a USD file")
        if self.checkpoint and self.checkpoint_every is None and not self.resume:
            raise ValueError("--checkpoint: requires --checkpoint-every or --resume")

    def check_unread(self, read: Iterable[str]) -> None:
        """Check that no file that is read is overwritten."""
        check_unread([*self.written, self.checkpoint or ""], read)

    def plan(self) -> runner.Plan:
        """The run, with checks of the options that need the scene."""
        plan = runner.plan_run(
            runner.find_scene(self.scene),
            self.assignments or (),
            num_envs=self.envs,
            compare=self.compare,
            frames=self.frames,
            fps=self.fps,
            substeps=self.substeps,
            device=self.device,
            seed=self.seed,
            memory_limit=_memory_limit(self.memory_limit),
            camera=self.camera,
        )
        self.check_unread(plan.scene.import_report.files if plan.scene.import_report else ())
        return plan

    def checkpoints(self, plan: runner.Plan) -> Checkpoints:
        """When and where checkpoints are written."""
        path = Path(self.checkpoint or f"{plan.demo.name}.ckpt")
        if self.checkpoint_every is not None:
            whole_in("--checkpoint-every", self.checkpoint_every, 1, 10**9)
            check_writable(path)
        if self.resume and not path.exists():
            note(f"{path}: no checkpoint found, starting from the beginning")
        return Checkpoints(path, self.checkpoint_every, self.resume)

    def recorded(self, plan: runner.Plan) -> list[int] | None:
        """Environments in animations and images; None for all."""
        chosen = _recorded_envs(self.usd_envs, plan.sim.num_envs) if self.written else []
        if self.overrides and plan.scene.import_report is None:
            raise ValueError(f"--usd-layout: override requires a scene from a USD file, got {self.scene}")
        if self.overrides and (plan.sim.num_envs if chosen is None else len(chosen)) != 1:
            raise ValueError("--usd-envs: must name one environment for --usd-layout override")
        return chosen


@takes(RunOptions)
def run_command(options: RunOptions) -> int:
    """Simulate a scene, evaluate its outcome, and write animations and images.

    Exit status 6: a verdict is not as expected.
    """
    options.check()
    plan = options.plan()
    checkpoints = options.checkpoints(plan)
    chosen = options.recorded(plan)
    for finding in plan.scene.import_report.findings if plan.scene.import_report else ():
        note(str(finding))
    _print_overlap(plan.sim)
    result, failure = _execute(options, plan, chosen, checkpoints)
    if failure is not None and options.written:
        note(f"{failure}; writing the {result.summary['frames']} frames before it")
    if options.to_usd and not options.streamed:
        export_usd(result.recording, options.to_usd, **vars(options.usd))
    elif options.output and not options.to_usd:
        export_gltf(result.recording, options.output)
    _draw(options, result.recording)
    summary = {**result.summary, "files": options.written}
    if options.as_json:
        print(json.dumps(summary))
    else:
        _print_summary(summary)
    if failure is not None:
        raise failure
    return _status(summary["failed"]) or (0 if all(_judged(summary["verdicts"])) else UNEXPECTED)


def _execute(
    options: RunOptions, plan: runner.Plan, chosen: list[int] | None, checkpoints: Checkpoints
) -> tuple[runner.Result, UserCodeError | None]:
    """The result of the run, or up to an error of the user's code, and that error."""
    done, path = 0, options.streamed
    labels = plan.labels if chosen is None else [plan.labels[env] for env in chosen]
    with told_if_interrupted(lambda: _kept(options, checkpoints, done, plan.frames), lambda: done > 0):
        try:
            with (
                progress(plan.demo.name, plan.frames) as advance,
                UsdStream(plan.sim, path, plan.fps, chosen, labels, plan.camera, **vars(options.usd))
                if path
                else nullcontext() as stream,
            ):

                def on_frame(frame: int) -> None:
                    nonlocal done
                    if stream is not None:
                        stream.capture(plan.sim)
                    done = frame
                    advance(frame)

                if path:  # memory stays constant, as nothing is recorded
                    return runner.execute(plan, [], on_frame), None
                velocities, contacts = options.color == "speed", options.usd_contacts
                return runner.execute(plan, chosen, on_frame, checkpoints, velocities, contacts), None
        except UserCodeError as error:
            if error.kept is None or not error.kept.summary["frames"]:
                raise
            return error.kept, error


def _memory_limit(text: str | None) -> int | float | None:
    """Parse bytes, or a fraction if the number has a decimal point; None if not given."""
    if text is None:
        return None
    try:
        return float(text) if "." in text else int(text)
    except ValueError:
        raise ValueError(f"--memory-limit: must be bytes or a fraction such as 0.5, got {text}") from None


def _kept(options: RunOptions, checkpoints: Checkpoints, done: int, total: int) -> str:
    """What a run that was interrupted after some frames has kept, and how to continue it."""
    text = f"after {done} of {total} frames; "
    every = checkpoints.every
    if every is not None and done >= every:
        frame = done - done % every
        return text + f"kept {checkpoints.path} of frame {frame}; to continue: {continued(options.context)}"
    if options.streamed:
        text += f"kept {options.streamed} with {done + 1} frames"
        return f"{text}; to be able to continue, use --checkpoint-every N"
    return text + "nothing was kept; to be able to continue, use --checkpoint-every N"


def _print_overlap(sim: Simulator) -> None:
    """Warn of bodies that start in each other, which move apart by themselves."""
    moving = [[body for body in scene.bodies if body.motion == Motion.DYNAMIC and body.active] for scene in sim.scenes]
    sizes = np.array([min((body.shape.size for body in bodies), default=np.inf) for bodies in moving])
    deepest = sim.penetration()
    if (deepest > START_OVERLAP * sizes[sim.scene_of]).any():
        worst = int(np.argmax(deepest / sizes[sim.scene_of]))
        note(
            f"environment {worst}: warning: bodies overlap by {1e3 * deepest[worst]:.3g} mm at the start and will be "
            "pushed apart; place them apart"
        )


def _recorded_envs(text: str | None, num_envs: int) -> list[int] | None:
    """Environments in animations and images; None for all."""
    if text == "all" or (text is None and num_envs <= MAX_RECORDED):
        return None
    if text is None:
        note(f"recording the first {MAX_RECORDED} environments; use --usd-envs to choose others")
        return list(range(MAX_RECORDED))
    try:
        chosen = [int(part) for part in text.split(",")]
    except ValueError:
        raise ValueError(f"--usd-envs: must be numbers such as 0,5,7 or all, got {text}") from None
    if not all(0 <= env < num_envs for env in chosen) or len(set(chosen)) < len(chosen):
        raise ValueError(f"--usd-envs: must be different numbers from 0 to {num_envs - 1}, got {text}")
    return chosen


def _draw(options: RunOptions, recording: Recording) -> None:
    """Write the requested images, videos and pages."""
    if not any((options.picture, options.film, options.contact_sheet, options.html)):
        return
    from warp_rigid.render.images import save_contact_sheet, save_picture
    from warp_rigid.viewer.film_files import film_to_draw, write_film

    drawn = film_to_draw(recording, options.color, usd=None if options.overrides else options.to_usd)
    for save, path in (
        (save_picture, options.picture),
        (save_contact_sheet, options.contact_sheet),
        (write_film, options.film),
        (write_film, options.html),
    ):
        if path:
            save(drawn, path)


def _print_summary(summary: dict[str, Any]) -> None:
    deepest = max(summary["deepest_penetration"], default=0.0)
    at_end = max(summary["penetration"], default=0.0)
    rate = summary["env_frames_per_second"]
    lines = [
        f"{summary['scene']}: {summary['envs']} environment(s) of {summary['bodies']} bodies, "
        f"{summary['frames']} frames ({summary['time']:.4g} s) on {summary['device']}",
        f"{summary['contacts']} contacts, {summary['levels']} levels; deepest overlap "
        f"{1e3 * deepest:.3g} mm, at the end {1e3 * at_end:.3g} mm",
        f"{rate:.4g} environment frames/s, {summary['envs'] / rate if rate > 0.0 else 0.0:.3g} s/frame "
        f"(setup {summary['setup_seconds']:.2g} s)",
    ]
    lines += [f"{name}: {shown_settings(changes)}" for name, changes in summary["variants"].items()]
    lines += [
        f"environment {record['env']}: {record['status']} since step {record['step']}, body {record['body']}"
        for record in summary["failed"] + summary["out_of_bounds"]
    ]
    lines += [
        f"environment {record['env']}: warning: {record['warning']} since step {record['step']}, body {record['body']}"
        for record in summary["warnings"]
    ]
    say(*lines)
    if summary["verdicts"]:
        console().print(_verdict_table(summary), highlight=False)
        if any(verdict["passed"] is not None for verdict in summary["verdicts"]):
            say(_conclusion(summary["verdicts"]))
    say_written(summary["files"])


def _verdict_table(summary: dict[str, Any]) -> Table:
    """One row per verdict; one column per environment if there are at most MAX_COLUMNS."""
    conditions = any(verdict["limit"] for verdict in summary["verdicts"])
    table = Table("outcome", *(["condition"] if conditions else []), box=None, pad_edge=False)
    few = summary["envs"] <= MAX_COLUMNS
    if few:
        for env, label in enumerate(summary["labels"]):
            table.add_column(label or (f"env {env}" if summary["envs"] > 1 else "measured"))
    else:
        table.add_column("holds in")
        table.add_column("from")
        table.add_column("to")
    for verdict in summary["verdicts"]:
        values, passed, count = verdict["values"], verdict["passed"], len(verdict["values"])
        if few:
            rows = zip(values, passed or [None] * count, verdict["expected"], strict=True)
            cells = [_cell(*row, verdict["unit"]) for row in rows]
        else:
            holds = "" if passed is None else f"[{'green' if all(passed) else 'red'}]{sum(passed)} of {count}[/]"
            ends = [] if isinstance(values[0], bool) else [min(values), max(values)]
            cells = [holds, *(shown_value(value, verdict["unit"]) for value in ends)]
        table.add_row(verdict["name"], *([verdict["limit"]] if conditions else []), *cells)
    return table


def _cell(value: float | bool, passed: bool | None, expected: bool | None, unit: str) -> str:
    answer = {None: "", True: "yes", False: "no"}[passed]
    shown = "" if isinstance(value, bool) else shown_value(value, unit)
    if expected is None:
        return f"{shown} {answer}".strip()
    if passed == expected:
        return f"{shown} [green]{answer}{'' if passed else ', as expected'}[/]".strip()
    return f"{shown} [red]{answer}, NOT AS EXPECTED[/]".strip()


def _judged(verdicts: list[dict[str, Any]]) -> list[bool]:
    """Whether each verdict with an expectation is as expected."""
    return [
        passed == expected
        for verdict in verdicts
        if verdict["passed"] is not None
        for passed, expected in zip(verdict["passed"], verdict["expected"], strict=True)
        if expected is not None
    ]


def _conclusion(verdicts: list[dict[str, Any]]) -> str:
    """Summarise how many verdicts are as expected."""
    judged = _judged(verdicts)
    if not judged:
        found = [passed for verdict in verdicts for passed in verdict["passed"] or []]
        return f"{sum(found)} of {len(found)} verdicts are yes"
    return f"{sum(judged)} of {len(judged)} verdicts as expected"


def _status(failed: list[dict[str, Any]]) -> int:
    if not failed:
        return 0
    first = failed[0]
    note(f"{len(failed)} environment(s) failed, first {first['env']}: {first['status']} since step {first['step']}")
    return CAPACITY if first["status"] == "capacity" else NON_FINITE
