"""Speed, work and quality of a case at one batch size, as plain data: of one period, or of three phases of one run.

Before a run of phases its first two seconds are simulated once, so that buffers have grown to their size, and undone.
"""

import os
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import warp as wp

from warp_rigid.bench.cases import BenchmarkCase, moving
from warp_rigid.diagnostics.machine import git, versions
from warp_rigid.engine.cores import usable_cores
from warp_rigid.engine.settings import Settings
from warp_rigid.engine.simulator import Simulator
from warp_rigid.scenes.builders.jointed import anchor_errors

FPS = 60
STAGE_STEPS = 32
"""Number of steps over which the times of the stages are averaged."""
OURS = "warp_rigid"
BLOCK = 6
"""Frames between two measurements of overlap and speed; the time for these is not counted."""
RESTING = 0.01
"""Speed below which every body of an environment at rest stays [m/s]."""
QUIET_BLOCKS = 5
"""Blocks for which all environments have to rest before the phase at rest begins."""
UNTIL = 10.0
"""Simulated time at which the last phase begins at the latest [s]."""


@dataclass(frozen=True)
class Conditions:
    """How a case is run.

    Attributes:
        envs: number of environments.
        substeps: steps per frame of 1/60 s.
        settle: frames before the timed ones.
        frames: timed frames.
        sleeping: whether bodies at rest may fall asleep; other engines use their defaults.
    """

    envs: int
    substeps: int
    settle: int
    frames: int
    sleeping: bool = False


def measure(case: BenchmarkCase, conditions: Conditions, device: Any) -> tuple[dict[str, Any], Simulator]:
    """Run a case and measure it.

    `seconds` is the wall-clock time of the timed frames; `processor_seconds` is the processor time of all threads of
    this process in the same period, which does not depend on other programs on the machine.

    Returns:
        Figures, ready for JSON, and the simulator at the end of the timed frames.
    """
    sim, build_seconds = prepare(case, conditions, device)
    advance(sim, conditions.substeps * conditions.settle)
    taken = advance(sim, conditions.substeps * conditions.frames)
    return figures(case, conditions, sim, *taken, build_seconds), sim


def prepare(case: BenchmarkCase, conditions: Conditions, device: Any) -> tuple[Simulator, float]:
    """A simulator of a case at its start, and the time that it took to build [s]."""
    begin = time.perf_counter()
    settings = Settings(dt=1.0 / (FPS * conditions.substeps), sleeping=conditions.sleeping)
    sim = Simulator(case.build(), conditions.envs, settings, device=device)
    case.scatter(sim)
    sim.prepare()
    wp.synchronize_device(sim.device)
    return sim, time.perf_counter() - begin


def figures(
    case: BenchmarkCase,
    conditions: Conditions,
    sim: Simulator,
    seconds: float,
    processor_seconds: float,
    build_seconds: float,
) -> dict[str, Any]:
    """Figures of timed frames at whose end the simulator is, ready for JSON."""
    rows = moving(sim.scene)
    return {
        "engine": OURS,
        **head(case, conditions),
        "collider": "samples against signed distances",
        **rates(case, conditions, seconds, processor_seconds),
        "build_seconds": build_seconds,
        "memory": sim.memory,
        **work(sim),
        "quality": quality(case, sim, sim.get("position")[:, rows], sim.get("linear_velocity")[:, rows]),
        "failed_envs": int((sim.status()["status"] != "ok").sum()),
        "stage_seconds": sim.stage_times(STAGE_STEPS),
    }


def head(case: BenchmarkCase, conditions: Conditions) -> dict[str, Any]:
    """What was run, ready for JSON."""
    return {"scene": case.name, "bodies": case.bodies, **vars(conditions)}


def rates(case: BenchmarkCase, conditions: Conditions, seconds: float, processor_seconds: float) -> dict[str, float]:
    """Frames, steps and body steps per wall-clock second over all environments, and frames per processor second."""
    frames = conditions.envs * conditions.frames
    return {
        "seconds": seconds,
        "processor_seconds": processor_seconds,
        "env_frames_per_second": frames / seconds,
        "env_frames_per_processor_second": frames / processor_seconds,
        "env_steps_per_second": frames * conditions.substeps / seconds,
        "body_steps_per_second": frames * conditions.substeps * case.bodies / seconds,
    }


def work(sim: Simulator) -> dict[str, Any]:
    """Contacts, pairs and levels of the last step, and the largest fraction of each pool's capacity used so far."""
    counts = sim.counts()
    pairs, _ = sim.pairs_and_contacts()
    return {
        "contacts": counts["contacts"],
        "pairs": counts["pairs"],
        "pairs_of_environments": [int(pairs.min()), int(pairs.max())],
        "levels": counts["levels"],
        "pair_capacity_used": counts["most_pairs"] / counts["pair_capacity"],
        "contact_capacity_used": counts["most_contacts"] / counts["contact_capacity"],
    }


