"""Prediction: roles, accelerations, world inertia and swept bounding boxes of the bodies, and the velocity update."""

import warp as wp

from warp_rigid.kernels.common.solver_body import inverse_inertia_at
from warp_rigid.kernels.enums import Motion, Role
from warp_rigid.kernels.schema import (
    Bodies,
    Environments,
    FieldForces,
    Motions,
    Shapes,
    SleepState,
    SolverBodyRecord,
    State,
)
from warp_rigid.kernels.tuning import CONTACT_DISTANCE
from warp_rigid.kernels.update.force_fields import drag_of, field_acceleration, response_in_drag

wp.set_module_options({"enable_backward": False})


LARGEST_COMPONENT = wp.constant(1.0e15)
"""Positions [m] and velocities [m/s, rad/s] from which products overflow in single precision; NaN is not below it."""

UNBOUNDED_EXTENT = wp.constant(1.0e9)
"""Half-extent from which a shape counts as unbounded [m]."""

LARGEST_UNIT = wp.constant(0.04)
"""Largest unit of the tolerances [m/s]: what gravity adds to a velocity in 1/240 s. Tolerances are not wider in longer
steps, and where there is no gravity, they have this unit."""

LEAST_UNIT = wp.constant(0.04 / 64.0)
"""Least unit of the tolerances [m/s]. With a smaller one, sweeps would go on at the rounding errors of velocities."""


@wp.func
def smaller_size(a: int, b: int, shapes: Shapes, bodies: Bodies):
    """Size of the smaller body of a pair [m], the length scale of contact tolerances."""
    return wp.min(shapes.shapes[bodies.shape[a]].size, shapes.shapes[bodies.shape[b]].size)


@wp.func
def extent_along_axes(turn: wp.quat, half: wp.vec3):
    """Half-extents of the axis-aligned bounding box of a box rotated by `turn`."""
    r = wp.quat_to_matrix(turn)
    return wp.vec3(
        wp.abs(r[0, 0]) * half[0] + wp.abs(r[0, 1]) * half[1] + wp.abs(r[0, 2]) * half[2],
        wp.abs(r[1, 0]) * half[0] + wp.abs(r[1, 1]) * half[1] + wp.abs(r[1, 2]) * half[2],
        wp.abs(r[2, 0]) * half[0] + wp.abs(r[2, 1]) * half[1] + wp.abs(r[2, 2]) * half[2],
    )


@wp.func
def role_of(b: int, bodies: Bodies, state: State, sleep_state: SleepState):
    """The role of a body in this step."""
    if state.active[b] == 0:
        return Role.ABSENT
    if bodies.motion[b] == Motion.DYNAMIC:
        return wp.where(sleep_state.asleep[b] == 1, Role.ASLEEP, Role.FREE)
    moving = wp.length_sq(state.linear_velocity[b]) + wp.length_sq(state.angular_velocity[b]) > 0.0
    return wp.where(moving, Role.KINEMATIC, Role.STATIC)


@wp.func
def is_finite(v: wp.vec3):
    """Whether all components are numbers whose squares and products are finite."""
    return wp.abs(v[0]) < LARGEST_COMPONENT and wp.abs(v[1]) < LARGEST_COMPONENT and wp.abs(v[2]) < LARGEST_COMPONENT


@wp.func
def body_is_finite(b: int, bodies: Bodies, state: State, acceleration: wp.vec3, spin_acceleration: wp.vec3):
    """Whether a body's state, its accelerations and its coefficients are finite."""
    moves = is_finite(state.linear_velocity[b]) and is_finite(state.angular_velocity[b])
    turn = state.orientation[b]
    placed = is_finite(state.position[b]) and is_finite(wp.vec3(turn[0], turn[1], turn[2])) and wp.isfinite(turn[3])
    pushed = is_finite(acceleration) and is_finite(spin_acceleration)
    dissipation = bodies.friction[b] + bodies.rolling_friction[b] + bodies.spinning_friction[b]
    return moves and placed and pushed and wp.isfinite(dissipation + bodies.restitution[b])


@wp.func
def velocity_unit(gained: float):
    """Unit of the tolerances of the solvers, where gravity adds `gained` to a velocity in a step [m/s].

    Scenes that differ in scale alone are then solved alike.
    """
    if gained == 0.0:
        return float(LARGEST_UNIT)
    return wp.clamp(gained, LEAST_UNIT, LARGEST_UNIT)


