"""Wheel and sdist: built from a copy of the checkout, installed into an environment that has nothing else of ours."""

import json
import os
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from hashlib import sha256
from importlib import metadata
from pathlib import Path

import numpy as np
import pytest
import warp as wp

from docs import make_dist

ROOT = Path(__file__).resolve().parents[1]


def build(source, target, kinds=("build_sdist", "build_wheel")):
    """Paths of what is built: the sdist and the wheel, or one of them."""
    target.mkdir()
    made = []
    for what in kinds:
        command = [sys.executable, "-c", make_dist.BUILD, what, str(target)]
        done = subprocess.run(command, cwd=source, check=True, capture_output=True, text=True)
        made.append(target / done.stdout.splitlines()[-1])
    return made


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    folder = tmp_path_factory.mktemp("built")
    copy = shutil.ignore_patterns(
        ".git", ".venv", "out", "build", "*.egg-info", "__pycache__", ".*_cache", ".hypothesis"
    )
    shutil.copytree(ROOT, folder / "source", symlinks=True, ignore=copy)
    return build(folder / "source", folder / "dist")


LIST_SCENES = "import warp_rigid; from warp_rigid.commands import cli; print(warp_rigid.__file__); cli.main(['scenes'])"


def contents(wheel):
    with zipfile.ZipFile(wheel) as file:
        return {name: file.read(name) for name in file.namelist() if not name.endswith("RECORD")}


@pytest.mark.long
def test_the_wheel_holds_the_package_and_nothing_else(built):
    names = set(contents(built[1]))
    own = {name for name in names if name.startswith("warp_rigid/")}
    assert names - own == {name for name in names if ".dist-info/" in name}
    assert {"warp_rigid/py.typed", "warp_rigid/kernels/schema.py", "warp_rigid/scenes/demo.py"} <= own
    assert all(any(name.endswith(f"licenses/{file}") for name in names) for file in ("LICENSE", "NOTICE"))


def test_a_wheel_from_the_sdist_is_the_same(built, tmp_path):
    with tarfile.open(built[0]) as file:
        file.extractall(tmp_path, filter="data")
    (source,) = tmp_path.iterdir()
    (again,) = build(source, tmp_path / "dist", ["build_wheel"])
    assert contents(again) == contents(built[1])


@pytest.mark.long
@pytest.mark.skipif(not (ROOT / ".git").exists(), reason="builds a commit")
def test_two_builds_of_a_commit_have_the_same_bytes(tmp_path, monkeypatch):
    """On another day, in another time zone, with other default permissions."""
    first = make_dist.build(tmp_path / "first")
    monkeypatch.setenv("TZ", "Asia/Tokyo")
    monkeypatch.setenv("PYTHONHASHSEED", "1")
    before = os.umask(0o077)
    try:
        second = make_dist.build(tmp_path / "second")
    finally:
        os.umask(before)
    assert [path.name for path in first] == [path.name for path in second]
    assert [sha256(path.read_bytes()).hexdigest() for path in first] == [
        sha256(path.read_bytes()).hexdigest() for path in second
    ]
    with tarfile.open(first[0]) as file:
        assert {member.mode & 0o777 for member in file if member.isfile()} <= {0o644, 0o755}


@pytest.mark.long
def test_the_wheel_runs_in_a_clean_environment(built, tmp_path):
    """Its own packages only, with the libraries it asks for beside it, away from the checkout."""
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", tmp_path / "venv"], check=True)
    python = tmp_path / "venv" / "bin" / "python"
    install = [sys.executable, "-m", "pip", "--python", python, "install", "--quiet", "--no-deps", "--no-index"]
    subprocess.run([*install, built[1]], check=True)
    (site,) = (tmp_path / "venv" / "lib").glob("python*/site-packages")
    (site / "libraries.pth").write_text(str(Path(np.__file__).parents[1]))
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}

    def run(*command):
        done = subprocess.run(command, cwd=tmp_path, env=environment, check=True, capture_output=True, text=True)
        return done.stdout

    where, *listed = run(python, "-c", LIST_SCENES).splitlines()
    assert Path(where).is_relative_to(tmp_path / "venv") and any("incline" in line for line in listed)
    command = tmp_path / "venv" / "bin" / "warp-rigid"
    summary = json.loads(run(command, "run", "incline", "--frames", "2", "--device", "cpu", "--json"))
    assert summary["frames"] == 2 and summary["failed"] == []


def test_the_warp_that_runs_is_one_that_is_supported():
    """The oldest and the newest version that the range allows are one at present: 1.19.0, which the lock pins."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    (wanted,) = [r for r in project["dependencies"] if r.startswith("warp-lang")]
    assert wanted == "warp-lang>=1.19,<1.20"
    assert wp.__version__.startswith("1.19.")
    lock = (ROOT / "requirements.lock").read_text().splitlines()
    assert any(line.split()[0] == f"warp-lang=={metadata.version('warp-lang')}" for line in lock)
