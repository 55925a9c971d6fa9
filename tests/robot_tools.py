"""Files of robots for tests: those that gymnasium and newton ship, in the environment of the converters."""

import shutil
from pathlib import Path

import pytest

from warp_rigid.usd.robots import search_path

FILES = {"ant.xml": "gymnasium/envs/mujoco/assets", "cartpole.urdf": "newton/examples/assets"}
"""Folders of the files in the packages."""


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
