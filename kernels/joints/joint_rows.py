"""Rows of a joint: how the velocities of its two bodies change its errors and its coordinate.

A row has the velocity w = linear . (va - vb) + angular_a . wa + angular_b . wb, where va and vb are the velocities of
the centres of mass. An impulse along the row acts on both bodies at the same point, so that both momenta are conserved.
"""

import warp as wp

from warp_rigid.kernels.common.solver_body import (
    PUSH,
    VELOCITY,
    inverse_inertia_of,
    inverse_mass_of,
    load_velocity,
    store_inverse_inertia,
)
from warp_rigid.kernels.common.team import Team, sync_warp
from warp_rigid.kernels.enums import Coordinate, JointNumber, Role
from warp_rigid.kernels.joints.arrays import Joints, mat33d
from warp_rigid.kernels.joints.elements import axis_row, rows_times, sum_of_rows
from warp_rigid.kernels.joints.poses import Ends, axis_of, ends_of, free_row
from warp_rigid.kernels.schema import Bodies, Motions

wp.set_module_options({"enable_backward": False, "max_unroll": 1})


@wp.func
def center_of(b: int, bodies: Bodies, joints: Joints):
    """Centre of mass at the stored pose of a body [m]."""
    return joints.pose_position[b] + wp.quat_rotate(joints.pose_turn[b], wp.vec3d(bodies.center_of_mass[b]))


@wp.func
def unit_or_axis(v: wp.vec3d, turn: wp.quatd):
    """A vector scaled to unit length; an axis of the frame if it is zero."""
    length = wp.length(v)
    if length < wp.float64(1.0e-9):
        return wp.quat_rotate(turn, wp.vec3d(wp.float64(0.0), wp.float64(0.0), wp.float64(1.0)))
    return v / length


@wp.func
def build_rows(j: int, bodies: Bodies, joints: Joints):
    """Store all rows of a joint at the stored poses of its bodies.

    The row of a distance is along the line from the second point to the first; its other rows are not used.
    """
    ends = ends_of(j, joints)
    arm_a = ends.point_a - center_of(joints.body_a[j], bodies, joints)
    base_b = ends.point_b
    if joints.to_world[j] == 0:
        base_b = center_of(joints.body_b[j], bodies, joints)
    arm_b = ends.point_a - base_b
    axes = wp.transpose(wp.quat_to_matrix(ends.turn_b))
    u, v, w = axes[0], axes[1], axes[2]
    p, q, s = axes[0], axes[1], axes[2]
    coordinate = joints.coordinate[j]
    if coordinate == Coordinate.CONE:
        p = unit_or_axis(wp.cross(u, axis_of(ends.turn_a)), ends.turn_b)
        q = u
        s = wp.cross(p, u)
    if coordinate == Coordinate.LENGTH:
        u = unit_or_axis(ends.point_a - ends.point_b, ends.turn_b)
        arm_b = ends.point_b - base_b
    zero = wp.vec3d()
    joints.linear[j] = wp.matrix_from_rows(u, v, w, zero, zero, zero)
    joints.angular_a[j] = wp.matrix_from_rows(wp.cross(arm_a, u), wp.cross(arm_a, v), wp.cross(arm_a, w), p, q, s)
    joints.angular_b[j] = -wp.matrix_from_rows(wp.cross(arm_b, u), wp.cross(arm_b, v), wp.cross(arm_b, w), p, q, s)


@wp.func
def is_locked(rows: int, k: int):
    """Whether a row is in a bit mask."""
    return (rows >> k) & 1 == 1


@wp.func
def is_damped(j: int, k: int, joints: Joints):
    """Whether a row is a rotation of a ball joint that its damping alone acts on, not its limit."""
    return k > 3 and joints.coordinate[j] == Coordinate.CONE and joints.numbers[j, JointNumber.DAMPING] > 0.0


@wp.func
def largest_across(n: wp.vec3d, matrix: mat33d):
    """Largest value of a symmetric matrix for unit vectors that are perpendicular to n."""
    across = wp.identity(n=3, dtype=wp.float64) - wp.outer(n, n)
    part = across * matrix * across
    sum = wp.trace(part)
    return wp.float64(0.5) * (sum + wp.sqrt(wp.max(wp.float64(2.0) * wp.ddot(part, part) - sum * sum, wp.float64(0.0))))


