"""MuJoCo Warp on the device of the problem; a frame is one graph where the device has graphs."""

from problem import PeerProblem, main, timed, write

PER_BODY = {"box": 12, "octree of distances": 120}
"""Capacity for contacts and candidate pairs per body, by collider; an overflow is a fault."""
JOINTED = 2
"""The same for bodies that are joined, which touch little."""


def run(problem: PeerProblem) -> None:
    """Step all worlds together."""
    import mujoco_warp
    import numpy as np
    import warp as wp

    wp.config.log_level = wp.LOG_WARNING
    import mujoco_model

    host, collider = mujoco_model.build(problem)
    capacity = JOINTED * problem.num_bodies if problem.hinges else PER_BODY[collider] * problem.num_bodies + 32
    rows = 4 * capacity + len(problem.hinges)
    with wp.ScopedDevice(problem.device):
        device = wp.get_device(problem.device)
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
        frame()  # compiles
        graph = None
        if device.is_cuda:
            with wp.ScopedCapture() as capture:
                frame()
            graph = capture.graph
        restart()

        def advance(frames: int) -> None:
            for _ in range(frames):
                frame() if graph is None else wp.capture_launch(graph)
            wp.synchronize_device(device)

        seconds = timed(problem, advance)
        if state.overflow.numpy().any():
            raise RuntimeError(f"its capacity of {capacity} contacts per world overflowed")
        figures = {
            "engine": "mujoco_warp",
            "version": mujoco_warp.__version__,
            "collider": collider,
            "device": str(device),
            **seconds,
            "contacts": int(state.nacon.numpy()[0]),
        }
        write(figures, *mujoco_model.final(host, state.qpos.numpy(), state.qvel.numpy(), problem))


if __name__ == "__main__":
    main(run)
