"""Heavy bodies that rest on the much lighter bodies of a mechanism.

A sweep over the contacts takes the bodies of a mechanism for free ones, and the direct solution then stops them again:
in both together, a load of a thousand times the mass of the body below loses a thousandth of its velocity. The contacts
of a mechanism that carries such a load are therefore solved with the velocity that an impulse causes where the joints
hold: the response M^-1 - M^-1 G^T A^-1 G M^-1 of the body that is touched. The impulse is then applied to the whole
mechanism. Such a visit minimizes the energy over the impulses of a pair and of all joints of its mechanisms.
"""

import warp as wp

from warp_rigid.kernels.common.solver_body import VELOCITY, BodyPair, load_bodies, store_bodies, with_impulse
from warp_rigid.kernels.common.tangents import world_vector
from warp_rigid.kernels.common.team import Team, any_of_team, sync_team
from warp_rigid.kernels.constraints import contact
from warp_rigid.kernels.constraints.rows import Rows
from warp_rigid.kernels.enums import IslandSolver, Role
from warp_rigid.kernels.joints.arrays import Joints, mat66d, vec6d
from warp_rigid.kernels.joints.factor import substitute
from warp_rigid.kernels.joints.joint_rows import add_velocity, apply_impulses, is_locked
from warp_rigid.kernels.schema import ContactRecord, Graph, Motions, Order, OrderRecord
from warp_rigid.kernels.solve.gauss_seidel import solve_constraint
from warp_rigid.kernels.solve.schedule import CONVERGED, end_of_entries, entry_at, first_of_color, stride_of_color

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

HEAVY = wp.constant(8.0)
"""Ratio of masses from which a body that touches a mechanism is a load on it. Sweeps converge up to about ten."""

PAIR_ROUNDS = wp.constant(4)
"""Maximum rounds over the contacts of a pair in a visit."""


@wp.func
def weighs_on(b: int, other: int, motions: Motions, joints: Joints):
    """Whether a body is a load on a body of a mechanism that joints hold to the world."""
    inverse_mass = motions.solver_bodies[b].inverse_mass
    lighter = inverse_mass * HEAVY < motions.solver_bodies[other].inverse_mass
    m = joints.of_body[other]
    if m >= 0 and inverse_mass > 0.0 and lighter:
        return joints.anchored[m] == 1
    return False


@wp.func
def find_loaded(team: Team, order: Order, motions: Motions, joints: Joints):
    """Mark the mechanisms that carry a load. Returns 1 if there are any."""
    for m in range(joints.first_mechanism[team.env] + team.lane, joints.first_mechanism[team.env + 1], team.lanes):
        joints.loaded[m] = 0
    sync_team(team)
    found = int(0)
    for k in range(order.color_start[team.env, 0] + team.lane, end_of_entries(team.env, order), team.lanes):
        entry = entry_at(k, order)
        if weighs_on(entry.body_a, entry.body_b, motions, joints):
            joints.loaded[joints.of_body[entry.body_b]] = 1
            found = 1
        if weighs_on(entry.body_b, entry.body_a, motions, joints):
            joints.loaded[joints.of_body[entry.body_a]] = 1
            found = 1
    return any_of_team(found, team)


@wp.func
def leave_out_of_shock(team: Team, motions: Motions, joints: Joints, graph: Graph):
    """Solve the islands of mechanisms that carry loads without shock propagation, whose passes leave the joints out."""
    for m in range(joints.first_mechanism[team.env] + team.lane, joints.first_mechanism[team.env + 1], team.lanes):
        if joints.loaded[m] == 1:
            for i in range(joints.first_member[m], joints.first_member[m + 1]):
                b = joints.member[i]
                if motions.role[b] == Role.FREE:
                    graph.solver[graph.island[b]] = IslandSolver.SWEEPS
    sync_team(team)


@wp.func
def sweep_others(team: Team, order: Order, motions: Motions, rows: Rows, joints: Joints):
    """As `sweep`, without the contacts that `solve_loads` solves."""
    change = float(0.0)
    for color in range(order.color_count[team.env]):
        stride = stride_of_color(color, team)
        for k in range(first_of_color(color, team, order), order.color_start[team.env, color + 1], stride):
            entry = entry_at(k, order)
            if mechanism_under_load(entry.body_a, joints) == mechanism_under_load(entry.body_b, joints):
                change = wp.max(change, solve_constraint(entry, motions, rows))
        sync_team(team)
    return change


