"""Results of checks as a table for the terminal, as Markdown and as JSON, and the exit status."""

import itertools
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.padding import Padding
from rich.table import Table

from warp_rigid.validation.case import CheckResult, ValidationCase

FAILED = 1
"""Exit status if a check failed or could not be done."""

COLUMNS = ("quantity", "value", "reference", "error", "tolerance", "verdict")
WIDTHS = (46, 18, 18, 13, 13, 7)
"""Widths of the columns on a terminal, 120 characters with the gaps."""
COLORS = {"PASS": "green", "MISS": "yellow", "FAIL": "bold red", "ERROR": "bold red"}


def exit_status(findings: Sequence[CheckResult]) -> int:
    """0 if every check passed or is a known miss that is not larger than known, else 1."""
    return FAILED if any(finding.verdict in ("FAIL", "ERROR") for finding in findings) else 0


def print_table(findings: Sequence[CheckResult], out: Console) -> None:
    """Print one line per check, for the variant with the largest error, a heading per case, and notes on misses."""
    with_device = len({finding.device for finding in findings}) > 1
    _grid(out, COLUMNS)
    last = None
    for finding in findings:
        if finding.case is not last:
            out.print(f"[bold]{finding.case.id}  {escape(finding.case.title)}[/]", highlight=False)
            last = finding.case
        *cells, verdict = row(finding, with_device)
        color = COLORS[verdict]
        _grid(out, [*(escape(cell) for cell in cells), f"[{color}]{verdict}[/]"])
        if finding.note:
            out.print(Padding(f"[{color}]{escape(finding.note)}[/]", (0, 0, 0, 4)), highlight=False)


def _grid(out: Console, cells: Sequence[str]) -> None:
    """Print a line of the table; long texts wrap within their columns."""
    line = Table.grid(padding=(0, 1, 0, 0))
    for width in WIDTHS:
        line.add_column(width=width)
    line.add_row("  " + cells[0], *cells[1:])
    out.print(line, highlight=False)


def markdown(findings: Sequence[CheckResult]) -> str:
    """The same as a Markdown table; each case names the source of its references."""
    with_device = len({finding.device for finding in findings}) > 1
    columns = ("case", *COLUMNS)
    lines = [f"| {' | '.join(columns)} |", "|---" * len(columns) + "|"]
    last = None
    for finding in findings:
        if finding.case is not last:
            case = finding.case
            lines.append(f"| **{case.id}** | **{case.title}** ({case.source}) |{' |' * 5}")
            last = case
        cells = [cell.replace("|", "\\|") for cell in row(finding, with_device)]
        lines.append(f"| | {' | '.join(cells)} |")
        if finding.note:
            lines.append(f"| | {finding.note} |{' |' * 5}")
    return "\n".join(lines) + "\n"


def row(finding: CheckResult, with_device: bool) -> list[str]:
    """A check's cells, in the order of COLUMNS."""
    worst, check = finding.worst, finding.check
    place = finding.labels[worst]
    if len(finding.labels) > 1:
        place = (
            f"{place}; worst of {len(finding.labels)}" if finding.error[worst] > 0.0 else f"all {len(finding.labels)}"
        )
    if with_device:
        place = f"{place}; {finding.device}" if place else finding.device
    quantity = f"{check.quantity} ({place})" if place else check.quantity
    unit = f" {check.unit}" if check.unit else ""
    if check.tolerance.kind == "outcome":
        agree = int((finding.error == 0.0).sum())
        words = [
            f"{agree} of {len(finding.labels)} as expected",
            "all as expected",
            str(len(finding.labels) - agree),
            "0",
        ]
    else:
        reference = f"{figure(finding.reference[worst])}{unit}"
        if check.tolerance.kind in ("at_most", "at_least") and finding.reference[worst] != 0.0:
            reference = f"{'<=' if check.tolerance.kind == 'at_most' else '>='} {reference}"
        words = [
            f"{figure(finding.value[worst])}{unit}",
            reference,
            _error(finding.error[worst], check.tolerance.kind, unit),
            _error(check.tolerance.limit, check.tolerance.kind, unit),
        ]
    return [quantity, *words, finding.verdict]


def figure(value: float) -> str:
    """A number with six significant digits."""
    return f"{value:.6g}"


def _error(value: float, kind: str, unit: str) -> str:
    return f"{100 * value:.3g} %" if kind == "relative" else f"{value:.3g}{unit}"


def summary(findings: Sequence[CheckResult]) -> str:
    """The number of checks with each verdict, in one line."""
    counts = {verdict: sum(f.verdict == verdict for f in findings) for verdict in COLORS}
    names = {"PASS": "passed", "MISS": "known misses", "FAIL": "failed", "ERROR": "not measured"}
    parts = [f"{counts[verdict]} {name}" for verdict, name in names.items() if counts[verdict] or verdict == "PASS"]
    return f"{len(findings)} checks: {', '.join(parts)}"


def agreement(checks: Sequence[dict[str, Any]]) -> list[str]:
    """A line with the number of equal verdicts on all devices, and a line for each difference.

    Args:
        checks: from one or several results of `as_json`; checks that ran on one device only do not count.
    """
    verdicts: dict[tuple, dict[str, str]] = {}
    for check in checks:
        device, name = check["device"], (check["case"], check["title"], check["quantity"])
        # A case may check a quantity several times, against different references.
        number = next(k for k in itertools.count() if device not in verdicts.get((*name, k), {}))
        verdicts.setdefault((*name, number), {})[device] = check["verdict"]
    shared = {check: found for check, found in verdicts.items() if len(found) > 1}
    differ = {check: found for check, found in shared.items() if len(set(found.values())) > 1}
    devices = sorted({device for found in shared.values() for device in found})
    lines = [f"{' and '.join(devices)}: {len(shared) - len(differ)} of {len(shared)} verdicts are the same"]
    for (case, _, quantity, _), found in differ.items():
        lines.append(f"{case} {quantity}: {', '.join(f'{verdict} on {device}' for device, verdict in found.items())}")
    return lines if shared else []


def as_json(findings: Sequence[CheckResult], devices: Sequence[str]) -> dict[str, Any]:
    """All results as one JSON object; numbers that are not finite become null."""
    return {
        "devices": list(devices),
        "passed": exit_status(findings) == 0,
        "counts": {verdict: sum(f.verdict == verdict for f in findings) for verdict in COLORS},
        "checks": [_record(finding) for finding in findings],
    }


def _record(finding: CheckResult) -> dict[str, Any]:
    case: ValidationCase = finding.case
    rows = zip(finding.labels, finding.value, finding.reference, finding.error, strict=True)
    return {
        "case": case.id,
        "title": case.title,
        "source": case.source,
        "device": finding.device,
        "quantity": finding.check.quantity,
        "unit": finding.check.unit,
        "tolerance": finding.check.tolerance.limit,
        "tolerance_kind": finding.check.tolerance.kind,
        "verdict": finding.verdict,
        "note": finding.note,
        "worst": finding.worst,
        "variants": [
            {"label": label, "value": number(value), "reference": number(reference), "error": number(error)}
            for label, value, reference, error in rows
        ],
    }


def number(value: float | np.floating) -> float | None:
    """A float, or None if it is not finite, because JSON has no such numbers."""
    return float(value) if math.isfinite(value) else None
