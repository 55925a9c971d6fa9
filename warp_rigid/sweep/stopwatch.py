"""Wall-clock time of a sweep by phase."""

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager

PHASES = {
    "plan": "checking the design",
    "start": "waiting for workers",
    "load": "loading kernels",
    "build": "building simulators",
    "record": "recording steps",
    "step": "stepping",
    "measure": "measuring",
    "write": "writing",
}
"""The phases of a sweep. Those from "load" to "measure" are added up over the batches, also of parallel workers."""


class Stopwatch:
    """Adds up wall-clock time by phase.

    Attributes:
        seconds: by phase [s].
    """

    def __init__(self) -> None:
        """Start at zero."""
        self.seconds = dict.fromkeys(PHASES, 0.0)

    @contextmanager
    def of(self, phase: str) -> Iterator[None]:
        """Add the time of the block to a phase."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[phase] += time.perf_counter() - start

    def add(self, seconds: Mapping[str, float]) -> None:
        """Add the times of another stopwatch, or of some phases."""
        for phase, value in seconds.items():
            self.seconds[phase] += value

    def __str__(self) -> str:
        """The phases that took time, in one line."""
        return ", ".join(f"{PHASES[phase]} {value:.2g} s" for phase, value in self.seconds.items() if value > 0.0)
