"""The recipes of CONTRIBUTING.md, applied to a copy of the checkout and run there.

A new recipe needs one test below: apply it, compare the files that it touches, and run a program in the copy.
"""

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
COPIED = ("kernels", "scenes", "warp_rigid")


@pytest.fixture
def copy(tmp_path):
    """The packages of this checkout, with their links."""
    for folder in COPIED:
        shutil.copytree(ROOT / folder, tmp_path / folder, symlinks=True, ignore=shutil.ignore_patterns("__pycache__"))
    return tmp_path


def apply(title, copy):
    """Apply a recipe to a copy: its python blocks are new files, its diff blocks changes.

    Returns:
        The files that the recipe touches, as named before each block.
    """
    text = (ROOT / "CONTRIBUTING.md").read_text()
    (section,) = re.findall(rf"^## {re.escape(title)}\n(.*?)(?=^## |\Z)", text, re.M | re.S)
    pieces = re.split(r"^```(\w+)\n(.*?)^```$", section, flags=re.M | re.S)
    touched = []
    for before, language, block in zip(pieces[0::3], pieces[1::3], pieces[2::3], strict=False):
        (name,) = re.findall(r"^`(\S+)`[:,]", before.rstrip().split("\n\n")[-1])
        file = copy / name
        if language == "python":
            assert not file.exists(), f"{name} is not new"
            file.write_text(block)
        else:
            for hunk in re.split(r"^@@.*\n", block, flags=re.M):
                change(file, hunk.splitlines(keepends=True))
        touched.append(name)
    return touched


def change(file, hunk):
    """Apply the lines of one hunk, at the only place where they fit."""
    before = "".join(line[1:] for line in hunk if not line.startswith("+"))
    after = "".join(line[1:] for line in hunk if not line.startswith("-"))
    text = file.read_text()
    assert text.count(before) == 1, f"{file.name} has not exactly one\n{before}"
    file.write_text(text.replace(before, after))


def run(copy, *arguments):
    """What a Python process prints that imports the copy."""
    done = subprocess.run([sys.executable, "-W", "ignore", *arguments], cwd=copy, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


ROUNDED_BOX = """
import json, sys
import numpy as np
import warp_rigid as wr
from warp_rigid.scene.serialization import scene_from_data, scene_to_data
from warp_rigid.scene.shapes.rounded_box import RoundedBox

shape = RoundedBox((0.2, 0.1, 0.05), 0.03)
points = np.random.default_rng(0).uniform(-1, 1, (400_000, 3)) * [0.24, 0.14, 0.09]
nearest = np.clip(points, -shape.half_extents, shape.half_extents)
expected = np.linalg.norm(points - nearest, axis=1) - shape.radius
outer = expected > -shape.radius
distance, gradient = shape.signed_distance(points)
inside = points[distance < 0.0]
volume = 8 * 0.24 * 0.14 * 0.09 * len(inside) / len(points)
second = volume * (inside**2).mean(axis=0)
step = 1e-6 * gradient

scene = wr.Scene()
scene.add_static(wr.Plane(), friction=0.5)
scene.add_static(wr.Box((0.5, 0.5, 0.1)), position=(2, 0, 0.1), friction=0.5)
scene.add_body(shape, position=(0, 0, 0.09))
scene.add_body(shape, position=(2, 0, 0.29))
scene.add_body(shape, position=(0, 2, 0.20), orientation=(0, 0.38, 0, 0.92))
data, arrays = scene_to_data(scene)
again = scene_from_data(json.loads(json.dumps(data)), arrays)
sim = wr.Simulator(again, device=sys.argv[1])
sim.step(720)
path = sys.argv[2]
wr.export_usd(wr.record(sim, 1), path)
drawn = wr.import_usd(path).bodies[2].shape
slope = shape.signed_distance(points + step)[0] - shape.signed_distance(points - step)[0]
print(json.dumps({
    "equal": again.bodies == scene.bodies,
    "distance": float(np.abs(distance - expected)[outer].max()),
    "slope": float(np.median(np.abs(slope / 2e-6 - 1.0))),
    "volume": shape.volume / volume,
    "inertia": (np.diag(shape.inertia) / (second.sum() - second)).tolist(),
    "heights": sim.get("position")[0, 2:, 2].tolist(),
    "speed": float(np.abs(sim.get("linear_velocity")).max()),
    "drawn": drawn.volume / shape.volume,
}))
"""


def test_an_analytic_shape_takes_three_files(copy, device):
    """Distance against that to the box inside, mass against random points, heights at rest against the half height."""
    touched = apply("Add an analytic shape", copy)
    assert touched == ["warp_rigid/scene/shapes/rounded_box.py", "kernels/enums.py", "kernels/collide/distance.py"]
    found = json.loads(run(copy, "-c", ROUNDED_BOX, str(device), str(copy / "box.usda")).splitlines()[-1])
    assert found["equal"]
    assert found["distance"] < 1e-14
    assert found["slope"] < 1e-6
    assert found["volume"] == pytest.approx(1.0, rel=3e-3)
    assert found["inertia"] == pytest.approx([1.0] * 3, rel=5e-3)
    assert found["heights"] == pytest.approx([0.08, 0.28, 0.08], abs=1e-4)
    assert found["speed"] < 1e-2
    assert 0.9 < found["drawn"] < 1.0, "the vertices of the triangles lie on the surface"


NAMES = "import json, warp_rigid; print(json.dumps(warp_rigid.scenes.names()))"


def test_a_scene_takes_two_files(copy, device):
    """The box stops after v^2 / (2 mu g), less v dt / 2: in each step it moves with the velocity at the step's end."""
    assert apply("Add a scene", copy) == ["scenes/sliding_box.py", "scenes/__init__.py"]
    command = ("-m", "warp_rigid.commands.cli", "run", "sliding_box", "--device", str(device), "--json")
    short = json.loads(run(copy, *command, "--frames", "5"))
    assert short["frames"] == 5
    assert json.loads(run(copy, "-c", NAMES)) == [*json.loads(run(ROOT, "-c", NAMES)), "sliding_box"]
    (verdict,) = json.loads(run(copy, *command, "--frames", "60"))["verdicts"]
    assert verdict["passed"] == [True]
    assert verdict["values"] == pytest.approx([2.0**2 / (2 * 0.5 * 9.81) - 2.0 / 240 / 2], abs=1e-4)
