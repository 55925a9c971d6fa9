"""Validation cases: a simulation or computation, the measured quantities and their reference values."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from warp_rigid.validation.experiment import Experiment, Trace

Values = float | Sequence[float] | np.ndarray
Measure = Callable[[Any], Values]


@dataclass(frozen=True)
class Tolerance:
    """Permitted deviation of a value from its reference.

    Attributes:
        kind: "relative" (error over reference), "absolute", "at_most" (only an excess counts),
            "at_least" (only a shortfall counts) or "outcome" (0 or 1, must be equal).
        limit: largest permitted error, in the quantity's unit; a ratio if relative.
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


relative = partial(Tolerance, "relative")
"""Error relative to the reference of at most `limit`."""
absolute = partial(Tolerance, "absolute")
"""Error of at most `limit`, in the quantity's unit."""
at_most = partial(Tolerance, "at_most")
"""At most `limit` above the reference, in the quantity's unit."""
AT_LEAST = Tolerance("at_least", 0.0)
"""No less than the reference."""
OUTCOME = Tolerance("outcome", 0.0)
"""An event that occurs (1) or does not (0), exactly as in the reference."""


@dataclass(frozen=True)
class Miss:
    """A known deviation beyond the tolerance.

    Attributes:
        reason: its cause, in one sentence.
        at_most: no more than twice the measured error, in the unit of the tolerance; a larger error is a failure.
    """

    reason: str
    at_most: float


@dataclass(frozen=True)
class Check:
    """A quantity and its reference value.

    Attributes:
        quantity: its name.
        unit: its unit, "" for a ratio.
        measure: function(subject of the case) -> one value for each variant.
        tolerance: permitted deviation.
        reference: expected value, one for all variants or one for each; or a function of the subject.
        labels: names of the variants; if empty, those of the case, or of its experiments' environments.
        rows: environments that are the variants, as an index of all environments of the case; None for all.
        miss: set if the tolerance is known to be exceeded.
        itemized: whether the table lists every variant, not only the worst.
    """

    quantity: str
    unit: str
    measure: Measure
    tolerance: Tolerance
    reference: Values | Measure = 0.0
    labels: Sequence[str] = ()
    rows: Any = None
    miss: Miss | None = None
    itemized: bool = False


def each(measure: Measure, rows: Any = None) -> Measure:
    """Apply a measure to all traces of a case: a value per environment, NaN for failed ones; or those of some rows."""

    def measure_all(traces: tuple[Trace, ...]) -> np.ndarray:
        of_trace = np.repeat(np.arange(len(traces)), [len(trace.failed) for trace in traces])
        chosen = np.arange(len(of_trace))[slice(None) if rows is None else rows]
        found = np.full(len(of_trace), np.nan)
        for k in np.unique(of_trace[chosen]):
            found[of_trace == k] = np.where(traces[k].failed, np.nan, np.asarray(measure(traces[k]), np.float64))
        return found[chosen]

    return measure_all


def measured(
    quantity: str, unit: str, measure: Measure, tolerance: Tolerance, reference: Any = 0.0, rows: Any = None, **options
) -> Check:
    """A check of environments, with a measure of one trace; the other arguments are those of Check."""
    return Check(quantity, unit, each(measure, rows), tolerance, reference, rows=rows, **options)


@dataclass(frozen=True)
class Curve:
    """Contents of a plot of a case: a series for each variant over time.

    Attributes:
        quantity: its name.
        unit: its unit.
        series: function(trace) -> (records, envs).
        exact: function(trace) -> reference values (records, envs); None if there is no reference.
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
        title: short description.
        source: of the reference values.
        checks: compared quantities.
        experiments: simulations; the subject of the checks is the tuple of their traces.
        compute: function(device) -> subject of the checks, for cases without a simulation.
        labels: names of the variants of a case without simulations.
        on_device: whether the case uses a device; if not, it runs once, independently of the devices.
        curve: contents of its plot.
    """

    id: str
    title: str
    source: str
    checks: tuple[Check, ...]
    experiments: tuple[Experiment, ...] = ()
    compute: Callable[[str], Any] | None = None
    labels: Sequence[str] = ()
    on_device: bool = True
    curve: Curve | None = None

    def subject(self, device: str) -> Any:
        """Simulate or compute the subject of the checks on a device."""
        if self.compute:
            return self.compute(device)
        return tuple(experiment.run(device) for experiment in self.experiments)


