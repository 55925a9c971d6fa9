"""Newton with its Steel or its XPBD solver on the device of the problem.

Meshes collide by distance grids on CUDA, by queries of the triangles on the CPU, which has no such grids. Buffers are
larger than Newton's estimates, which overflow in piles of meshes; Newton prints an overflow, which `warp-rigid bench`
reports.
"""

import newton
import numpy as np
import warp as wp
from problem import PeerProblem, timed_on_device

GAP, RESOLUTION = 0.01, 64
"""Values from its examples: contact distance [m], cells along the longest side."""
CONTACTS_PER_BODY = {"box": 40, "mesh": 128, "joined": 4}
TRIANGLE_PAIRS = 2
"""Capacity for pairs of close triangles, per triangle of every body."""
EXPLICIT_UP_TO = 64
"""Up to this number of bodies its list of all pairs is faster than its sweep."""
ITERATIONS = {"newton_steel": 12, "newton_xpbd": 10}
"""Those of the examples of Steel; those of XPBD use 2 to 20, at ten steps a frame."""


def run(problem: PeerProblem) -> tuple:
    """Step all worlds together."""
    wp.config.log_level = wp.LOG_ERROR
    with wp.ScopedDevice(problem.device):
        device = wp.get_device(problem.device)
        mesh = _mesh(problem, device)
        model = _model(problem, mesh).finalize(device=device)
        crowd = "joined" if problem.hinges else ("box" if mesh is None else "mesh")
        capacity = CONTACTS_PER_BODY[crowd] * problem.num_bodies
        pipeline = _pipeline(model, problem, capacity)
        contacts = pipeline.contacts()
        solver = _solver(problem, model, capacity)
        state = _States(model)
        if problem.hinges:
            state.control.joint_target_q.assign(problem.targets.astype(np.float32).ravel())

        def frame() -> None:
            for _ in range(problem.substeps):
                state.now.clear_forces()
                pipeline.collide(state.now, contacts)
                solver.step(state.now, state.then, state.control, contacts, problem.dt)
                state.swap()
            if problem.substeps % 2:
                # A recorded frame begins and ends in the same arrays.
                state.then.assign(state.now)
                state.swap()

        seconds = timed_on_device(problem, frame, state.restart)
        figures = {
            "iterations": ITERATIONS[problem.engine],
            "version": newton.__version__,
            "collider": "box" if mesh is None else ("distance grids" if device.is_cuda else "triangles"),
            "device": str(device),
            **seconds,
            "contacts": int(contacts.rigid_contact_count.numpy()[0]),
        }
        poses = state.now.body_q.numpy().reshape(problem.num_envs, problem.num_bodies, 7)
        speeds = state.now.body_qd.numpy().reshape(problem.num_envs, problem.num_bodies, 6)
        return figures, poses[..., :3], poses[..., 3:], speeds[..., :3]


def _solver(problem: PeerProblem, model: newton.Model, capacity: int):
    """The solver of the engine for the largest number of contacts of a world."""
    iterations = ITERATIONS[problem.engine]
    if problem.engine == "newton_steel":
        rows = max(512, 3 * capacity)
        return newton.solvers.SolverSteel(model, iterations=iterations, free_body_constraint_max=rows)
    bounces = problem.restitution > 0.0
    return newton.solvers.SolverXPBD(model, iterations=iterations, enable_restitution=bounces)


class _States:
    """The states before and after a substep."""

    def __init__(self, model: newton.Model) -> None:
        self.now, self.then, self.control = model.state(), model.state(), model.control()
        newton.eval_fk(model, model.joint_q, model.joint_qd, self.now)
        self._begin = {name: getattr(self.now, name).numpy() for name in ("body_q", "body_qd", "joint_q", "joint_qd")}

    def swap(self) -> None:
        self.now, self.then = self.then, self.now

    def restart(self) -> None:
        for name, values in self._begin.items():
            getattr(self.now, name).assign(values)


def _mesh(problem: PeerProblem, device: wp.Device) -> newton.Mesh | None:
    """The shape of the bodies, with a distance grid where the device has them; None if it is a box."""
    if problem.vertices is None:
        return None
    mesh = newton.Mesh(problem.vertices.astype(np.float32), problem.faces.astype(np.int32).ravel())
    if device.is_cuda:
        mesh.build_sdf(max_resolution=RESOLUTION, narrow_band_range=(-0.05, 0.05), margin=2.0 * GAP)
    return mesh


def _pipeline(model: newton.Model, problem: PeerProblem, capacity: int) -> newton.CollisionPipeline:
    """Collision detection with a capacity for contacts in each world."""
    triangles = 0 if problem.faces is None else len(problem.faces) * problem.num_bodies * problem.num_envs
    return newton.CollisionPipeline(
        model,
        broad_phase="explicit" if problem.num_bodies <= EXPLICIT_UP_TO else "sap",
        reduce_contacts=True,
        rigid_contact_max=capacity * problem.num_envs,
        max_triangle_pairs=TRIANGLE_PAIRS * triangles or None,
    )


def _model(problem: PeerProblem, mesh: newton.Mesh | None) -> newton.ModelBuilder:
    """One world per environment, each with the ground."""
    whole = newton.ModelBuilder()
    _configure(whole, problem)
    whole.add_ground_plane()
    for env in range(problem.num_envs):
        world = newton.ModelBuilder()
        _configure(world, problem)
        add = world.add_link if problem.hinges else world.add_body
        for pose in zip(problem.position[env], problem.orientation[env], strict=True):
            body = add(xform=_frame(pose))
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
        if problem.hinges:
            world.add_articulation([_add_hinge(world, hinge) for hinge in problem.hinges])
        whole.add_world(world)
    return whole


def _add_hinge(world: newton.ModelBuilder, hinge: dict) -> int:
    return world.add_joint_revolute(
        hinge["parent"],
        hinge["child"],
        parent_xform=_frame(hinge["in_parent"]),
        child_xform=_frame(hinge["in_child"]),
        axis=(1.0, 0.0, 0.0),
        limit_lower=hinge["limits"][0],
        limit_upper=hinge["limits"][1],
        target_ke=hinge["stiffness"],
        target_kd=hinge["damping"],
        effort_limit=hinge["max_force"],
    )


def _frame(values) -> wp.transform:
    place, orientation = values
    return wp.transform(wp.vec3(*place), wp.quat(*orientation))


def _configure(builder: newton.ModelBuilder, problem: PeerProblem) -> None:
    config = builder.default_shape_cfg
    config.density, config.mu = problem.density, problem.friction
    config.restitution, config.gap = problem.restitution, GAP
    config.mu_torsional = config.mu_rolling = 0.0
