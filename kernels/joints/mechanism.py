"""Direct solution of a mechanism: impulses of all its joints at once, for velocities or for the push-out.

A locked row requires (error at the predicted pose - allowed error) / dt = 0. The prediction is linear in the velocities
between two calls of `predict_mechanism`; after a few of them, the joints hold at the pose that the step ends with
(Weinstein, Teran and Fedkiw 2006). The rows are those of the pose at the start of the step, as in SHAKE.
"""

from enum import IntEnum

import warp as wp

from warp_rigid.kernels.common.solver_body import PUSH, START, VELOCITY, load_velocity, store_velocity
from warp_rigid.kernels.common.team import Team, any_of_warp, max_of_lanes, sync_warp
from warp_rigid.kernels.enums import JointNumber, Role
from warp_rigid.kernels.joints.arrays import Joints, vec6d
from warp_rigid.kernels.joints.coordinate import (
    Mode,
    damping_slope,
    drive_slope,
    excess_of,
    first_mode,
    held_residual,
    is_held,
    law_impulse,
    mode_before_forces,
    next_mode,
)
from warp_rigid.kernels.joints.factor import active_rows, compliance_of, factorize, substitute
from warp_rigid.kernels.joints.joint_rows import (
    add_to_impulses,
    apply_solution,
    build_rows,
    coordinate_rate,
    has_coordinate,
    is_damped,
    is_locked,
    present_rows,
    row_velocities,
    row_velocity,
    store_masses,
)
from warp_rigid.kernels.joints.poses import ends_of, errors_of, free_row, predict_pose, take_pose
from warp_rigid.kernels.schema import Bodies, Graph, Motions, State

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

MOST_PREDICTIONS = wp.constant(16)
"""Maximum solutions at newly predicted poses, at the start and at the end of a step. Two are enough for slow bodies."""

JOINT_SOLVED = wp.constant(1.0e-5)
"""Residual of a joint below which it counts as solved [m/s, rad/s]: less than 0.1 micrometres per step."""


class Activity(IntEnum):
    """Activity of a mechanism in a step."""

    STILL = 0
    """No body is free to move."""
    UNTOUCHED = 1
    """No contact. Nothing but its joints changes its velocities after those of the step's forces. It is solved once,
    for the pose at the end of the step. Impulses that made its velocities obey the joints before would act along the
    same rows, so they are part of that solution."""
    IN_CONTACT = 2
    """Some bodies have contacts."""


@wp.func
def activity_of(m: int, team: Team, motions: Motions, graph: Graph, joints: Joints):
    """Activity of a mechanism in this step."""
    free = int(0)
    touched = int(0)
    for i in range(joints.first_member[m] + team.lane, joints.first_member[m + 1], team.lanes):
        b = joints.member[i]
        if motions.role[b] == Role.FREE:
            free = 1
            touched |= wp.where(graph.touching[b] > 0, 1, 0)
    touched = any_of_warp(touched, team.lanes)
    return any_of_warp(free, team.lanes) * wp.where(touched == 1, Activity.IN_CONTACT, Activity.UNTOUCHED)


@wp.func
def needs_solution(m: int, joints: Joints):
    """Whether a mechanism is solved again after its first solution in a step."""
    return joints.activity[m] == Activity.IN_CONTACT or (
        joints.activity[m] == Activity.UNTOUCHED and joints.unsettled[m] == 1
    )


@wp.func
def start_joint(j: int, dt: float, bodies: Bodies, motions: Motions, joints: Joints):
    """Rows of a joint at the start of a step, its errors over dt as the bias, and those that may remain after it."""
    build_rows(j, bodies, joints)
    errors = errors_of(j, ends_of(j, joints), joints)
    joints.bias[j] = errors / wp.float64(dt)
    joints.mode[j] = wp.vec3i(Mode.IDLE, 0, 0)
    row = free_row(joints.coordinate[j])
    if row >= 0:
        speed = row_velocity(j, row, motions, joints)
        joints.speed[j] = speed
        joints.drift[j] = wp.float64(0.0)
        joints.mode[j] = mode_before_forces(j, errors[row], speed, joints)
        errors[row] = excess_of(j, errors[row], joints)
    # Half of an error is corrected, at 1 m/s or 1 rad/s at most.
    most = wp.float64(dt)
    allowed = vec6d()
    for k in range(6):
        allowed[k] = errors[k] - wp.clamp(wp.float64(0.5) * errors[k], -most, most)
    joints.allowed[j] = allowed
    joints.total[j] = vec6d()