Cases = list[ValidationCase]
"""The cases of a section."""


def case(
    name: str, source: str, *checks: Check, of: Experiment | Sequence[Experiment] = (), **options: Any
) -> ValidationCase:
    """A case with its id and title as one name, of an experiment or several; other arguments as of ValidationCase."""
    id, _, title = name.partition(" ")
    experiments = (of,) if isinstance(of, Experiment) else tuple(of)
    return ValidationCase(id, title, source, checks, experiments, **options)


@dataclass(frozen=True)
class CheckResult:
    """A check's result on a device; arrays have one entry for each variant.

    Attributes:
        case: the case.
        check: the check.
        device: on which the case ran.
        labels: names of the variants.
        value: measured values.
        reference: reference values.
        error: errors as defined by the tolerance.
        fault: reason for missing values, "" if there are values.
        contacts: contacts of all simulations of the case in their last step; None without simulations.
        residual: largest residual of their last step, as in `Simulator.stats` [m/s]; None without simulations.
    """

    case: ValidationCase
    check: Check
    device: str
    labels: tuple[str, ...]
    value: np.ndarray
    reference: np.ndarray
    error: np.ndarray
    fault: str = ""
    contacts: int | None = None
    residual: float | None = None

    @property
    def worst(self) -> int:
        """Index of the variant with the largest error; an error that is not finite counts as the largest."""
        return int(np.argmax(np.where(np.isfinite(self.error), self.error, np.inf)))

    @property
    def passed(self) -> bool:
        """Whether all variants are within the tolerance."""
        return not self.fault and bool((self.error <= self.check.tolerance.limit).all())

    @property
    def verdict(self) -> str:
        """PASS, MISS (a known deviation, not larger than known), MET, FAIL, or ERROR if nothing could be measured.

        MET is a known deviation that is within the tolerance: it is none, and must not be listed as one.
        """
        if self.fault:
            return "ERROR"
        miss = self.check.miss
        if self.passed:
            return "MET" if miss else "PASS"
        return "MISS" if miss and self.error[self.worst] <= miss.at_most else "FAIL"

    @property
    def note(self) -> str:
        """Explanation of the verdict; empty for a pass without a known deviation."""
        if self.fault:
            return self.fault
        miss = self.check.miss
        if miss and self.passed:
            return f"listed as a miss, but within the tolerance: {miss.reason}"
        return miss.reason if miss else ""


def judge(case: ValidationCase, device: str) -> tuple[Any, list[CheckResult]]:
    """Run a case on a device. Returns its subject (None if it failed) and a result for each check."""
    try:
        subject = case.subject(device)
        return subject, [_find(case, check, device, subject) for check in case.checks]
    except Exception as error:  # the other cases must still run
        fault = f"{type(error).__name__}: {' '.join(str(error).split())}"
        nothing = np.full(1, np.nan)
        return None, [
            CheckResult(case, check, device, ("",), nothing, nothing, nothing, fault) for check in case.checks
        ]


def _find(case: ValidationCase, check: Check, device: str, subject: Any) -> CheckResult:
    """Measure and compare."""
    value = np.atleast_1d(np.asarray(check.measure(subject), np.float64))
    given = check.reference(subject) if callable(check.reference) else check.reference
    reference = np.broadcast_to(np.asarray(given, np.float64), value.shape)
    labels = tuple(check.labels or case.labels)
    if not labels:
        labels = tuple(label for trace in subject for label in trace.labels)
        labels = labels if check.rows is None else tuple(labels[row] for row in np.arange(len(labels))[check.rows])
    if len(labels) != len(value):
        raise ValueError(f"{case.id} {check.quantity}: {len(value)} values for {len(labels)} labels")
    error = check.tolerance.error(value, reference)
    traces = subject if case.experiments else ()
    contacts = sum(len(trace.contacts) for trace in traces) if traces else None
    residual = max((trace.residual for trace in traces), default=None)
    return CheckResult(case, check, device, labels, value, reference, error, "", contacts, residual)
