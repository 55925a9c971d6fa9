"""A table of shock propagation and its alternatives on structures where their results differ."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from warp_rigid.scenes.builders import stacks
from warp_rigid.scenes.builders.scene_parts import on_ground
from warp_rigid.validation.case import AT_LEAST, Check, at_most, measured
from warp_rigid.validation.experiment import DT, Experiment
from warp_rigid.validation.towers import HALF, falling_piles, farthest, leaning, pyramid_scene, stack_scene

SCHEMES: dict[str, dict[str, Any]] = {
    "two_pass (default)": {},
    "two_pass, 4 sweeps": {"contact_iterations": 4},
    "two_pass, 3 shock iterations": {"shock_iterations": 3},
    "two_pass, cold": {"warm_starting": False},
    "two_pass, dt 1/60": {"dt": 1 / 60},
    "one_pass, cold (2003)": {"shock_propagation": "one_pass", "warm_starting": False},
    "one_pass": {"shock_propagation": "one_pass"},
    "off, cold": {"shock_propagation": "off", "warm_starting": False},
    "off": {"shock_propagation": "off"},
    "off, 50 sweeps": {"shock_propagation": "off", "contact_iterations": 50},
    "off, dt 1/960": {"shock_propagation": "off", "dt": 1 / 960},
}
"""Differences from the default settings, and the time step."""


Structure = tuple[Experiment, Check]
"""A simulation, and the check of its decisive figure, whose quantity is the heading of its column."""


def structures(quick: bool) -> list[Structure]:
    """The compared structures; smaller and shorter if quick."""
    duration = 2.0 if quick else 5.0
    tall, layers, count = (20, 8, 20) if quick else (50, 20, 40)

    def end_speed(trace):
        return trace.speed[trace.time > trace.time[-1] - 0.5].max(axis=0)

    def still(name, scene, limit=1e-4):
        return Experiment(scene, duration), measured(name, "m", farthest, at_most(limit))

    pile = falling_piles(2.0 * duration, count).experiments[0]
    one_pile = replace(pile, variants=("",), starts=(replace(pile.starts[0], value=pile.starts[0].value[:1]),))
    heavy = on_ground(partial(stacks.add_stack, count=4, masses=[8.0, 8.0, 8.0, 8000.0]))
    fall = measured("leans 0.15 w", "m", lambda t: t.displacement[-1], AT_LEAST, HALF)
    return [
        still("10 high", partial(stack_scene, 10)),
        still(f"{tall} high", partial(stack_scene, tall)),
        (leaning([0.15], ["default"], duration), fall),
        (leaning([0.08], ["default"], duration), measured("leans 0.08 w", "m", farthest, at_most(1e-4))),
        still("1000 : 1 on three", heavy, 5e-4),
        still(f"pyramid, {layers} rows", partial(pyramid_scene, layers)),
        (one_pile, measured(f"pile of {count}, speed", "m/s", end_speed, at_most(0.01))),
    ]


@dataclass(frozen=True)
class Cell:
    """A scheme on a structure.

    Attributes:
        value: the structure's figure; NaN if the state did not stay finite.
        right: whether it is correct.
        milliseconds: wall-clock time per 1/240 s of simulated time.
    """

    value: float
    right: bool
    milliseconds: float


def compare(device: str, quick: bool, on_cell: Callable[[], None] | None = None) -> dict[str, dict[str, Cell]]:
    """Run every scheme on every structure, one at a time, so that each is timed separately.

    Returns:
        For each scheme and structure by name, its cell.
    """
    made = structures(quick)
    return {
        name: {check.quantity: _cell(experiment, check, scheme, device, on_cell) for experiment, check in made}
        for name, scheme in SCHEMES.items()
    }


def _cell(experiment: Experiment, check: Check, scheme: dict[str, Any], device: str, on_cell) -> Cell:
    dt = scheme.get("dt", DT)
    settings = {name: value for name, value in scheme.items() if name != "dt"}
    # The scheme applies to the whole batch; settings of single environments must not override it.
    starts = tuple(start for start in experiment.starts if start.name in ("position", "orientation"))
    every = max(1, round(0.05 / dt))
    trace = replace(experiment, settings=settings, starts=starts, dt=dt, every=every).run(device)
    if on_cell:
        on_cell()
    value = np.asarray(check.measure((trace,)), np.float64)
    right = (check.tolerance.error(value, np.asarray(check.reference)) <= check.tolerance.limit).all()
    return Cell(float(value[0]), bool(right), 1e3 * trace.seconds * DT / trace.time[-1])


def rows(table: dict[str, dict[str, Cell]], quick: bool) -> list[list[str]]:
    """The heading and a row for each scheme: its figure on each structure, and its time in brackets."""
    made = structures(quick)
    heading = ["scheme", *(check.quantity for _, check in made), "right"]
    found = []
    for scheme, cells in table.items():
        texts = [_text(check, cells[check.quantity]) for _, check in made]
        found.append([scheme, *texts, f"{sum(cell.right for cell in cells.values())} of {len(made)}"])
    return [heading, *found]


def _text(check: Check, cell: Cell) -> str:
    """Text of a cell."""
    if check.tolerance is AT_LEAST:
        words = "falls" if cell.right else "STANDS"
    elif check.unit == "m" and cell.value > HALF:
        words = "COLLAPSES"
    elif check.unit == "m":
        words = f"{1e3 * cell.value:.2g} mm{'' if cell.right else ' !'}"
    else:
        words = f"{cell.value:.2g} {check.unit}{'' if cell.right else ' !'}"
    return f"{words} [{cell.milliseconds:.2g}]"
