"""Why rates depend on the number of environments, from the rows of `measure` and `run_peer`."""

from collections.abc import Sequence
from typing import Any

from warp_rigid.bench.measure import OURS

ALIKE = 1.1
"""Ratio of costs up to which they count as equal."""
MOVING = 0.05
"""Speed from which a scene counts as still in motion [m/s]."""
BUSY = 0.8
"""Fraction of a core below which other programs took the rest."""


def notes(rows: Sequence[dict[str, Any]]) -> list[str]:
    """Lines on each scene that was run with several numbers of environments.

    Costs are of one environment and frame: processor time on a CPU, wall-clock time on a GPU.
    """
    scenes: dict[str, dict[str, list]] = {}
    for row in rows:
        if "fault" not in row:
            phase = f", {row['phase']}" if "phase" in row else ""
            title = f"{row['scene']}:{row['bodies']}, {row['substeps']} steps{phase}"
            scenes.setdefault(title, {}).setdefault(row["engine"], []).append(row)
    found = [line for title, engines in scenes.items() for line in _lines(title, engines)]
    head = ["Cost of one environment and frame, as the number of environments grows:"] if found else []
    return [*head, *found, *_waiting(rows)]


def _lines(title: str, engines: dict[str, list]) -> list[str]:
    """How the cost of a scene changes from the fewest to the most environments, a line for each engine, and why."""
    if len(engines.get(OURS, ())) < 2:
        return []
    found = []
    for name, own in engines.items():
        few, many = min(own, key=lambda row: row["envs"]), max(own, key=lambda row: row["envs"])
        line = f"  {title}, {few['envs']} to {many['envs']}: {name} {duration(_cost(few))} to {duration(_cost(many))}"
        if "ratio" in few and "ratio" in many:
            line += f", ratio {few['ratio']:.2g} to {many['ratio']:.2g}"
        reasons = _reasons(few, many, max(engines[OURS], key=lambda row: row["envs"]))
        found.append(line + (f": {', '.join(reasons)}" if reasons else ""))
    return found


def _reasons(few: dict[str, Any], many: dict[str, Any], ours: dict[str, Any]) -> list[str]:
    """Why an environment costs more or less among many than among few; `ours` is the row of our own with the most."""
    if few["envs"] == many["envs"]:
        return []
    if _cost(few) > ALIKE * _cost(many):
        before, after = few["envs"] * _cost(few), many["envs"] * _cost(many)
        shared = min(before, before - few["envs"] * (after - before) / (many["envs"] - few["envs"]))
        what = ", as the launches of the stages" if few["engine"] == OURS else ""
        return [f"{duration(shared)} of a frame are the same for any number of environments{what}"]
    if _cost(many) <= ALIKE * _cost(few):
        return []
    found = []
    each = [seconds / many["frames"] for seconds in many.get("environment_seconds", ())]
    if each and max(each) > ALIKE * min(each):
        found.append(f"an environment takes {duration(min(each))} to {duration(max(each))} by its start")
    for name in ("contacts", "pairs"):
        amounts = [row.get(name, 0) / row["envs"] for row in (few, many)]
        if amounts[1] > ALIKE * amounts[0]:
            found.append(f"{name} of an environment: {amounts[0]:.3g} to {amounts[1]:.3g}")
    least, most = ours["pairs_of_environments"]
    if least < most:
        found.append(f"{least} to {most} pairs of an environment are close to each other")
    speed = many["quality"]["max_speed"]
    if speed is not None and speed > MOVING:
        found.append(f"bodies still move at up to {speed:.2g} m/s")
    return found


def _waiting(rows: Sequence[dict[str, Any]]) -> list[str]:
    """A line if other programs took the processor, which frames/s feel as wall-clock time."""
    timed = [row for row in rows if "fault" not in row and "cuda" not in row["device"]]
    least = min((row["processor_seconds"] / row["seconds"] for row in timed), default=1.0)
    if least >= BUSY:
        return []
    return [f"Other programs left as little as {least:.2g} of a core: frames/s include the waiting, per core does not."]


def _cost(row: dict[str, Any]) -> float:
    """Time of an environment and frame [s]."""
    seconds = row["seconds"] if "cuda" in row["device"] else row["processor_seconds"]
    return float(seconds) / (row["envs"] * row["frames"])


def duration(seconds: float) -> str:
    """Three significant digits with a unit."""
    for size, unit in ((1.0, "s"), (1e-3, "ms")):
        if seconds >= size:
            return f"{seconds / size:.3g} {unit}"
    return f"{1e6 * seconds:.3g} µs"
