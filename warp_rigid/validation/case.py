"""Cases: what is simulated or computed, which quantities are read from it, and what they are compared with."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from warp_rigid.validation.experiment import Experiment, Trace

Values = float | Sequence[float] | np.ndarray
Measure = Callable[[Any], Values]


@dataclass(frozen=True)
class Tolerance:
    """How far a value may be from its reference.

    Attributes:
        kind: "relative" (error over reference), "absolute", "at_most" (only an excess counts),
            "at_least" (only a shortfall counts) or "outcome" (0 or 1, must be equal).
        limit: largest error that passes, in the quantity's unit; a ratio if relative.
    """

    kind: str
    limit: float

    def error(self, value: np.ndarray, reference: np.ndarray) -> np.ndarray:
        """Errors of values."""
        if self.kind == "at_most":
            return np.maximum(value - reference, 0.0)
        if self.kind == "at_least":
            return np.maximum(reference - value, 0.0)
        error = np.abs(value - reference)
        return error / np.abs(reference) if self.kind == "relative" else error


def relative(limit: float) -> Tolerance:
    """Within a part of the reference."""
    return Tolerance("relative", limit)


def absolute(limit: float) -> Tolerance:
    """Within so much of the reference, in the quantity's unit."""
    return Tolerance("absolute", limit)


def at_most(limit: float) -> Tolerance:
    """No more than so much above the reference, in the quantity's unit."""
    return Tolerance("at_most", limit)


def at_least(limit: float) -> Tolerance:
    """No more than so much below the reference, in the quantity's unit."""
    return Tolerance("at_least", limit)


AT_LEAST = at_least(0.0)
"""No less than the reference."""
OUTCOME = Tolerance("outcome", 0.0)
"""Happens (1) or does not (0), as the reference says."""


@dataclass(frozen=True)
class Miss:
    """A reference that is known not to be met.

    Attributes:
        reason: why, in one sentence.
        at_most: error that was measured, rounded up; a larger one is a failure.
        always: whether it is missed on every run; False where the last bits of a chaotic motion decide.
    """

    reason: str
    at_most: float
    always: bool = True


@dataclass(frozen=True)
class ReferenceCheck:
    """A quantity that has a reference.

    Attributes:
        quantity: what it is.
        unit: its unit, "" for a ratio.
        measure: reads it from the case's subject, one value for each variant.
        reference: the value it must have, one for all variants or one for each; or reads them from the subject.
        tolerance: how far it may be off.
        labels: names of the variants; those of the experiments' environments if there are none.
        miss: set where the tolerance is known not to be met.
    """

    quantity: str
    unit: str
    measure: Measure
    reference: Values | Measure
    tolerance: Tolerance
    labels: Sequence[str] = ()
    miss: Miss | None = None


@dataclass(frozen=True)
class Curve:
    """What a plot of a case shows: a series for each variant, over time.

    Attributes:
        quantity: what it is.
        unit: its unit.
        series: reads (records, envs) from a trace.
        exact: the reference, (records, envs), from a trace; None if there is none.
    """

    quantity: str
    unit: str
    series: Callable[[Trace], np.ndarray]
    exact: Callable[[Trace], np.ndarray] | None = None


@dataclass(frozen=True)
class ValidationCase:
    """One case of the validation.

    Attributes:
        id: such as V23; cases of one family share it.
        title: what is done.
        source: where the reference is from.
        checks: what is compared.
        experiments: what is simulated; the checks get the tuple of its traces.
        compute: for cases without a simulation: computes the checks' subject on a device.
        on_device: whether a device takes part; if not, the case runs once, whatever the devices.
        curve: what its plot shows.
    """

    id: str
    title: str
    source: str
    checks: tuple[ReferenceCheck, ...]
    experiments: tuple[Experiment, ...] = ()
    compute: Callable[[str], Any] | None = None
    on_device: bool = True
    curve: Curve | None = None

    def subject(self, device: str) -> Any:
        """Simulate or compute on a device what the checks read."""
        if self.compute:
            return self.compute(device)
        return tuple(experiment.run(device) for experiment in self.experiments)


def each(measure: Callable[[Trace], Values]) -> Measure:
    """A measure of one trace, taken of all traces of a case, one value for each environment; NaN where one failed."""

    def measure_all(traces: tuple[Trace, ...]) -> np.ndarray:
        values = [np.where(trace.failed, np.nan, np.asarray(measure(trace), np.float64)) for trace in traces]
        return np.concatenate(values)

    return measure_all


@dataclass(frozen=True)
class CheckResult:
    """A check's result on a device; arrays have one entry for each variant.

    Attributes:
        case: the case.
        check: the check.
        device: where it ran.
        labels: names of the variants.
        value: measured.
        reference: what it must be.
        error: by the tolerance's rule.
        fault: why there is no value, "" if there is one.
    """

    case: ValidationCase
    check: ReferenceCheck
    device: str
    labels: tuple[str, ...]
    value: np.ndarray
    reference: np.ndarray
    error: np.ndarray
    fault: str = ""

    @property
    def worst(self) -> int:
        """The variant with the largest error; one without a finite value comes first."""
        return int(np.argmax(np.where(np.isfinite(self.error), self.error, np.inf)))

    @property
    def passed(self) -> bool:
        """Whether all variants are within the tolerance."""
        return not self.fault and bool((self.error <= self.check.tolerance.limit).all())

    @property
    def verdict(self) -> str:
        """PASS, MISS (known, and no worse than known), FAIL, or ERROR where nothing could be measured."""
        if self.fault:
            return "ERROR"
        if self.passed:
            return "PASS"
        miss = self.check.miss
        return "MISS" if miss and self.error[self.worst] <= miss.at_most else "FAIL"

    @property
    def note(self) -> str:
        """What to say about the verdict; empty for a plain pass."""
        if self.fault:
            return self.fault
        miss = self.check.miss
        if miss and self.passed:
            return f"listed as a miss, but met here: {miss.reason}"
        return miss.reason if miss else ""


def judge(case: ValidationCase, device: str) -> tuple[Any, list[CheckResult]]:
    """Run a case on a device; its subject (None if that failed), and a finding for each check."""
    try:
        subject = case.subject(device)
        return subject, [_find(case, check, device, subject) for check in case.checks]
    except Exception as error:  # one broken case must not cost the others their results
        fault = f"{type(error).__name__}: {' '.join(str(error).split())}"
        nothing = np.full(1, np.nan)
        return None, [
            CheckResult(case, check, device, ("",), nothing, nothing, nothing, fault) for check in case.checks
        ]


def _find(case: ValidationCase, check: ReferenceCheck, device: str, subject: Any) -> CheckResult:
    """Measure and compare."""
    value = np.atleast_1d(np.asarray(check.measure(subject), np.float64))
    given = check.reference(subject) if callable(check.reference) else check.reference
    reference = np.broadcast_to(np.asarray(given, np.float64), value.shape)
    labels = tuple(check.labels) or tuple(label for trace in subject for label in trace.labels)
    if len(labels) != len(value):
        raise ValueError(f"{case.id} {check.quantity}: {len(value)} values for {len(labels)} labels")
    return CheckResult(case, check, device, labels, value, reference, check.tolerance.error(value, reference))