@wp.func
def take_poses(m: int, team: Team, state: State, joints: Joints):
    """Store the present poses of the bodies of a mechanism."""
    for i in range(joints.first_member[m] + team.lane, joints.first_member[m + 1], team.lanes):
        take_pose(joints.member[i], state, joints)
    sync_warp(team.lanes)


@wp.func
def start_mechanism(m: int, dt: float, parts: int, team: Team, bodies: Bodies, motions: Motions, joints: Joints):
    """Masses, rows and allowed errors of all joints at the stored poses, for one of the parts of a step."""
    for i in range(joints.first_member[m] + team.lane, joints.first_member[m + 1], team.lanes):
        store_masses(i, dt, parts, bodies, motions, joints)
    for place in range(joints.first_place[m] + team.lane, joints.first_place[m + 1], team.lanes):
        start_joint(joints.sequence[place], dt / float(parts), bodies, motions, joints)
    sync_warp(team.lanes)


@wp.func
def predict_joint(j: int, dt: float, anew: int, bodies: Bodies, motions: Motions, joints: Joints):
    """Errors of a joint at the predicted poses, as a bias of the velocities along its rows."""
    if anew == 1:
        build_rows(j, bodies, joints)
    ends = ends_of(j, joints)
    errors = errors_of(j, ends, joints)
    speeds = row_velocities(j, VELOCITY, motions, joints)
    joints.bias[j] = errors / wp.float64(dt) - speeds
    if joints.numbers[j, JointNumber.ARMATURE] > 0.0:
        after = coordinate_rate(j, ends, bodies, motions, joints)
        joints.drift[j] = after - speeds[free_row(joints.coordinate[j])]


@wp.func
def predict_mechanism(
    m: int, dt: float, anew: int, team: Team, bodies: Bodies, state: State, motions: Motions, joints: Joints
):
    """Errors of all joints at the predicted poses, as a bias of the velocities along their rows.

    `anew`: 1 if the rows become those of the predicted poses; the factors are stale then.
    """
    for i in range(joints.first_member[m] + team.lane, joints.first_member[m + 1], team.lanes):
        b = joints.member[i]
        predict_pose(b, dt, 1.0, load_velocity(b, VELOCITY, motions), bodies, state, motions, joints)
    sync_warp(team.lanes)
    for place in range(joints.first_place[m] + team.lane, joints.first_place[m + 1], team.lanes):
        predict_joint(joints.sequence[place], dt, anew, bodies, motions, joints)
    sync_warp(team.lanes)


@wp.func
def constant_change(j: int, dt: float, motions: Motions, joints: Joints):
    """Change of the impulse of a coordinate that does not depend on the velocities.

    It is that of a saturated drive or of sliding friction.
    """
    row = free_row(joints.coordinate[j])
    if not has_coordinate(j, motions, joints) or is_locked(joints.active[j], row):
        return wp.float64(0.0)
    if joints.mode[j][1] == 0 and joints.mode[j][2] == 0:
        return -joints.total[j][row]
    return law_impulse(j, wp.float64(dt), wp.float64(0.0), wp.float64(0.0), joints) - joints.total[j][row]


@wp.func
def apply_constants(m: int, dt: float, team: Team, motions: Motions, joints: Joints):
    """Apply the impulses of coordinates that do not depend on the velocities."""
    found = int(0)
    for place in range(joints.first_place[m] + team.lane, joints.first_place[m + 1], team.lanes):
        j = joints.sequence[place]
        change = constant_change(j, dt, motions, joints)
        impulses = vec6d()
        if change != wp.float64(0.0):
            impulses[free_row(joints.coordinate[j])] = change
            joints.total[j] = joints.total[j] + impulses
            found = 1
        joints.solution[j, 0] = -impulses
    if any_of_warp(found, team.lanes) == 1:
        apply_solution(m, VELOCITY, team, motions, joints)


