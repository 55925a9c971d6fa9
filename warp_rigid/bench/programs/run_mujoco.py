"""MuJoCo on one core of the CPU."""

import mujoco
import mujoco_model
import numpy as np
from problem import PeerProblem, timed_one_by_one


def run(problem: PeerProblem) -> tuple:
    """Step one environment after another."""
    model, collider = mujoco_model.build(problem)
    worlds = [mujoco.MjData(model) for _ in range(problem.num_envs)]
    for world, start in zip(worlds, mujoco_model.starts(problem), strict=True):
        world.qpos[:] = start
    if problem.hinges:
        for world, target in zip(worlds, problem.targets, strict=True):
            world.ctrl[:] = target

    def advance(env: int, frames: int) -> None:
        mujoco.mj_step(model, worlds[env], nstep=frames * problem.substeps)

    figures = {
        "version": mujoco.__version__,
        "collider": collider,
        "device": "cpu",
        **timed_one_by_one(problem, advance),
        "contacts": int(sum(world.ncon for world in worlds)),
    }
    positions, velocities = np.array([w.qpos for w in worlds]), np.array([w.qvel for w in worlds])
    return figures, *mujoco_model.final(model, positions, velocities, problem)
