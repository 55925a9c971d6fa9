"""Parts of a step: a mechanism without contacts takes equal substeps where one step does not resolve its motion.

A part is a step of SHAKE: impulses along the rows of the pose at its start, with joints that hold at its end. This
scheme is symplectic, so that energy does not drift (Leimkuhler and Reich 2004), as long as the masses are those of the
bodies and the length of the parts stays the same. Where it changes, velocities of passive mechanisms are scaled so that
what the scheme conserves does not change. There is no solution where links turn by about a radian in a part.
"""

import warp as wp

from warp_rigid.kernels.common.solver_body import VELOCITY, inverse_inertia_at, load_velocity, store_inverse_inertia
from warp_rigid.kernels.common.team import Team, any_of_warp, max_of_lanes, sync_warp
from warp_rigid.kernels.enums import Coordinate, JointNumber, Role
from warp_rigid.kernels.joints.arrays import Joints
from warp_rigid.kernels.joints.joint_rows import (
    center_of,
    has_coordinate,
    is_locked,
    is_present,
    present_rows,
    vibrations_of,
)
from warp_rigid.kernels.joints.mechanism import predict_mechanism, settle_mechanism, start_mechanism, take_poses
from warp_rigid.kernels.joints.poses import ends_of, free_row, take_pose
from warp_rigid.kernels.schema import Bodies, Motions, State
from warp_rigid.kernels.update.integrate import mat33d, rotation_vector, turn_freely

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

MOST_PARTS = wp.constant(64)
"""Maximum number of parts. Vibrations that are faster are slowed, and faster turns lose energy."""


@wp.struct
class Balance:
    """Energies of a mechanism at the start of a part.

    Attributes:
        kinetic: kinetic energy [J].
        slope: its change for a relative change of the velocities before the part [J].
        growth: what the scheme adds to the energy for a time, over the square of the length of the part [J/s^2].
        fall: such an addition that always is allowed, as it hardly changes a motion that starts from rest [J/s^2].
    """

    kinetic: wp.float64
    slope: wp.float64
    growth: wp.float64
    fall: wp.float64


@wp.func
def turning_of(j: int, bodies: Bodies, motions: Motions, joints: Joints):
    """Angular velocity with which the arms of a joint turn, or the line between the points of a distance [rad/s]."""
    tiny = 1.0e-6  # of an arm that counts as none [m]
    ends = ends_of(j, joints)
    a = joints.body_a[j]
    b = joints.body_b[j]
    arm = wp.vec3(ends.point_a - center_of(a, bodies, joints))
    moved = wp.cross(load_velocity(a, VELOCITY + 1, motions), arm)
    rate = wp.length(moved) / wp.max(wp.length(arm), tiny)
    velocity = load_velocity(a, VELOCITY, motions) + moved
    if joints.to_world[j] == 0:
        arm = wp.vec3(ends.point_b - center_of(b, bodies, joints))
        moved = wp.cross(load_velocity(b, VELOCITY + 1, motions), arm)
        rate = wp.max(rate, wp.length(moved) / wp.max(wp.length(arm), tiny))
        velocity -= load_velocity(b, VELOCITY, motions) + moved
    if joints.coordinate[j] == Coordinate.LENGTH:
        apart = wp.vec3(ends.point_a - ends.point_b)
        rate = wp.max(rate, wp.length(wp.cross(velocity, apart)) / wp.max(wp.length_sq(apart), tiny))
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
    # Links turn by at most 0.1 rad in a part.
    needed = max_of_lanes(wp.max(wp.sqrt(2.0 * ratio), turn / 0.1), team.lanes)
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
    sync_warp(team.lanes)


@wp.func
def begin_parts(
    m: int, scale: float, early: float, team: Team, bodies: Bodies, state: State, motions: Motions, joints: Joints
):
    """Return to the poses at the start of the step, and to its velocities, scaled, with the acceleration of a time."""
    take_poses(m, team, state, joints)
    for i in range(joints.first_member[m] + team.lane, joints.first_member[m + 1], team.lanes):
        b = joints.member[i]
        if motions.role[b] == Role.FREE:
            motions.solver_bodies[b].linear = scale * state.linear_velocity[b]
            motions.solver_bodies[b].angular = scale * state.angular_velocity[b]
            store_inverse_inertia(b, inverse_inertia_at(b, state.orientation[b], bodies), motions)
    store_before_part(m, team, motions, joints)
    accelerate(m, early, team, motions, joints)


