"""`warp-rigid bench`: throughput and solution quality of scenes at several batch sizes, optionally of other engines."""

import itertools
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.markup import escape
from rich.table import Table

from warp_rigid.bench import measure, peers
from warp_rigid.bench.cases import STANDARD, find_case
from warp_rigid.bench.chart import save_chart
from warp_rigid.bench.measure import UNTIL, Conditions, measure_phases
from warp_rigid.bench.notes import duration, notes
from warp_rigid.bench.startup import start_up
from warp_rigid.commands.options import AsJson, Device, takes
from warp_rigid.commands.terminal import check_outputs, check_writable, console, note, say, say_written
from warp_rigid.engine.simulator import choose_device
from warp_rigid.progress_bar import progress


@dataclass(frozen=True)
class BenchOptions:
    """Options of `warp-rigid bench`."""

    scenes: Annotated[
        list[str] | None,
        typer.Argument(
            help="NAME:BODIES with the name stack, pile_box, pile_torus, pile_bunny, rings, pyramid, kapla or arm; a "
            f"built-in scene; or a .py file with a function scene(). Default: {', '.join(STANDARD)}."
        ),
    ] = None
    envs: Annotated[str, typer.Option(help="Numbers of environments, such as 1024,4096.")] = "1"
    substeps: Annotated[str, typer.Option(help="Numbers of time steps per frame of 1/60 s, such as 1,4.")] = "4"
    frames: Annotated[int | None, typer.Option(help="Number of timed frames. Default: 60.")] = None
    settle: Annotated[int | None, typer.Option(help="Number of untimed frames before them. Default: 120.")] = None
    phases: Annotated[
        bool, typer.Option("--phases", help="Time the first and the second second, and a second at rest.")
    ] = False
    until: Annotated[
        float | None, typer.Option(help="With --phases: latest start of the last second, in seconds. Default: 10.")
    ] = None
    sleeping: Annotated[bool, typer.Option("--sleeping", help="Enable sleeping.")] = False
    device: Device = None
    json_lines: Annotated[str | None, typer.Option(help="Append one JSON line per run to this file.")] = None
    output: Annotated[str | None, typer.Option("-o", "--output", help="Plot of all runs, .png.")] = None
    peers: Annotated[
        str | None,
        typer.Option(help="Engines to compare with: newton_steel, newton_xpbd, mujoco_warp, mujoco, rapier, pybullet."),
    ] = None
    peer_python: Annotated[
        list[str] | None, typer.Option(help="Python interpreter of an engine, as name=path; repeatable.")
    ] = None
    cold: Annotated[bool, typer.Option("--cold", help="Also time the first frame in a new process.")] = False
    as_json: AsJson = False

    def check(self) -> None:
        """Check the times, and that the files can be written.

        Raises:
            ValueError: A time is out of its range, or options cannot be combined.
        """
        times = (("--frames", self.frames, 1), ("--settle", self.settle, 0), ("--until", self.until, 2))
        for name, value, least in times:
            if value is not None and not least <= value <= 1e6:
                raise ValueError(f"{name}: must be from {least} to 1000000, got {value:g}")
        others = (self.frames, self.settle, self.peers, self.output)
        if self.phases and any(option is not None for option in others):
            raise ValueError("--phases: cannot be combined with --frames, --settle, --peers and --output")
        if self.until is not None and not self.phases:
            raise ValueError("--until: needs --phases")
        check_outputs(None, {self.output: (".png",)})
        if self.json_lines:
            check_writable(self.json_lines)

    def runs(self, cases: Sequence[Any]) -> list[tuple[Any, Conditions]]:
        """Each case with each number of steps and environments."""
        sizes, steps = _numbers("--envs", self.envs), _numbers("--substeps", self.substeps)
        settle = 120 if self.settle is None else self.settle
        return [
            (case, Conditions(size, substep, settle, self.frames or 60, self.sleeping))
            for case, substep, size in itertools.product(cases, steps, sizes)
        ]


