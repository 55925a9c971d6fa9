"""The tables of the roofline: of one scene, for the terminal, and of all scenes, for docs/roofline_table.md."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from warp_rigid.engine.stage_times import STAGES

if TYPE_CHECKING:
    from benchmarks.roofline import Found

MARKS = {"memory": "", "launches": "*", "arithmetic": "†"}
"""What sets a floor."""


def markdown(found: "Found") -> str:
    """One scene as a heading, a line of counts and a table."""
    c, lines = found.counts, []
    total, floor = sum(found.measured.values()), sum(seconds for seconds, _ in found.floors.values())
    lines += [
        f"## {_title(found)}",
        "",
        f"{found.device}, commit {found.commit or 'unknown'}. {c.pairs:,} pairs, {c.searched:,} of them searched again "
        f"({c.clusters:,} clusters, {c.samples:,} samples, {c.near + c.close:,} distances); {c.touching:,} touch, in "
        f"{c.contacts:,} contacts and up to {c.levels} levels; {c.sweeps / max(c.contacts, 1):.1f} solver "
        f"sweeps per contact, {c.unsettled / max(c.contacts, 1):.0%} of the contacts need shock propagation. The "
        f"simulator's arrays fill {found.working_set / 1e6:,.0f} MB; solver sweeps visit {_visits(found) / 1e9:.3g} G "
        "contacts/s.",
        "",
        "stage | launches | MB | Mflop | floor [µs] | set by | measured [µs]",
        " | ".join(["---"] * 7),
    ]
    for stage, taken in found.measured.items():
        work, (least, by) = found.work[stage], found.floors[stage]
        if work.launches:
            cells = [stage, work.launches, _short((work.read + work.written) / 1e6)]
            cells += [_short((work.single + work.double) / 1e6), _short(1e6 * least), by, _short(1e6 * taken)]
            lines.append(" | ".join(map(str, cells)))
    lines.append(f"all | | | | {_short(1e6 * floor)} | | {_short(1e6 * total)}")
    return "\n".join(lines) + "\n"


def _short(number: float) -> str:
    """A number with three digits."""
    return f"{number:,.0f}" if number >= 100.0 else f"{number:.3g}"


def page(scenes: list["Found"]) -> str:
    """The page of all scenes: one table of times and one of counts, with a column for each scene."""
    note = (
        "Written by `python -m benchmarks.roofline --write docs/roofline_table.md`, which also prints launches, bytes "
        f"and operations; [explanation](roofline.md). {scenes[0].device}, commit {scenes[0].commit or 'unknown'}.\n"
    )
    times = (
        "## Floor/measured time of a step [µs]\n\nThe floor is set by memory, by launches (*) or by arithmetic (†).\n"
    )
    return "\n".join(["# Roofline: all results\n", note, times, _times(scenes), "\n## Work of a step\n", _work(scenes)])


def _times(scenes: list["Found"]) -> str:
    """Floor and time of each stage that some scene launches, and of all."""
    lines = []
    for stage in STAGES:
        cells = [_time(found, stage) for found in scenes]
        if set(cells) != {"–"}:
            lines.append([stage, *cells])
    totals = [(sum(floor for floor, _ in found.floors.values()), sum(found.measured.values())) for found in scenes]
    lines.append(["all", *(f"{_short(1e6 * floor)}/{_short(1e6 * total)}" for floor, total in totals)])
    return _table(["stage", *map(_title, scenes)], lines)


def _time(found: "Found", stage: str) -> str:
    """A cell of the table of times; a dash for a stage that a scene does not launch."""
    if stage not in found.work or not found.work[stage].launches:
        return "–"
    floor, by = found.floors[stage]
    return f"{_short(1e6 * floor)}{MARKS[by]}/{_short(1e6 * found.measured[stage])}"


def _work(scenes: list["Found"]) -> str:
    """What is counted in the arrays and in the narrow phase."""
    rows: dict[str, Callable[[Found], Any]] = {
        "pairs": lambda found: f"{found.counts.pairs:,}",
        "searched again": lambda found: f"{found.counts.searched:,}",
        "clusters": lambda found: f"{found.counts.clusters:,}",
        "samples": lambda found: f"{found.counts.samples:,}",
        "distances": lambda found: f"{found.counts.near + found.counts.close:,}",
        "touching": lambda found: f"{found.counts.touching:,}",
        "contacts": lambda found: f"{found.counts.contacts:,}",
        "levels": lambda found: found.counts.levels,
        "sweeps per contact": lambda found: f"{found.counts.sweeps / max(found.counts.contacts, 1):.1f}",
        "need shock propagation": lambda found: f"{found.counts.unsettled / max(found.counts.contacts, 1):.0%}",
        "arrays [MB]": lambda found: f"{found.working_set / 1e6:,.0f}",
        "G contacts/s": lambda found: f"{_visits(found) / 1e9:.3g}",
    }
    return _table(["number", *map(_title, scenes)], [[name, *map(cell, scenes)] for name, cell in rows.items()]) + "\n"


def _visits(found: "Found") -> float:
    """Contacts that the solver visits in a second."""
    return (found.counts.contacts + found.counts.sweeps) / max(found.measured["solve_contacts"], 1e-12)


def _title(found: "Found") -> str:
    """The scene, the number of environments and the time at which the work is counted."""
    scene, _, seconds = found.scene.partition("@")
    return f"{scene.rpartition(':')[0]} × {found.counts.envs}" + (f", {seconds} s" if seconds else "")


def _table(columns: list[str], rows: list[list[Any]]) -> str:
    """A table in Markdown."""
    lines = [columns, ["---"] * len(columns), *rows]
    return "\n".join(" | ".join(map(str, line)) for line in lines)
