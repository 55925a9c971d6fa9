"""Files of robots for tests: those that gymnasium and newton ship, in the environment of the converters."""

import json
import os
import shutil
import subprocess
import tempfile
from pathlib import Path

import pytest

from warp_rigid.usd.robots import search_path

GYMNASIUM = (
    "ant.xml",
    "half_cheetah.xml",
    "hopper.xml",
    "humanoid.xml",
    "inverted_double_pendulum.xml",
    "inverted_pendulum.xml",
    "reacher.xml",
    "swimmer.xml",
    "walker2d_v5.xml",
)
NEWTON = ("cartpole.urdf", "quadruped.urdf")
FILES = {**dict.fromkeys(GYMNASIUM, "gymnasium/envs/mujoco/assets"), **dict.fromkeys(NEWTON, "newton/examples/assets")}
"""Folders of the files in the packages."""


def moved_by_mujoco(path: Path, seconds: float) -> dict:
    """Masses, inertia tensors and motion of a robot in MuJoCo without contacts and limits; see mujoco_oracle.py."""
    python = Path(shutil.which("mujoco_usd_converter", path=search_path())).resolve().parent / "python"
    script = Path(__file__).with_name("mujoco_oracle.py")
    surroundings = {key: value for key, value in os.environ.items() if key not in ("PYTHONPATH", "PYTHONHOME")}
    command = [str(python), str(script), str(path), str(seconds)]
    with tempfile.TemporaryDirectory() as folder:  # MuJoCo writes a log
        done = subprocess.run(command, capture_output=True, text=True, check=True, env=surroundings, cwd=folder)
    return json.loads(done.stdout.splitlines()[-1])


def robot_files() -> dict[str, Path]:
    """Paths of the files by name; skips the test if they or the converters are not installed."""
    programs = [shutil.which(f"{kind}_usd_converter", path=search_path()) for kind in ("mujoco", "urdf")]
    if None in programs:
        pytest.skip("the converters of robots' files are not installed")
    packages = sorted(Path(programs[0]).resolve().parents[1].glob("lib/python*/site-packages"))
    found = {name: place / folder / name for place in packages for name, folder in FILES.items()}
    if not all(file.is_file() for file in found.values()):
        pytest.skip("gymnasium and newton are not installed beside the converters")
    return found
