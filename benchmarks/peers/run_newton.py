"""Newton with its Steel solver on the device of the problem; a frame is one graph on CUDA.

Meshes collide by distance grids on CUDA, by queries of the triangles on the CPU, which has no such grids.
"""

from problem import PeerProblem, main, timed, write

ITERATIONS, GAP, RESOLUTION = 12, 0.01, 64
"""Values from its examples: sweeps, contact distance [m], cells along the longest side."""
CONTACTS_PER_BODY = {"box": 20, "mesh": 64}
EXPLICIT_UP_TO = 64
"""Up to this number of bodies its list of all pairs is faster than its sweep."""


def run(problem: PeerProblem) -> None:
    """Step all worlds together."""
    import newton
    import numpy as np
    import warp as wp

    wp.config.log_level = wp.LOG_ERROR
    with wp.ScopedDevice(problem.device):
        device = wp.get_device(problem.device)
        mesh = None
        if problem.vertices is not None:
            mesh = newton.Mesh(problem.vertices.astype(np.float32), problem.faces.astype(np.int32).ravel())
            if device.is_cuda:
                band = {"narrow_band_range": (-0.05, 0.05), "margin": 2.0 * GAP}
                mesh.build_sdf(max_resolution=RESOLUTION, **band)
        model = _model(newton, wp, problem, mesh).finalize(device=device)
        broad = "explicit" if problem.num_bodies <= EXPLICIT_UP_TO else "sap"
        pipeline = newton.CollisionPipeline(model, broad_phase=broad, reduce_contacts=True)
        contacts = pipeline.contacts()
        capacity = CONTACTS_PER_BODY["box" if mesh is None else "mesh"] * problem.num_bodies
        rows = max(512, 3 * capacity)
        solver = newton.solvers.SolverSteel(model, iterations=ITERATIONS, free_body_constraint_max=rows)
        now, then, control = model.state(), model.state(), model.control()
        newton.eval_fk(model, model.joint_q, model.joint_qd, now)
        begin = (now.body_q.numpy(), now.body_qd.numpy())

        def frame() -> None:
            nonlocal now, then
            for _ in range(problem.substeps):
                now.clear_forces()
                pipeline.collide(now, contacts)
                solver.step(now, then, control, contacts, problem.dt)
                now, then = then, now
            if problem.substeps % 2:
                # A recorded frame begins and ends in the same arrays.
                then.assign(now)
                now, then = then, now

        frame()  # compiles
        graph = None
        if device.is_cuda:
            with wp.ScopedCapture() as capture:
                frame()
            graph = capture.graph
        now.body_q.assign(begin[0])
        now.body_qd.assign(begin[1])

        def advance(frames: int) -> None:
            for _ in range(frames):
                frame() if graph is None else wp.capture_launch(graph)
            wp.synchronize_device(device)

        seconds = timed(problem, advance)
        touching = int(contacts.rigid_contact_count.numpy()[0])
        if touching > contacts.rigid_contact_max or np.asarray(solver.constraint_overflow.numpy()).any():
            raise RuntimeError("its capacity for contacts overflowed")
        figures = {
            "engine": "newton",
            "version": newton.__version__,
            "collider": "box" if mesh is None else ("distance grids" if device.is_cuda else "triangles"),
            "device": str(device),
            **seconds,
            "contacts": touching,
        }
        poses = now.body_q.numpy().reshape(problem.num_envs, problem.num_bodies, 7)
        speeds = now.body_qd.numpy().reshape(problem.num_envs, problem.num_bodies, 6)
        write(figures, poses[..., :3], poses[..., 3:], speeds[..., :3])


def _model(newton, wp, problem: PeerProblem, mesh):
    """One world per environment, each with the ground."""
    whole = newton.ModelBuilder()
    _configure(whole, problem)
    whole.add_ground_plane()
    for env in range(problem.num_envs):
        world = newton.ModelBuilder()
        _configure(world, problem)
        for place, turned in zip(problem.position[env], problem.orientation[env], strict=True):
            body = world.add_body(xform=wp.transform(wp.vec3(*place), wp.quat(*turned)))
            if mesh is None:
                hx, hy, hz = problem.half_extents
                world.add_shape_box(body, hx=hx, hy=hy, hz=hz)
            else:
                world.add_shape_mesh(body, mesh=mesh)
        for part in problem.fixed:
            place = wp.transform(wp.vec3(*part["position"]), wp.quat_identity())
            if part["kind"] == "box":
                hx, hy, hz = part["half_extents"]
                world.add_shape_box(-1, xform=place, hx=hx, hy=hy, hz=hz)
            else:
                world.add_shape_cylinder(-1, xform=place, radius=part["radius"], half_height=part["half_height"])
        whole.add_world(world)
    return whole


def _configure(builder, problem: PeerProblem) -> None:
    config = builder.default_shape_cfg
    config.density, config.mu, config.restitution, config.gap = (
        problem.density,
        problem.friction,
        problem.restitution,
        GAP,
    )
    config.mu_torsional = config.mu_rolling = 0.0


if __name__ == "__main__":
    main(run)
