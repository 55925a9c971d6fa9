"""Speed and quality of a case in its first second, in its second second and at rest, in one run.

Before the timed run the first two seconds are simulated once, so that buffers have grown to their size, and undone.
"""

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import warp as wp

from warp_rigid.bench.cases import BenchmarkCase, moving
from warp_rigid.bench.measure import FPS, Conditions, advance, figures, prepare
from warp_rigid.engine.simulator import Simulator

BLOCK = 6
"""Frames between two measurements of overlap and speed; the time for these is not counted."""
RESTING = 0.01
"""Speed below which every body of an environment at rest stays [m/s]."""
QUIET_BLOCKS = 5
"""Blocks for which all environments have to rest before the phase at rest begins."""
UNTIL = 10.0
"""Simulated time at which the last phase begins at the latest [s]."""


@dataclass
class _Film:
    """A run in progress: what each block of frames took, and what was measured at its end.

    Attributes:
        case: the case.
        conditions: how it is run.
        sim: its simulator.
        end: (blocks,) simulated time [s].
        seconds: (blocks,) wall-clock time [s].
        processor_seconds: (blocks,) processor time [s].
        frames: (blocks,) timed frames; 0 where a buffer grew, which is not timed.
        overlap: (blocks, envs) deepest overlap [m].
        speed: (blocks, envs) largest speed of a body [m/s].
    """

    case: BenchmarkCase
    conditions: Conditions
    sim: Simulator
    end: list[float] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    processor_seconds: list[float] = field(default_factory=list)
    frames: list[int] = field(default_factory=list)
    overlap: list[np.ndarray] = field(default_factory=list)
    speed: list[np.ndarray] = field(default_factory=list)

    def block(self) -> None:
        """Simulate a block of frames and measure."""
        before = self.sim.memory
        seconds, processor_seconds = advance(self.sim, BLOCK * self.conditions.substeps)
        grown = self.sim.memory != before
        velocity = self.sim.get("linear_velocity")[:, moving(self.sim.scene)]
        self.end.append((self.end[-1] if self.end else 0.0) + BLOCK / FPS)
        self.seconds.append(seconds)
        self.processor_seconds.append(processor_seconds)
        self.frames.append(0 if grown else BLOCK)
        self.overlap.append(self.sim.penetration())
        self.speed.append(np.linalg.norm(velocity, axis=-1).max(axis=1))

    def at_rest(self) -> bool:
        """Whether all environments have been at rest in the last blocks."""
        last = self.speed[-QUIET_BLOCKS:]
        return len(last) == QUIET_BLOCKS and all((speed < RESTING).all() for speed in last)

    def phase(self, name: str, blocks: int, build_seconds: float) -> dict[str, Any]:
        """Simulate blocks and return their figures."""
        begin = len(self.end)
        for _ in range(blocks):
            self.block()
        kept = [k for k in range(begin, len(self.end)) if self.frames[k]] or [begin]
        timed = replace(self.conditions, settle=begin * BLOCK, frames=len(kept) * BLOCK)
        seconds, processor_seconds = (sum(some[k] for k in kept) for some in (self.seconds, self.processor_seconds))
        row = figures(self.case, timed, self.sim, seconds, processor_seconds, build_seconds)
        row["quality"]["deepest_overlap_during"] = float(np.max(self.overlap[begin:]))
        return {"phase": name, **row}

    def rest(self) -> dict[str, Any]:
        """When the environments came to rest: the first measurement from which on no body is faster than RESTING."""
        awake = np.array(self.speed) >= RESTING
        first = np.where(awake.any(axis=0), len(awake) - np.argmax(awake[::-1], axis=0), 0)
        time = np.array([*self.end, np.inf])[first]
        last = int(first.max())
        all_rest = last < len(awake)
        median = float(np.median(time))
        return {
            "resting_envs": int((first < len(awake)).sum()),
            "median_rest_time": median if np.isfinite(median) else None,
            "rest_time": float(time.max()) if all_rest else None,
            "rest_seconds": float(sum(self.seconds[: last + 1])) if all_rest else None,
        }


def measure_phases(
    case: BenchmarkCase, conditions: Conditions, device: Any, until: float = UNTIL
) -> list[dict[str, Any]]:
    """Run a case from its start until it rests.

    Args:
        case: the case.
        conditions: how to run it; `settle` and `frames` do not count.
        device: the Warp device.
        until: simulated time at which the last phase begins unless all environments rest earlier, at least 2 [s].

    Returns:
        Figures of `measure` for each phase, with the name "phase" and, in "quality", "deepest_overlap_during" of the
        phase, next to the "deepest_overlap" at its end. The last phase has "rest": the number "resting_envs" of
        environments at rest, the simulated times from the start until half ("median_rest_time") and all of them
        ("rest_time") rest [s], and the wall-clock time "rest_seconds" that all take; None where that is not reached.
    """
    sim, build_seconds = prepare(case, conditions, device)
    second = FPS // BLOCK
    sim.step(2 * FPS * conditions.substeps)
    sim.penetration()
    sim.reset()
    case.scatter(sim)
    wp.synchronize_device(sim.device)
    film = _Film(case, conditions, sim)
    rows = [film.phase(name, second, build_seconds) for name in ("first second", "second second")]
    while not film.at_rest() and film.end[-1] < until - 1e-6:
        film.block()
    rows.append(film.phase("at rest" if film.at_rest() else "last second", second, build_seconds))
    rows[-1]["rest"] = film.rest()
    return rows
