"""Poses of jointed bodies, now and predicted for the end of the step, and the errors of joints at these poses."""

import warp as wp

from warp_rigid.kernels.common.solver_body import PUSH, VELOCITY, load_velocity
from warp_rigid.kernels.enums import Coordinate, Motion, Role
from warp_rigid.kernels.joints.arrays import Joints, vec6d
from warp_rigid.kernels.schema import Bodies, Motions, State
from warp_rigid.kernels.update.integrate import mat33d, precise, rotate_by, turn_freely

wp.set_module_options({"enable_backward": False, "max_unroll": 1})


@wp.struct
class Ends:
    """Both frames of a joint in the world: origins [m] and orientations."""

    point_a: wp.vec3d
    point_b: wp.vec3d
    turn_a: wp.quatd
    turn_b: wp.quatd


@wp.func
def in_double(q: wp.quat):
    """A quaternion in float64."""
    return wp.quatd(wp.float64(q[0]), wp.float64(q[1]), wp.float64(q[2]), wp.float64(q[3]))


@wp.func
def take_pose(b: int, state: State, joints: Joints):
    """Store the present pose of a body."""
    joints.base_position[b] = wp.vec3d(state.position[b])
    joints.base_turn[b] = wp.normalize(precise(state.orientation[b], state.orientation_remainder[b]))
    joints.pose_position[b] = joints.base_position[b]
    joints.pose_turn[b] = joints.base_turn[b]


@wp.func
def predict_pose(
    b: int, dt: float, part: float, course: wp.vec3, bodies: Bodies, state: State, motions: Motions, joints: Joints
):
    """Store the pose at which `integrate_positions` will place a body that moves with its present velocities.

    `part`: fraction of the step in which it rotates. `course`: mean velocity over the step [m/s], without the push-out.
    """
    turn = joints.base_turn[b]
    joints.pose_position[b] = joints.base_position[b]
    joints.pose_turn[b] = turn
    joints.pose_spin[b] = wp.vec3d()
    if motions.role[b] != Role.FREE and motions.role[b] != Role.KINEMATIC:
        return
    step = wp.float64(dt)
    time = wp.float64(dt * part)
    spin = wp.vec3d(load_velocity(b, VELOCITY + 1, motions)) + wp.vec3d(state.angular_velocity_remainder[b])
    kept = rotate_by(turn, time * spin)
    if bodies.motion[b] == Motion.DYNAMIC:
        kept, spin = turn_freely(turn, spin, mat33d(bodies.inertia[b]), time)
    joints.pose_spin[b] = spin
    after = wp.normalize(rotate_by(kept, step * wp.vec3d(load_velocity(b, PUSH + 1, motions))))
    travel = step * wp.vec3d(course + load_velocity(b, PUSH, motions))
    center = wp.vec3d(bodies.center_of_mass[b])
    shift = wp.quat_rotate(after, center) - wp.quat_rotate(turn, center)
    joints.pose_position[b] = joints.base_position[b] + travel - shift
    joints.pose_turn[b] = after


@wp.func
def ends_of(j: int, joints: Joints):
    """Both frames of a joint at the stored poses of its bodies."""
    ends = Ends()
    a = joints.body_a[j]
    ends.turn_a = joints.pose_turn[a] * in_double(joints.turn_a[j])
    ends.point_a = joints.pose_position[a] + wp.quat_rotate(joints.pose_turn[a], wp.vec3d(joints.anchor_a[j]))
    ends.turn_b = in_double(joints.turn_b[j])
    ends.point_b = wp.vec3d(joints.anchor_b[j])
    if joints.to_world[j] == 0:
        b = joints.body_b[j]
        ends.turn_b = joints.pose_turn[b] * ends.turn_b
        ends.point_b = joints.pose_position[b] + wp.quat_rotate(joints.pose_turn[b], ends.point_b)
    return ends


@wp.func
def axis_of(turn: wp.quatd):
    """The x axis of a frame."""
    return wp.quat_rotate(turn, wp.vec3d(wp.float64(1.0), wp.float64(0.0), wp.float64(0.0)))


@wp.func
def angle_near(angle: wp.float64, near: float):
    """The angle, changed by full turns to be closest to another one [rad]."""
    full = wp.float64(6.283185307179586)
    return angle + full * wp.round((wp.float64(near) - angle) / full)


@wp.func
def free_row(coordinate: int):
    """Row of a joint's coordinate, -1 if it has none."""
    if coordinate == Coordinate.ANGLE or coordinate == Coordinate.CONE:
        return 3
    return wp.where(coordinate == Coordinate.NONE, -1, 0)


@wp.func
def coordinate_of(coordinate: int, ends: Ends, near: float):
    """Value of a joint's coordinate [m or rad]."""
    if coordinate == Coordinate.ANGLE:
        between = wp.quat_inverse(ends.turn_b) * ends.turn_a
        return angle_near(wp.float64(2.0) * wp.atan2(between[0], between[3]), near)
    axis = axis_of(ends.turn_b)
    if coordinate == Coordinate.SLIDE:
        return wp.dot(ends.point_a - ends.point_b, axis)
    if coordinate == Coordinate.CONE:
        other = axis_of(ends.turn_a)
        return wp.atan2(wp.length(wp.cross(axis, other)), wp.dot(axis, other))
    return wp.length(ends.point_a - ends.point_b)


@wp.func
def turn_in_step(j: int, dt: float, state: State, motions: Motions, joints: Joints):
    """Rotation of the first body of a joint relative to the second in a step with their velocities, about its axis.

    An angle counts turns by it: the poses tell the angle but for full turns [rad].
    """
    a = joints.body_a[j]
    b = joints.body_b[j]
    moves = Role.FREE | Role.KINEMATIC
    spin = wp.where((motions.role[a] & moves) != 0, state.angular_velocity[a], wp.vec3())
    if joints.to_world[j] == 0 and (motions.role[b] & moves) != 0:
        spin -= state.angular_velocity[b]
    return dt * wp.dot(spin, wp.vec3(axis_of(ends_of(j, joints).turn_b)))


@wp.func
def errors_of(j: int, ends: Ends, joints: Joints):
    """Errors of the rows of a joint [m, rad], with its coordinate at its row."""
    coordinate = joints.coordinate[j]
    apart = wp.quat_rotate_inv(ends.turn_b, ends.point_a - ends.point_b)
    between = wp.quat_inverse(ends.turn_b) * ends.turn_a
    scale = wp.float64(2.0)
    if between[3] < wp.float64(0.0):
        scale = -scale
    turned = scale * wp.vec3d(between[0], between[1], between[2])
    if coordinate == Coordinate.ANGLE:
        axis = axis_of(between)
        turned = wp.vec3d(wp.float64(0.0), -axis[2], axis[1])
    errors = vec6d(apart[0], apart[1], apart[2], turned[0], turned[1], turned[2])
    row = free_row(coordinate)
    if row >= 0:
        errors[row] = coordinate_of(coordinate, ends, joints.position[j])
    return errors
