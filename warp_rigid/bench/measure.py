"""Speed, work and quality of a case at one batch size, as plain data."""

import os
import time
from collections.abc import Sequence
from dataclasses import dataclass
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
