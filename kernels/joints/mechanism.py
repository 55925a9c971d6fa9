"""Direct solution of a mechanism: impulses of all its joints at once, for velocities or for the push-out.

A locked row requires (error at the predicted pose - allowed error) / dt = 0. The prediction is linear in the velocities
between two calls of `predict_mechanism`; after a few of them, the joints hold at the pose that the step ends with
(Weinstein, Teran and Fedkiw 2006). The rows are those of the pose at the start of the step, as in SHAKE.
"""

import warp as wp

from warp_rigid.kernels.common.solver_body import PUSH, START, VELOCITY, load_velocity, store_velocity
from warp_rigid.kernels.enums import JointNumber, Role
from warp_rigid.kernels.joints.arrays import Joints, vec6d
from warp_rigid.kernels.joints.coordinate import (
    IDLE,
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
from warp_rigid.kernels.joints.factor import active_rows, factorize, substitute
from warp_rigid.kernels.joints.joint_rows import (
    apply_impulses,
    build_rows,
    coordinate_rate,
    has_coordinate,
    is_damped,
    is_locked,
    present_rows,
    row_velocities,
    stabilize,
    store_masses,
)
from warp_rigid.kernels.joints.poses import ends_of, errors_of, free_row, predict_pose, take_pose
from warp_rigid.kernels.schema import Bodies, Motions, State

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

MOST_CHANGES = wp.constant(8)
"""Maximum changes of modes in one solution, each with a new factorization."""

MOST_PREDICTIONS = wp.constant(16)
"""Maximum solutions at newly predicted poses, at the start and at the end of a step. Two are enough for slow bodies."""

SLOW = wp.constant(0.1)
"""Ratio of two successive residuals from which on the rows become those of the predicted poses.

With the rows of the pose at the start of the step, the solutions converge slowly, or diverge, if light links between
heavy bodies turn by a larger angle in a step than the square root of the ratio of masses. With those of the predicted
poses, each solution is a projection of the pose: they converge as Newton's method does, and lose some energy.
"""

UNSETTLED = wp.constant(0.1)
"""Residual of the last solution above which the solutions at predicted poses do not converge [m/s, rad/s]."""

KEPT_ERROR = wp.constant(wp.float64(0.5))
"""Fraction of an error at the start of a step that may remain after it."""

FASTEST = wp.constant(wp.float64(1.0))
"""Largest speed at which errors are corrected [m/s, rad/s]."""

FINE = wp.constant(1.0e-5)
"""Residual of a joint below which it counts as solved [m/s, rad/s]: less than 0.1 micrometres per step."""


@wp.func
def is_awake(m: int, motions: Motions, joints: Joints):
    """Whether a mechanism has a body that is free to move."""
    for i in range(joints.first_member[m], joints.first_member[m + 1]):
        if motions.role[joints.member[i]] == Role.FREE:
            return True
    return False


@wp.func
def start_joint(j: int, dt: float, bodies: Bodies, motions: Motions, joints: Joints):
    """Rows of a joint at the start of a step, and the errors that may remain after it."""
    build_rows(j, bodies, joints)
    errors = errors_of(j, ends_of(j, joints), joints)
    joints.mode[j] = wp.vec3i(IDLE, 0, 0)
    row = free_row(joints.coordinate[j])
    if row >= 0:
        speed = row_velocities(j, VELOCITY, motions, joints)[row]
        joints.speed[j] = speed
        joints.drift[j] = wp.float64(0.0)
        joints.mode[j] = mode_before_forces(j, errors[row], speed, joints)
        errors[row] = excess_of(j, errors[row], joints)
    most = FASTEST * wp.float64(dt)
    allowed = vec6d()
    for k in range(6):
        allowed[k] = errors[k] - wp.clamp((wp.float64(1.0) - KEPT_ERROR) * errors[k], -most, most)
    joints.allowed[j] = allowed
    joints.total[j] = vec6d()
    joints.bias[j] = vec6d()


@wp.func
def start_mechanism(m: int, dt: float, bodies: Bodies, state: State, motions: Motions, joints: Joints):
    """Rows and allowed errors of all joints of a mechanism."""
    for i in range(joints.first_member[m], joints.first_member[m + 1]):
        take_pose(joints.member[i], state, joints)
        joints.added[joints.member[i]] = wp.vec2d()
    for place in range(joints.first_place[m], joints.first_place[m + 1]):
        stabilize(joints.sequence[place], dt, bodies, joints)
    for i in range(joints.first_member[m], joints.first_member[m + 1]):
        store_masses(joints.member[i], motions, joints)
    for place in range(joints.first_place[m], joints.first_place[m + 1]):
        start_joint(joints.sequence[place], dt, bodies, motions, joints)


@wp.func
def predict_mechanism(m: int, dt: float, anew: bool, bodies: Bodies, state: State, motions: Motions, joints: Joints):
    """Errors of all joints at the predicted poses, as a bias of the velocities along their rows.

    `anew`: whether the rows become those of the predicted poses; the factors are stale then.
    """
    for i in range(joints.first_member[m], joints.first_member[m + 1]):
        predict_pose(joints.member[i], dt, 1.0, bodies, state, motions, joints)
    for place in range(joints.first_place[m], joints.first_place[m + 1]):
        j = joints.sequence[place]
        if anew:
            build_rows(j, bodies, joints)
        ends = ends_of(j, joints)
        errors = errors_of(j, ends, joints)
        speeds = row_velocities(j, VELOCITY, motions, joints)
        joints.bias[j] = errors / wp.float64(dt) - speeds
        if joints.numbers[j, JointNumber.ARMATURE] > 0.0:
            after = coordinate_rate(j, ends, bodies, motions, joints)
            joints.drift[j] = after - speeds[free_row(joints.coordinate[j])]


@wp.func
def extrapolate_mechanism(m: int, dt: float, state: State, joints: Joints):
    """Errors of all joints at the start of the step as the bias: the prediction is linear in the velocities."""
    for i in range(joints.first_member[m], joints.first_member[m + 1]):
        take_pose(joints.member[i], state, joints)
    for place in range(joints.first_place[m], joints.first_place[m + 1]):
        j = joints.sequence[place]
        joints.bias[j] = errors_of(j, ends_of(j, joints), joints) / wp.float64(dt)


@wp.func
def apply_constant(j: int, dt: float, motions: Motions, joints: Joints):
    """Apply the impulse of a coordinate that does not depend on the velocities: saturated drive, sliding friction."""
    row = free_row(joints.coordinate[j])
    if not has_coordinate(j, motions, joints) or is_locked(joints.active[j], row):
        return
    change = law_impulse(j, wp.float64(dt), wp.float64(0.0), wp.float64(0.0), joints) - joints.total[j][row]
    if joints.mode[j][1] == 0 and joints.mode[j][2] == 0:
        change = -joints.total[j][row]
    if change != wp.float64(0.0):
        impulses = vec6d()
        impulses[row] = change
        joints.total[j] = joints.total[j] + impulses
        apply_impulses(j, VELOCITY, impulses, motions, joints)


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
def compliance_of(j: int, k: int, dt: float, joints: Joints):
    """Velocity along an active row per impulse of a drive or of damping; 0 for a row that holds."""
    step = wp.float64(dt)
    if k == free_row(joints.coordinate[j]) and not is_held(joints.mode[j]):
        return wp.float64(1.0) / drive_slope(j, step, joints)
    if is_damped(j, k, joints):
        return wp.float64(1.0) / damping_slope(j, step, joints)
    return wp.float64(0.0)


@wp.func
def energy_terms(j: int, dt: float, motions: Motions, joints: Joints):
    """Contribution of a joint to the two sums of the line search [J], as `contact.energy_terms`.

    Rows that are not active now were released; they were solved before.
    """
    residual = residual_of(j, dt, motions, joints)
    gained = row_velocities(j, VELOCITY, motions, joints) - row_velocities(j, START, motions, joints)
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
def solve_once(m: int, dt: float, motions: Motions, joints: Joints):
    """One direct solution in the present modes. Returns the largest residual that it removed [m/s, rad/s]."""
    change = float(0.0)
    for place in range(joints.first_place[m], joints.first_place[m + 1]):
        apply_constant(joints.sequence[place], dt, motions, joints)
    for place in range(joints.first_place[m], joints.first_place[m + 1]):
        j = joints.sequence[place]
        residual = residual_of(j, dt, motions, joints)
        joints.solution[j] = residual
        change = wp.max(change, largest_of(residual))
    substitute(m, joints)
    for place in range(joints.first_place[m], joints.first_place[m + 1]):
        j = joints.sequence[place]
        impulses = -joints.solution[j]
        joints.total[j] = joints.total[j] + impulses
        apply_impulses(j, VELOCITY, impulses, motions, joints)
    return change


@wp.func
def update_modes(m: int, dt: float, motions: Motions, joints: Joints):
    """Check the modes of all coordinates after a solution. Returns whether any changed."""
    step = wp.float64(dt)
    changed = bool(False)
    for place in range(joints.first_place[m], joints.first_place[m + 1]):
        j = joints.sequence[place]
        if has_coordinate(j, motions, joints):
            row = free_row(joints.coordinate[j])
            speed = row_velocities(j, VELOCITY, motions, joints)[row]
            mode = next_mode(j, step, step * (speed + joints.bias[j][row]), speed, joints)
            if not (mode == joints.mode[j]):
                joints.mode[j] = mode
                changed = True
    return changed


@wp.func
def solve_mechanism(m: int, dt: float, is_stale: bool, motions: Motions, joints: Joints):
    """Solve all joints of a mechanism for the velocities. Returns the largest residual [m/s], 0 below FINE.

    `is_stale`: whether the factors are not those of the present modes.
    """
    change = float(0.0)
    left = int(MOST_CHANGES)
    stale = is_stale
    while left > 0 or stale:
        if stale:
            factorize(m, dt, motions, joints)
            stale = False
        if left > 0:
            change = wp.max(change, solve_once(m, dt, motions, joints))
            left -= 1
            if update_modes(m, dt, motions, joints):
                stale = True
            else:
                left = 0
    return wp.where(change > FINE, change, 0.0)


@wp.func
def choose_modes(m: int, dt: float, motions: Motions, joints: Joints):
    """Modes of all coordinates from their predicted values. Returns whether the active rows differ from the factors."""
    differ = bool(False)
    for place in range(joints.first_place[m], joints.first_place[m + 1]):
        j = joints.sequence[place]
        if has_coordinate(j, motions, joints):
            row = free_row(joints.coordinate[j])
            speed = row_velocities(j, VELOCITY, motions, joints)[row]
            joints.mode[j] = first_mode(j, wp.float64(dt) * (speed + joints.bias[j][row]), joints)
            differ = differ or joints.active[j] != active_rows(j, dt, motions, joints)
    return differ


@wp.func
def take_back(m: int, motions: Motions, joints: Joints):
    """Return to the velocities and impulses before `settle_mechanism`."""
    for i in range(joints.first_member[m], joints.first_member[m + 1]):
        b = joints.member[i]
        motions.solver_bodies[b].linear = load_velocity(b, START, motions)
        motions.solver_bodies[b].angular = load_velocity(b, START + 1, motions)
    for place in range(joints.first_place[m], joints.first_place[m + 1]):
        joints.total[joints.sequence[place]] = joints.start[joints.sequence[place]]


@wp.func
def store_before_settling(m: int, motions: Motions, joints: Joints):
    """Store the velocities and impulses to which `take_back` returns."""
    for i in range(joints.first_member[m], joints.first_member[m + 1]):
        body = motions.solver_bodies[joints.member[i]]
        store_velocity(joints.member[i], START, body.linear, body.angular, motions)
    for place in range(joints.first_place[m], joints.first_place[m + 1]):
        joints.start[joints.sequence[place]] = joints.total[joints.sequence[place]]


@wp.func
def stop_mechanism(m: int, dt: float, state: State, motions: Motions, joints: Joints):
    """First solution in a step, with new modes and a prediction that is linear in the velocities.

    The impulses with which contacts start may give light bodies high velocities, at which predicted poses mean nothing.
    """
    extrapolate_mechanism(m, dt, state, joints)
    is_stale = choose_modes(m, dt, motions, joints)
    solve_mechanism(m, dt, is_stale, motions, joints)


@wp.func
def settle_mechanism(m: int, dt: float, bodies: Bodies, state: State, motions: Motions, joints: Joints):
    """Solve a mechanism at newly predicted poses until its joints hold."""
    k = int(0)
    anew = bool(False)
    last = float(0.0)
    store_before_settling(m, motions, joints)
    while k < MOST_PREDICTIONS:
        predict_mechanism(m, dt, anew, bodies, state, motions, joints)
        change = solve_mechanism(m, dt, anew, motions, joints)
        if k > 0 and change > SLOW * last and not anew:
            take_back(m, motions, joints)
            anew = True
        last = change
        k = wp.where(change == 0.0, MOST_PREDICTIONS, k + 1)
    joints.unsettled[m] = wp.where(last > UNSETTLED, 1, 0)
    if last > UNSETTLED:
        # Velocities that obey the joints of the present pose add no energy; `close_joints` corrects the poses.
        take_back(m, motions, joints)


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
def close_joints(m: int, dt: float, bodies: Bodies, state: State, motions: Motions, joints: Joints):
    """Push the bodies of a mechanism until its joints hold at the poses where they stop; velocities stay.

    The velocities lead to poses at the end of the step at which the joints hold. On the way, bodies that turn do not
    follow arcs but chords.
    """
    k = int(0)
    while k < MOST_PREDICTIONS:
        for i in range(joints.first_member[m], joints.first_member[m + 1]):
            b = joints.member[i]
            predict_pose(b, dt, motions.next_time_of_impact[b], bodies, state, motions, joints)
        gap = float(0.0)
        for place in range(joints.first_place[m], joints.first_place[m + 1]):
            j = joints.sequence[place]
            build_rows(j, bodies, joints)
            joints.bias[j] = gap_of(j, dt, motions, joints)
            gap = wp.max(gap, largest_of(joints.bias[j]))
        if gap > FINE:
            push_back(m, dt, motions, joints)
        k = wp.where(gap > FINE, k + 1, MOST_PREDICTIONS)


@wp.func
def push_back(m: int, dt: float, motions: Motions, joints: Joints):
    """Push the bodies of a mechanism such that their velocities along the rows of its joints decrease by `bias`."""
    factorize(m, dt, motions, joints)
    for place in range(joints.first_place[m], joints.first_place[m + 1]):
        joints.solution[joints.sequence[place]] = joints.bias[joints.sequence[place]]
    substitute(m, joints)
    for place in range(joints.first_place[m], joints.first_place[m + 1]):
        j = joints.sequence[place]
        apply_impulses(j, PUSH, -joints.solution[j], motions, joints)


@wp.func
def project(m: int, which: int, motions: Motions, joints: Joints):
    """Remove the velocities along the active rows: those that are locked or held; `which`: VELOCITY or PUSH."""
    for place in range(joints.first_place[m], joints.first_place[m + 1]):
        j = joints.sequence[place]
        speeds = row_velocities(j, which, motions, joints)
        row = free_row(joints.coordinate[j])
        for k in range(6):
            is_driven = is_damped(j, k, joints) or (k == row and not is_held(joints.mode[j]))
            if is_driven or not is_locked(joints.active[j], k):
                speeds[k] = wp.float64(0.0)
        joints.solution[j] = speeds
    substitute(m, joints)
    for place in range(joints.first_place[m], joints.first_place[m + 1]):
        j = joints.sequence[place]
        if which == VELOCITY:
            joints.total[j] = joints.total[j] - joints.solution[j]
        apply_impulses(j, which, -joints.solution[j], motions, joints)
