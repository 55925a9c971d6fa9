"""Prescribed motions: kinematic bodies that follow the keyframes of a path.

The pose at the start of a step and that at its end follow from the environment's step counter, in float64. The body
gets the first one, and the velocity that leads to the second one. Rounding errors do not add up, and a reset, a
checkpoint or a repeated step needs nothing but the counter.
"""

import math

import warp as wp

from warp_rigid.kernels.schema import Bodies, Environments, Paths, State
from warp_rigid.kernels.update.integrate import rotation_vector, store_turn

wp.set_module_options({"enable_backward": False})

HALF_TURN = wp.constant(wp.float64(math.pi))
SAME_ORIENTATION = wp.constant(wp.float64(1e-6))
"""Angle below which rounding decides the axis of a rotation [rad]."""


@wp.func
def time_on_path(k: int, time: wp.float64, paths: Paths):
    """Time of the keyframes at a time of the simulation [s]: held before the start and after the end, or repeated."""
    first = paths.time[paths.first[k]]
    last = paths.time[paths.first[k] + paths.count[k] - 1]
    if paths.loop[k] == 1 and time > first:
        return first + wp.mod(time - first, last - first)
    return wp.clamp(time, first, last)


@wp.func
def keyframe_before(k: int, time: wp.float64, paths: Paths):
    """The last keyframe at or before a time, of those that have a next one."""
    low = paths.first[k]
    high = paths.first[k] + paths.count[k] - 1
    while high - low > 1:
        middle = (low + high) / 2
        if paths.time[middle] <= time:
            low = middle
        else:
            high = middle
    return low


@wp.func
def segment_at(k: int, time: wp.float64, paths: Paths):
    """Time of the keyframes, the keyframe before it, and the share of the time to the next one that has passed."""
    t = time_on_path(k, time, paths)
    i = keyframe_before(k, t, paths)
    return t, i, (t - paths.time[i]) / (paths.time[i + 1] - paths.time[i])


@wp.func
def is_same(p: wp.quatd, q: wp.quatd):
    """Whether two quaternions are equal to the bit."""
    return p[0] == q[0] and p[1] == q[1] and p[2] == q[2] and p[3] == q[3]


@wp.func
def turn_between(p: wp.quatd, q: wp.quatd):
    """Rotation vector of the shorter turn from one orientation to another [rad], exactly 0 for equal ones."""
    if is_same(p, q):
        return wp.vec3d()
    return rotation_vector(q * wp.quat_inverse(p))


@wp.func
def turned(q: wp.quatd, rotation: wp.vec3d):
    """An orientation turned by a rotation vector in the world frame; unchanged by exactly 0."""
    angle = wp.length(rotation)
    if angle == wp.float64(0.0):
        return q
    return wp.normalize(wp.quat_from_axis_angle(rotation / angle, angle) * q)


@wp.func
def pose_at(k: int, time: wp.float64, paths: Paths):
    """Position and orientation on a path at a time: between keyframes the body moves and turns evenly."""
    _, i, share = segment_at(k, time, paths)
    position = paths.position[i] + share * (paths.position[i + 1] - paths.position[i])
    turn = turn_between(paths.orientation[i], paths.orientation[i + 1])
    return position, turned(paths.orientation[i], share * turn)


@wp.func
def turned_until(k: int, time: wp.float64, paths: Paths):
    """Sum of the turns on a path until a time, those of its repetitions included [rad]."""
    t, i, share = segment_at(k, time, paths)
    total = paths.turned[i] + share * (paths.turned[i + 1] - paths.turned[i])
    first = paths.time[paths.first[k]]
    if paths.loop[k] == 1 and time > first:
        last = paths.first[k] + paths.count[k] - 1
        total += wp.round((time - t) / (paths.time[last] - first)) * paths.turned[last]
    return total


@wp.func
def with_full_turns(rotation: wp.vec3d, turned: wp.vec3d):
    """The rotation of a step by at most half a turn, with the full turns that its path makes beyond it [rad].

    They are about the same axis, so that the body ends where the path does. A rotation that is almost 0 has no axis;
    then it is that of the path.
    """
    if wp.length(turned) <= HALF_TURN:
        return rotation
    axis = wp.normalize(turned)
    if wp.length(rotation) > SAME_ORIENTATION:
        axis = wp.normalize(rotation)
    full = wp.float64(2.0) * HALF_TURN
    return rotation + full * wp.round((wp.dot(turned, axis) - wp.dot(rotation, axis)) / full) * axis


@wp.kernel
def follow_paths(dt: wp.float64, paths: Paths, bodies: Bodies, envs: Environments, state: State):
    """One thread per path: pose of the body at the start of the step, and its mean velocity in the step."""
    k = wp.tid()
    b = paths.body[k]
    env = bodies.env[b]
    if envs.failed[env] == 1:
        return
    time = wp.float64(envs.step[env]) * dt
    position, turn = pose_at(k, time, paths)
    next_position, next_turn = pose_at(k, time + dt, paths)
    center = wp.vec3d(bodies.center_of_mass[b])
    way = next_position - position
    total = turned_until(k, time + dt, paths) - turned_until(k, time, paths)
    rotation = with_full_turns(turn_between(turn, next_turn), total)
    if wp.length(rotation) > wp.float64(0.0):
        way += wp.quat_rotate(next_turn, center) - wp.quat_rotate(turn, center)
    state.position[b] = wp.vec3(position)
    state.linear_velocity[b] = wp.vec3(way / dt)
    store_turn(b, turn, rotation / dt, state)
