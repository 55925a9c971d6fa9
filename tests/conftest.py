"""What all tests of the engine share: every one of them runs on every device that is present."""

import os

import pytest
import warp as wp

wp.config.log_level = wp.LOG_WARNING


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
