"""Environments with many bodies, in which some stages differ: rounds, and longer chains of impacts."""

import warp as wp

from warp_rigid.kernels.schema import Environments

wp.set_module_options({"enable_backward": False})

CROWDED = wp.constant(128)
"""Bodies above which an environment is crowded. There, sweeps and shock propagation of many islands, colour by colour,
would take longer than rounds. With few bodies sweeps converge faster: three boxes are at rest after half the time."""


@wp.func
def is_crowded(env: int, envs: Environments):
    """Whether an environment has many bodies."""
    return envs.first_body[env + 1] - envs.first_body[env] > CROWDED
