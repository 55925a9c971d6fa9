"""Each lock holds all that its packages need, and nothing else: what is published later cannot matter."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parents[1]
LOCKS = {"dev": "requirements.lock", "robots": "tests/robots.lock", "frameworks": "tests/frameworks.lock"}
"""By the extra or the group of pyproject.toml that each is for."""


def lines_of(name):
    """The lines of a lock, one for each package: its version, and the hashes of its files."""
    text = (ROOT / LOCKS[name]).read_text().replace("\\\n", "")
    return [line.split() for line in text.splitlines() if not line.startswith("#")]


def pin_in(line):
    """A line without its hashes."""
    return " ".join(word for word in line if not word.startswith("--"))


def pins_of(name):
    """Versions by the names of packages: those that this Python gets from a lock."""
    pins = [Requirement(pin_in(line)) for line in lines_of(name)]
    return {
        canonicalize_name(pin.name): str(pin.specifier).removeprefix("==")
        for pin in pins
        if not pin.marker or pin.marker.evaluate()
    }


def test_versions_of_one_environment_are_the_same():
    """PyTorch, JAX and gymnasium are installed beside the others."""
    main, frameworks = pins_of("dev"), pins_of("frameworks")
    shared = main.keys() & frameworks.keys()
    assert "numpy" in shared and {key: main[key] for key in shared} == {key: frameworks[key] for key in shared}


@pytest.mark.long
def test_renewing_the_locks_changes_nothing(tmp_path):
    """By the metadata of the index, for each Python and platform; later files of the same version do not count."""
    for file in ("Makefile", "pyproject.toml", "docs/make_sbom.py", *LOCKS.values()):
        (tmp_path / file).parent.mkdir(exist_ok=True)
        shutil.copy(ROOT / file, tmp_path / file)
    command = ["make", f"--assume-old={sys.prefix}/.ready", f"VENV={sys.prefix}", "locks"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    if "Failed to fetch" in done.stderr:
        pytest.skip("the index cannot be reached")
    assert done.returncode == 0, done.stderr
    for lock in LOCKS.values():
        before, after = ((folder / lock).read_text().splitlines() for folder in (ROOT, tmp_path))
        assert [line for line in before if "--hash" not in line] == [line for line in after if "--hash" not in line]
