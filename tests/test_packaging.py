"""What is installed, and what importing it costs."""

import json
import os
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from docs import make_sbom

ROOT = Path(__file__).resolve().parents[1]
HEAVY = [
    "pxr",
    "viser",
    "pandas",
    "trimesh",
    "manifold3d",
    "typer",
    "rich",
    "PIL",
    "matplotlib",
    "scipy",
    "pyarrow",
    "zarr",
    "distributed",
    "dask",
    "optuna",
    "polars",
]


@pytest.fixture(scope="module")
def pyproject() -> dict:
    return tomllib.loads((ROOT / "pyproject.toml").read_text())


def test_every_folder_with_source_is_in_the_wheel(pyproject):
    setuptools = pyproject["tool"]["setuptools"]
    shipped = {setuptools["package-dir"].get(package, package.replace(".", "/")) for package in setuptools["packages"]}
    # rglob does not descend into the linked folders, so each file counts once, where it lies.
    with_source = {
        file.parent.relative_to(ROOT).as_posix()
        for top in ("warp_rigid", "kernels", "scenes")
        for file in (ROOT / top).rglob("*.py")
        if not any(parent.is_symlink() for parent in file.parents)
    }
    assert with_source == shipped


def test_the_bill_of_materials_is_that_of_the_lock():
    made = json.loads((ROOT / "sbom.json").read_text())
    assert made == json.loads(make_sbom.bill_of_materials())
    assert made["bomFormat"] == "CycloneDX" and len(made["components"]) > 80


def test_the_notice_names_every_dependency(pyproject):
    notice = (ROOT / "NOTICE").read_text()
    for requirement in pyproject["project"]["dependencies"]:
        assert f"- {requirement.split('>')[0]} (" in notice


IMPORT = """
import sys, time
start = time.process_time()
import warp
between = time.process_time()
import warp_rigid
print((time.process_time() - between) / (between - start), *sys.modules)
"""


@pytest.mark.quiet
def test_import_is_quick_and_light(tmp_path):
    """Compared with the import of Warp, as both take longer on a slow machine: measured 1.3 to 1.7 times as much.

    Half of it is the decoration of the kernels.
    """
    environment = {**os.environ, "PYTHONDONTWRITEBYTECODE": "", "PYTHONPYCACHEPREFIX": str(tmp_path)}
    runs = [
        subprocess.run(
            [sys.executable, "-c", IMPORT], cwd=ROOT, check=True, capture_output=True, text=True, env=environment
        ).stdout.split()
        for _ in range(3)
    ]
    loaded = {module.split(".")[0] for module in runs[0][1:]}
    assert loaded.isdisjoint(HEAVY)
    # The first run wrote the bytecode that the others read, as in any installed package.
    assert min(float(run[0]) for run in runs[1:]) < 2.5
