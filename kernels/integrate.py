"""Last stage: the position update, and the watch over non-finite states."""

import warp as wp

from warp_rigid.kernels.data import MOTION_DYNAMIC, MOTION_STATIC, Bodies, Environments, Motions, State
from warp_rigid.kernels.team import any_of_team

wp.set_module_options({"enable_backward": False})

DYNAMIC = wp.constant(MOTION_DYNAMIC)
STATIC = wp.constant(MOTION_STATIC)

mat33d = wp.types.matrix(shape=(3, 3), dtype=wp.float64)


@wp.func
def rotate_by(turn: wp.quatd, rotation: wp.vec3d):
    """Turn an orientation by a rotation vector in the world [rad], exactly; the result has unit length."""
    angle = wp.length(rotation)
    half = wp.float64(0.5) * angle
    scale = wp.float64(0.5) - angle * angle / wp.float64(48.0)
    if angle > wp.float64(1.0e-4):
        scale = wp.sin(half) / angle
    spin = wp.quatd(scale * rotation[0], scale * rotation[1], scale * rotation[2], wp.cos(half))
    return wp.normalize(spin * turn)


@wp.func
def precise(q: wp.quat, rest: wp.vec4):
    """A stored orientation with what its rounding left over."""
    return wp.quatd(
        wp.float64(q[0]) + wp.float64(rest[0]),
        wp.float64(q[1]) + wp.float64(rest[1]),
        wp.float64(q[2]) + wp.float64(rest[2]),
        wp.float64(q[3]) + wp.float64(rest[3]),
    )


@wp.func
def spin_of(turn: wp.quatd, momentum: wp.vec3d, inverse: mat33d):
    """Angular velocity that belongs to an angular momentum in an orientation: R I^-1 R^T L."""
    r = wp.quat_to_matrix(wp.normalize(turn))
    return r * (inverse * (wp.transpose(r) * momentum))


@wp.func
def free_turn(turn: wp.quatd, momentum: wp.vec3d, inverse: mat33d, dt: wp.float64):
    """Orientation after a torque-free time dt: the angular momentum stays, the orientation follows.

    Fourth order and made of rotations only, so that a steady spin is exact (Celledoni, Marthinsen and Owren 2003,
    commutator-free method). The second-order update of Guendelman et al. 2003, section 3, keeps the energy to 4e-5;
    a body that flips about its middle axis needs more.
    """
    parts = 1 + int(wp.min(dt * wp.length(spin_of(turn, momentum, inverse)) * wp.float64(2.0), wp.float64(63.0)))
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
def is_finite(v: wp.vec3):
    """Whether all components are finite numbers."""
    return wp.isfinite(v[0]) and wp.isfinite(v[1]) and wp.isfinite(v[2])


@wp.func
def body_is_finite(b: int, state: State):
    """Whether a body's velocity and place are finite."""
    return is_finite(state.linear_velocity[b]) and is_finite(state.angular_velocity[b]) and is_finite(state.position[b])


@wp.kernel
def watch(lanes: int, bodies_per_env: int, envs: Environments, state: State):
    """A team an environment: halt it if a body's velocity or pose is not finite, and note which body and when."""
    env = wp.tid() / lanes
    lane = wp.tid() % lanes
    if envs.failed[env] == 1:
        return
    first = env * bodies_per_env
    broken = int(0)
    for b in range(first + lane, first + bodies_per_env, lanes):
        if not body_is_finite(b, state):
            broken = 1
    broken = any_of_team(broken, lanes)
    if lane > 0:
        return
    if broken == 1:
        body = int(0)
        while body_is_finite(first + body, state):
            body += 1
        envs.failed[env] = 1
        envs.failed_body[env] = body
        envs.failed_step[env] = envs.step[env]
    envs.step[env] = envs.step[env] + 1


@wp.kernel
def move(dt: float, bodies_per_env: int, bodies: Bodies, motions: Motions, envs: Environments, state: State):
    """One thread a body: position and orientation follow the velocity and the push-out; angular momentum is kept.

    The rotation is done in float64, and what rounding leaves over is kept for the next step: it would otherwise be what
    changes the angular momentum.
    """
    b = wp.tid()
    if bodies.motion[b] == STATIC or envs.failed[b / bodies_per_env] == 1:
        return
    step = wp.float64(dt)
    turn = precise(state.orientation[b], state.turn_rest[b])
    spin = wp.vec3d(state.angular_velocity[b]) + wp.vec3d(state.spin_rest[b])
    kept = rotate_by(turn, step * spin)
    if bodies.motion[b] == DYNAMIC:
        inertia = mat33d(bodies.inertia[b])
        inverse = wp.inverse(inertia)
        r = wp.quat_to_matrix(turn)
        momentum = r * (inertia * (wp.transpose(r) * spin))
        kept = free_turn(turn, momentum, inverse, step)
        spin = spin_of(kept, momentum, inverse)
    after = rotate_by(kept, step * wp.vec3d(motions.push_angular[b]))
    state.angular_velocity[b] = wp.vec3(spin)
    state.spin_rest[b] = wp.vec3(spin - wp.vec3d(wp.vec3(spin)))
    travel = step * wp.vec3d(state.linear_velocity[b] + motions.push_linear[b])
    center = wp.vec3d(bodies.center_of_mass[b])
    swing = wp.quat_rotate(after, center) - wp.quat_rotate(turn, center)
    state.position[b] = wp.vec3(wp.vec3d(state.position[b]) + travel - swing)
    rounded = wp.quat(wp.float32(after[0]), wp.float32(after[1]), wp.float32(after[2]), wp.float32(after[3]))
    state.orientation[b] = rounded
    rest = after - precise(rounded, wp.vec4(0.0, 0.0, 0.0, 0.0))
    state.turn_rest[b] = wp.vec4(wp.float32(rest[0]), wp.float32(rest[1]), wp.float32(rest[2]), wp.float32(rest[3]))
