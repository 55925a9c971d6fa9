"""The recipes of CONTRIBUTING.md, applied to one copy of the checkout and run there.

A new recipe needs an entry of RECIPES and one test below that runs a program in the copy. The files are as many as the
recipe states. Beside them, other programs reach all kernels of the copy, which are compiled with checks of indices.
"""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from warp_rigid import scenes

ROOT = Path(__file__).resolve().parents[1]
COPIED = ("kernels", "scenes", "warp_rigid")
NUMBERS = ("No", "One", "Two", "Three", "Four")


RECIPES = {
    "Add an analytic shape": [
        "warp_rigid/scene/shapes/rounded_box.py",
        "kernels/enums.py",
        "kernels/collide/distance.py",
    ],
    "Add a scene": ["scenes/sliding_box.py", "scenes/__init__.py"],
    "Add a body coefficient": [
        "warp_rigid/scene/coefficients.py",
        "kernels/schema.py",
        "kernels/constraints/build_contacts.py",
        "kernels/constraints/contact.py",
    ],
    "Add a force field": ["kernels/enums.py", "warp_rigid/scene/fields.py", "kernels/update/force_fields.py"],
}
"""The recipes and the files that each of them touches."""


@pytest.fixture(scope="module")
def copy(tmp_path_factory):
    """The packages of this checkout, with their links, and all recipes applied: kernels are compiled once for all."""
    folder = tmp_path_factory.mktemp("copy")
    for name in COPIED:
        shutil.copytree(ROOT / name, folder / name, symlinks=True, ignore=shutil.ignore_patterns("__pycache__"))
    assert {title: apply(title, folder) for title in RECIPES} == RECIPES
    return folder


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
    (stated,) = re.findall(r"\b(\w+)\s+files\s+change\.", section)
    assert NUMBERS.index(stated) == len(touched)
    return touched


def change(file, hunk):
    """Apply the lines of one hunk, at the only place where they fit."""
    before = "".join(line[1:] for line in hunk if not line.startswith("+"))
    after = "".join(line[1:] for line in hunk if not line.startswith("-"))
    text = file.read_text()
    assert text.count(before) == 1, f"{file.name} has not exactly one\n{before}"
    file.write_text(text.replace(before, after))


def run(copy, program, *arguments):
    """What a program prints that imports the copy. All kernels are new; on a CPU they have Warp's checks."""
    if not any("cuda" in argument for argument in arguments):
        program = "import warp; warp.config.mode = 'debug'\n" + program
    command = [sys.executable, "-W", "ignore", "-c", program, *arguments]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}  # behind the copy
    done = subprocess.run(command, cwd=copy, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


ROUNDED_BOX = """
import json, sys
import numpy as np
import warp_rigid as wr
from warp_rigid.scene.serialization import scenes_from_data, scenes_to_data
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
data, arrays = scenes_to_data([scene])
(again,) = scenes_from_data(json.loads(json.dumps(data)), arrays)
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


@pytest.mark.long
def test_an_analytic_shape_takes_three_files(copy, device):
    """Distance against that to the box inside, mass against random points, heights at rest against the half height."""
    found = json.loads(run(copy, ROUNDED_BOX, str(device), str(copy / "box.usda")).splitlines()[-1])
    assert found["equal"]
    assert found["distance"] < 1e-14
    assert found["slope"] < 1e-6
    assert found["volume"] == pytest.approx(1.0, rel=3e-3)
    assert found["inertia"] == pytest.approx([1.0] * 3, rel=5e-3)
    assert found["heights"] == pytest.approx([0.08, 0.28, 0.08], abs=1e-4)
    assert found["speed"] < 1e-2
    assert 0.9 < found["drawn"] < 1.0, "the vertices of the triangles lie on the surface"


COMMAND = """
import json, sys, warp_rigid
from warp_rigid.commands import cli
print(json.dumps(warp_rigid.scenes.names()), flush=True)
sys.exit(cli.main(sys.argv[1:]))
"""


@pytest.mark.long
def test_a_scene_takes_two_files(copy, device):
    """The box stops after v^2 / (2 mu g), less v dt / 2: in each step it moves with the velocity at the step's end."""
    command = ("run", "sliding_box", "--device", str(device), "--json", "--frames", "60")
    names, told = run(copy, COMMAND, *command).split("\n", 1)
    assert json.loads(names) == [*scenes.names(), "sliding_box"]
    found = json.loads(told)
    (verdict,) = found["verdicts"]
    assert (found["frames"], verdict["passed"]) == (60, [True])
    assert verdict["values"] == pytest.approx([2.0**2 / (2 * 0.5 * 9.81) - 2.0 / 240 / 2], abs=1e-4)


VISCOUS_FRICTION = """
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


@pytest.mark.long
def test_a_body_coefficient_takes_four_files(copy, device):
    """Speed of a box that slides with a friction coefficient proportional to its speed."""
    run(copy, VISCOUS_FRICTION, str(device))


@pytest.mark.long
def test_a_force_field_takes_three_files(copy, device):
    """Energy of a body on a spring, and its position after a second."""
    run(copy, OSCILLATOR, str(device))


CHECKED = """
import os
os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:1])  # Warp's debug mode runs kernels on one thread only
import numpy as np
import warp_rigid as wr
from tests import random_scenes
from tests.random_scenes import act, heap, random_scene, random_settings

for seed in range(4):
    rng = np.random.default_rng(seed)
    sim = wr.Simulator(random_scene(rng), settings=random_settings(rng), device="cpu", capacity={"contacts": 4})
    sim.watch([None, 1])
    for step in range(6):
        act(sim, step, rng)
        sim.step(12)
        sim.penetration()
few = wr.Settings(sleeping=True, contact_iterations=1)  # more rounds read the same places
sim = wr.Simulator(heap(rng), settings=few, device="cpu")
sim.step(8)
print("read", len(sim.contacts()), "contacts of a heap")
"""


@pytest.mark.long
@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="needs a process on one core")
def test_no_index_is_out_of_bounds(copy):
    """Warp's checks end the process at the first element that is read or written outside an array, in all kernels."""
    assert int(run(copy, CHECKED).split()[-5]) > 100