@wp.func
def coordinate_residual(j: int, row: int, dt: float, speeds: vec6d, joints: Joints):
    """Velocity to be removed from an active coordinate."""
    step = wp.float64(dt)
    value = step * (speeds[row] + joints.bias[j][row])
    if is_held(joints.mode[j]):
        return held_residual(j, step, value, speeds[row], joints)
    law = law_impulse(j, step, value, speeds[row], joints)
    return (joints.total[j][row] - law) / drive_slope(j, step, joints)


@wp.func
def residual_of(j: int, dt: float, motions: Motions, joints: Joints):
    """Velocities to be removed from the active rows of a joint."""
    speeds = row_velocities(j, VELOCITY, motions, joints)
    row = free_row(joints.coordinate[j])
    residual = vec6d()
    for k in range(6):
        if is_locked(joints.active[j], k):
            if k == row:
                residual[k] = coordinate_residual(j, row, dt, speeds, joints)
            elif is_damped(j, k, joints):
                residual[k] = speeds[k] + joints.total[j][k] / damping_slope(j, wp.float64(dt), joints)
            else:
                residual[k] = speeds[k] + joints.bias[j][k] - joints.allowed[j][k] / wp.float64(dt)
    return residual


@wp.func
def energy_terms(j: int, since: int, dt: float, motions: Motions, joints: Joints):
    """Contribution of a joint to the two sums of a line search [J], as `contact.energy_terms`.

    `since`: the velocities at the start of the search, START or BEFORE_CONTACTS.

    Rows that are not active now were released; they were solved before.
    """
    residual = residual_of(j, dt, motions, joints)
    gained = row_velocities(j, VELOCITY, motions, joints) - row_velocities(j, since, motions, joints)
    sums = wp.vec2d()
    for k in range(6):
        change = joints.total[j][k] - joints.start[j][k]
        slope = wp.float64(0.0)
        if is_locked(joints.active[j], k):
            gained[k] = gained[k] + compliance_of(j, k, dt, joints) * change
            slope = residual[k] - gained[k]
        sums += change * wp.vec2d(-slope, gained[k])
    return sums


@wp.func
def largest_of(v: vec6d):
    """Largest absolute value of the components."""
    most = wp.float64(0.0)
    for k in range(6):
        most = wp.max(most, wp.abs(v[k]))
    return float(most)


@wp.func
def solve_once(m: int, dt: float, team: Team, motions: Motions, joints: Joints):
    """One direct solution in the present modes. Returns the largest residual that it removed [m/s, rad/s]."""
    change = float(0.0)
    apply_constants(m, dt, team, motions, joints)
    for place in range(joints.first_place[m] + team.lane, joints.first_place[m + 1], team.lanes):
        j = joints.sequence[place]
        residual = residual_of(j, dt, motions, joints)
        joints.solution[j, 0] = residual
        change = wp.max(change, largest_of(residual))
    sync_warp(team.lanes)
    apply_substituted(m, VELOCITY, team, motions, joints)
    return max_of_lanes(change, team.lanes)


@wp.func
def apply_substituted(m: int, which: int, team: Team, motions: Motions, joints: Joints):
    """Solve for the impulses that remove the velocities in `solution`, and apply them: VELOCITY or PUSH."""
    substitute(m, 0, team, joints)
    if which == VELOCITY:
        add_to_impulses(m, team, joints)
    apply_solution(m, which, team, motions, joints)


@wp.func
def update_modes(m: int, dt: float, team: Team, motions: Motions, joints: Joints):
    """Check the modes of all coordinates after a solution. Returns 1 if any changed."""
    step = wp.float64(dt)
    changed = int(0)
    for place in range(joints.first_place[m] + team.lane, joints.first_place[m + 1], team.lanes):
        j = joints.sequence[place]
        if has_coordinate(j, motions, joints):
            row = free_row(joints.coordinate[j])
            speed = row_velocity(j, row, motions, joints)
            mode = next_mode(j, step, step * (speed + joints.bias[j][row]), speed, joints)
            if not (mode == joints.mode[j]):
                joints.mode[j] = mode
                changed = 1
    return any_of_warp(changed, team.lanes)