def quality(case: BenchmarkCase, sim: Simulator, position: np.ndarray, velocity: np.ndarray) -> dict[str, Any]:
    """Quality of the final states, by the same measures for every engine; lengths in metres.

    Args:
        case: the simulated case.
        sim: a simulator in the state that is judged; it measures the overlap with its samples.
        position: (envs, bodies, 3) of the dynamic bodies.
        velocity: (envs, bodies, 3) of the dynamic bodies.

    Returns:
        "deepest_overlap" of all environments, "median_overlap" (median over environments of the deepest) and
        "max_speed", which are None if a state is not finite; "escaped"; for a stack also "height_error" (largest of
        all cubes), "top_height_error" (mean of the top cubes) and "drift"; with joints "joint_error" (largest gap of a
        joint).
    """
    whole = bool(np.isfinite(position).all() and np.isfinite(velocity).all())
    overlap = sim.penetration() if whole else None
    figures: dict[str, Any] = {
        "deepest_overlap": None if overlap is None else float(overlap.max()),
        "median_overlap": None if overlap is None else float(np.median(overlap)),
        "max_speed": float(np.linalg.norm(velocity, axis=-1).max()) if whole else None,
        "escaped": case.escaped(position),
    }
    moved = case.displacement(position.astype(np.float64))
    if moved is not None and whole:
        figures["height_error"] = float(np.abs(moved[..., 2]).max())
        figures["top_height_error"] = float(moved[:, -1, 2].mean())
        figures["drift"] = float(np.linalg.norm(moved[..., :2], axis=-1).max())
    if sim.scene.joints and whole:
        figures["joint_error"] = float(anchor_errors(sim).max())
    return figures


def surroundings(device: Any) -> dict[str, Any]:
    """Device, versions, commit and load of the machine."""
    return {
        "device": str(device),
        "device_name": device.name,
        "processors": os.cpu_count(),
        "cores": usable_cores(),
        "load": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
        "versions": versions(),
        "commit": commit(),
    }


def commit() -> str:
    """Commit of the checkout, with a + if files differ from it; "" if there is no checkout."""
    return git("rev-parse", "--short=12", "HEAD") + ("+" if git("status", "--porcelain", "-uno") else "")


def compare(rows: Sequence[dict[str, Any]]) -> None:
    """Add to the row of every other engine the ratio of its time to ours under the same conditions.

    The ratio is of wall-clock times if one of the two ran on a GPU, else of processor times.
    """
    ours = {_conditions(row): row for row in rows if row["engine"] == OURS}
    for row in rows:
        if row["engine"] != OURS and "seconds" in row:
            own = ours[_conditions(row)]
            kind = "seconds" if "cuda" in own["device"] + row["device"] else "processor_seconds"
            row["ratio"] = row[kind] / own[kind]


def _conditions(row: dict[str, Any]) -> tuple:
    return tuple(row[name] for name in ("scene", "bodies", "envs", "substeps", "settle", "frames"))


def advance(sim: Simulator, steps: int) -> tuple[float, float]:
    """Wall-clock and processor time that steps take [s]."""
    start, begin = time.process_time(), time.perf_counter()
    sim.step(steps)
    wp.synchronize_device(sim.device)
    return time.perf_counter() - begin, time.process_time() - start


@dataclass
class _Film:
    """A run in progress: what each block of frames took, and what was measured at its end.

    Attributes:
        case: the case.
        conditions: how it is run.
        sim: its simulator.
        seconds: (blocks,) wall-clock time [s].
        processor_seconds: (blocks,) processor time [s].
        frames: (blocks,) timed frames; 0 where a buffer grew, which is not timed.
        overlap: (blocks, envs) deepest overlap [m].
        speed: (blocks, envs) largest speed of a body [m/s].
    """

    case: BenchmarkCase
    conditions: Conditions
    sim: Simulator
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
        begin = len(self.frames)
        for _ in range(blocks):
            self.block()
        kept = [k for k in range(begin, len(self.frames)) if self.frames[k]] or [begin]
        timed = replace(self.conditions, settle=begin * BLOCK, frames=len(kept) * BLOCK)
        seconds, processor_seconds = (sum(some[k] for k in kept) for some in (self.seconds, self.processor_seconds))
        row = figures(self.case, timed, self.sim, seconds, processor_seconds, build_seconds)
        row["quality"]["deepest_overlap_during"] = float(np.max(self.overlap[begin:]))
        return {"phase": name, **row}

    def rest(self) -> dict[str, Any]:
        """When the environments came to rest: the first measurement from which on no body is faster than RESTING."""
        awake = np.array(self.speed) >= RESTING
        first = np.where(awake.any(axis=0), len(awake) - np.argmax(awake[::-1], axis=0), 0)
        time = np.where(first < len(awake), (first + 1.0) * BLOCK / FPS, np.inf)
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
    while not film.at_rest() and len(film.frames) * BLOCK / FPS < until - 1e-6:
        film.block()
    rows.append(film.phase("at rest" if film.at_rest() else "last second", second, build_seconds))
    rows[-1]["rest"] = film.rest()
    return rows
