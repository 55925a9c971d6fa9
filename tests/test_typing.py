"""The types of the public names: all are stated, and a user's program passes a strict check."""

import inspect
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import warp_rigid as wr

ROOT = Path(__file__).resolve().parents[1]

PROGRAM = """
import numpy as np


def tower(count: int) -> wr.Scene:
    scene = wr.Scene(gravity=(0, 0, -9.81))
    scene.add_static(wr.Plane(), name="ground")
    boxes = [scene.add_body(wr.Box((0.1, 0.1, 0.1)), position=(0, 0, 0.1 + 0.2 * i)) for i in range(count)]
    scene.add_joint(wr.FixedJoint(), boxes[0], boxes[1])
    return scene


tall = wr.Simulator(tower(5), num_envs=8, settings=wr.Settings(dt=1 / 240, sleeping=True))
tall.apply_impulse((0, 0, 1), (0, 0, 0.1), 1)
table = wr.sweep("leaning_tower", {"offset": [0.1, 0.2]}, duration=0.5, metrics=["drift"])
drift: float = table.column("drift").max()
film = wr.Recording.load("film.npz")
wr.export_gltf(film, "film.glb")
again = wr.import_usd("film.usdc")
hills = wr.Heightfield(np.zeros((3, 3)), (2, 2))
wr.Mesh.from_file("bunny.obj").signed_distance([(0, 0, 0)])
"""

MISTAKES = """
wr.Settings(dt="a")
wr.Simulator(wr.Scene()).stepp(3)
wr.Scene().add_body(wr.Sphere(0.1), colour="red")
"""


def functions():
    """Public functions and methods, by name."""
    for name in wr.__all__:
        value = getattr(wr, name)
        if inspect.isfunction(value):
            yield name, inspect.unwrap(value)
        for base in value.__mro__ if inspect.isclass(value) else ():
            for member, function in vars(base).items():
                function = getattr(function, "__func__", getattr(function, "fget", function))
                own = base.__module__.startswith("warp_rigid") and (member[0] != "_" or member == "__init__")
                if own and inspect.isfunction(function):
                    yield f"{base.__name__}.{member}", inspect.unwrap(function)


def test_every_parameter_and_result_of_the_public_names_has_a_type():
    missing = set()
    for name, function in functions():
        signature = inspect.signature(function)
        missing |= {f"{name}({p.name})" for p in list(signature.parameters.values()) if p.annotation is p.empty}
        if signature.return_annotation is signature.empty and not name.endswith("__init__"):
            missing.add(name)
    assert {name for name in missing if not name.endswith(("(self)", "(cls)"))} == set()


@pytest.mark.long
def test_a_users_program_passes_the_strict_check(tmp_path):
    """The program of the README and more of the interface; mistakes are found."""
    (first,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), flags=re.DOTALL)
    (tmp_path / "right.py").write_text(first + PROGRAM)
    (tmp_path / "wrong.py").write_text(first + MISTAKES)
    command = [sys.executable, "-m", "mypy", "--strict", "--follow-imports=silent", "right.py", "wrong.py"]
    path = {**os.environ, "MYPYPATH": str(ROOT)}
    done = subprocess.run(command, cwd=tmp_path, env=path, capture_output=True, text=True)
    found = [line.split(":")[0] for line in done.stdout.splitlines() if ": error: " in line]
    assert (found, done.returncode) == (["wrong.py"] * 3, 1), done.stdout
