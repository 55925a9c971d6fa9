"""MuJoCo on one core of the CPU."""

from problem import PeerProblem, main, timed, write


def run(problem: PeerProblem) -> None:
    """Step one environment after another."""
    import mujoco
    import mujoco_model
    import numpy as np

    model, collider = mujoco_model.build(problem)
    worlds = [mujoco.MjData(model) for _ in range(problem.num_envs)]
    for world, start in zip(worlds, mujoco_model.starts(problem), strict=True):
        world.qpos[:] = start
    if problem.hinges:
        for world, target in zip(worlds, problem.targets, strict=True):
            world.ctrl[:] = target

    def advance(frames: int) -> None:
        for world in worlds:
            mujoco.mj_step(model, world, nstep=frames * problem.substeps)

    figures = {
        "engine": "mujoco",
        "version": mujoco.__version__,
        "collider": collider,
        "device": "cpu",
        **timed(problem, advance),
        "contacts": int(sum(world.ncon for world in worlds)),
    }
    positions, velocities = np.array([w.qpos for w in worlds]), np.array([w.qvel for w in worlds])
    write(figures, *mujoco_model.final(model, positions, velocities, problem))


if __name__ == "__main__":
    main(run)
