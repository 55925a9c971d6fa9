"""Settings of all tests: workers beside each other, a cache per session, and every device that is present.

`make test` starts several pytest processes (pytest-xdist). Each of them gets its own share of the cores, so that no
simulation takes the cores of another worker's. All kernels are compiled before the first worker starts, so that no two
workers compile the same one.
"""

import os
import subprocess
import sys

MOST_WORKERS = 4
"""More workers need 1.5 GB of memory each and gain little: the longest file takes a fifth of the whole time."""

COMPILE = """
import warp as wp
from warp_rigid.engine.step import EVERYTHING, WARP, load_kernels
from warp_rigid.kernels.common import team
from warp_rigid.render import raycast

wp.config.log_level = wp.LOG_WARNING
for device in wp.get_devices():
    load_kernels(device, (*EVERYTHING, raycast), lanes=(WARP, team.BLOCK))
"""


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
    """Compile all kernels in one process before the workers start."""
    if getattr(session.config.option, "numprocesses", None):
        subprocess.run([sys.executable, "-W", "ignore", "-c", COMPILE], check=True)


@pytest.fixture(params=[str(device) for device in wp.get_devices()])
def device(request):
    """A device of this machine, by name."""
    return request.param


@pytest.fixture(scope="session", autouse=True)
def own_cache(tmp_path_factory):
    """Grids of meshes are baked anew, and not into the user's cache."""
    before = os.environ.get("WARP_RIGID_CACHE")
    os.environ["WARP_RIGID_CACHE"] = str(tmp_path_factory.mktemp("cache"))
    yield
    if before is None:
        del os.environ["WARP_RIGID_CACHE"]
    else:
        os.environ["WARP_RIGID_CACHE"] = before