@wp.func
def mechanism_under_load(b: int, joints: Joints):
    """The mechanism of a body if it carries a load, else -1."""
    m = joints.of_body[b]
    if m >= 0:
        if joints.loaded[m] == 1:
            return m
    return -1


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
        speeds = joints.linear[j] * linear + joints.angular_a[j] * angular
    elif joints.body_b[j] == b and joints.to_world[j] == 0:
        speeds = joints.angular_b[j] * angular - joints.linear[j] * linear
    for k in range(6):
        if not is_locked(joints.active[j], k):
            speeds[k] = wp.float64(0.0)
    return speeds


@wp.func
def reaction(j: int, b: int, impulses: vec6d, joints: Joints):
    """Impulse and angular impulse on a body by impulses along the rows of a joint; 0 if it holds other bodies."""
    if joints.body_a[j] != b and (joints.body_b[j] != b or joints.to_world[j] == 1):
        return vec6d()
    linear = wp.transpose(joints.linear[j]) * impulses
    angular = wp.transpose(joints.angular_a[j]) * impulses
    if joints.body_a[j] != b:
        linear = -linear
        angular = wp.transpose(joints.angular_b[j]) * impulses
    return vec6d(linear[0], linear[1], linear[2], angular[0], angular[1], angular[2])


@wp.func
def solve_for(m: int, b: int, impulse: vec6d, joints: Joints):
    """Store in `solution` the impulses by which the joints of a mechanism answer to an impulse on a body, negative."""
    velocity = free_velocity(b, impulse, joints)
    for place in range(joints.first_place[m], joints.first_place[m + 1]):
        j = joints.sequence[place]
        joints.solution[j] = speeds_along(j, b, velocity, joints)
    substitute(m, joints)


@wp.func
def store_response(m: int, b: int, joints: Joints):
    """Store the velocities that unit impulses on a body give it where the joints hold, unless they are known."""
    if joints.answered[b] == joints.factorizations[m]:
        return
    response = mat66d()
    for k in range(6):
        unit = vec6d()
        unit[k] = wp.float64(1.0)
        solve_for(m, b, unit, joints)
        for place in range(joints.first_place[m], joints.first_place[m + 1]):
            j = joints.sequence[place]
            unit -= reaction(j, b, joints.solution[j], joints)
        velocity = free_velocity(b, unit, joints)
        for i in range(6):
            response[i, k] = velocity[i]
    joints.response[b] = response
    joints.answered[b] = joints.factorizations[m]


@wp.func
def wrench(arm: wp.vec3, direction: wp.vec3):
    """Impulse and angular impulse of a unit impulse at an arm."""
    turn = wp.cross(wp.vec3d(arm), wp.vec3d(direction))
    d = wp.vec3d(direction)
    return vec6d(d[0], d[1], d[2], turn[0], turn[1], turn[2])


@wp.func
def inverse_masses(response: mat66d, arm: wp.vec3, n: wp.vec3, u: wp.vec3):
    """Inverse effective masses at a contact: normal, both couplings, then the tangential entries 11, 12 and 22."""
    along_n = wrench(arm, n)
    along_u = wrench(arm, u)
    along_v = wrench(arm, wp.cross(n, u))
    by_n = response * along_n
    by_u = response * along_u
    by_v = response * along_v
    couplings = wp.vec2d(wp.dot(along_u, by_n), wp.dot(along_v, by_n))
    return vec6d(
        wp.dot(along_n, by_n),
        couplings[0],
        couplings[1],
        wp.dot(along_u, by_u),
        wp.dot(along_u, by_v),
        wp.dot(along_v, by_v),
    )


@wp.func
def with_responses(row: ContactRecord, a: int, b: int, joints: Joints):
    """The row with the effective masses of bodies whose mechanisms carry a load."""
    if mechanism_under_load(a, joints) >= 0:
        k = inverse_masses(joints.response[a], row.arm_a, row.normal, row.tangent)
        row.normal_a = float(k[0])
        row.coupling_a = wp.vec2(float(k[1]), float(k[2]))
        row.tangent_a = wp.vec3(float(k[3]), float(k[4]), float(k[5]))
    if mechanism_under_load(b, joints) >= 0:
        k = inverse_masses(joints.response[b], row.arm_b, row.normal, row.tangent)
        row.normal_b = float(k[0])
        row.coupling_b = wp.vec2(float(k[1]), float(k[2]))
        row.tangent_b = wp.vec3(float(k[3]), float(k[4]), float(k[5]))
    return row


