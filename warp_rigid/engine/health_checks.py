"""Health checks: launched every few steps, and the warnings that they recorded."""

from typing import Any

import numpy as np
import warp as wp

from warp_rigid.engine.step import Stages
from warp_rigid.kernels.enums import WarningKind
from warp_rigid.kernels.update import health

EVERY = 64
"""Steps from one check to the next."""


def is_due(step: int) -> bool:
    """Whether to check after a number of completed steps.

    The first step is checked, too: a load that single precision does not carry can throw bodies apart in fewer steps
    than lie between two checks, and is gone then.
    """
    return step == 1 or step % EVERY == 0


WARNING_NAMES = ("env", "warning", "step", "time", "body")
WARNING_RECORD = np.dtype(list(zip(WARNING_NAMES, (np.int64, "U9", np.int64, np.float64, np.int64), strict=True)))


def check(stages: Stages) -> None:
    """Check all environments of a shard after a step; `load_kernels` must have been called for `STEP`."""
    model, pools, device = stages.model, stages.pools, stages.device
    threads = pools.sizes["pairs"] if device.is_cuda else 1
    wp.launch(
        health.check_pairs,
        dim=threads,
        inputs=[stages.dt, threads, model.shapes, model.bodies, pools.pairs, pools.history],
        outputs=[stages.motions, stages.envs],
        device=device,
    )
    inputs = [model.shapes, model.bodies, stages.motions]
    for kernel, dim in ((health.check_bodies, stages.rows), (health.check_environments, stages.num_envs)):
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=[stages.state, stages.envs], device=device)


def warning_records(envs: Any, dt: float) -> np.ndarray:
    """The warnings of all environments by time; see Simulator.warnings."""
    steps, bodies = envs.warned_step.numpy(), envs.warned_body.numpy()
    env, kind = np.nonzero(steps)
    records = np.zeros(len(env), WARNING_RECORD)
    records["env"], records["step"], records["body"] = env, steps[env, kind], bodies[env, kind]
    records["warning"] = [WarningKind(int(number)).name.lower() for number in kind]
    records["time"] = records["step"] * dt
    return records[np.lexsort((kind, records["step"], env))]
