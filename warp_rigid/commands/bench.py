"""`warp-rigid bench`: throughput and solution quality of scenes at several batch sizes, optionally of other engines."""

import itertools
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.markup import escape
from rich.table import Table

from warp_rigid.bench.cases import STANDARD, find_case
from warp_rigid.commands.terminal import check_outputs, check_writable, console, note, progress
from warp_rigid.engine.simulator import choose_device


def bench_command(
    scenes: Annotated[
        list[str] | None,
        typer.Argument(
            help="Scenes with their number of bodies: stack, pile_box, pile_torus, pile_bunny, rings. "
            f"[{', '.join(STANDARD)}]"
        ),
    ] = None,
    envs: Annotated[str, typer.Option(help="Numbers of environments, such as 1024,4096.")] = "1",
    substeps: Annotated[str, typer.Option(help="Numbers of steps per frame of 1/60 s, such as 1,4.")] = "4",
    frames: Annotated[int, typer.Option(help="Number of timed frames.")] = 60,
    settle: Annotated[int, typer.Option(help="Number of untimed frames before them.")] = 120,
    sleeping: Annotated[bool, typer.Option("--sleeping", help="Enable sleeping.")] = False,
    device: Annotated[str | None, typer.Option(help="Device, such as cpu or cuda:0.")] = None,
    json_lines: Annotated[str | None, typer.Option(help="Append one JSON line per run to this file.")] = None,
    output: Annotated[str | None, typer.Option("-o", "--output", help="Plot of all runs, .png.")] = None,
    peers: Annotated[
        str | None, typer.Option(help="Engines to compare with: newton, mujoco_warp, mujoco, rapier, pybullet.")
    ] = None,
    peer_python: Annotated[
        list[str] | None, typer.Option(help="Python interpreter of an engine, as name=path; repeatable.")
    ] = None,
    cold: Annotated[bool, typer.Option("--cold", help="Also time the first frame in a new process.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> int:
    """Measure scenes: environment frames/s, body steps/s, time per stage, contacts, capacity used, solution quality.

    Sleeping is off by default. The settling frames are not timed. Other engines simulate the same initial states for
    the same number of frames, and the penetration of their final states is measured with the same code. On the CPU
    this engine uses all cores and the others one; ratios there compare processor time summed over cores.
    """
    from warp_rigid.bench import measure
    from warp_rigid.bench import peers as other

    cases = [find_case(text) for text in scenes or STANDARD]
    sizes, steps = _numbers("--envs", envs), _numbers("--substeps", substeps)
    for name, value, least in (("--frames", frames, 1), ("--settle", settle, 0)):
        if value < least:
            raise ValueError(f"{name}: must be >= {least}, got {value}")
    chosen = other.choose_peers(peers, peer_python)
    check_outputs(None, {output: (".png",)} if output else {})
    if json_lines:
        check_writable(json_lines)
    found = choose_device(device)
    machine = measure.surroundings(found)
    rows: list[dict[str, Any]] = []
    started = {str(case): _start_up(str(case), str(found)) for case in cases} if cold else {}
    runs = [
        (case, measure.Conditions(size, substep, settle, frames, sleeping))
        for case, substep, size in itertools.product(cases, steps, sizes)
    ]
    with progress("bench", len(runs) * (1 + len(chosen))) as advance:
        for case, conditions in runs:
            done = [{**machine, **row} for row in _engines(case, conditions, found, chosen)]
            measure.compare(done)
            _append(done, json_lines)
            rows += done
            advance(len(rows))
    if output:
        _draw(rows, output)
    files = [path for path in (json_lines, output) if path]
    if as_json:
        print(json.dumps({"rows": rows, "start_up": started, "files": files}))
        return 0
    _print(rows, started, files)
    return 0


def _numbers(name: str, text: str) -> list[int]:
    parts = text.split(",")
    if not all(part.isdigit() and int(part) > 0 for part in parts):
        raise ValueError(f"{name}: must be whole numbers >= 1 such as 1,4, got {text!r}")
    return [int(part) for part in parts]


def _start_up(case: str, device: str) -> dict[str, Any]:
    from warp_rigid.bench.startup import start_up

    return start_up(case, device)


def _engines(case: Any, conditions: Any, device: Any, chosen: dict[str, str]) -> Iterator[dict[str, Any]]:
    """Rows of this engine and of the others; the simulator is released before the next run allocates memory."""
    from warp_rigid.bench import measure
    from warp_rigid.bench import peers as other

    row, sim = measure.measure(case, conditions, device)
    yield row
    for name, python in chosen.items():
        row = other.run_peer(name, python, case, conditions, sim)
        if "fault" in row:
            note(f"{name}: {case}: {row['fault']}")
        yield row


def _append(rows: list[dict[str, Any]], json_lines: str | None) -> None:
    """Append the rows immediately, so that an interrupted benchmark keeps its measurements."""
    if json_lines:
        Path(json_lines).parent.mkdir(parents=True, exist_ok=True)
        with open(json_lines, "a") as file:
            file.writelines(json.dumps(row) + "\n" for row in rows)


def _draw(rows: list[dict[str, Any]], output: str) -> None:
    from warp_rigid.bench.chart import save_chart

    Path(output).parent.mkdir(parents=True, exist_ok=True)
    save_chart(rows, output)


def _print(rows: list[dict[str, Any]], started: dict[str, Any], files: list[str]) -> None:
    out = console()
    names = ("scene", "envs", "steps", "engine", "frames/s", "per core", "body steps/s", "contacts", "used")
    table = Table(box=None, pad_edge=False, padding=(0, 1, 0, 0))
    for name in (*names, "overlap", "error", "lost", "m/s", "ratio"):
        table.add_column(name, no_wrap=True, justify="left" if name in ("scene", "engine") else "right")
    for row in rows:
        if "fault" not in row:
            table.add_row(*(escape(cell) for cell in _cells(row)))
    out.print(table, highlight=False)
    out.print(
        "frames/s: all environments; per core: per second of processor time; used: largest used share of a "
        "buffer; overlap: maximum penetration [mm]; error: maximum error of stack height [mm]; lost: escaped bodies; "
        "ratio: speed of warp_rigid over that engine",
        style="dim",
        markup=False,
        highlight=False,
    )
    for row in rows:
        if "stage_seconds" in row:
            out.print(_stages(row), highlight=False, markup=False)
    for case, cost in started.items():
        costs = ", ".join(
            f"{k} {v['seconds']:.2f} s ({v['processor_seconds']:.2f} s processor time)" for k, v in cost.items()
        )
        out.print(f"first frame of {case}: {costs}, {cost['warm']['modules']} modules", highlight=False, markup=False)
    for path in files:
        out.print(f"wrote {path}", highlight=False, markup=False)


def _cells(row: dict[str, Any]) -> list[str]:
    judged = row["quality"]
    used = max(row.get(name, 0.0) for name in ("pair_capacity_used", "contact_capacity_used"))
    return [
        f"{row['scene']}:{row['bodies']}",
        str(row["envs"]),
        str(row["substeps"]),
        row["engine"],
        _short(row["env_frames_per_second"]),
        "" if "cuda" in row["device"] else _short(row["env_frames_per_processor_second"]),
        _short(row["body_steps_per_second"]),
        str(row.get("contacts", "")),
        f"{used:.0%}" if used else "",
        _millimetres(judged["deepest_overlap"]),
        _millimetres(judged.get("height_error")),
        str(judged["escaped"]),
        "" if judged["max_speed"] is None else f"{judged['max_speed']:.0e}",
        f"{row['ratio']:.3g}" if "ratio" in row else "",
    ]


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
    case = f"{row['scene']}:{row['bodies']} × {row['envs']}, {row['substeps']} steps"
    return f"{case}, {row['levels']} levels: {1e6 * total:.4g} µs/step: {parts}"