@wp.func
def solve_mechanism(m: int, dt: float, is_stale: int, team: Team, motions: Motions, joints: Joints):
    """Solve all joints of a mechanism for the velocities. Returns the largest residual [m/s], 0 below JOINT_SOLVED.

    `is_stale`: 1 if the factors are not those of the present modes.
    """
    change = float(0.0)
    # Each change of modes needs a new factorization.
    left = int(8)
    stale = int(is_stale)
    while left > 0 or stale == 1:
        if stale == 1:
            factorize(m, dt, team, motions, joints)
            stale = 0
        if left > 0:
            change = wp.max(change, solve_once(m, dt, team, motions, joints))
            stale = update_modes(m, dt, team, motions, joints)
            left = stale * (left - 1)
    return wp.where(change > JOINT_SOLVED, change, 0.0)


@wp.func
def choose_modes(m: int, dt: float, team: Team, motions: Motions, joints: Joints):
    """Modes of all coordinates from their predicted values. Returns 1 if the active rows differ from the factors."""
    differ = int(0)
    for place in range(joints.first_place[m] + team.lane, joints.first_place[m + 1], team.lanes):
        j = joints.sequence[place]
        if has_coordinate(j, motions, joints):
            row = free_row(joints.coordinate[j])
            speed = row_velocity(j, row, motions, joints)
            joints.mode[j] = first_mode(j, wp.float64(dt) * (speed + joints.bias[j][row]), joints)
            differ |= wp.where(joints.active[j] != active_rows(j, dt, motions, joints), 1, 0)
    return any_of_warp(differ, team.lanes)


@wp.func
def take_back(m: int, team: Team, motions: Motions, joints: Joints):
    """Return to the velocities and impulses before `settle_mechanism`."""
    for i in range(joints.first_member[m] + team.lane, joints.first_member[m + 1], team.lanes):
        b = joints.member[i]
        motions.solver_bodies[b].linear = load_velocity(b, START, motions)
        motions.solver_bodies[b].angular = load_velocity(b, START + 1, motions)
    for place in range(joints.first_place[m] + team.lane, joints.first_place[m + 1], team.lanes):
        joints.total[joints.sequence[place]] = joints.start[joints.sequence[place]]
    sync_warp(team.lanes)


@wp.func
def store_before_settling(m: int, team: Team, motions: Motions, joints: Joints):
    """Store the velocities and impulses to which `take_back` returns."""
    for i in range(joints.first_member[m] + team.lane, joints.first_member[m + 1], team.lanes):
        body = motions.solver_bodies[joints.member[i]]
        store_velocity(joints.member[i], START, body.linear, body.angular, motions)
    for place in range(joints.first_place[m] + team.lane, joints.first_place[m + 1], team.lanes):
        joints.start[joints.sequence[place]] = joints.total[joints.sequence[place]]


@wp.func
def first_modes(m: int, dt: float, team: Team, motions: Motions, joints: Joints):
    """Choose the modes for the first solution in a step. Returns 1 if the factors are not those of the modes."""
    differ = choose_modes(m, dt, team, motions, joints)
    if joints.activity[m] == Activity.UNTOUCHED:
        return 1
    return differ


@wp.func
def settle_mechanism(
    m: int,
    dt: float,
    after_push: int,
    exact: int,
    team: Team,
    bodies: Bodies,
    state: State,
    motions: Motions,
    joints: Joints,
):
    """Solve a mechanism at newly predicted poses until its joints hold. Returns 1 if they do not.

    `exact`: 1 if it gives up where the rows of the pose at the start are not enough.

    The first solution in a step has a prediction that is linear in the velocities; it is the one to return to. With the
    rows of the pose at the start of the step, the solutions converge slowly, or diverge, if light links between heavy
    bodies turn by a larger angle in a step than the square root of the ratio of masses. Once a residual has not halved,
    the rows are those of the predicted poses: each solution is a projection of the pose, which converges as Newton's
    method does, and loses some energy. With a tenth instead of a half, gyroscopes lose their spin.
    """
    k = int(0)
    anew = int(0)
    stale = int(0)
    last = float(0.0)
    if after_push == 1:
        store_before_settling(m, team, motions, joints)
    else:
        k = -1
        stale = first_modes(m, dt, team, motions, joints)
    while k < MOST_PREDICTIONS:
        if k >= 0:
            predict_mechanism(m, dt, anew, team, bodies, state, motions, joints)
        change = solve_mechanism(m, dt, stale, team, motions, joints)
        if k < 0:
            store_before_settling(m, team, motions, joints)
            k = 0
        else:
            left = change
            if k > 0 and change > 0.5 * last and anew == 0:
                if exact == 1:
                    return 1
                take_back(m, team, motions, joints)
                anew = 1
            if k > 0 and anew == 0 and joints.activity[m] == Activity.UNTOUCHED:
                # Each solution decreases the residual by the same ratio, or more. Contacts need a known residual.
                left = change * change / last
            last = change
            k = wp.where(left <= JOINT_SOLVED, MOST_PREDICTIONS, k + 1)
        stale = anew
    # The solutions at predicted poses do not converge [m/s, rad/s].
    unsettled = wp.where(last > 0.1, 1, 0)
    if team.lane == 0:
        joints.unsettled[m] = unsettled
    if unsettled == 1 and exact == 0:
        # Velocities that obey the joints of the present pose add no energy; `close_joints` corrects the poses.
        take_back(m, team, motions, joints)
    sync_warp(team.lanes)
    return unsettled