@wp.func
def sweep_box(b: int, dt: float, shapes: Shapes, bodies: Bodies, state: State, motions: Motions):
    """Bounding box of a body over the step, for any rotation.

    For a fast body it includes the displacement in all directions, as the body may rebound.
    """
    shape = bodies.shape[b]
    half = 0.5 * (shapes.shapes[shape].upper - shapes.shapes[shape].lower)
    middle = 0.5 * (shapes.shapes[shape].upper + shapes.shapes[shape].lower)
    if wp.max(half) > UNBOUNDED_EXTENT:
        motions.lower[b] = wp.vec3(-2.0 * UNBOUNDED_EXTENT, -2.0 * UNBOUNDED_EXTENT, -2.0 * UNBOUNDED_EXTENT)
        motions.upper[b] = wp.vec3(2.0 * UNBOUNDED_EXTENT, 2.0 * UNBOUNDED_EXTENT, 2.0 * UNBOUNDED_EXTENT)
        motions.radius[b] = 2.0 * UNBOUNDED_EXTENT
        motions.max_travel[b] = 2.0 * UNBOUNDED_EXTENT
        return
    turn = state.orientation[b]
    radius = wp.length(half) + wp.length(middle - bodies.center_of_mass[b])
    motions.radius[b] = radius
    at = state.position[b] + wp.quat_rotate(turn, middle)
    travel = dt * (state.linear_velocity[b] + dt * motions.acceleration[b])
    rotation = wp.min(dt * wp.length(state.angular_velocity[b] + dt * motions.spin_acceleration[b]), 2.0)
    reach = rotation * radius + CONTACT_DISTANCE * shapes.shapes[shape].size
    extent = extent_along_axes(turn, half) + wp.vec3(reach, reach, reach)
    motions.lower[b] = wp.min(at, at + travel) - extent
    motions.upper[b] = wp.max(at, at + travel) + extent
    way = wp.length(travel)
    motions.max_travel[b] = wp.max(0.5 * shapes.shapes[shape].size, 1.01 * way)
    if way > 0.5 * shapes.shapes[shape].size:
        around = wp.vec3(motions.max_travel[b], motions.max_travel[b], motions.max_travel[b])
        motions.lower[b] = at - around - extent
        motions.upper[b] = at + around + extent


@wp.kernel
def derive_motion(
    dt: float,
    shapes: Shapes,
    bodies: Bodies,
    state: State,
    sleep_state: SleepState,
    envs: Environments,
    fields: FieldForces,
    motions: Motions,
):
    """Role, centre of mass, mass, world inertia, external accelerations and swept bounding box of each body.

    In a medium, the mass is that with which all forces of a step act, those of contacts and joints too.
    """
    b = wp.tid()
    motions.role[b] = role_of(b, bodies, state, sleep_state)
    env = bodies.env[b]
    if motions.role[b] == Role.FREE or motions.role[b] == Role.KINEMATIC:
        envs.moving[env] = envs.step[env] + 1
    turn = state.orientation[b]
    center = state.position[b] + wp.quat_rotate(turn, bodies.center_of_mass[b])
    motions.center[b] = center
    inverse = inverse_inertia_at(b, turn, bodies)
    solver_body = SolverBodyRecord()
    solver_body.linear = state.linear_velocity[b]
    response = response_in_drag(fields, env, dt)
    solver_body.inverse_mass = response * bodies.inverse_mass[b]
    solver_body.angular = state.angular_velocity[b]
    solver_body.inverse_inertia_xx = wp.vec4(inverse[0, 0], inverse[0, 1], inverse[0, 2], inverse[1, 1])
    solver_body.inverse_inertia_yz = wp.vec3(inverse[1, 2], inverse[2, 2], 0.0)
    motions.solver_bodies[b] = solver_body
    acceleration = wp.vec3(0.0, 0.0, 0.0)
    if bodies.motion[b] == Motion.DYNAMIC:
        acceleration = envs.gravity[env] + field_acceleration(fields, env, center, state.linear_velocity[b])
    motions.acceleration[b] = response * (acceleration + bodies.inverse_mass[b] * state.force[b])
    spin_acceleration = inverse * state.torque[b]
    motions.spin_acceleration[b] = spin_acceleration
    motions.velocity_unit[b] = velocity_unit(dt * wp.length(envs.gravity[env]))
    motions.is_finite[b] = wp.where(body_is_finite(b, bodies, state, motions.acceleration[b], spin_acceleration), 1, 0)
    sweep_box(b, dt, shapes, bodies, state, motions)


@wp.kernel
def integrate_velocities(
    dt: float,
    after_impacts: int,
    bodies: Bodies,
    envs: Environments,
    fields: FieldForces,
    state: State,
    motions: Motions,
):
    """Velocity update, before the impacts of a step or after them, in environments whose `collision_first` says so.

    Media resist the mean of the velocities before and after the impacts of the step, as impacts are time-centred. With
    that before them, a medium would accelerate a body that rebounds.
    """
    b = wp.tid()
    env = bodies.env[b]
    if envs.collision_first[env] != after_impacts or motions.role[b] != Role.FREE:
        return
    linear = motions.solver_bodies[b].linear
    drag = drag_of(fields, env)
    if drag > 0.0:
        half = 0.5 * drag * response_in_drag(fields, env, dt)
        motions.acceleration[b] = motions.acceleration[b] - half * (linear - state.linear_velocity[b])
    motions.solver_bodies[b].linear = linear + dt * motions.acceleration[b]
    motions.solver_bodies[b].angular = motions.solver_bodies[b].angular + dt * motions.spin_acceleration[b]
