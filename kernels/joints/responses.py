"""Responses of a mechanism: velocities that an impulse on one of its bodies causes where the joints hold.

The response of a body is its diagonal block of M^-1 - M^-1 G^T A^-1 G M^-1 (factor.py), the cross response of two
bodies of a mechanism their other block. A team of lanes stores them, each lane for some of the six unit impulses, and
applies an impulse to the whole mechanism.
"""

import warp as wp

from warp_rigid.kernels.common.solver_body import VELOCITY
from warp_rigid.kernels.common.team import Team, single_lane, sync_warp
from warp_rigid.kernels.joints.arrays import Joints, vec6d
from warp_rigid.kernels.joints.elements import rows_times, set_entry, sum_of_rows
from warp_rigid.kernels.joints.factor import substitute
from warp_rigid.kernels.joints.joint_rows import add_to_impulses, add_velocity, apply_solution, is_locked
from warp_rigid.kernels.schema import Motions

wp.set_module_options({"enable_backward": False, "max_unroll": 1})


@wp.func
def free_velocity(b: int, impulse: vec6d, joints: Joints):
    """Velocity that an impulse and an angular impulse give a body without joints: linear, then angular."""
    linear = joints.inverse_mass[b] * wp.vec3d(impulse[0], impulse[1], impulse[2])
    angular = joints.inverse_inertia[b] * wp.vec3d(impulse[3], impulse[4], impulse[5])
    return vec6d(linear[0], linear[1], linear[2], angular[0], angular[1], angular[2])


@wp.func
def speeds_along(j: int, b: int, velocity: vec6d, joints: Joints):
    """Velocities along the active rows of a joint if only one of its bodies moves; 0 if it is none of them."""
    linear = wp.vec3d(velocity[0], velocity[1], velocity[2])
    angular = wp.vec3d(velocity[3], velocity[4], velocity[5])
    speeds = vec6d()
    if joints.body_a[j] == b:
        speeds = rows_times(joints.linear, j, linear) + rows_times(joints.angular_a, j, angular)
    elif joints.body_b[j] == b and joints.to_world[j] == 0:
        speeds = rows_times(joints.angular_b, j, angular) - rows_times(joints.linear, j, linear)
    for k in range(6):
        if not is_locked(joints.active[j], k):
            speeds[k] = wp.float64(0.0)
    return speeds


@wp.func
def reaction(j: int, b: int, impulses: vec6d, joints: Joints):
    """Impulse and angular impulse on a body by impulses along the rows of a joint; 0 if it holds other bodies."""
    if joints.body_a[j] != b and (joints.body_b[j] != b or joints.to_world[j] == 1):
        return vec6d()
    linear = sum_of_rows(joints.linear, j, impulses)
    angular = sum_of_rows(joints.angular_a, j, impulses)
    if joints.body_a[j] != b:
        linear = -linear
        angular = sum_of_rows(joints.angular_b, j, impulses)
    return vec6d(linear[0], linear[1], linear[2], angular[0], angular[1], angular[2])


@wp.func
def solve_for(m: int, b: int, impulse: vec6d, column: int, team: Team, joints: Joints):
    """Store the impulses by which the joints of a mechanism answer to an impulse on a body, negative.

    They are stored in a column of `solution`.
    """
    velocity = free_velocity(b, impulse, joints)
    for place in range(joints.first_place[m] + team.lane, joints.first_place[m + 1], team.lanes):
        j = joints.sequence[place]
        joints.solution[j, column] = speeds_along(j, b, velocity, joints)
    sync_warp(team.lanes)
    substitute(m, column, team, joints)


@wp.func
def response_column(m: int, pushed: int, b: int, k: int, joints: Joints):
    """The velocity that a unit impulse along axis k on a body of a mechanism gives a body of it."""
    unit = vec6d()
    unit[k] = wp.float64(1.0)
    solve_for(m, pushed, unit, 1 + k, single_lane(), joints)
    total = vec6d()
    if pushed == b:
        total = unit
    for place in range(joints.first_place[m], joints.first_place[m + 1]):
        j = joints.sequence[place]
        total -= reaction(j, b, joints.solution[j, 1 + k], joints)
    return free_velocity(b, total, joints)


@wp.func
def store_response(m: int, pushed: int, b: int, team: Team, joints: Joints):
    """Store the velocities that unit impulses on a body of a mechanism give one of its bodies where the joints hold.

    Those of a body by impulses on itself are kept until the next factorization.
    """
    if pushed == b and joints.answered[b] == joints.factorizations[m]:
        return
    for k in range(team.lane, 6, team.lanes):
        velocity = response_column(m, pushed, b, k, joints)
        for i in range(6):
            if pushed == b:
                set_entry(joints.response, b, i, k, velocity[i])
            else:
                # Bodies that joints hold to each other have no relative motion along some axes, and no effective mass
                # there without the factor.
                set_entry(joints.cross_response, m, i, k, wp.static(wp.float64(1.0 - 2.0**-10)) * velocity[i])
    sync_warp(team.lanes)
    if team.lane == 0 and pushed == b:
        joints.answered[b] = joints.factorizations[m]
    sync_warp(team.lanes)


@wp.func
def move_mechanism(m: int, b: int, which: int, team: Team, motions: Motions, joints: Joints):
    """Apply what a visit has applied to a body of a mechanism, whose joints stay solved: VELOCITY or PUSH."""
    solve_for(m, b, joints.pushed[b], 0, team, joints)
    if team.lane == 0:
        velocity = free_velocity(b, joints.pushed[b], joints)
        linear = wp.vec3d(velocity[0], velocity[1], velocity[2])
        add_velocity(b, which, linear, wp.vec3d(velocity[3], velocity[4], velocity[5]), motions)
    sync_warp(team.lanes)
    apply_solution(m, which, team, motions, joints)


@wp.func
def push_mechanism(m: int, b: int, which: int, team: Team, motions: Motions, joints: Joints):
    """As `move_mechanism`; velocities are changed by impulses of the joints, which are added to those of the step."""
    move_mechanism(m, b, which, team, motions, joints)
    if which == VELOCITY:
        add_to_impulses(m, team, joints)
    sync_warp(team.lanes)