@wp.func
def gap_of(j: int, dt: float, motions: Motions, joints: Joints):
    """Errors of the rows of a joint at the stored poses beyond the allowed ones, over dt; 0 where it is not held."""
    errors = errors_of(j, ends_of(j, joints), joints)
    held = present_rows(j, motions, joints)
    row = free_row(joints.coordinate[j])
    if row >= 0:
        errors[row] = excess_of(j, errors[row], joints)
        if has_coordinate(j, motions, joints) and is_held(joints.mode[j]):
            held = held | (1 << row)
    errors = (errors - joints.allowed[j]) / wp.float64(dt)
    for k in range(6):
        if not is_locked(held, k):
            errors[k] = wp.float64(0.0)
    return errors


@wp.func
def close_joints(m: int, dt: float, team: Team, bodies: Bodies, state: State, motions: Motions, joints: Joints):
    """Push the bodies of a mechanism until its joints hold at the poses where they stop; velocities stay.

    The velocities lead to poses at the end of the step at which the joints hold. Within the step, bodies that turn move
    on chords instead of arcs.
    """
    k = int(0)
    while k < MOST_PREDICTIONS:
        for i in range(joints.first_member[m] + team.lane, joints.first_member[m + 1], team.lanes):
            b = joints.member[i]
            part = motions.next_time_of_impact[b]
            predict_pose(b, dt, part, motions.next_course[b], bodies, state, motions, joints)
        sync_warp(team.lanes)
        gap = float(0.0)
        for place in range(joints.first_place[m] + team.lane, joints.first_place[m + 1], team.lanes):
            j = joints.sequence[place]
            build_rows(j, bodies, joints)
            joints.bias[j] = gap_of(j, dt, motions, joints)
            gap = wp.max(gap, largest_of(joints.bias[j]))
        gap = max_of_lanes(gap, team.lanes)
        sync_warp(team.lanes)
        if gap > JOINT_SOLVED:
            push_back(m, dt, team, motions, joints)
        k = wp.where(gap > JOINT_SOLVED, k + 1, MOST_PREDICTIONS)


@wp.func
def push_back(m: int, dt: float, team: Team, motions: Motions, joints: Joints):
    """Push the bodies of a mechanism such that their velocities along the rows of its joints decrease by `bias`."""
    factorize(m, dt, team, motions, joints)
    for place in range(joints.first_place[m] + team.lane, joints.first_place[m + 1], team.lanes):
        joints.solution[joints.sequence[place], 0] = joints.bias[joints.sequence[place]]
    sync_warp(team.lanes)
    apply_substituted(m, PUSH, team, motions, joints)


@wp.func
def project(m: int, which: int, team: Team, motions: Motions, joints: Joints):
    """Remove the velocities along the active rows: those that are locked or held; `which`: VELOCITY or PUSH."""
    for place in range(joints.first_place[m] + team.lane, joints.first_place[m + 1], team.lanes):
        j = joints.sequence[place]
        speeds = row_velocities(j, which, motions, joints)
        row = free_row(joints.coordinate[j])
        for k in range(6):
            is_driven = is_damped(j, k, joints) or (k == row and not is_held(joints.mode[j]))
            if is_driven or not is_locked(joints.active[j], k):
                speeds[k] = wp.float64(0.0)
        joints.solution[j, 0] = speeds
    sync_warp(team.lanes)
    apply_substituted(m, which, team, motions, joints)
