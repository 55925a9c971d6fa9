"""Parts of a step: a mechanism without contacts moves in several equal parts where one does not resolve its motion.

A part is a step of SHAKE: impulses along the rows of the pose at its start, with joints that hold at its end. This
scheme is symplectic, so that energy does not drift (Leimkuhler and Reich 2004), as long as the masses are those of the
bodies, and the length of the parts does not matter much. It has no solution where links turn by about a radian.
"""

import warp as wp

from warp_rigid.kernels.common.solver_body import VELOCITY, load_velocity
from warp_rigid.kernels.common.team import Team, max_of_lanes, sync_team
from warp_rigid.kernels.enums import Coordinate, Role
from warp_rigid.kernels.joints.arrays import Joints
from warp_rigid.kernels.joints.joint_rows import center_of, has_coordinate, present_rows, vibrations_of
from warp_rigid.kernels.joints.mechanism import predict_mechanism, settle_mechanism, start_mechanism, take_poses
from warp_rigid.kernels.joints.poses import ends_of, take_pose
from warp_rigid.kernels.schema import Bodies, Motions, State
from warp_rigid.kernels.update.integrate import mat33d, rotation_vector, turn_freely

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

MOST_PARTS = wp.constant(64)
"""Maximum number of parts. Vibrations that are faster are slowed, and faster turns lose energy."""

LARGEST_TURN = wp.constant(0.1)
"""Angle by which links turn in a part, at most [rad]. Where the length of the parts changes, the energy changes by a
twelfth of the square of this angle."""

TINY = wp.constant(1.0e-6)
"""Length below which an arm counts as none [m]."""


@wp.func
def turning_of(j: int, bodies: Bodies, motions: Motions, joints: Joints):
    """Angular velocity with which the arms of a joint turn, or the line between the points of a distance [rad/s]."""
    ends = ends_of(j, joints)
    a = joints.body_a[j]
    b = joints.body_b[j]
    arm = wp.vec3(ends.point_a - center_of(a, bodies, joints))
    moved = wp.cross(load_velocity(a, VELOCITY + 1, motions), arm)
    rate = wp.length(moved) / wp.max(wp.length(arm), TINY)
    velocity = load_velocity(a, VELOCITY, motions) + moved
    if joints.to_world[j] == 0:
        arm = wp.vec3(ends.point_b - center_of(b, bodies, joints))
        moved = wp.cross(load_velocity(b, VELOCITY + 1, motions), arm)
        rate = wp.max(rate, wp.length(moved) / wp.max(wp.length(arm), TINY))
        velocity -= load_velocity(b, VELOCITY, motions) + moved
    if joints.coordinate[j] == Coordinate.LENGTH:
        apart = wp.vec3(ends.point_a - ends.point_b)
        rate = wp.max(rate, wp.length(wp.cross(velocity, apart)) / wp.max(wp.length_sq(apart), TINY))
    return rate


@wp.func
def parts_needed(m: int, dt: float, team: Team, bodies: Bodies, motions: Motions, joints: Joints):
    """Number of parts that resolve the vibrations of links under the forces of the last step, and their turns.

    It decreases by half or not at all.
    """
    ratio = float(0.0)
    turn = float(0.0)
    for place in range(joints.first_place[m] + team.lane, joints.first_place[m + 1], team.lanes):
        j = joints.sequence[place]
        if present_rows(j, motions, joints) != 0 or has_coordinate(j, motions, joints):
            turn = wp.max(turn, dt * turning_of(j, bodies, motions, joints))
    for i in range(joints.first_member[m] + team.lane, joints.first_member[m + 1], team.lanes):
        if motions.role[joints.member[i]] == Role.FREE:
            sums = vibrations_of(i, dt, 1, bodies, motions, joints)
            ratio = wp.max(ratio, float(wp.max(sums[2], sums[3])))
    needed = max_of_lanes(wp.max(wp.sqrt(2.0 * ratio), turn / LARGEST_TURN), team.lanes)
    parts = wp.clamp(int(wp.ceil(needed)), 1, MOST_PARTS)
    if 2 * parts > joints.parts[m]:
        parts = wp.max(parts, joints.parts[m])
    return parts


@wp.func
def accelerate(m: int, time: float, team: Team, motions: Motions, joints: Joints):
    """Add the accelerations of the step over a time to the velocities of the bodies of a mechanism."""
    for i in range(joints.first_member[m] + team.lane, joints.first_member[m + 1], team.lanes):
        b = joints.member[i]
        if motions.role[b] == Role.FREE:
            body = motions.solver_bodies[b]
            motions.solver_bodies[b].linear = body.linear + time * motions.acceleration[b]
            motions.solver_bodies[b].angular = body.angular + time * motions.spin_acceleration[b]
    sync_team(team)


@wp.func
def begin_parts(m: int, team: Team, state: State, motions: Motions, joints: Joints):
    """Return to the poses and velocities at the start of the step."""
    take_poses(m, team, state, joints)
    for i in range(joints.first_member[m] + team.lane, joints.first_member[m + 1], team.lanes):
        b = joints.member[i]
        if motions.role[b] == Role.FREE:
            motions.solver_bodies[b].linear = state.linear_velocity[b]
            motions.solver_bodies[b].angular = state.angular_velocity[b]
    sync_team(team)