@takes(BenchOptions)
def bench_command(options: BenchOptions) -> int:
    """Measure scenes: environment frames/s, body steps/s, time per stage, contacts, capacity used, solution quality.

    Other engines simulate the same initial states for the same number of frames.
    The overlap of their final states is measured with the same code.
    On the CPU this engine uses all cores and the others one; ratios compare processor time.

    With several numbers of environments it reports why the cost per environment changes.

    With --phases each scene runs from its start until it rests: moving bodies cost more than resting ones.
    """
    cases = [find_case(text) for text in options.scenes or STANDARD]
    runs = options.runs(cases)
    options.check()
    chosen = peers.choose_peers(options.peers, options.peer_python)
    found = choose_device(options.device)
    machine = measure.surroundings(found)
    rows: list[dict[str, Any]] = []
    faults: set[str] = set()
    started = {str(case): start_up(str(case), str(found)) for case in cases} if options.cold else {}
    with progress("bench", len(runs) * (1 + len(chosen))) as advance:
        for case, conditions in runs:
            if options.phases:
                done = [{**machine, **row} for row in measure_phases(case, conditions, found, options.until or UNTIL)]
            else:
                done = [{**machine, **row} for row in _engines(case, conditions, found, chosen)]
                measure.compare(done)
            _report({f"{row['engine']}: {case}: {row['fault']}" for row in done if "fault" in row}, faults)
            if options.json_lines:  # at once, so that an interrupted benchmark keeps its measurements
                Path(options.json_lines).parent.mkdir(parents=True, exist_ok=True)
                with open(options.json_lines, "a") as file:
                    file.writelines(json.dumps(row) + "\n" for row in done)
            rows += done
            advance(len(rows))
    if options.output:
        save_chart(rows, options.output)
    files = [path for path in (options.json_lines, options.output) if path]
    if options.as_json:
        print(json.dumps({"rows": rows, "start_up": started, "files": files}))
    else:
        _print(rows, started, files, options.phases)
    return 0


def _numbers(name: str, text: str) -> list[int]:
    parts = text.split(",")
    if not all(part.isdigit() and int(part) > 0 for part in parts):
        raise ValueError(f"{name}: must be whole numbers >= 1 such as 1,4, got {text!r}")
    return [int(part) for part in parts]


def _engines(case: Any, conditions: Any, device: Any, chosen: dict[str, str]) -> Iterator[dict[str, Any]]:
    """Rows of this engine and of the others; the simulator is released before the next run allocates memory."""
    row, sim = measure.measure(case, conditions, device)
    yield row
    for name, python in chosen.items():
        yield peers.run_peer(name, python, case, conditions, sim)


def _report(found: set[str], reported: set[str]) -> None:
    """Print each fault of an engine once, for all numbers of environments."""
    for text in sorted(found - reported):
        note(text)
    reported |= found


ENGINES = (
    ("scene", "envs", "steps", "engine", "frames/s", "per core", "body steps/s", "contacts", "used", "overlap")
    + ("error", "lost", "m/s", "ratio"),
    "steps: of a frame of 1/60 s; frames/s: all environments; per core: per second of processor time; contacts: of all "
    "environments at the end; used: largest used share of a buffer; overlap: deepest overlap at the end [mm], measured "
    "independently of contacts; error: maximum error of stack height, or gap of a joint [mm]; lost: escaped bodies; "
    "m/s: largest speed at the end; ratio: speed of warp_rigid over that engine",
)
"""Columns of the table of engines, and their explanation."""
PHASES = (
    ("scene", "envs", "steps", "phase", "frames/s", "per core", "contacts", "used", "overlap", "at end", "median")
    + ("error", "lost", "m/s"),
    "steps: of a frame of 1/60 s; frames/s: all environments; per core: per second of processor time; contacts: of all "
    "environments at the end; used: largest used share of a buffer; overlap: deepest overlap during the phase and at "
    "its end, and the median over environments at its end [mm], measured independently of contacts; error: maximum "
    "error of stack height, or gap of a joint [mm]; lost: escaped bodies; m/s: largest speed at the end",
)
"""The same of the table of phases."""


