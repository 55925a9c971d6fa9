"""Position update, and checks for non-finite states and for bodies that leave the scene's bounds."""

import warp as wp

from warp_rigid.kernels.enums import Motion, OutOfBounds, Role
from warp_rigid.kernels.schema import Bodies, Environments, Graph, Motions, State
from warp_rigid.kernels.update.predict import is_finite

wp.set_module_options({"enable_backward": False})


MOST_TURN_PARTS = wp.constant(1024)
"""Maximum substeps for the rotation of a step."""

ENERGY_TOLERANCE = wp.constant(wp.float64(1.0e-3))
"""Relative change of energy allowed in the rotation of a step."""

ENERGY_ROUNDING = wp.constant(wp.float64(1.0e-12))
"""Relative error of the energy that is not corrected."""
LARGEST_CORRECTION = wp.constant(wp.float64(5.0e-3))
"""Largest turn that corrects the energy of a step, over the turn in the step, or over 1 rad if that is less."""
NEWTON_STEPS = wp.constant(3)

RESIDUAL_FADING = wp.constant(0.5)
"""Factor for the recent residual from one step to the next. With 0, one step in eight of a tray of 400 boxes counts as
solved by chance."""

mat33d = wp.types.matrix(shape=(3, 3), dtype=wp.float64)


@wp.func
def rotate_by(turn: wp.quatd, rotation: wp.vec3d):
    """Rotate an orientation by a rotation vector in the world frame [rad], exactly; the result has unit length."""
    angle = wp.length(rotation)
    half = wp.float64(0.5) * angle
    scale = wp.float64(0.5) - angle * angle / wp.float64(48.0)
    if angle > wp.float64(1.0e-4):
        scale = wp.sin(half) / angle
    spin = wp.quatd(scale * rotation[0], scale * rotation[1], scale * rotation[2], wp.cos(half))
    return wp.normalize(spin * turn)


@wp.func
def rotation_vector(turn: wp.quatd):
    """Axis times angle of a rotation by at most half a turn [rad]."""
    axis = wp.vec3d(turn[0], turn[1], turn[2])
    length = wp.length(axis)
    if length == wp.float64(0.0):
        return axis
    angle = wp.atan2(length, wp.abs(turn[3]))
    return (wp.float64(2.0) * wp.sign(turn[3]) * angle / length) * axis


@wp.func
def precise(q: wp.quat, remainder: wp.vec4):
    """A stored orientation in float64, with its rounding error added."""
    return wp.quatd(
        wp.float64(q[0]) + wp.float64(remainder[0]),
        wp.float64(q[1]) + wp.float64(remainder[1]),
        wp.float64(q[2]) + wp.float64(remainder[2]),
        wp.float64(q[3]) + wp.float64(remainder[3]),
    )


@wp.func
def store_turn(b: int, turn: wp.quatd, spin: wp.vec3d, state: State):
    """Store the orientation and the angular velocity of a body, rounded, and their rounding errors."""
    rounded = wp.quat(wp.float32(turn[0]), wp.float32(turn[1]), wp.float32(turn[2]), wp.float32(turn[3]))
    rest = turn - precise(rounded, wp.vec4(0.0, 0.0, 0.0, 0.0))
    state.orientation[b] = rounded
    state.orientation_remainder[b] = wp.vec4(
        wp.float32(rest[0]), wp.float32(rest[1]), wp.float32(rest[2]), wp.float32(rest[3])
    )
    state.angular_velocity[b] = wp.vec3(spin)
    state.angular_velocity_remainder[b] = wp.vec3(spin - wp.vec3d(wp.vec3(spin)))


@wp.func
def spin_of(turn: wp.quatd, momentum: wp.vec3d, inverse: mat33d):
    """Angular velocity for an angular momentum and an orientation: R I^-1 R^T L."""
    r = wp.quat_to_matrix(wp.normalize(turn))
    return r * (inverse * (wp.transpose(r) * momentum))


