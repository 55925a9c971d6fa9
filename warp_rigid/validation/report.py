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

FAILED, UNEXPECTED = 1, 6
"""Exit status if a check failed or could not be done, and if a known miss is met."""

COLUMNS = ("quantity", "value", "reference", "error", "tolerance", "verdict")
WIDTHS = (46, 18, 18, 13, 13, 7)
"""Widths of the columns on a terminal, 120 characters with the gaps."""
COLORS = {"PASS": "green", "MISS": "yellow", "MET": "bold yellow", "FAIL": "bold red", "ERROR": "bold red"}
WORDS = ("passed", "known misses", "met although listed as misses", "failed", "not measured")
"""The verdicts of COLORS in words."""


def exit_status(findings: Sequence[CheckResult]) -> int:
    """0 if every check is as expected; FAILED if one failed; else UNEXPECTED if a known miss is met."""
    verdicts = {finding.verdict for finding in findings}
    if verdicts & {"FAIL", "ERROR"}:
        return FAILED
    return UNEXPECTED if "MET" in verdicts else 0


def print_table(findings: Sequence[CheckResult], out: Console) -> None:
    """Print the checks under a heading per case, which names the source of the references, and notes on misses.

    A check has one line, for the variant with the largest error, or a line per variant if it is itemized.
    """
    with_device = len({finding.device for finding in findings}) > 1
    _grid(out, COLUMNS)
    last: tuple[Any, str] = (None, "")
    for finding in findings:
        if finding.case is not last[0]:
            out.print(f"[bold]{finding.case.id}  {escape(finding.case.title)}[/]", highlight=False)
            out.print(Padding(f"[dim]oracle: {escape(finding.case.source)}[/]", (0, 0, 0, 4)), highlight=False)
        if (finding.case, finding.device) != last and finding.contacts is not None:
            work = (
                f"{finding.device}: {finding.contacts} contacts, residual {finding.residual:.2g} m/s in the last step"
            )
            out.print(Padding(f"[dim]{escape(work)}[/]", (0, 0, 0, 4)), highlight=False)
        last = finding.case, finding.device
        for *cells, verdict in rows(finding, with_device):
            _grid(out, [*(escape(cell) for cell in cells), f"[{COLORS[verdict]}]{verdict}[/]"])
        if finding.note:
            out.print(Padding(f"[{COLORS[finding.verdict]}]{escape(finding.note)}[/]", (0, 0, 0, 4)), highlight=False)


def _grid(out: Console, cells: Sequence[str]) -> None:
    """Print a line of the table; long texts wrap within their columns."""
    line = Table.grid(padding=(0, 1, 0, 0))
    for width in WIDTHS:
        line.add_column(width=width)
    line.add_row("  " + cells[0], *cells[1:])
    out.print(line, highlight=False)


def markdown(findings: Sequence[CheckResult]) -> str:
    """The same as a Markdown table; lines of an itemized check that differ in the variant alone are one."""
    with_device = len({finding.device for finding in findings}) > 1
    lines = [" | ".join(COLUMNS), " | ".join(["---"] * len(COLUMNS))]
    last: tuple[Any, str] = (None, "")
    for finding in findings:
        if (finding.case, finding.device) != last and (heading := _heading(finding, last[0], with_device)):
            lines.append(f"{heading} |")
        last = finding.case, finding.device
        lines += [" | ".join(map(_cell, cells)) for cells in _joined(rows(finding, with_device))]
        if finding.note:
            lines.append(f"{_cell(finding.note)} |")
    return "\n".join(lines) + "\n"


def _heading(finding: CheckResult, last: ValidationCase | None, with_device: bool) -> str:
    """The case if it is not the last one, its oracle if it has another, and the contacts of the last step if any."""
    case, parts = finding.case, []
    if case is not last:
        oracle = "" if last is not None and case.source == last.source else f" (oracle: {_cell(case.source)})"
        parts.append(f"**{case.id} {_cell(case.title)}**{oracle}")
    if finding.contacts:
        device = f" on {finding.device}" if with_device else ""
        parts.append(f"{finding.contacts} contacts, residual {finding.residual:.2g} m/s{device}")
    return "; ".join(parts)


