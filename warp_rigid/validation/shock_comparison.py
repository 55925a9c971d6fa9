"""A table of shock propagation and its alternatives on structures where their results differ."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from warp_rigid.scenes.builders import stacks
from warp_rigid.scenes.builders.grounds import level_scene
from warp_rigid.validation.experiment import DT, Experiment, Trace
from warp_rigid.validation.towers import HALF, falling_piles, leaning, pyramid_scene, stack_scene

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


@dataclass(frozen=True)
class Structure:
    """A structure and its correct behaviour.

    Attributes:
        name: heading of its column.
        experiment: its simulation.
        measure: function(trace) -> the decisive figure.
        unit: of the figure.
        limit: largest correct figure.
        must_fall: whether a figure is correct only above the limit instead.
    """

    name: str
    experiment: Experiment
    measure: Callable[[Trace], float]
    unit: str
    limit: float
    must_fall: bool = False

    def right(self, value: float) -> bool:
        """Whether a figure is correct."""
        return bool(value > self.limit) if self.must_fall else bool(value <= self.limit)


def structures(quick: bool) -> list[Structure]:
    """The compared structures; smaller and shorter if quick."""
    duration = 2.0 if quick else 5.0
    tall, layers, count = (20, 8, 20) if quick else (50, 20, 40)

    def displaced(trace):
        return float(trace.displacement.max())

    def end_speed(trace):
        late = trace.time > trace.time[-1] - 0.5
        return float(trace.speed[late].max())

    def fall(trace):
        return float(trace.displacement[-1].max())

    def three():
        scene = level_scene()
        stacks.add_stack(scene, 4, masses=[8.0, 8.0, 8.0, 8000.0])
        return scene

    pile = falling_piles(2.0 * duration, count).experiments[0]
    one_pile = replace(pile, variants=("",), starts=(replace(pile.starts[0], value=pile.starts[0].value[:1]),))
    return [
        Structure("10 high", Experiment(lambda: stack_scene(10), duration), displaced, "m", 1e-4),
        Structure(f"{tall} high", Experiment(lambda: stack_scene(tall), duration), displaced, "m", 1e-4),
        Structure("leans 0.15 w", leaning([0.15], ["default"], duration), fall, "m", HALF, must_fall=True),
        Structure("leans 0.08 w", leaning([0.08], ["default"], duration), displaced, "m", 1e-4),
        Structure("1000 : 1 on three", Experiment(three, duration), displaced, "m", 5e-4),
        Structure(f"pyramid, {layers} rows", Experiment(lambda: pyramid_scene(layers), duration), displaced, "m", 1e-4),
        Structure(f"pile of {count}, speed", one_pile, end_speed, "m/s", 0.01),
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
    return {name: {one.name: _cell(one, scheme, device, on_cell) for one in made} for name, scheme in SCHEMES.items()}


def _cell(structure: Structure, scheme: dict[str, Any], device: str, on_cell) -> Cell:
    dt = scheme.get("dt", DT)
    settings = {name: value for name, value in scheme.items() if name != "dt"}
    # The scheme applies to the whole batch; settings of single environments must not override it.
    starts = tuple(start for start in structure.experiment.starts if start.name in ("position", "orientation"))
    every = max(1, round(0.05 / dt))
    trace = replace(structure.experiment, settings=settings, starts=starts, dt=dt, every=every).run(device)
    if on_cell:
        on_cell()
    value = structure.measure(trace) if not trace.failed.any() else np.nan
    return Cell(value, structure.right(value), 1e3 * trace.seconds * DT / trace.time[-1])


def rows(table: dict[str, dict[str, Cell]], quick: bool) -> list[list[str]]:
    """The heading and a row for each scheme: its figure on each structure, and its time in brackets."""
    made = structures(quick)
    heading = ["scheme", *(one.name for one in made), "right"]
    found = []
    for scheme, cells in table.items():
        texts = [_text(one, cells[one.name]) for one in made]
        found.append([scheme, *texts, f"{sum(cell.right for cell in cells.values())} of {len(made)}"])
    return [heading, *found]


def _text(structure: Structure, cell: Cell) -> str:
    """Text of a cell."""
    if structure.must_fall:
        words = "falls" if cell.right else "STANDS"
    elif structure.unit == "m" and cell.value > HALF:
        words = "COLLAPSES"
    elif structure.unit == "m":
        words = f"{1e3 * cell.value:.2g} mm{'' if cell.right else ' !'}"
    else:
        words = f"{cell.value:.2g} {structure.unit}{'' if cell.right else ' !'}"
    return f"{words} [{cell.milliseconds:.2g}]"
