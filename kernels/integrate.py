"""Last stage: the position update, and the watch over non-finite states."""

import warp as wp

from warp_rigid.kernels.data import MOTION_DYNAMIC, MOTION_STATIC, Bodies, Environments, Motions, State

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
def free_rotation(turn: wp.quatd, spin: wp.vec3d, inertia: mat33d, inverse: mat33d, dt: wp.float64):
    """Rotation vector of a torque-free step, second order: dt w + dt^2/2 I^-1 (L x w) (Guendelman 2003, section 3)."""
    r = wp.quat_to_matrix(turn)
    back = wp.transpose(r)
    momentum = r * (inertia * (back * spin))
    change = r * (inverse * (back * wp.cross(momentum, spin)))
    return dt * spin + wp.float64(0.5) * dt * dt * change


@wp.func
def is_finite(v: wp.vec3):
    """Whether all components are finite numbers."""
    return wp.isfinite(v[0]) and wp.isfinite(v[1]) and wp.isfinite(v[2])


@wp.kernel
def watch(bodies_per_env: int, envs: Environments, state: State):
    """One thread an environment: halt it if a body's velocity or pose is not finite, and note which body and when."""
    env = wp.tid()
    if envs.failed[env] == 1:
        return
    first = env * bodies_per_env
    for b in range(first, first + bodies_per_env):
        finite = is_finite(state.linear_velocity[b]) and is_finite(state.angular_velocity[b])
        if not (finite and is_finite(state.position[b])) and envs.failed[env] == 0:
            envs.failed[env] = 1
            envs.failed_body[env] = b - first
            envs.failed_step[env] = envs.step[env]
    envs.step[env] = envs.step[env] + 1


@wp.kernel
def move(dt: float, bodies_per_env: int, bodies: Bodies, motions: Motions, envs: Environments, state: State):
    """One thread a body: position and orientation follow the velocity and the push-out; angular momentum is kept.

    The rotation is done in float64: its rounding would otherwise be what changes the angular momentum.
    """
    b = wp.tid()
    if bodies.motion[b] == STATIC or envs.failed[b / bodies_per_env] == 1:
        return
    step = wp.float64(dt)
    turn = wp.quatd(
        wp.float64(state.orientation[b][0]),
        wp.float64(state.orientation[b][1]),
        wp.float64(state.orientation[b][2]),
        wp.float64(state.orientation[b][3]),
    )
    spin = wp.vec3d(state.angular_velocity[b])
    rotation = step * spin
    inertia = mat33d(bodies.inertia[b])
    inverse = mat33d(bodies.inverse_inertia[b])
    dynamic = bodies.motion[b] == DYNAMIC
    if dynamic:
        rotation = free_rotation(turn, spin, inertia, inverse, step)
    after = rotate_by(turn, rotation + step * wp.vec3d(motions.push_angular[b]))
    if dynamic:
        r = wp.quat_to_matrix(turn)
        kept = rotate_by(turn, rotation)
        s = wp.quat_to_matrix(kept)
        momentum = r * (inertia * (wp.transpose(r) * spin))
        state.angular_velocity[b] = wp.vec3(s * (inverse * (wp.transpose(s) * momentum)))
    travel = step * wp.vec3d(state.linear_velocity[b] + motions.push_linear[b])
    center = wp.vec3d(bodies.center_of_mass[b])
    swing = wp.quat_rotate(after, center) - wp.quat_rotate(turn, center)
    state.position[b] = wp.vec3(wp.vec3d(state.position[b]) + travel - swing)
    state.orientation[b] = wp.quat(
        wp.float32(after[0]), wp.float32(after[1]), wp.float32(after[2]), wp.float32(after[3])
    )