def _joined(lines: list[list[str]]) -> list[list[str]]:
    """Lines whose cells are the same but for the variant in parentheses, as one line that lists the variants."""
    groups: dict[tuple[str, ...], list[str]] = {}
    for quantity, *cells in lines:
        name, _, variant = quantity.partition(" (")
        groups.setdefault((name, *cells), []).append(variant.removesuffix(")"))
    found = []
    for (name, *cells), variants in groups.items():
        listed = f" ({' / '.join(variants)})" if variants != [""] else ""
        found.append([f"{name}{listed}", *cells])
    return found


def _cell(text: str) -> str:
    """Text of a cell of Markdown."""
    return text.replace("|", "\\|")


def rows(finding: CheckResult, with_device: bool) -> list[list[str]]:
    """A check's lines, each with its cells in the order of COLUMNS; numbers are in the unit in the first cell."""
    if finding.check.itemized and not finding.fault:
        return [_line(finding, k, finding.labels[k], with_device) for k in range(len(finding.labels))]
    worst, count = finding.worst, len(finding.labels)
    place = finding.labels[worst]
    if count > 1:
        place = f"{place}; worst of {count}" if finding.error[worst] > 0.0 else f"all {count}"
    return [_line(finding, worst, place, with_device)]


def _line(finding: CheckResult, variant: int, place: str, with_device: bool) -> list[str]:
    """Cells of a variant."""
    check, error = finding.check, finding.error[variant]
    if with_device:
        place = f"{place}; {finding.device}" if place else finding.device
    quantity = f"{check.quantity} [{check.unit}]" if check.unit else check.quantity
    if place:
        quantity = f"{quantity} ({place})"
    verdict = finding.verdict
    if check.itemized and error <= check.tolerance.limit:
        verdict = "PASS"
    if check.tolerance.kind == "outcome":
        words = _outcome_words(finding, variant)
    else:
        reference = f"{finding.reference[variant]:.6g}"
        if check.tolerance.kind in ("at_most", "at_least") and finding.reference[variant] != 0.0:
            reference = f"{'<=' if check.tolerance.kind == 'at_most' else '>='} {reference}"
        words = [
            f"{finding.value[variant]:.6g}",
            reference,
            _error(error, check.tolerance.kind),
            _error(check.tolerance.limit, check.tolerance.kind),
        ]
    return [quantity, *words, verdict]


def _outcome_words(finding: CheckResult, variant: int) -> list[str]:
    """Value, reference, error and tolerance of an event: of all variants, or of one if the check is itemized."""
    if finding.check.itemized and not finding.fault:
        found, due = (
            {0.0: "no", 1.0: "yes"}.get(array[variant], "failed") for array in (finding.value, finding.reference)
        )
        return [found, due, str(int(found != due)), "0"]
    agree, count = int((finding.error == 0.0).sum()), len(finding.labels)
    return [f"{agree} of {count} as expected", "all as expected", str(count - agree), "0"]


def _error(value: float, kind: str) -> str:
    """In the unit of the quantity, or relative, in percent."""
    return f"{100 * value:.3g} %" if kind == "relative" else f"{value:.3g}"


def summary(findings: Sequence[CheckResult]) -> str:
    """The number of checks with each verdict, in one line."""
    counts = zip(_counts(findings).items(), WORDS, strict=True)
    parts = [f"{count} {word}" for (verdict, count), word in counts if count or verdict == "PASS"]
    return f"{len(findings)} checks: {', '.join(parts)}"


def _counts(findings: Sequence[CheckResult]) -> dict[str, int]:
    return {verdict: sum(f.verdict == verdict for f in findings) for verdict in COLORS}


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
        "counts": _counts(findings),
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
        "contacts": finding.contacts,
        "residual": finding.residual,
        "variants": [
            {"label": label, "value": number(value), "reference": number(reference), "error": number(error)}
            for label, value, reference, error in rows
        ],
    }


def number(value: float | np.floating) -> float | None:
    """A float, or None if it is not finite, because JSON has no such numbers."""
    return float(value) if math.isfinite(value) else None
