"""CONTRIBUTING.md: "Add a body coefficient" and "Add a force field", applied to a copy of the checkout."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
LEFT_OUT = shutil.ignore_patterns(".*", "out", "shared", "__pycache__", "docs", "tests")

SLIDING_BOX = """
import sys
import numpy as np
import warp_rigid as wr

g, dt, k, v0, steps = 9.81, 1 / 240, 0.5, 2.0, 120
scene = wr.Scene()
scene.add_static(wr.Plane((0, 0, 1), 0.0), friction=0.0, viscous_friction=10.0)
scene.add_body(
    wr.Box((0.2, 0.2, 0.05)), position=(0, 0, 0.05), linear_velocity=(v0, 0, 0), friction=0.0, viscous_friction=k
)
try:
    scene.add_body(wr.Sphere(0.1), viscous_friction=-1.0)
    raise SystemExit("a negative value was accepted")
except ValueError as error:
    assert str(error) == "viscous_friction: must be a finite number >= 0, got -1.0", error

sim = wr.Simulator(scene, num_envs=3, settings=wr.Settings(dt=dt), device=sys.argv[1])
factors = np.array([1.0, 0.5, 0.0])
sim.set("viscous_friction", k * factors[:, None], bodies=[1])
sim.save("box.ckpt")
sim = wr.Simulator.load("box.ckpt", device=sys.argv[1])
assert np.allclose(sim.get("viscous_friction")[:, 1], k * factors)
recording = wr.record(sim, frames=0, fps=60)
wr.export_usd(recording, "box.usda", envs=[0])
assert abs(wr.import_usd("box.usda").bodies[1].viscous_friction - k) < 1e-6

# dv/dt = -k g v; the solver finds the velocity at the end of each step, so v = v0 / (1 + k g dt)^n.
sim.step(steps)
expected = v0 / (1 + k * factors * g * dt) ** steps
found = sim.get("linear_velocity")[:, 1, 0]
assert np.allclose(found, expected, rtol=1e-4), (found, expected)

result = wr.sweep(scene, {"viscous_friction": [0.1, 0.2]}, duration=0.1, device=sys.argv[1])
assert [row["viscous_friction"] for row in result.rows] == [0.1, 0.2]
"""

OSCILLATOR = """
import sys
import numpy as np
import warp_rigid as wr

center, stiffness, dt, steps = np.array([0.5, 0.0, 0.0]), 4.0, 1e-3, 1000
scene = wr.Scene(gravity=(0, 0, 0))
scene.add_force_field(wr.SpringField(center, stiffness))
scene.add_body(wr.Sphere(0.1), position=(1.5, 0, 0), linear_velocity=(0, 1, 0))
try:
    wr.SpringField(center, np.inf)
    raise SystemExit("an infinite value was accepted")
except ValueError as error:
    assert str(error) == "stiffness: must be a finite number, got inf", error

sim = wr.Simulator(scene, settings=wr.Settings(dt=dt), device=sys.argv[1])
sim.save("spring.ckpt")
sim = wr.Simulator.load("spring.ckpt", device=sys.argv[1])
assert sim.scene.force_fields == scene.force_fields
wr.export_usd(wr.record(sim, frames=0, fps=50), "spring.usda")
assert wr.import_usd("spring.usda").force_fields == scene.force_fields

# Harmonic motion with angular frequency w; the integrator's position error is at most of the size of w dt.
w, t = np.sqrt(stiffness), steps * dt
energy = (sim.get("kinetic_energy") + sim.get("potential_energy"))[0, 0]
mass = scene.bodies[0].mass
assert np.isclose(energy, mass * (0.5 + 0.5 * stiffness), rtol=1e-5), energy
sim.step(steps)
expected = center + np.array([np.cos(w * t), np.sin(w * t) / w, 0.0])
assert np.abs(sim.get("position")[0, 0] - expected).max() < w * dt, (sim.get("position"), expected)
"""


def blocks(title: str) -> dict[str, list[tuple[str, str]]]:
    """For each file of a recipe its changes: the text before and after."""
    text = (ROOT / "CONTRIBUTING.md").read_text()
    section = re.search(rf"^## {title}\n(.*?)(?=^## |\Z)", text, flags=re.M | re.S)
    assert section is not None
    changes: dict[str, list[tuple[str, str]]] = {}
    for path, diff in re.findall(r"^`([\w/]+\.py)`:[^`]*?```diff\n(.*?)```", section[1], flags=re.M | re.S):
        for hunk in re.split(r"^@@.*\n", diff, flags=re.M):
            lines = hunk.splitlines(keepends=True)
            before = "".join(line[1:] or "\n" for line in lines if not line.startswith("+"))
            after = "".join(line[1:] or "\n" for line in lines if not line.startswith("-"))
            changes.setdefault(path, []).append((before, after))
    assert section[1].count("```diff") == len(changes)
    return changes


def apply(title: str, checkout: Path) -> set[str]:
    """Apply a recipe to a checkout. Returns the files that it changes."""
    changes = blocks(title)
    for path, hunks in changes.items():
        file = checkout / path
        source = file.read_text()
        for before, after in hunks:
            assert source.count(before) == 1, f"{path}: must have these lines once:\n{before}"
            source = source.replace(before, after)
        file.write_text(source)
    return set(changes)


@pytest.fixture(scope="module")
def changed(tmp_path_factory):
    """A copy of the checkout with both recipes applied, which compiles the kernels once, and the files of each."""
    checkout = tmp_path_factory.mktemp("recipes") / "checkout"
    shutil.copytree(ROOT, checkout, symlinks=True, ignore=LEFT_OUT)
    titles = ("Add a body coefficient", "Add a force field")
    return checkout, {title: apply(title, checkout) for title in titles}


def run(program: str, checkout: Path, folder: Path, device: str) -> None:
    done = subprocess.run(
        [sys.executable, "-W", "error::SyntaxWarning", "-c", program, device],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(checkout)},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr


def test_a_body_coefficient_takes_four_files(changed, tmp_path, device):
    checkout, files = changed
    assert len(files["Add a body coefficient"]) <= 4
    run(SLIDING_BOX, checkout, tmp_path, device)


def test_a_force_field_takes_three_files(changed, tmp_path, device):
    checkout, files = changed
    assert len(files["Add a force field"]) <= 3
    run(OSCILLATOR, checkout, tmp_path, device)