@wp.func
def free_turn(turn: wp.quatd, momentum: wp.vec3d, inverse: mat33d, dt: wp.float64, parts: int):
    """Orientation after a torque-free time dt, in `parts` substeps with constant angular momentum.

    The scheme is of fourth order and composed of rotations only, so that a steady spin is exact (Celledoni, Marthinsen
    and Owren 2003, commutator-free method). The second-order update of Guendelman et al. 2003, section 3, conserves the
    energy to 4e-5; a body that flips about its intermediate axis requires more.
    """
    h = dt / wp.float64(parts)
    half = wp.float64(0.5) * h
    twelfth = h / wp.float64(12.0)
    two = wp.float64(2.0)
    three = wp.float64(3.0)
    q = turn
    for _ in range(parts):
        k1 = spin_of(q, momentum, inverse)
        middle = rotate_by(q, half * k1)
        k2 = spin_of(middle, momentum, inverse)
        k3 = spin_of(rotate_by(q, half * k2), momentum, inverse)
        k4 = spin_of(rotate_by(middle, h * k3 - half * k1), momentum, inverse)
        first = rotate_by(q, twelfth * (three * k1 + two * (k2 + k3) - k4))
        q = rotate_by(first, twelfth * (two * (k2 + k3) + three * k4 - k1))
    return q


@wp.func
def with_energy(turn: wp.quatd, momentum: wp.vec3d, inverse: mat33d, energy: wp.float64, largest: wp.float64):
    """Orientation turned by at most `largest`, so that a momentum has a given rotational energy (twice the energy).

    The momentum p in the body's frame moves on a sphere, on which the energy p . w with w = I^-1 p changes fastest
    along p x w (Newton's method). Without this, the energy of a fast spin drifts in one direction (Hairer, Lubich and
    Wanner, Geometric Numerical Integration, section IV.4: projection keeps the order of a scheme). In a steady spin
    the energy cannot be changed, and a turn that is not small beside that of the step is not a correction.
    """
    q = turn
    for _ in range(NEWTON_STEPS):
        p = wp.quat_rotate_inv(q, momentum)
        w = inverse * p
        axis = wp.cross(p, w)
        slope = wp.length(axis)
        missing = energy - wp.dot(p, w)
        if wp.abs(missing) <= ENERGY_ROUNDING * energy or wp.abs(missing) > wp.float64(2.0) * largest * slope:
            return q
        # Turning the body by -angle turns p by angle in the body's frame; p . w changes by 2 slope times the angle.
        angle = wp.float64(0.5) * missing / slope
        q = rotate_by(q, wp.quat_rotate(q, (-angle / slope) * axis))
    return q


@wp.func(inline=False)
def turn_freely(turn: wp.quatd, spin: wp.vec3d, inertia: mat33d, dt: wp.float64):
    """Orientation and angular velocity after a torque-free time dt.

    The rotation of a thin rod is stiff: a small error of its axis greatly changes the spin for its momentum. The
    number of substeps is therefore increased until the energy is conserved. If the maximum is not enough, the
    angular velocity is taken as constant.

    It is not inlined, which would make the compilation of kernels of joints for a GPU 1.4 times as long.
    """
    inverse = wp.inverse(inertia)
    r = wp.quat_to_matrix(turn)
    momentum = r * (inertia * (wp.transpose(r) * spin))
    energy = wp.dot(momentum, spin)
    parts = 1 + int(wp.min(dt * wp.length(spin) * wp.float64(2.0), wp.float64(63.0)))
    while parts <= MOST_TURN_PARTS:
        after = free_turn(turn, momentum, inverse, dt, parts)
        spin_after = spin_of(after, momentum, inverse)
        if wp.abs(wp.dot(momentum, spin_after) - energy) <= ENERGY_TOLERANCE * energy:
            largest = LARGEST_CORRECTION * wp.min(dt * wp.length(spin), wp.float64(1.0))
            after = with_energy(after, momentum, inverse, energy, largest)
            return after, spin_of(after, momentum, inverse)
        parts *= 4
    return rotate_by(turn, dt * spin), spin


@wp.kernel
def find_non_finite(bodies: Bodies, motions: Motions, envs: Environments):
    """One thread per body: record it if its velocity or pose is not finite; the body with the highest rank is reported.

    Bodies that were not finite before the step rank above those that became so in it; lower indices rank higher.
    """
    b = wp.tid()
    env = bodies.env[b]
    if motions.role[b] == Role.ABSENT:
        return
    rank = envs.first_body[env + 1] - b
    if motions.is_finite[b] == 0:
        wp.atomic_max(envs.broken, env, envs.first_body[env + 1] - envs.first_body[env] + rank)
    elif not (is_finite(motions.solver_bodies[b].linear) and is_finite(motions.solver_bodies[b].angular)):
        wp.atomic_max(envs.broken, env, rank)


