"""What all tests of the engine share: every one of them runs on every device that is present."""

import pytest
import warp as wp

wp.config.log_level = wp.LOG_WARNING


@pytest.fixture(params=[str(device) for device in wp.get_devices()])
def device(request):
    """A device of this machine, by name."""
    return request.param