@wp.func
def store_before_part(m: int, team: Team, motions: Motions, joints: Joints):
    """Store the velocities before the impulses of a part."""
    for i in range(joints.first_member[m] + team.lane, joints.first_member[m + 1], team.lanes):
        b = joints.member[i]
        joints.linear_before[b] = motions.solver_bodies[b].linear
        joints.angular_before[b] = motions.solver_bodies[b].angular
    sync_warp(team.lanes)


@wp.func
def product_of(b: int, linear: wp.vec3, spin: wp.vec3, by: wp.vec3, turned: wp.vec3, bodies: Bodies, joints: Joints):
    """Product of two motions of a body, by its mass and moment of inertia."""
    r = joints.base_turn[b]
    momentum = mat33d(bodies.inertia[b]) * wp.quat_rotate_inv(r, wp.vec3d(spin))
    sum = wp.dot(momentum, wp.quat_rotate_inv(r, wp.vec3d(turned)))
    return sum + wp.float64(bodies.mass[b]) * wp.dot(wp.vec3d(linear), wp.vec3d(by))


@wp.func
def is_driven(j: int, motions: Motions, joints: Joints):
    """1 if a joint does work in this part, by drive, friction, damping, armature or a limit, or if it does not act."""
    if not is_present(j, motions, joints):
        return 1
    held = joints.locked[j]
    if joints.numbers[j, JointNumber.LOWER] == joints.numbers[j, JointNumber.UPPER]:
        held = held | (1 << wp.max(free_row(joints.coordinate[j]), 0))
    for k in range(6):
        if not is_locked(held, k) and joints.total[j][k] != wp.float64(0.0):
            return 1
    return 0


@wp.func
def is_passive(m: int, team: Team, motions: Motions, joints: Joints):
    """1 if a mechanism is held by the world, and nothing but the accelerations of the step does work on it.

    To scale the velocities of one that is not held would change its momentum.
    """
    driven = int(1 - joints.anchored[m])
    for place in range(joints.first_place[m] + team.lane, joints.first_place[m + 1], team.lanes):
        driven |= is_driven(joints.sequence[place], motions, joints)
    for i in range(joints.first_member[m] + team.lane, joints.first_member[m + 1], team.lanes):
        driven |= wp.where(motions.role[joints.member[i]] == Role.KINEMATIC, 1, 0)
    return 1 - any_of_warp(driven, team.lanes)


@wp.func
def balance_terms(b: int, before: float, time: float, bodies: Bodies, motions: Motions, joints: Joints):
    """Contributions of a body to the energies of `balance_of`; 0 unless it is free to move."""
    if motions.role[b] != Role.FREE:
        return wp.vec4d()
    v = joints.linear_before[b]
    w = joints.angular_before[b]
    rate = 2.0 / (before + time)
    a = rate * (motions.solver_bodies[b].linear - v)
    s = rate * (motions.solver_bodies[b].angular - w)
    now = v + 0.5 * before * a
    spin = w + 0.5 * before * s
    pull = motions.acceleration[b]
    twist = motions.spin_acceleration[b]
    two = wp.float64(2.0)
    twelve = wp.float64(12.0)
    power = product_of(b, pull, twist, a, s, bodies, joints)
    square = product_of(b, a, s, a, s, bodies, joints)
    return wp.vec4d(
        product_of(b, now, spin, now, spin, bodies, joints) / two,
        product_of(b, now, spin, v, w, bodies, joints),
        (power - square / two) / twelve,
        product_of(b, pull, twist, pull, twist, bodies, joints) / twelve,
    )


@wp.func
def balance_of(m: int, before: float, time: float, team: Team, bodies: Bodies, motions: Motions, joints: Joints):
    """Energies of a mechanism at the start of a part, after its impulses.

    While the length h of the parts stays the same, the scheme conserves H - h^2 (P / 12 - A / 24), up to terms in h^4:
    H is the energy, P the second derivative of the kinetic energy, which is the product of the accelerations of the
    step with those of the bodies, and A is the product of the latter with themselves (Hairer, Lubich and Wanner,
    Geometric Numerical Integration, section IX.3).

    `before`: length of the part before [s]. `time`: length of this part [s].
    """
    for i in range(joints.first_member[m] + team.lane, joints.first_member[m + 1], team.lanes):
        b = joints.member[i]
        joints.balance[b] = balance_terms(b, before, time, bodies, motions, joints)
    sync_warp(team.lanes)
    sums = wp.vec4d()
    for i in range(joints.first_member[m], joints.first_member[m + 1]):
        sums += joints.balance[joints.member[i]]
    return Balance(sums[0], sums[1], sums[2], sums[3])


