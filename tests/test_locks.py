"""Each lock holds all that its packages need, and nothing else: what is published later cannot matter."""

import shutil
import subprocess
import sys
import tomllib
from importlib import metadata
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
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


def is_wanted(requirement, extra=""):
    return requirement.marker is None or requirement.marker.evaluate({"extra": extra})


def pins_of(name):
    """Versions by the names of packages: those that this Python gets from a lock."""
    pins = [Requirement(pin_in(line)) for line in lines_of(name)]
    return {canonicalize_name(pin.name): str(pin.specifier).removeprefix("==") for pin in pins if is_wanted(pin)}


def roots_of(name):
    """Requirements that a lock is for, as pyproject.toml states them."""
    stated = tomllib.loads((ROOT / "pyproject.toml").read_text())
    if name != "dev":
        return stated["dependency-groups"][name]
    extras = [requirement for extra in stated["project"]["optional-dependencies"].values() for requirement in extra]
    others = [requirement for requirement in extras if not requirement.startswith("warp-rigid[")]
    return stated["build-system"]["requires"] + stated["project"]["dependencies"] + others


def needed(roots, needs):
    """Versions that the roots, and what they need in turn, leave open: a range by the name of each package."""
    ranges, done = {}, set()
    asked = [(root, "") for root in map(Requirement, roots)]
    while asked:
        requirement, extra = asked.pop()
        if not is_wanted(requirement, extra=extra):
            continue
        name = canonicalize_name(requirement.name)
        ranges[name] = ranges.get(name, SpecifierSet()) & requirement.specifier
        for wanted in {"", *requirement.extras} - {extra for key, extra in done if key == name}:
            done.add((name, wanted))
            asked += [(need, wanted) for need in map(Requirement, needs.get(name, []))]
    return ranges


def test_versions_of_one_environment_are_the_same():
    """PyTorch, JAX and gymnasium are installed beside the others."""
    main, frameworks = pins_of("dev"), pins_of("frameworks")
    shared = main.keys() & frameworks.keys()
    assert "numpy" in shared and {key: main[key] for key in shared} == {key: frameworks[key] for key in shared}


@pytest.mark.parametrize("name", LOCKS)
def test_a_lock_holds_what_its_packages_need(name):
    """By the metadata of what it has installed here."""
    environment = Path(sys.prefix) / "robots" if name == "robots" else Path(sys.prefix)
    places = [str(place) for place in environment.glob("lib/python*/site-packages")]
    found = {canonicalize_name(each.metadata["Name"]): each for each in metadata.distributions(path=places)}
    pins = pins_of(name)
    if name != "dev" and not (pins.keys() - pins_of("dev").keys()) & found.keys():
        pytest.skip("not installed here; the next test reads the metadata from the index")
    assert {key: found[key].version for key in pins if key in found} == pins
    ranges = needed(roots_of(name), {key: each.requires or [] for key, each in found.items()})
    assert sorted(pins) == sorted(ranges)
    assert [key for key, allowed in ranges.items() if not allowed.contains(pins[key], prereleases=True)] == []


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
