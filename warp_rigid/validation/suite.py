"""The suite: all cases in the order of their sections, their selection by name, and runs on devices."""

from collections.abc import Callable, Sequence
from importlib import import_module
from typing import Any

from warp_rigid.checks import shown, suggestion
from warp_rigid.validation.case import CheckResult, ValidationCase, judge

SECTIONS = (
    "mass_and_distance",
    "free_motion",
    "impact",
    "friction",
    "rolling",
    "towers",
    "nonconvex",
    "many_bodies",
    "arches",
    "walls_and_unions",
    "contact_search",
    "sliding",
    "smooth_motion",
    "articulated",
    "passive_mechanisms",
    "conveyors",
    "resting_meshes",
    "robustness",
)
"""Files of this folder with the cases of a section each."""


def all_cases(quick: bool = False) -> list[ValidationCase]:
    """All cases; with `quick` only those that take one or two seconds at reduced sizes."""
    sections = [import_module(f"{__package__}.{name}") for name in SECTIONS]
    return [case for section in sections for case in section.cases(quick)]


def choose(cases: Sequence[ValidationCase], names: Sequence[str]) -> list[ValidationCase]:
    """The cases of some families, such as V10 or V22.

    Raises:
        ValueError: There is no such family.
    """
    known = list(dict.fromkeys(case.id for case in cases))
    for name in names:
        if name not in known:
            first, *_, last = sorted(known, key=lambda name: int(name[1:]))
            where = f"{first} to {last}, in docs/validation_table.md"
            raise ValueError(f"--cases: must be names of cases, got {shown(name)}{suggestion(name, known, where)}")
    return [case for case in cases if case.id in names]


def run_suite(
    cases: Sequence[ValidationCase],
    devices: Sequence[str],
    on_case: Callable[[ValidationCase, str, Any, list[CheckResult]], None] | None = None,
) -> list[CheckResult]:
    """Run cases on devices, one case after another on all devices.

    Args:
        cases: cases to run.
        devices: names of Warp devices. Cases that use no device run once.
        on_case: called after each case with the case, the device, its subject (None if it failed) and its results.
    """
    findings = []
    for case in cases:
        for device in devices if case.on_device else ["cpu"]:
            subject, found = judge(case, device)
            findings += found
            if on_case:
                on_case(case, device, subject, found)
    return findings
