"""Every kernel compiles for a GPU of compute capability 9.0 on a machine that has none."""

from importlib import import_module
from pathlib import Path

import pytest
import warp as wp

from warp_rigid import kernels
from warp_rigid.engine import loading, step

ARCHITECTURE = 90

FOLDER = Path(kernels.__path__[0])
FILES = sorted(file for file in FOLDER.rglob("*.py") if file.stem != "__init__")
MODULES = {
    file.stem: import_module(".".join((kernels.__name__, *file.relative_to(FOLDER).with_suffix("").parts)))
    for file in FILES
}
NAMES = sorted(MODULES)
assert len(MODULES) == len(FILES), "two kernel files of one name"


def kernels_of(name):
    """Names of the kernels in a module's compilation unit."""
    return set(wp.get_module(MODULES[name].__name__).kernels)


@pytest.mark.parametrize(
    "ptx",
    [
        pytest.param(True, marks=pytest.mark.short, id="compiled"),
        pytest.param(False, marks=pytest.mark.long, id="assembled"),
    ],
)
@pytest.mark.parametrize("name", [name for name in NAMES if kernels_of(name)])
def test_module_compiles_for_compute_capability_90(name, ptx, tmp_path):
    """To PTX, and also to the code of the GPU, which takes up to a minute for the largest module."""
    (binary,) = wp.compile_aot_module(MODULES[name].__name__, arch=ARCHITECTURE, module_dir=tmp_path, use_ptx=ptx)
    assert binary.suffix == (".ptx" if ptx else ".cubin")
    content = binary.read_bytes()
    assert [kernel for kernel in kernels_of(name) if f"{kernel}_".encode() not in content] == []


def test_every_stage_of_a_step_is_among_the_compiled():
    """The modules that a step uses are those of the test above, and the borrowed kernels lie in a unit of theirs."""
    used = {name for name, value in vars(step).items() if value in MODULES.values()}
    without_kernels = {name for name in used if not kernels_of(name)}
    assert without_kernels == {"calm", "crowd", "declare", "pair_contacts", "schema", "team", "touches"}
    loaded = {module.__name__.rpartition(".")[2] for module in loading.everything()}
    assert used - without_kernels <= loaded
    assert {name for name in NAMES if kernels_of(name)} - loaded == {"host_distance", "probe"}, "compiled on first use"
    searches = {"keep_contacts", "list_near_samples", "touch_near_samples", "choose_contacts", "build_contacts"}
    assert kernels_of("narrowphase") >= searches
    assert kernels_of("gauss_seidel") >= {"sweep_constraints", "sweep_calm_islands"}