def _print(rows: list[dict[str, Any]], started: dict[str, Any], files: list[str], phases: bool) -> None:
    out = console()
    names, explanation = PHASES if phases else ENGINES
    table = Table(box=None, pad_edge=False, padding=(0, 1, 0, 0))
    for name in names:
        table.add_column(name, no_wrap=True, justify="left" if name in ("scene", "engine", "phase") else "right")
    for row in rows:
        if "fault" not in row:
            cells = _cells(row)
            table.add_row(*(escape(cells[name]) for name in names))
    out.print(table, highlight=False)
    out.print(explanation, style="dim", markup=False, highlight=False)
    say(*notes(rows), *(_rest(row) for row in rows if "rest" in row))
    say(*(_stages(row) for row in rows if "stage_seconds" in row))
    for case, cost in started.items():
        costs = ", ".join(
            f"{k} {v['seconds']:.2f} s ({v['processor_seconds']:.2f} s processor time)" for k, v in cost.items()
        )
        say(f"first frame of {case}: {costs}, {cost['warm']['modules']} modules")
    say_written(files)


def _cells(row: dict[str, Any]) -> dict[str, str]:
    """Cells of a row by the name of their column."""
    judged = row["quality"]
    used = max(row.get(name, 0.0) for name in ("pair_capacity_used", "contact_capacity_used"))
    return {
        "scene": f"{row['scene']}:{row['bodies']}",
        "envs": str(row["envs"]),
        "steps": str(row["substeps"]),
        "engine": row["engine"],
        "phase": row.get("phase", ""),
        "frames/s": _short(row["env_frames_per_second"]),
        "per core": "" if "cuda" in row["device"] else _short(row["env_frames_per_processor_second"]),
        "body steps/s": _short(row["body_steps_per_second"]),
        "contacts": str(row.get("contacts", "")),
        "used": f"{used:.0%}" if used else "",
        "overlap": _millimetres(judged.get("deepest_overlap_during", judged["deepest_overlap"])),
        "at end": _millimetres(judged["deepest_overlap"]),
        "median": _millimetres(judged["median_overlap"]),
        "error": _millimetres(judged.get("height_error", judged.get("joint_error"))),
        "lost": str(judged["escaped"]),
        "m/s": "" if judged["max_speed"] is None else f"{judged['max_speed']:.0e}",
        "ratio": f"{row['ratio']:.3g}" if "ratio" in row else "",
    }


def _rest(row: dict[str, Any]) -> str:
    """When a scene came to rest."""
    rest, name = row["rest"], _title(row)
    if rest["rest_time"] is None:
        half = rest["median_rest_time"]
        some = f", half of them after {half:.1f} s" if half is not None else ""
        return f"{name}: {rest['resting_envs']} of {row['envs']} environments at rest at the end{some}"
    when = f"{rest['rest_time']:.1f} s after the start, simulated in {rest['rest_seconds']:.3g} s"
    half = "" if row["envs"] == 1 else f"; half of the environments after {rest['median_rest_time']:.1f} s"
    return f"{name}: at rest {when}{half}"


def _short(number: float) -> str:
    """Format to three significant digits, with k or M for thousands and millions."""
    for size, letter in ((1e6, "M"), (1e3, "k")):
        if number >= size:
            return f"{number / size:.3g}{letter}"
    return f"{number:.3g}"


def _millimetres(length: float | None) -> str:
    return "" if length is None else f"{1e3 * length:.3g}"


def _stages(row: dict[str, Any]) -> str:
    total = sum(row["stage_seconds"].values())
    largest = sorted(row["stage_seconds"].items(), key=lambda item: -item[1])
    parts = ", ".join(f"{name} {seconds / total:.0%}" for name, seconds in largest if seconds >= 0.02 * total)
    phase = f", {row['phase']}" if "phase" in row else ""
    return f"{_title(row)}{phase}, {row['levels']} levels: {duration(total)}/step: {parts}"


def _title(row: dict[str, Any]) -> str:
    return f"{row['scene']}:{row['bodies']} × {row['envs']}, {row['substeps']} steps"
