"""Settings of all tests: workers beside each other, a cache per session, and every device that is present.

`make test` starts several pytest processes (pytest-xdist). Each of them gets its own share of the cores, so that no
simulation takes the cores of another worker's. All kernels are compiled before the first worker starts, so that no two
workers compile the same one.
"""

import functools
import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]

MOST_WORKERS = 4
"""More workers need 1.5 GB of memory each and gain little: the longest files take a tenth of the whole time each."""

LONGEST = (
    "validation",
    "setup",
    "recipes",
    "scene_runs",
    "passive_mechanisms",
    "readme",
    "sweep_cluster",
    "ragdolls",
    "sweep_costs",
    "usd_scene",
    "determinism",
    "overlap",
    "forgetting",
    "ahead_of_time",
    "worlds",
    "deep_starts",
    "rounds",
    "resume",
    "doctor",
    "bench",
    "trust",
    "rolling_floors",
    "caches",
    "fuzz",
    "startup",
    "step_parts",
    "convex",
)
"""Files that take longest, in this order: the workers begin with them, so that none is left for one worker alone."""


def keep_to_own_cores():
    """Restrict a worker, and every process that it starts, to its share of the cores.

    It runs before NumPy and Warp are imported, whose threads inherit it.
    """
    worker = os.environ.get("PYTEST_XDIST_WORKER")
    if worker is not None and hasattr(os, "sched_setaffinity"):
        index, count = int(worker.removeprefix("gw")), int(os.environ["PYTEST_XDIST_WORKER_COUNT"])
        cores = sorted(os.sched_getaffinity(0))
        os.sched_setaffinity(0, cores[index % len(cores) :: count])


keep_to_own_cores()

import pytest  # noqa: E402
import warp as wp  # noqa: E402

wp.config.log_level = wp.LOG_WARNING


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers(config):
    """Workers of `-n auto`: one a core that this process may use."""
    from warp_rigid.engine.cores import usable_cores

    return min(usable_cores(), MOST_WORKERS)


def pytest_sessionstart(session):
    """Compile all kernels in one process before the workers start, at the level of messages that a new user has.

    A warning of the compiler for the CPU ends the tests: it is seen where a kernel is compiled for the first time.
    """
    if getattr(session.config.option, "numprocesses", None):
        command = [sys.executable, "-W", "ignore", "-m", "tests.compile_kernels"]
        done = subprocess.run(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
        warned = "warning:" in done.stdout and not wp.is_cuda_available()
        if done.returncode or warned:
            print(done.stdout)
            pytest.exit("the kernels do not compile without warnings", returncode=done.returncode or 1)


def untraced(function):
    """Pause the thread's coverage while a function of another package runs."""

    @functools.wraps(function)
    def call(*arguments, **options):
        tracer = sys.gettrace()
        if not hasattr(tracer, "stop"):
            return function(*arguments, **options)
        tracer.stop()
        try:
            return function(*arguments, **options)
        finally:
            tracer.start()

    return call


def pytest_configure(config):
    """Let coverage not follow Warp's own lines: it counts none of them, and that doubled the time of the tests."""
    if config.pluginmanager.hasplugin("_cov"):
        for owner, names in ((wp, ("launch", "zeros", "copy", "clone")), (wp.array, ("__init__", "zero_", "numpy"))):
            for name in names:
                setattr(owner, name, untraced(getattr(owner, name)))


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config, items):
    """Leave out the short form of a test whose long form is run as well, and begin with the longest files.

    Coverage leaves out long tests, some of which take 1.6 times as long with it.
    """
    long_ones = {item.function for item in items if item.get_closest_marker("long")}
    repeated = [item for item in items if item.get_closest_marker("short") and item.function in long_ones]
    if repeated:
        config.hook.pytest_deselected(items=repeated)
        items[:] = [item for item in items if item not in repeated]
    if config.pluginmanager.hasplugin("_cov"):
        for item in items:
            if item.get_closest_marker("long"):
                item.add_marker("no_cover")
    place = {f"test_{name}": number for number, name in enumerate(LONGEST)}
    items.sort(key=lambda item: place.get(item.path.stem, len(place)))


@pytest.fixture(params=[str(device) for device in wp.get_devices()])
def device(request):
    """A device of this machine, by name."""
    return request.param


@pytest.fixture(scope="session", autouse=True)
def own_cache(tmp_path_factory):
    """Grids of meshes are baked anew, once for all workers, and not into the user's cache."""
    before = os.environ.get("WARP_RIGID_CACHE")
    base = tmp_path_factory.getbasetemp()
    shared = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base
    os.environ["WARP_RIGID_CACHE"] = str(shared / "cache")
    yield
    if before is None:
        del os.environ["WARP_RIGID_CACHE"]
    else:
        os.environ["WARP_RIGID_CACHE"] = before
