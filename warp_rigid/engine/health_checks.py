"""Health checks: launched every few steps, and the warnings that they recorded."""

from typing import Any

import numpy as np

from warp_rigid.engine.model import Model
from warp_rigid.engine.step import Stages
from warp_rigid.kernels.enums import Motion, WarningKind
from warp_rigid.kernels.update import health

EVERY = 64
"""Steps from one check to the next."""


UNEQUAL = 1e3
"""Ratio of the masses of an environment up to which every load is carried, as towers and chains of 1000 : 1 show."""

WARNING_NAMES = ("env", "warning", "step", "time", "body")
WARNING_RECORD = np.dtype(list(zip(WARNING_NAMES, (np.int64, "U9", np.int64, np.float64, np.int64), strict=True)))


def may_be_overloaded(model: Model) -> bool:
    """Whether a body of an environment can carry more than HEAVIEST_LOAD times its weight: all others, if at rest.

    The masses must be unequal besides. Loads are then checked in every step: they throw bodies apart in fewer steps
    than lie between two checks, and are gone then.
    """
    masses = np.where(model.bodies.motion.numpy() == Motion.DYNAMIC, model.bodies.mass.numpy(), np.nan)
    rows = model.layout.by_environment(masses.astype(np.float64))
    rows = rows[~np.isnan(rows).all(axis=1)]
    least = np.nanmin(rows, axis=1)
    overload = np.nansum(rows, axis=1) > float(health.HEAVIEST_LOAD) * least
    return bool((overload & (np.nanmax(rows, axis=1) > UNEQUAL * least)).any())


def check_loads(stages: Stages) -> None:
    """Note overloaded bodies of all environments of a shard after a step, for the next check."""
    pools = stages.pools
    inputs = [stages.model.bodies, pools.pairs, pools.history, stages.motions]
    stages.share(health.check_loads, pools.sizes["pairs"], inputs, [stages.envs], before=[stages.dt])


def check(stages: Stages) -> None:
    """Check all environments of a shard after a step; `load_kernels` must have been called for `STEP`."""
    model, pools = stages.model, stages.pools
    stages.motions.overlap.zero_()
    inputs = [model.shapes, model.bodies, pools.pairs, pools.history]
    stages.share(health.check_overlaps, pools.sizes["pairs"], inputs, [stages.motions])
    check_loads(stages)
    joints = model.joints
    stages.launch(health.check_drives, joints.broken.shape[0], [model.bodies, joints], [stages.envs])
    inputs, outputs = [model.shapes, model.bodies, stages.motions], [stages.state, stages.envs]
    stages.per_body(health.check_bodies, inputs, outputs)
    stages.per_env(health.check_environments, [stages.dt, *inputs, pools.graph], outputs)


def warning_records(envs: Any, dt: float) -> np.ndarray:
    """The warnings of all environments by time; see Simulator.warnings."""
    steps, bodies = envs.warned_step.numpy(), envs.warned_body.numpy()
    env, kind = np.nonzero(steps)
    records = np.zeros(len(env), WARNING_RECORD)
    records["env"], records["step"], records["body"] = env, steps[env, kind], bodies[env, kind]
    records["warning"] = [WarningKind(int(number)).name.lower() for number in kind]
    records["time"] = records["step"] * dt
    return records[np.lexsort((kind, records["step"], env))]