@wp.func
def vibration_of(j: int, b: int, dt: float, parts: int, bodies: Bodies, motions: Motions, joints: Joints):
    """Mass and moment of inertia that Newmark's method adds to a body for a joint, and both over those of the body.

    A joint's force F at an arm r resists small rotations with a stiffness of at most k = (F . r + |F| |r|) / 2, and a
    string of length l under tension T resists lateral motion with T / l. Vibrations of links under a large tension can
    be faster than the time step resolves. M + dt^2 k / 4 in place of M keeps them stable at any step without damping
    (Newmark's method with beta = 1/4; geometric stiffness after Tournier et al. 2015 and Andrews et al. 2017). The
    body's own moment of inertia is the least one about an axis across the arm.
    """
    step = wp.float64(dt) / wp.float64(parts)
    force = wp.vec3d(joints.impulse[j]) / wp.float64(dt)
    if wp.length(force) == wp.float64(0.0) or joints.broken[j] == 1:
        return wp.vec4d()
    lateral = wp.float64(0.0)
    if joints.coordinate[j] == Coordinate.LENGTH:
        ends = ends_of(j, joints)
        apart = ends.point_a - ends.point_b
        lateral = wp.max(-wp.dot(force, apart), wp.float64(0.0)) / wp.max(wp.length_sq(apart), wp.float64(1.0e-12))
    anchor = joints.anchor_a[j]
    if joints.body_a[j] != b:
        anchor = joints.anchor_b[j]
        force = -force
    arm = wp.quat_rotate(joints.pose_turn[b], wp.vec3d(anchor - bodies.center_of_mass[b]))
    stiffness = wp.float64(0.5) * (wp.dot(force, arm) + wp.length(force) * wp.length(arm))
    mass = wp.float64(0.5) * step * step * lateral
    moment = wp.float64(0.25) * step * step * stiffness
    across = largest_across(wp.normalize(arm), mat33d(inverse_inertia_of(b, motions)))
    return wp.vec4d(mass, moment, mass * wp.float64(inverse_mass_of(b, motions)), moment * across)


@wp.func
def unresolved(added: wp.float64, ratio: wp.float64):
    """Part of an added mass that vibrations need which the step does not resolve; `ratio`: over the body's own mass.

    The ratio is (omega dt)^2 / 4, at most. The scheme is stable below 1, and conserves energy with masses that do not
    depend on the last step. Nothing is added below 1/2, and above it as much as leaves 1/2.
    """
    if ratio <= wp.float64(0.5):
        return wp.float64(0.0)
    return added * (wp.float64(2.0) - wp.float64(1.0) / ratio)


@wp.func
def vibrations_of(i: int, dt: float, parts: int, bodies: Bodies, motions: Motions, joints: Joints):
    """Sums of `vibration_of` over all joints of a member, for a step in `parts` equal parts."""
    sums = wp.vec4d()
    for e in range(joints.first_end[i], joints.first_end[i + 1]):
        sums += vibration_of(joints.joint_of_end[e], joints.member[i], dt, parts, bodies, motions, joints)
    return sums


@wp.func
def store_masses(i: int, dt: float, parts: int, bodies: Bodies, motions: Motions, joints: Joints):
    """Inverse mass and inertia of a member with what is added for stability; 0 unless it is free to move.

    Contacts use the same ones in this step, so that both act on the same momentum.
    """
    b = joints.member[i]
    joints.inverse_mass[b] = wp.float64(0.0)
    joints.inverse_inertia[b] = mat33d()
    if motions.role[b] != Role.FREE:
        return
    sums = vibrations_of(i, dt, parts, bodies, motions, joints)
    added = wp.vec2d(unresolved(sums[0], sums[2]), unresolved(sums[1], sums[3]))
    one = wp.float64(1.0)
    joints.inverse_mass[b] = one / (one / wp.float64(inverse_mass_of(b, motions)) + added[0])
    inverse = mat33d(inverse_inertia_of(b, motions))
    if added[0] + added[1] > wp.float64(0.0):
        inverse = wp.inverse(wp.inverse(inverse) + added[1] * wp.identity(n=3, dtype=wp.float64))
        motions.solver_bodies[b].inverse_mass = float(joints.inverse_mass[b])
        store_inverse_inertia(b, wp.mat33(inverse), motions)
    joints.inverse_inertia[b] = inverse


@wp.func
def row_velocities(j: int, which: int, motions: Motions, joints: Joints):
    """Velocities along all rows of a joint [m/s, rad/s]; `which`: VELOCITY or PUSH."""
    a = joints.body_a[j]
    linear = wp.vec3d(load_velocity(a, which, motions))
    speeds = rows_times(joints.angular_a, j, wp.vec3d(load_velocity(a, which + 1, motions)))
    if joints.to_world[j] == 0:
        b = joints.body_b[j]
        linear = linear - wp.vec3d(load_velocity(b, which, motions))
        speeds = speeds + rows_times(joints.angular_b, j, wp.vec3d(load_velocity(b, which + 1, motions)))
    return speeds + rows_times(joints.linear, j, linear)


