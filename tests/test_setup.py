"""The oldest pip takes what the locks hold, and the command of the README brings all that its pages use."""

import json
import os
import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
from packaging.utils import canonicalize_name

from tests.pages import ROOT, commands
from tests.test_locks import LOCKS, pins_of

OLDEST, HASH = "22.3", "1daab4b8d3b97d1d763caeb01a4640a2250a0ea899e257b1e44b9eded91e15ab"
"""The version of pip that Python 3.11.0 brings, and the hash of its wheel."""

MADE = {"dev": ".venv/.ready", "robots": ".venv/.robots-ready"}
"""The targets of the Makefile that install the locks."""

ENVIRONMENT = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "VIRTUAL_ENV")}


def clone(folder):
    """The files of this checkout that git tracks, or that are new, as they are now."""
    listed = subprocess.run(
        ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
        cwd=ROOT,
        check=True,
        capture_output=True,
        text=True,
    ).stdout.split("\0")
    for name in filter(lambda name: name and os.path.lexists(ROOT / name), listed):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(ROOT / name, folder / name, follow_symlinks=False)
    return folder


def publish_newer(folder):
    """A wheel of a version 9999 of every package of the locks, as an index might offer it tomorrow."""
    folder.mkdir()
    for name in {package.replace("-", "_") for lock in LOCKS for package in pins_of(lock)}:
        info = f"{name}-9999.dist-info"
        with zipfile.ZipFile(folder / f"{name}-9999-py3-none-any.whl", "w") as wheel:
            wheel.writestr(f"{info}/METADATA", f"Metadata-Version: 2.1\nName: {name}\nVersion: 9999\n")
            wheel.writestr(f"{info}/WHEEL", "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n")
            wheel.writestr(f"{info}/RECORD", "")
    return folder


def oldest_pip(folder):
    """The oldest pip as one file, which Python runs."""
    (folder / "pip.txt").write_text(f"pip=={OLDEST} --hash=sha256:{HASH}\n")
    command = [sys.executable, "-m", "pip", "download", "--quiet", "--require-hashes", "--dest", folder]
    subprocess.run([*command, "-r", folder / "pip.txt"], check=True)
    return folder / f"pip-{OLDEST}-py3-none-any.whl" / "pip"


@pytest.mark.long
@pytest.mark.parametrize("lock", MADE)
def test_the_oldest_pip_takes_what_is_locked(lock, tmp_path):
    """Although newer versions of all packages exist. `.ci/run` installs the same with the pip of its machine."""
    if not pins_of(lock):
        pytest.skip("there are no converters of robots' files for this Python")
    pip = oldest_pip(tmp_path)
    links = f"{publish_newer(tmp_path / 'newer')} {os.environ.get('PIP_FIND_LINKS', '')}"
    environment = {**ENVIRONMENT, "PIP_FIND_LINKS": links}

    def run(*command):
        return subprocess.run(command, cwd=ROOT, env=environment, check=True, capture_output=True, text=True).stdout

    offered = run(sys.executable, pip, "download", "--no-deps", "--dest", tmp_path / "offered", "coverage")
    assert "coverage-9999" in offered
    recipe = run("make", "--dry-run", f"--assume-new={LOCKS[lock]}", MADE[lock])
    (options,) = re.findall(rf"-m pip (install .* -r {LOCKS[lock]})", recipe)
    report = tmp_path / "report.json"
    run(sys.executable, pip, *options.split(), "--ignore-installed", "--dry-run", "--report", report)
    found = [package["metadata"] for package in json.loads(report.read_text())["install"]]
    assert {canonicalize_name(package["name"]): package["version"] for package in found} == pins_of(lock)


@pytest.mark.long
def test_the_documented_command_brings_all_that_the_pages_use(tmp_path):
    """In a new environment, all commands and programs of the README, the tutorials and the notebooks run.

    uv reads the same requirements as pip in a tenth of the time; pip follows where uv fails, as in the Makefile.
    """
    copy, new = clone(tmp_path / "clone"), tmp_path / "venv" / "bin" / "python"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", tmp_path / "venv"], check=True)
    (documented,) = [command for command in commands([copy / "README.md"]) if command.startswith("pip install ")]
    wanted = f"{documented.removeprefix('pip ')} --quiet"
    with_uv = f"{Path(sys.executable).with_name('uv')} pip {wanted} --python {new}"
    with_pip = f"{sys.executable} -m pip --python {new} {wanted} --no-compile"
    subprocess.run(f"{with_uv} || {with_pip}", shell=True, cwd=copy, env=ENVIRONMENT, check=True)
    (tmp_path / "work").mkdir()
    environment = {**ENVIRONMENT, "PATH": f"{new.parent}{os.pathsep}{os.environ['PATH']}"}
    command = [new, copy / "tests" / "pages.py"]
    done = subprocess.run(command, cwd=tmp_path / "work", env=environment, capture_output=True, text=True)
    assert done.returncode == 0 and done.stdout.endswith("ran all\n"), done.stdout + done.stderr