@wp.func
def with_velocity(which: int, change: vec6d, pair: BodyPair):
    """The pair after a change of the velocity of one body: 0 for the first, 1 for the second."""
    linear = wp.vec3(float(change[0]), float(change[1]), float(change[2]))
    angular = wp.vec3(float(change[3]), float(change[4]), float(change[5]))
    if which == 0:
        pair.linear_a += linear
        pair.angular_a += angular
    else:
        pair.linear_b += linear
        pair.angular_b += angular
    return pair


@wp.func
def solve_pair(entry: OrderRecord, m_a: int, m_b: int, motions: Motions, rows: Rows, joints: Joints):
    """Solve the contacts of a pair, and apply the impulses to both bodies and their mechanisms. Returns the change."""
    a = entry.body_a
    b = entry.body_b
    pair = load_bodies(a, b, wp.where(m_a < 0, 1.0, 0.0), wp.where(m_b < 0, 1.0, 0.0), motions)
    on_a = vec6d()
    on_b = vec6d()
    left = int(PAIR_ROUNDS)
    first = float(0.0)
    while left > 0:
        change = float(0.0)
        for c in range(entry.begin, entry.end):
            row = with_responses(contact.read_contact(c, rows.contacts.rows), a, b, joints)
            old = contact.impulse_of(c, contact.IMPULSE, rows.contacts)
            new = contact.next_impulse(old, 1.0, 1.0, row, pair)
            contact.set_impulse(c, contact.IMPULSE, new, rows.contacts)
            impulse = world_vector(row.normal, row.tangent, new - old)
            pair = with_impulse(row.arm_a, row.arm_b, impulse, pair)
            change = wp.max(change, contact.velocity_change(new - old, 1.0, 1.0, row))
            if m_a >= 0:
                on_a += wrench(row.arm_a, impulse)
                pair = with_velocity(0, joints.response[a] * wrench(row.arm_a, impulse), pair)
            if m_b >= 0:
                on_b -= wrench(row.arm_b, impulse)
                pair = with_velocity(1, -(joints.response[b] * wrench(row.arm_b, impulse)), pair)
        first = wp.max(first, change)
        left = wp.where(change > CONVERGED, left - 1, 0)
    store_bodies(a, b, pair, motions)
    if m_a >= 0:
        push_mechanism(m_a, a, on_a, motions, joints)
    if m_b >= 0:
        push_mechanism(m_b, b, on_b, motions, joints)
    return first


@wp.func
def push_mechanism(m: int, b: int, impulse: vec6d, motions: Motions, joints: Joints):
    """Apply an impulse and an angular impulse to a body of a mechanism, whose joints stay solved."""
    solve_for(m, b, impulse, joints)
    velocity = free_velocity(b, impulse, joints)
    linear = wp.vec3d(velocity[0], velocity[1], velocity[2])
    add_velocity(b, VELOCITY, linear, wp.vec3d(velocity[3], velocity[4], velocity[5]), motions)
    for place in range(joints.first_place[m], joints.first_place[m + 1]):
        j = joints.sequence[place]
        joints.total[j] = joints.total[j] - joints.solution[j]
        apply_impulses(j, VELOCITY, -joints.solution[j], motions, joints)


@wp.func
def solve_loads(team: Team, order: Order, motions: Motions, rows: Rows, joints: Joints):
    """Solve all contacts of mechanisms that carry loads, one pair after another. Returns a lane's largest change [m/s].

    Contacts between bodies of the same mechanism are left to the sweeps.
    """
    change = float(0.0)
    if team.lane == 0:
        for k in range(order.color_start[team.env, 0], end_of_entries(team.env, order)):
            entry = entry_at(k, order)
            m_a = mechanism_under_load(entry.body_a, joints)
            m_b = mechanism_under_load(entry.body_b, joints)
            if m_a != m_b:
                if m_a >= 0:
                    store_response(m_a, entry.body_a, joints)
                if m_b >= 0:
                    store_response(m_b, entry.body_b, joints)
                change = wp.max(change, solve_pair(entry, m_a, m_b, motions, rows, joints))
    sync_team(team)
    return change