@wp.func
def scale_at_change(balance: Balance, before: float, time: float):
    """Factor of the velocities before a part of another length, with which the scheme goes on with the same energy."""
    change = wp.float64(time * time - before * before) * balance.growth
    if balance.slope <= wp.float64(0.0):
        return 1.0
    # By at most a twentieth.
    return 1.0 + wp.clamp(float(change / balance.slope), -0.05, 0.05)


@wp.func
def is_too_long(balance: Balance, dt: float, time: float):
    """Whether shorter parts are needed to keep the energy."""
    growth = wp.abs(balance.growth) * wp.float64(time * time)
    # A uniform turn by 0.1 rad adds less than half as much.
    return growth > wp.float64(2.0e-3) * balance.kinetic + balance.fall * wp.float64(dt * dt)


@wp.func
def end_part(m: int, time: float, team: Team, bodies: Bodies, state: State, motions: Motions, joints: Joints):
    """Advance to the poses and velocities at the end of a part, which are those before the next one."""
    predict_mechanism(m, time, 0, team, bodies, state, motions, joints)
    for i in range(joints.first_member[m] + team.lane, joints.first_member[m + 1], team.lanes):
        b = joints.member[i]
        joints.base_position[b] = joints.pose_position[b]
        joints.base_turn[b] = joints.pose_turn[b]
        if motions.role[b] == Role.FREE:
            spin = joints.pose_spin[b] - wp.vec3d(state.angular_velocity_remainder[b])
            motions.solver_bodies[b].angular = wp.vec3(spin)
            store_inverse_inertia(b, inverse_inertia_at(b, wp.quat(joints.pose_turn[b]), bodies), motions)
    store_before_part(m, team, motions, joints)


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
    """Move a mechanism in equal parts. Returns 1 if the joints do not hold, or a passive one does not keep its energy.

    Velocities belong to the middle of the last part, so the first one takes half of that part's acceleration. Where the
    length of the parts of a passive mechanism changes, the first one is solved twice: its impulses tell by which factor
    the velocities keep the energy. Velocities that are not those of a part, with `parts` of 0, are not scaled.
    """
    time = dt / float(parts)
    before = float(dt / float(wp.max(joints.parts[m], 1)))
    early = 0.5 * (before - time)
    scale = float(1.0)
    failed = int(0)
    part = int(wp.where(before == time or joints.parts[m] == 0, 0, -1))
    # Each call is inlined into the kernel of a GPU, so the large functions are called in one place.
    while part < parts:
        if part <= 0:
            begin_parts(m, scale, early, team, bodies, state, motions, joints)
        start_mechanism(m, dt, parts, team, bodies, motions, joints)
        accelerate(m, time, team, motions, joints)
        failed = settle_mechanism(m, time, 0, exact, team, bodies, state, motions, joints)
        next = wp.max(part, 0) + 1
        if exact * (1 - failed) == 1 and is_passive(m, team, motions, joints) == 1:
            balance = balance_of(m, before, time, team, bodies, motions, joints)
            if part == -1:
                scale = scale_at_change(balance, before, time)
                next = 0
            elif 2 * parts <= MOST_PARTS and is_too_long(balance, dt, time):
                failed = 1
        if failed * exact == 1:
            return 1
        if next > 0 and parts > 1:
            end_part(m, time, team, bodies, state, motions, joints)
            before = time
        part = next
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
    store_inverse_inertia(b, inverse_inertia_at(b, state.orientation[b], bodies), motions)
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
    for i in range(joints.first_member[m] + team.lane, joints.first_member[m + 1], team.lanes):
        b = joints.member[i]
        if parts > 1:
            join_parts(b, dt, bodies, state, motions, joints)
        motions.acceleration[b] = (1.0 + late) * motions.acceleration[b]
    for place in range(joints.first_place[m] + team.lane, joints.first_place[m + 1], team.lanes):
        j = joints.sequence[place]
        joints.total[j] = wp.float64(parts) * joints.total[j]
    sync_warp(team.lanes)


@wp.func
def move_in_parts(m: int, dt: float, team: Team, bodies: Bodies, state: State, motions: Motions, joints: Joints):
    """Move a mechanism without contacts in as few parts as resolve its motion; in a single one where none do."""
    take_poses(m, team, state, joints)
    parts = int(parts_needed(m, dt, team, bodies, motions, joints))
    exact = int(1)
    while try_parts(m, dt, parts, exact, team, bodies, state, motions, joints) * exact == 1:
        parts = 2 * parts
        if parts > MOST_PARTS:
            parts = 1
            exact = 0
    finish_parts(m, dt, parts, team, bodies, state, motions, joints)
    if team.lane == 0:
        joints.parts[m] = exact * parts