@wp.func
def is_inside(x: wp.vec3, lower: wp.vec3, upper: wp.vec3):
    """Whether a point lies in a box."""
    above = x[0] >= lower[0] and x[1] >= lower[1] and x[2] >= lower[2]
    return above and x[0] <= upper[0] and x[1] <= upper[1] and x[2] <= upper[2]


@wp.kernel
def keep_inside(bodies: Bodies, motions: Motions, state: State, envs: Environments):
    """One thread per body: record it if its centre of mass has left the bounds, and switch it off if so required."""
    b = wp.tid()
    env = bodies.env[b]
    if envs.out_of_bounds[env] == OutOfBounds.UNBOUNDED:
        return
    if bodies.motion[b] == Motion.STATIC or motions.role[b] == Role.ABSENT:
        return
    center = state.position[b] + wp.quat_rotate(state.orientation[b], bodies.center_of_mass[b])
    if not is_inside(center, envs.lower[env], envs.upper[env]):
        wp.atomic_max(envs.strayed, env, envs.first_body[env + 1] - b)
        if envs.out_of_bounds[env] == OutOfBounds.REMOVE:
            state.active[b] = 0


@wp.kernel
def close_step(graph: Graph, envs: Environments):
    """One thread per environment: halt it if not finite, record the first body out of bounds, count the step.

    The recent residual is kept for the next health check.
    """
    env = wp.tid()
    count = envs.first_body[env + 1] - envs.first_body[env]
    strayed = envs.strayed[env]
    broken = envs.broken[env]
    envs.strayed[env] = 0
    envs.broken[env] = 0
    if envs.failed[env] == 1:
        return
    if strayed > 0 and envs.outside[env] == 0:
        envs.outside[env] = 1
        envs.outside_body[env] = count - strayed
        envs.outside_step[env] = envs.step[env]
    if broken > 0:
        envs.failed[env] = 1
        envs.failed_body[env] = count - 1 - (broken - 1) % count
        envs.failed_step[env] = envs.step[env]
    envs.recent_residual[env] = wp.max(graph.residual[env], RESIDUAL_FADING * envs.recent_residual[env])
    envs.step[env] = envs.step[env] + 1


@wp.func
def without_added_speed(v: wp.vec3, a: wp.vec3, missed: wp.vec3):
    """Velocity without the kinetic energy that an acceleration gave over a displacement that the body did not make."""
    work = wp.dot(a, missed)
    squared = wp.length_sq(v)
    if work == 0.0 or squared == 0.0:
        return v
    return wp.sqrt(wp.max(squared - 2.0 * work, 0.0) / squared) * v


@wp.func
def rotational_energy(turn: wp.quatd, spin: wp.vec3d, inertia: wp.mat33):
    """Kinetic energy of a rotation [J], for an angular velocity in the world frame."""
    w = wp.quat_rotate_inv(turn, spin)
    return wp.float64(0.5) * wp.dot(w, mat33d(inertia) * w)


@wp.func
def energy_without_work(
    b: int,
    dt: wp.float64,
    turning: wp.float64,
    missed: wp.vec3,
    linear: wp.vec3,
    spin: wp.vec3d,
    turn_change: wp.float64,
    bodies: Bodies,
    motions: Motions,
    state: State,
):
    """Kinetic energy that a dynamic body gained in a step beyond the work of accelerations and torques [J].

    Args:
        b: the body.
        dt: time of the step [s].
        turning: time in which it rotated [s].
        missed: displacement by its velocity that it did not make [m].
        linear: its velocity after the step.
        spin: its angular velocity before the free rotation of the step.
        turn_change: rotational energy after the step less that before the step [J].
        bodies: the bodies.
        motions: their accelerations in the step.
        state: their state before the step.
    """
    before = wp.vec3d(state.linear_velocity[b])
    after = wp.vec3d(linear)
    mass = wp.float64(bodies.mass[b])
    pull = wp.vec3d(motions.acceleration[b])
    gain = mass * (
        wp.dot(before + after, after - before - dt * pull) + wp.float64(2.0) * wp.dot(pull, wp.vec3d(missed))
    )
    work = turning * wp.dot(wp.vec3d(state.angular_velocity[b]) + spin, wp.vec3d(state.torque[b]))
    return wp.float64(0.5) * (gain - work) + turn_change


