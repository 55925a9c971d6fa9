"""Every kernel compiles for a GPU of compute capability 9.0 on a machine that has none."""

import re
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace

import pytest
import warp as wp

from warp_rigid import kernels
from warp_rigid.engine import loading, step
from warp_rigid.kernels.common import team

ARCHITECTURE = 90

FOLDER = Path(kernels.__path__[0])
FILES = sorted(file for file in FOLDER.rglob("*.py") if file.stem != "__init__")
MODULES = {
    file.stem: import_module(".".join((kernels.__name__, *file.relative_to(FOLDER).with_suffix("").parts)))
    for file in FILES
}
NAMES = sorted(MODULES)
assert len(MODULES) == len(FILES), "two kernel files of one name"


CPU, GPU = SimpleNamespace(is_cuda=False), SimpleNamespace(is_cuda=True)
UNITS = sorted(unit for module in MODULES.values() for unit in loading.units_of(module, GPU))


def kernels_of(name):
    """Names of the kernels in a module's compilation unit."""
    return set(wp.get_module(MODULES[name].__name__).kernels)


def short(unit):
    """The name of a compilation unit without that of the package."""
    return unit.removeprefix(f"{kernels.__name__}.")


ENTRY = re.compile(r"(__global__ void [^{]*\{)")
"""The start of a kernel in CUDA."""


@pytest.fixture
def only_checked(monkeypatch):
    """Let kernels return at once: the compiler reads and checks all code, and has nothing to optimize.

    The optimization takes 20 times as long as the rest, and could only reveal faults of the compiler.
    """
    build = wp._src.build.build_cuda

    def build_without_bodies(path, *arguments, **options):
        source, count = ENTRY.subn(r"\1 return;", Path(path).read_text())
        assert count > 0
        Path(path).write_text(source)
        build(path, *arguments, **options)

    monkeypatch.setattr(wp._src.build, "build_cuda", build_without_bodies)


@pytest.mark.parametrize("unit", UNITS, ids=short)
def test_unit_passes_the_compiler_for_compute_capability_90(unit, only_checked, tmp_path):
    (binary,) = wp.compile_aot_module(unit, arch=ARCHITECTURE, module_dir=tmp_path, use_ptx=True)
    entries = binary.read_text().split(".entry ")[1:]
    assert [name for name in wp.get_module(unit).kernels if sum(e.startswith(f"{name}_") for e in entries) != 1] == []


def test_inline_assembly_is_assembled(tmp_path):
    """All that a GPU executes is in `kernels/common/team.py`, in functions that the colouring calls."""
    assert {file.stem for file in FILES if re.search(r"\basm\b", file.read_text())} == {"team", "branching"}
    wp.compile_aot_module(MODULES["coloring"].__name__, arch=ARCHITECTURE, module_dir=tmp_path, use_ptx=False)
    (source,) = tmp_path.glob("*.cu")
    instructions = set(re.findall(r'asm volatile\("[^"]+"', Path(team.__file__).read_text()))
    assert len(instructions) == 4 and all(instruction in source.read_text() for instruction in instructions)


@pytest.mark.parametrize(
    ("name", "kernel", "function"),
    [
        ("probe", "", "part_distance"),
        ("narrowphase", ".keep_contacts", "find_axis"),
        ("narrowphase", ".keep_contacts", "leave"),
    ],
)
def test_functions_that_only_a_cpu_calls_are_inlined(name, kernel, function):
    """The smallest units of large functions (`inline_on_gpu`)."""
    (binary,) = wp.compile_aot_module(MODULES[name].__name__ + kernel, arch=ARCHITECTURE, use_ptx=True)
    assert f"{function}_0".encode() not in binary.read_bytes()


def test_kernels_of_teams_are_compiled_for_clusters_of_blocks():
    """Kernels with a team for each environment, and no others of their module."""
    (unit,) = loading.units_of(MODULES["support"], GPU, team.CLUSTER)
    (binary,) = wp.compile_aot_module(unit, arch=ARCHITECTURE, use_ptx=True)
    entries = binary.read_text().split(".entry ")[1:]
    clustered = {entry.split("_cuda_kernel")[0] for entry in entries if ".reqnctapercluster" in entry}
    assert len(entries) == len(kernels_of("support"))
    assert [name.startswith("find_structure") for name in clustered] == [True]


@pytest.mark.parametrize("device", [CPU, GPU], ids=["cpu", "gpu"])
def test_every_kernel_lies_in_one_unit(device):
    """For a GPU, kernels of the modules that take longest to compile lie in units of their own."""
    for name in NAMES:
        units = loading.units_of(MODULES[name], device)
        found = [kernel for unit in units for kernel in wp.get_module(unit).kernels]
        assert sorted(found) == sorted(kernels_of(name))
        alone = device is GPU and MODULES[name].__name__ in loading.DIVIDED
        assert len(units) == (len(found) if alone else min(len(found), 1))


def test_every_stage_of_a_step_is_among_the_compiled():
    """The modules that a step uses are those of the test above, and the borrowed kernels lie in a unit of theirs."""
    used = {name for name, value in vars(step).items() if value in MODULES.values()}
    without_kernels = {name for name in used if not kernels_of(name)}
    assert without_kernels == {"declare", "pair_contacts", "schema", "touches"}
    loaded = {module.__name__.rpartition(".")[2] for module in loading.everything()}
    assert used - without_kernels <= loaded
    assert {name for name in NAMES if kernels_of(name)} - loaded == {"host_distance", "probe"}, "compiled on first use"
    searches = {"keep_contacts", "list_near_samples", "touch_near_samples", "choose_contacts", "build_contacts"}
    assert kernels_of("narrowphase") >= searches
