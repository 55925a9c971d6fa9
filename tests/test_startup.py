"""What starting costs: processor time, which other programs on the machine do not stretch."""

from warp_rigid.bench.startup import first_frame

WARM_SECONDS = 2.0
MODULES = 17
"""Modules of kernels a step loads; each is compiled, cached and loaded on its own."""


def test_a_warm_start_is_quick(device):
    first_frame("stack:8", device)
    cost = min((first_frame("stack:8", device) for _ in range(2)), key=lambda found: found["processor_seconds"])
    assert cost["processor_seconds"] < WARM_SECONDS
    assert 0 < cost["modules"] <= MODULES