@wp.func
def spin_after_push(kept: wp.quatd, after: wp.quatd, spin: wp.vec3d, inertia: mat33d):
    """Angular velocity after a push-out, which changes neither the energy nor the direction of the angular momentum."""
    r = wp.quat_to_matrix(kept)
    momentum = r * (inertia * (wp.transpose(r) * spin))
    pushed = spin_of(after, momentum, wp.inverse(inertia))
    energy = wp.dot(momentum, pushed)
    if energy <= wp.float64(0.0):
        return spin
    return wp.sqrt(wp.dot(momentum, spin) / energy) * pushed


@wp.kernel
def integrate_positions(dt: float, bodies: Bodies, motions: Motions, graph: Graph, envs: Environments, state: State):
    """One thread per body: integrate position and orientation with the velocity and the push-out.

    Angular momentum is conserved. The rotation is computed in float64, and its rounding error is stored for the next
    step; otherwise it would be the main error of the angular momentum. The push-out keeps the energy and the direction
    of the angular momentum. With a constant angular velocity, the spin of a thin rod about its axis would become a fast
    spin about another axis; with one that turns with the body, a top would lean over. Velocities that obey joints turn
    with the bodies. From its first impact on, a body follows its course (ccd.py). The push-out prevents overlaps by the
    motion of the whole step, so a body is pushed as far as it makes that motion. The joints of a mechanism are closed
    for the whole push-out.
    """
    b = wp.tid()
    moves = motions.role[b] == Role.FREE or motions.role[b] == Role.KINEMATIC
    env = bodies.env[b]
    halted = envs.failed[env] == 1 or envs.broken[env] > 0
    if bodies.motion[b] == Motion.STATIC or halted or not moves:
        return
    turning = wp.float64(dt * motions.next_time_of_impact[b])
    turn = precise(state.orientation[b], state.orientation_remainder[b])
    spin = wp.vec3d(motions.solver_bodies[b].angular) + wp.vec3d(state.angular_velocity_remainder[b])
    kept_push = wp.where(motions.joined[b] == 1, 1.0, motions.next_time_of_impact[b])
    pushed = kept_push * motions.solver_bodies[b].push_angular
    push_turn = wp.float64(dt) * wp.vec3d(pushed + motions.next_shared_spin[b])
    missed = wp.vec3(0.0, 0.0, 0.0)
    if motions.next_time_of_impact[b] < 1.0:
        missed = dt * (motions.solver_bodies[b].linear - motions.next_course[b])
    linear = without_added_speed(motions.solver_bodies[b].linear, motions.acceleration[b], missed)
    kept = rotate_by(turn, turning * spin)
    health = state.health[b]
    if bodies.motion[b] == Motion.DYNAMIC:
        spin_before = wp.vec3d(state.angular_velocity[b]) + wp.vec3d(state.angular_velocity_remainder[b])
        change = -rotational_energy(turn, spin_before, bodies.inertia[b])
        kept, free_spin = turn_freely(turn, spin, mat33d(bodies.inertia[b]), turning)
        change += rotational_energy(kept, free_spin, bodies.inertia[b])
        duration = wp.float64(dt)
        health[0] += energy_without_work(b, duration, turning, missed, linear, spin, change, bodies, motions, state)
        spin = free_spin
    else:
        health[0] = wp.float64(1.0)
    state.health[b] = health
    push = rotate_by(wp.quatd(wp.float64(0.0), wp.float64(0.0), wp.float64(0.0), wp.float64(1.0)), push_turn)
    after = wp.normalize(push * kept)
    travel = wp.float64(dt) * wp.vec3d(motions.next_course[b] + kept_push * motions.solver_bodies[b].push_linear)
    state.linear_velocity[b] = linear
    center = wp.vec3d(bodies.center_of_mass[b])
    center_shift = wp.quat_rotate(after, center) - wp.quat_rotate(turn, center)
    state.position[b] = wp.vec3(wp.vec3d(state.position[b]) + travel - center_shift)
    if bodies.motion[b] == Motion.DYNAMIC and graph.tied[b] == 0:
        spin = spin_after_push(kept, after, spin, mat33d(bodies.inertia[b]))
    else:
        spin = wp.quat_rotate(push, spin)
    store_turn(b, after, spin, state)