@wp.func
def row_velocity(j: int, k: int, motions: Motions, joints: Joints):
    """Velocity along one row of a joint [m/s, rad/s]."""
    a = joints.body_a[j]
    linear = wp.vec3d(load_velocity(a, VELOCITY, motions))
    speed = wp.dot(axis_row(joints.angular_a, j, k), wp.vec3d(load_velocity(a, VELOCITY + 1, motions)))
    if joints.to_world[j] == 0:
        b = joints.body_b[j]
        linear = linear - wp.vec3d(load_velocity(b, VELOCITY, motions))
        speed = speed + wp.dot(axis_row(joints.angular_b, j, k), wp.vec3d(load_velocity(b, VELOCITY + 1, motions)))
    return speed + wp.dot(axis_row(joints.linear, j, k), linear)


@wp.func
def point_velocity(b: int, point: wp.vec3d, bodies: Bodies, motions: Motions, joints: Joints):
    """Velocity of a point of a body at the predicted pose [m/s]."""
    linear = wp.vec3d(load_velocity(b, VELOCITY, motions))
    return linear + wp.cross(joints.pose_spin[b], point - center_of(b, bodies, joints))


@wp.func
def coordinate_rate(j: int, ends: Ends, bodies: Bodies, motions: Motions, joints: Joints):
    """Velocity of the coordinate of a hinge or slider at the predicted poses, after the free motion of the step."""
    a = joints.body_a[j]
    b = joints.body_b[j]
    angular = joints.pose_spin[a]
    linear = point_velocity(a, ends.point_a, bodies, motions, joints)
    if joints.to_world[j] == 0:
        angular = angular - joints.pose_spin[b]
        linear = linear - point_velocity(b, ends.point_a, bodies, motions, joints)
    axis = wp.quat_rotate(ends.turn_b, wp.vec3d(wp.float64(1.0), wp.float64(0.0), wp.float64(0.0)))
    return wp.dot(axis, wp.where(joints.coordinate[j] == Coordinate.ANGLE, angular, linear))


@wp.func
def add_velocity(b: int, which: int, linear: wp.vec3d, angular: wp.vec3d, motions: Motions):
    """Change one of the velocities of a body: VELOCITY or PUSH."""
    body = motions.solver_bodies[b]
    if which == PUSH:
        motions.solver_bodies[b].push_linear = wp.vec3(wp.vec3d(body.push_linear) + linear)
        motions.solver_bodies[b].push_angular = wp.vec3(wp.vec3d(body.push_angular) + angular)
    else:
        motions.solver_bodies[b].linear = wp.vec3(wp.vec3d(body.linear) + linear)
        motions.solver_bodies[b].angular = wp.vec3(wp.vec3d(body.angular) + angular)


@wp.func
def apply_solution(m: int, which: int, team: Team, motions: Motions, joints: Joints):
    """Apply the impulses of all joints of a mechanism in `solution`, negative, to its bodies: VELOCITY or PUSH."""
    for i in range(joints.first_member[m] + team.lane, joints.first_member[m + 1], team.lanes):
        b = joints.member[i]
        if motions.role[b] == Role.FREE:
            linear = wp.vec3d()
            angular = wp.vec3d()
            for e in range(joints.first_end[i], joints.first_end[i + 1]):
                j = joints.joint_of_end[e]
                impulses = joints.solution[j, 0]
                along = sum_of_rows(joints.linear, j, impulses)
                if joints.body_a[j] == b:
                    linear -= along
                    angular -= sum_of_rows(joints.angular_a, j, impulses)
                else:
                    linear += along
                    angular -= sum_of_rows(joints.angular_b, j, impulses)
            add_velocity(b, which, joints.inverse_mass[b] * linear, joints.inverse_inertia[b] * angular, motions)
    sync_warp(team.lanes)


@wp.func
def add_to_impulses(m: int, team: Team, joints: Joints):
    """Add the impulses in `solution`, negative, to those of the step."""
    for place in range(joints.first_place[m] + team.lane, joints.first_place[m + 1], team.lanes):
        j = joints.sequence[place]
        joints.total[j] = joints.total[j] - joints.solution[j, 0]


@wp.func
def is_present(j: int, motions: Motions, joints: Joints):
    """Whether a joint acts in this step: it is not broken, and its bodies are not switched off."""
    absent = motions.role[joints.body_a[j]] == Role.ABSENT or motions.role[joints.body_b[j]] == Role.ABSENT
    return joints.broken[j] == 0 and not absent


@wp.func
def present_rows(j: int, motions: Motions, joints: Joints):
    """Rows that a joint prevents in this step; 0 if it does not act."""
    return wp.where(is_present(j, motions, joints), joints.locked[j], 0)


@wp.func
def has_coordinate(j: int, motions: Motions, joints: Joints):
    """Whether limits, drive and friction of a joint act in this step."""
    return is_present(j, motions, joints) and free_row(joints.coordinate[j]) >= 0
