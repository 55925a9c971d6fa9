"""MuJoCo Warp on the device of the problem."""

import mujoco_model
import mujoco_warp
import numpy as np
import warp as wp
from problem import PeerProblem, timed_on_device

PER_BODY = {"box": 12, "octree of distances": 120}
"""Capacity for contacts and candidate pairs per body, by collider; an overflow is a fault."""
JOINTED = 2
"""The same for bodies that are joined, which touch little."""


def run(problem: PeerProblem) -> tuple:
    """Step all worlds together."""
    wp.config.log_level = wp.LOG_WARNING
    host, collider = mujoco_model.build(problem)
    capacity = JOINTED * problem.num_bodies if problem.hinges else PER_BODY[collider] * problem.num_bodies + 32
    rows = 4 * capacity + len(problem.hinges)
    with wp.ScopedDevice(problem.device):
        model = mujoco_warp.put_model(host)
        state = mujoco_warp.make_data(host, nworld=problem.num_envs, nconmax=capacity, njmax=rows)

        def restart() -> None:
            mujoco_warp.reset_data(model, state)
            state.qpos.assign(mujoco_model.starts(problem).astype(np.float32))
            state.qvel.zero_()
            state.qacc_warmstart.zero_()
            if problem.hinges:
                state.ctrl.assign(problem.targets.astype(np.float32))

        def frame() -> None:
            for _ in range(problem.substeps):
                mujoco_warp.step(model, state)

        restart()
        seconds = timed_on_device(problem, frame, restart)
        if state.overflow.numpy().any():
            raise RuntimeError(f"its capacity of {capacity} contacts per world overflowed")
        figures = {
            "version": mujoco_warp.__version__,
            "collider": collider,
            "device": problem.device,
            **seconds,
            "contacts": int(state.nacon.numpy()[0]),
        }
        return figures, *mujoco_model.final(host, state.qpos.numpy(), state.qvel.numpy(), problem)
