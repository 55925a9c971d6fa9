"""Other engines from the same start, each in a separate process and Python environment.

`programs/run.py` reads a problem (.npz), runs the program of the engine's package, and writes the results. The program
measures its speed; quality is measured here, with the same measures for all engines.
"""

import json
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from warp_rigid.bench.cases import BenchmarkCase, moving
from warp_rigid.bench.measure import FPS, Conditions, head, quality, rates
from warp_rigid.checks import one_of
from warp_rigid.engine.simulator import Simulator
from warp_rigid.scene.joints import RevoluteJoint
from warp_rigid.scene.scene import Scene
from warp_rigid.scene.shapes import Box, Cylinder, Mesh
from warp_rigid.scene.shapes.distance_grid import cache_folder

FOLDER = Path(__file__).resolve().parent / "programs"
PACKAGES = {
    "newton_steel": "newton",
    "newton_xpbd": "newton",
    "mujoco_warp": "mujoco-warp",
    "mujoco": "mujoco",
    "rapier": "rapier3d",
    "pybullet": "pybullet",
}
"""Engines, and the packages that contain them."""
WITH_JOINTS = ("newton_steel", "newton_xpbd", "mujoco_warp", "mujoco")
"""Engines whose program sets up joints."""
NOT_INSTALLED = 3
"""Exit status of a program whose engine is missing."""
TIMEOUT = 3600.0
OVERFLOW = re.compile(r"buffer overflow|overflowed|overflow - |dropped|insert failures|buffer is full", re.IGNORECASE)
"""A line with this, printed by an engine, means that a buffer was too small and contacts are missing."""


def choose_peers(names: str | None, pythons: list[str] | None) -> dict[str, str]:
    """Engines to run, and the interpreter of each.

    Args:
        names: names of engines, separated by commas.
        pythons: texts "name=interpreter"; engines that are not listed run with this process's interpreter.

    Raises:
        ValueError: A name is unknown, or an interpreter is given for an engine that does not run.
    """
    listed = names.split(",") if names else []
    chosen = {one_of("--peers", name.strip(), tuple(PACKAGES)): sys.executable for name in listed}
    for text in pythons or ():
        name, _, interpreter = text.partition("=")
        one_of("--peer-python", name, tuple(chosen) or ("an engine of --peers",))
        if not Path(interpreter).is_file():
            raise ValueError(f"--peer-python: {name}: no interpreter at {interpreter!r}")
        chosen[name] = interpreter
    return chosen


def run_peer(name: str, python: str, case: BenchmarkCase, conditions: Conditions, sim: Simulator) -> dict[str, Any]:
    """Run one engine from the start of a case.

    Args:
        name: of the engine.
        python: its interpreter.
        case: the case to simulate.
        conditions: how to run it.
        sim: a simulator of the case; afterwards it is in the final state of the engine.

    Returns:
        Figures as those of `measure`, as far as the engine reports them; only "engine" and "fault" if it failed.
    """
    if sim.scene.joints and name not in WITH_JOINTS:
        return _fault(name, case, conditions, "its program sets up no joints")
    with tempfile.TemporaryDirectory() as folder:
        problem, result = Path(folder) / "problem.npz", Path(folder) / "result.npz"
        write_problem(problem, name, case, conditions, sim)
        program = f"run_{PACKAGES[name].replace('-', '_')}"
        command = [python, str(FOLDER / "run.py"), program, str(problem), str(result)]
        # The variables of this Python environment must not affect the other interpreter's imports.
        surroundings = {key: value for key, value in os.environ.items() if key not in ("PYTHONPATH", "PYTHONHOME")}
        try:
            done = subprocess.run(command, capture_output=True, text=True, timeout=TIMEOUT, env=surroundings)
        except subprocess.TimeoutExpired:
            return _fault(name, case, conditions, f"no result after {TIMEOUT:.0f} s")
        if done.returncode or not result.is_file():
            lines = done.stderr.strip().splitlines() or [f"ended with status {done.returncode}"]
            missing = f"not installed: pip install {PACKAGES[name]}, or give its interpreter by --peer-python"
            return _fault(name, case, conditions, missing if done.returncode == NOT_INSTALLED else lines[-1][:200])
        for line in (done.stdout + done.stderr).splitlines():
            if OVERFLOW.search(line):
                return _fault(name, case, conditions, f"contacts are missing: {line.strip()[:160]}")
        with np.load(result) as found:
            return _read_result(case, conditions, sim, {key: found[key] for key in found.files})


