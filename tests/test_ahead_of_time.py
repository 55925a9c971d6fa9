"""Every kernel compiles for a GPU of compute capability 9.0 on a machine that has none."""

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


ASSEMBLED = {module.__name__ for module in loading.TEAM_MODULES}
"""Units with inline assembly, which only the assembler checks: it is that of `kernels/common/team.py`. The units of
joints call the same functions, and take minutes to assemble."""

SLOW = ("move_untouched", "settle_joints", "sweep_with_joints", "close_stopped")
"""Kernels that take one to three minutes together to compile, of functions that other kernels of joints call, too."""


def marks_of(unit, form):
    """When a form of a unit is compiled: what is assembled needs not be compiled beside that."""
    if unit.rpartition(".")[2] in SLOW:
        return pytest.mark.long
    return form if unit in ASSEMBLED else ()


FORMS = [
    pytest.param(unit, ptx, id=f"{short(unit)}-{name}", marks=marks_of(unit, marks))
    for unit in UNITS
    for ptx, name, marks in ((True, "compiled", pytest.mark.short), (False, "assembled", pytest.mark.long))
    if ptx or unit in ASSEMBLED
]


@pytest.mark.parametrize(("unit", "ptx"), FORMS)
def test_unit_compiles_for_compute_capability_90(unit, ptx):
    """To PTX, or to the code of the GPU. Functions that only a CPU calls are inlined.

    What is compiled stays in Warp's cache: units that have not changed are not compiled again.
    """
    (binary,) = wp.compile_aot_module(unit, arch=ARCHITECTURE, use_ptx=ptx)
    assert binary.suffix == (".ptx" if ptx else ".cubin")
    content = binary.read_bytes()
    assert [kernel for kernel in wp.get_module(unit).kernels if f"{kernel}_".encode() not in content] == []
    assert [name for name in (b"part_distance_0", b"find_axis_0", b"leave_0") if name in content] == []


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