@wp.func
def end_part(m: int, time: float, team: Team, bodies: Bodies, state: State, motions: Motions, joints: Joints):
    """Advance to the poses and velocities at the end of a part."""
    predict_mechanism(m, time, 0, team, bodies, state, motions, joints)
    for i in range(joints.first_member[m] + team.lane, joints.first_member[m + 1], team.lanes):
        b = joints.member[i]
        joints.base_position[b] = joints.pose_position[b]
        joints.base_turn[b] = joints.pose_turn[b]
        if motions.role[b] == Role.FREE:
            spin = joints.pose_spin[b] - wp.vec3d(state.angular_velocity_remainder[b])
            motions.solver_bodies[b].angular = wp.vec3(spin)
    sync_team(team)


@wp.func
def try_parts(
    m: int,
    dt: float,
    parts: int,
    exact: int,
    team: Team,
    bodies: Bodies,
    state: State,
    motions: Motions,
    joints: Joints,
):
    """Move a mechanism in equal parts. Returns 1 if the joints do not hold.

    Velocities belong to the middle of the last part, so the first one takes half of that part's acceleration.
    """
    time = dt / float(parts)
    begin_parts(m, team, state, motions, joints)
    accelerate(m, 0.5 * (dt / float(wp.max(joints.parts[m], 1)) - time), team, motions, joints)
    failed = int(0)
    part = int(0)
    while part < parts:
        if part > 0:
            end_part(m, time, team, bodies, state, motions, joints)
        start_mechanism(m, dt, parts, team, bodies, motions, joints)
        accelerate(m, time, team, motions, joints)
        failed = settle_mechanism(m, time, 0, exact, team, bodies, state, motions, joints)
        part = wp.where(failed * exact == 1, parts, part + 1)
    return failed


@wp.func
def join_parts(b: int, dt: float, bodies: Bodies, state: State, motions: Motions, joints: Joints):
    """Express the motion in parts as a velocity, with which a body would arrive with its final one, and a push-out.

    The free rotation back from the final pose is that of the initial pose but for a constant rotation.
    """
    position = joints.pose_position[b]
    turn = joints.pose_turn[b]
    spin = joints.pose_spin[b]
    take_pose(b, state, joints)
    if motions.role[b] != Role.FREE:
        return
    step = wp.float64(dt)
    back, reverse = turn_freely(turn, -spin, mat33d(bodies.inertia[b]), step)
    between = back * wp.quat_inverse(joints.base_turn[b])
    spin = -wp.quat_rotate_inv(between, reverse)
    center = wp.vec3d(bodies.center_of_mass[b])
    shift = wp.quat_rotate(turn, center) - wp.quat_rotate(joints.base_turn[b], center)
    mean = (position - joints.base_position[b] + shift) / step
    body = motions.solver_bodies[b]
    motions.solver_bodies[b].angular = wp.vec3(spin - wp.vec3d(state.angular_velocity_remainder[b]))
    motions.solver_bodies[b].push_angular = wp.vec3(rotation_vector(between) / step)
    motions.solver_bodies[b].push_linear = wp.vec3(mean - wp.vec3d(body.linear))


@wp.func
def finish_parts(
    m: int, dt: float, parts: int, team: Team, bodies: Bodies, state: State, motions: Motions, joints: Joints
):
    """Leave the motion in parts, and the forces of the last part, to the rest of the step."""
    late = 0.5 * (1.0 / float(wp.max(joints.parts[m], 1)) - 1.0 / float(parts))
    if parts > 1:
        end_part(m, dt / float(parts), team, bodies, state, motions, joints)
    for i in range(joints.first_member[m] + team.lane, joints.first_member[m + 1], team.lanes):
        b = joints.member[i]
        if parts > 1:
            join_parts(b, dt, bodies, state, motions, joints)
        motions.acceleration[b] = (1.0 + late) * motions.acceleration[b]
    for place in range(joints.first_place[m] + team.lane, joints.first_place[m + 1], team.lanes):
        j = joints.sequence[place]
        joints.total[j] = wp.float64(parts) * joints.total[j]
    sync_team(team)
    if team.lane == 0:
        joints.parts[m] = parts


@wp.func
def move_in_parts(m: int, dt: float, team: Team, bodies: Bodies, state: State, motions: Motions, joints: Joints):
    """Move a mechanism without contacts in as few parts as resolve its motion; in a single one where none do."""
    take_poses(m, team, state, joints)
    parts = int(parts_needed(m, dt, team, bodies, motions, joints))
    failed = int(1)
    while failed == 1 and parts <= MOST_PARTS:
        failed = try_parts(m, dt, parts, 1, team, bodies, state, motions, joints)
        if failed == 1:
            parts = 2 * parts
    if failed == 1:
        parts = 1
        failed = try_parts(m, dt, parts, 0, team, bodies, state, motions, joints)
    finish_parts(m, dt, parts, team, bodies, state, motions, joints)