def write_problem(path: Path, engine: str, case: BenchmarkCase, conditions: Conditions, sim: Simulator) -> None:
    """Write a case as plain arrays: starts, the bodies' common shape, mass and inertia, static bodies, and hinges."""
    scene = case.build()
    body = scene.bodies[moving(scene)[0]]
    sim.reset()
    case.scatter(sim)
    rows = moving(sim.scene)
    volume = body.shape.mass_properties
    density = body.mass / volume.volume
    arrays: dict[str, Any] = {
        "position": sim.get("position")[:, rows].astype(np.float64),
        "orientation": sim.get("orientation")[:, rows].astype(np.float64),
        "inertia": density * np.diag(volume.inertia),
    }
    if isinstance(body.shape, Mesh):
        arrays |= {"vertices": body.shape.vertices, "faces": body.shape.faces}
    elif isinstance(body.shape, Box):
        arrays["half_extents"] = np.array(body.shape.half_extents)
    if scene.joints:
        arrays["targets"] = sim.get("joint_target_position").astype(np.float64)
    figures = {
        "engine": engine,
        "mass": body.mass,
        "density": density,
        "friction": body.friction,
        "restitution": body.restitution,
        "gravity": list(scene.gravity),
        "dt": 1.0 / (FPS * conditions.substeps),
        "substeps": conditions.substeps,
        "settle": conditions.settle,
        "frames": conditions.frames,
        "fixed": _fixed(scene),
        "hinges": _hinges(scene, rows),
        "device": str(sim.device),
        "cache": str(cache_folder()),
    }
    np.savez(path, figures=json.dumps(figures), **arrays)


def _fixed(scene: Scene) -> list[dict[str, Any]]:
    """Static bodies on the ground plane z = 0, which every scene has."""
    return [
        {"kind": body.shape.kind(), **body.shape.to_data(lambda _: 0)[0], "position": list(body.position)}
        for body in scene.bodies
        if body.mass == 0.0 and isinstance(body.shape, Box | Cylinder)
    ]


def _hinges(scene: Scene, rows: list[int]) -> list[dict[str, Any]]:
    """The driven hinges; each turns a body about the x axis of a frame of the parent, which is -1 for the world."""
    hinges: list[dict[str, Any]] = []
    for entry in scene.joints:
        assert isinstance(entry.joint, RevoluteJoint) and entry.drive is not None
        drive = {key: getattr(entry.drive, key) for key in ("stiffness", "damping", "max_force")}
        ends = {
            "child": rows.index(entry.body_a),
            "parent": -1 if entry.body_b is None else rows.index(entry.body_b),
            "in_child": [entry.frame_a.position, entry.frame_a.orientation],
            "in_parent": [entry.frame_b.position, entry.frame_b.orientation],
        }
        hinges.append({**ends, **drive, "limits": entry.joint.range})
    return hinges


def _read_result(
    case: BenchmarkCase, conditions: Conditions, sim: Simulator, found: Mapping[str, Any]
) -> dict[str, Any]:
    """The engine's figures; the simulator is set to its final state and measures the overlap."""
    figures = json.loads(str(found["figures"]))
    rows = moving(sim.scene)
    position, velocity = found["position"].astype(np.float32), found["linear_velocity"].astype(np.float32)
    if np.isfinite(position).all() and np.isfinite(found["orientation"]).all():
        sim.set("position", position, bodies=rows)
        sim.set("orientation", found["orientation"], bodies=rows)
    seconds, processor_seconds = figures.pop("seconds"), figures.pop("processor_seconds")
    return {
        **head(case, conditions),
        **figures,
        **rates(case, conditions, seconds, processor_seconds),
        "quality": quality(case, sim, position, velocity),
    }


def _fault(name: str, case: BenchmarkCase, conditions: Conditions, text: str) -> dict[str, Any]:
    return {**head(case, conditions), "engine": name, "fault": text}
