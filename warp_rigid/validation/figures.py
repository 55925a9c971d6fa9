"""Plots of cases over time, and of the error of each check relative to its tolerance."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from warp_rigid.files.atomic import atomic_file
from warp_rigid.validation.case import CheckResult, ValidationCase
from warp_rigid.validation.experiment import Trace
from warp_rigid.validation.report import COLORS

MOST_LINES = 12
"""Largest number of variants in a plot, which are chosen at equal intervals."""
SMALLEST = 1e-6
"""Smallest ratio of error and tolerance in the overview."""
INK = {"PASS": "tab:green", "MISS": "tab:orange", "MET": "gold", "FAIL": "tab:red", "ERROR": "tab:red"}
assert set(INK) == set(COLORS)


def save_case(case: ValidationCase, device: str, traces: tuple[Trace, ...], folder: Path) -> Path:
    """Draw a case's curve for its variants; returns the PNG's path."""
    from matplotlib.figure import Figure

    curve = case.curve
    assert curve is not None
    chart = Figure(figsize=(8, 5), layout="constrained")
    axes = chart.add_subplot()
    lines = [(trace, env) for trace in traces for env in range(len(trace.labels))]
    for index in np.unique(np.linspace(0, len(lines) - 1, MOST_LINES).astype(int)):
        trace, env = lines[index]
        (drawn,) = axes.plot(trace.time, curve.series(trace)[:, env], label=trace.labels[env] or case.title, lw=1.2)
        if curve.exact:
            exact = np.broadcast_to(curve.exact(trace), curve.series(trace).shape)[:, env]
            axes.plot(trace.time, exact, color=drawn.get_color(), ls="--", lw=0.8)
    axes.set(xlabel="time [s]", ylabel=f"{curve.quantity} [{curve.unit}]" if curve.unit else curve.quantity)
    axes.set_title(f"{case.id}: {case.title} ({device}{', dashed: exact' if curve.exact else ''})", fontsize=9)
    axes.legend(fontsize=7)
    axes.grid(alpha=0.3)
    slug = re.sub(r"[^a-z0-9]+", "_", case.title.lower()).strip("_")
    return _save(chart, folder / f"{case.id}_{slug}_{device.replace(':', '')}.png")


def save_overview(findings: Sequence[CheckResult], folder: Path) -> Path:
    """Draw the largest error of every check relative to its tolerance; returns the PNG's path."""
    from matplotlib.figure import Figure

    shown = [f for f in findings if not f.fault and f.check.tolerance.limit > 0.0]
    chart = Figure(figsize=(9, 1.5 + 0.19 * len(shown)), layout="constrained")
    axes = chart.add_subplot()
    parts = [f.error[f.worst] / f.check.tolerance.limit for f in shown]
    parts = np.clip(np.nan_to_num(parts, nan=100.0, posinf=100.0), SMALLEST, 100.0)
    axes.barh(range(len(shown)), parts, left=SMALLEST, color=[INK[f.verdict] for f in shown])
    axes.set_yticks(range(len(shown)), [f"{f.case.id} {f.check.quantity} ({f.device})" for f in shown], fontsize=6)
    axes.set(xscale="log", xlim=(SMALLEST, 100.0), xlabel="worst error over tolerance")
    axes.axvline(1.0, color="black", lw=1)
    axes.set_ylim(len(shown) - 0.5, -0.5)
    return _save(chart, folder / "overview.png")


def _save(chart: Any, path: Path) -> Path:
    with atomic_file(path) as temporary:
        chart.savefig(temporary, dpi=120)
    return path
