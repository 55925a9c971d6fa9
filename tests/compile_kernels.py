"""Compile all kernels: `python -m tests.compile_kernels` for every device, or for those that are named."""

import sys

import warp as wp

from warp_rigid.engine.loading import everything, load_kernels
from warp_rigid.engine.teams import sizes_of_teams
from warp_rigid.render import raycast
from warp_rigid.warp_start import start_warp


def main(devices):
    """Fill Warp's cache, each module once."""
    for device in devices:
        # Pictures are drawn on the CPU only.
        modules = (*everything(), raycast) if device.is_cpu else everything()
        load_kernels(device, modules, lanes=sizes_of_teams(device))


if __name__ == "__main__":
    start_warp()
    main([wp.get_device(name) for name in sys.argv[1:]] or wp.get_devices())
