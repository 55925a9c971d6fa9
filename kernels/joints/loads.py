"""Contacts of mechanisms: each impulse acts on the whole mechanism, whose joints hold.

A sweep over the contacts treats the bodies of a mechanism as free, and the direct solution then stops them. Together
they take a fiftieth of the velocity of a figure of 45 kg that lands on a foot of 1 kg, and reduce too large impulses of
the last step as slowly: these would add energy. The contacts of a mechanism are therefore solved with the velocity that
an impulse causes where the joints hold: the response M^-1 - M^-1 G^T A^-1 G M^-1 of the body that is touched. The
impulse is then applied to the whole mechanism. Such a visit minimizes the energy over the impulses of a pair and of all
joints of its mechanisms.

The pairs are visited colour by colour (visit_coloring.py).
"""

from enum import IntEnum

import warp as wp

from warp_rigid.kernels.common.solver_body import (
    VELOCITY,
    BodyPair,
    inverse_mass_of,
    load_bodies,
    store_bodies,
    with_angular_impulse,
    with_impulse,
)
from warp_rigid.kernels.common.tangents import world_vector
from warp_rigid.kernels.common.team import Team, any_of_team, part_of_team, sync_team, sync_warp
from warp_rigid.kernels.constraints import contact
from warp_rigid.kernels.constraints.load_distribution import distribute_contact_load
from warp_rigid.kernels.enums import IslandSolver, Role
from warp_rigid.kernels.joints.arrays import Joints, mat66d, vec6d
from warp_rigid.kernels.joints.elements import block_times, entry_of, transposed_block_times
from warp_rigid.kernels.joints.mechanism import Activity, needs_solution, solve_mechanism
from warp_rigid.kernels.joints.responses import push_mechanism, store_response
from warp_rigid.kernels.schema import ContactRecord, Contacts, Graph, Motions, Order, OrderRecord
from warp_rigid.kernels.solve.gauss_seidel import is_of_level, solve_constraint
from warp_rigid.kernels.solve.schedule import end_of_entries, entry_at, first_entry, first_of_color, stride_of_color
from warp_rigid.kernels.solve.shock import island_of
from warp_rigid.kernels.tuning import CONVERGED, PAIR_ITERATIONS

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

HEAVY = wp.constant(8.0)
"""Ratio of masses from which a body that touches a mechanism is a load on it, and a mechanism one on its lightest body.
Sweeps converge up to about ten."""


class Load(IntEnum):
    """Load of a mechanism: how its contacts are solved.

    The passes of shock propagation leave the joints out, and a pile of mechanisms keeps moving with them.
    """

    SWEPT = 0
    """By sweeps."""
    TOUCHED = 1
    """Where the joints hold, without passes if all contacts of the island are those of mechanisms."""
    LOADED = 2
    """The same with a load that joints hold to the world: without passes."""
    CRUSHED = 3
    """The same with a load heavier than the mechanism under it, which the ground carries: with passes."""


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
def is_crushed(m: int, b: int, motions: Motions, joints: Joints):
    """Whether a body is heavier than a whole mechanism that it touches, which no joint holds to the world."""
    inverse_mass = motions.solver_bodies[b].inverse_mass
    if joints.anchored[m] == 1 or inverse_mass == 0.0:
        return False
    return inverse_mass * joints.weight[m] < 1.0


@wp.func
def note_touch(entry: OrderRecord, motions: Motions, joints: Joints):
    """Count a pair for the mechanisms that it touches, and mark those on which it is a load."""
    m_a = joints.of_body[entry.body_a]
    m_b = joints.of_body[entry.body_b]
    if m_a >= 0:
        wp.atomic_add(joints.touching, m_a, 1)
        if is_crushed(m_a, entry.body_b, motions, joints):
            joints.loaded[m_a] = Load.CRUSHED
    if m_b >= 0 and m_a != m_b:
        wp.atomic_add(joints.touching, m_b, 1)
        if is_crushed(m_b, entry.body_a, motions, joints):
            joints.loaded[m_b] = Load.CRUSHED
    if weighs_on(entry.body_a, entry.body_b, motions, joints):
        joints.loaded[m_b] = Load.LOADED
    if weighs_on(entry.body_b, entry.body_a, motions, joints):
        joints.loaded[m_a] = Load.LOADED


@wp.func
def weight_of(m: int, motions: Motions, joints: Joints):
    """Mass of a mechanism [kg]."""
    total = float(0.0)
    for i in range(joints.first_member[m], joints.first_member[m + 1]):
        inverse_mass = inverse_mass_of(joints.member[i], motions)
        if inverse_mass > 0.0:
            total += 1.0 / inverse_mass
    return total


@wp.func
def is_heavy(m: int, motions: Motions, joints: Joints):
    """Whether a mechanism is much heavier than its lightest body."""
    largest_inverse = float(0.0)
    for i in range(joints.first_member[m], joints.first_member[m + 1]):
        largest_inverse = wp.max(largest_inverse, inverse_mass_of(joints.member[i], motions))
    return joints.weight[m] * largest_inverse > HEAVY


@wp.func
def find_touched(team: Team, order: Order, motions: Motions, joints: Joints):
    """Find the mechanisms whose contacts are solved where the joints hold. Returns 1 if there are any."""
    begin = joints.first_mechanism[team.env] + team.lane
    end = joints.first_mechanism[team.env + 1]
    for m in range(begin, end, team.lanes):
        joints.loaded[m] = Load.SWEPT
        joints.touching[m] = 0
        if joints.activity[m] == Activity.IN_CONTACT:
            joints.weight[m] = weight_of(m, motions, joints)
    sync_team(team)
    for k in range(first_entry(team, order), end_of_entries(team.env, order), team.lanes):
        note_touch(entry_at(k, order), motions, joints)
    sync_team(team)
    for m in range(begin, end, team.lanes):
        work = joints.touching[m] * (joints.first_member[m + 1] - joints.first_member[m])
        if joints.loaded[m] != Load.LOADED:
            # A visit takes a time proportional to the bodies, too long for a chain on the ground.
            is_solved = work > 0 and work <= 2048 and is_heavy(m, motions, joints)
            joints.loaded[m] = wp.where(is_solved, wp.max(joints.loaded[m], Load.TOUCHED), Load.SWEPT)
    sync_team(team)
    return any_touched(team, joints)


@wp.func
def any_touched(team: Team, joints: Joints):
    """Whether the contacts of any mechanism of an environment are solved where the joints hold."""
    found = int(0)
    for m in range(joints.first_mechanism[team.env] + team.lane, joints.first_mechanism[team.env + 1], team.lanes):
        if joints.loaded[m] != Load.SWEPT:
            found = 1
    return any_of_team(found, team)


@wp.func
def sweep_others(
    level: int, team: Team, order: Order, graph: Graph, motions: Motions, contacts: Contacts, joints: Joints
):
    """As `sweep`, without the contacts that `solve_touching` solves."""
    change = float(0.0)
    for color in range(order.color_count[team.env]):
        stride = stride_of_color(color, team)
        for k in range(first_of_color(color, team, order), order.color_start[team.env, color + 1], stride):
            entry = entry_at(k, order)
            if is_of_level(level, entry, graph) and not is_visited(entry, joints):
                change = wp.max(change, solve_constraint(entry, motions, contacts))
        sync_team(team)
    return change


@wp.func
def solved_mechanism(b: int, joints: Joints):
    """The mechanism of a body if its contacts are solved where the joints hold, else -1."""
    m = joints.of_body[b]
    if m >= 0:
        if joints.loaded[m] != Load.SWEPT:
            return m
    return -1


@wp.func
def is_visited(entry: OrderRecord, joints: Joints):
    """Whether a pair is solved where the joints hold: the contacts of a mechanism, also between its own bodies."""
    return solved_mechanism(entry.body_a, joints) >= 0 or solved_mechanism(entry.body_b, joints) >= 0


@wp.func
def leave_out_of_shock(first: int, last: int, team: Team, order: Order, motions: Motions, joints: Joints, graph: Graph):
    """Solve islands without shock propagation: with a LOADED mechanism, or a TOUCHED one and no other contacts."""
    for b in range(first + team.lane, last, team.lanes):
        joints.swept[b] = 0
    sync_team(team)
    for k in range(first_entry(team, order), end_of_entries(team.env, order), team.lanes):
        entry = entry_at(k, order)
        if not is_visited(entry, joints):
            joints.swept[island_of(entry, motions, graph)] = 1
    sync_team(team)
    for m in range(joints.first_mechanism[team.env] + team.lane, joints.first_mechanism[team.env + 1], team.lanes):
        for i in range(joints.first_member[m], joints.first_member[m + 1]):
            b = joints.member[i]
            island = graph.island[b]
            if motions.role[b] == Role.FREE:
                alone = joints.loaded[m] == Load.TOUCHED and joints.swept[island] == 0
                if joints.loaded[m] == Load.LOADED or alone:
                    graph.solver[island] = IslandSolver.SWEEPS
    sync_team(team)


@wp.func
def wrench(arm: wp.vec3, direction: wp.vec3):
    """Impulse and angular impulse of a unit impulse at an arm."""
    moment = wp.cross(wp.vec3d(arm), wp.vec3d(direction))
    d = wp.vec3d(direction)
    return vec6d(d[0], d[1], d[2], moment[0], moment[1], moment[2])


@wp.func(inline=False)
def inverse_masses(responses: wp.array[mat66d], b: int, arm: wp.vec3, n: wp.vec3, u: wp.vec3):
    """Inverse effective masses at a contact: normal, both couplings, then the tangential entries 11, 12 and 22.

    This function, `inverse_cross_masses` and `solve_rolling` are not inlined, which would make the compilation for a
    GPU 1.3 times as long.
    """
    along_n = wrench(arm, n)
    along_u = wrench(arm, u)
    along_v = wrench(arm, wp.cross(n, u))
    by_n = block_times(responses, b, along_n)
    by_u = block_times(responses, b, along_u)
    by_v = block_times(responses, b, along_v)
    couplings = wp.vec2d(wp.dot(along_u, by_n), wp.dot(along_v, by_n))
    return vec6d(
        wp.dot(along_n, by_n),
        couplings[0],
        couplings[1],
        wp.dot(along_u, by_u),
        wp.dot(along_u, by_v),
        wp.dot(along_v, by_v),
    )


@wp.struct
class Visit:
    """A visit of a pair: the bodies, their mechanisms (-1 for none), and what has been applied to them so far.

    `on_a` and `on_b` are impulses and angular impulses on bodies of mechanisms; `change` is the largest velocity change
    by a contact [m/s].
    """

    a: int
    b: int
    m_a: int
    m_b: int
    pair: BodyPair
    on_a: vec6d
    on_b: vec6d
    change: float


@wp.func
def is_within(visit: Visit):
    """Whether both bodies of a pair belong to the same mechanism: each answers to impulses on the other, too."""
    return visit.m_a >= 0 and visit.m_a == visit.m_b


@wp.func(inline=False)
def inverse_cross_masses(cross_responses: wp.array[mat66d], m: int, row: ContactRecord):
    """What the inverse effective masses of both bodies of a mechanism exceed those of their relative motion by.

    With the response C of the second body to the first, and the unit wrenches a and b of an axis on both, the entry of
    two axes x and y is b_x.C a_y + b_y.C a_x. The entries are in the order of `inverse_masses`.
    """
    v = wp.cross(row.normal, row.tangent)
    n_b = wrench(row.arm_b, row.normal)
    u_b = wrench(row.arm_b, row.tangent)
    v_b = wrench(row.arm_b, v)
    by_n = block_times(cross_responses, m, wrench(row.arm_a, row.normal))
    by_u = block_times(cross_responses, m, wrench(row.arm_a, row.tangent))
    by_v = block_times(cross_responses, m, wrench(row.arm_a, v))
    two = wp.float64(2.0)
    return vec6d(
        two * wp.dot(n_b, by_n),
        wp.dot(u_b, by_n) + wp.dot(n_b, by_u),
        wp.dot(v_b, by_n) + wp.dot(n_b, by_v),
        two * wp.dot(u_b, by_u),
        wp.dot(u_b, by_v) + wp.dot(v_b, by_u),
        two * wp.dot(v_b, by_v),
    )


@wp.func
def with_responses(row: ContactRecord, visit: Visit, joints: Joints):
    """The row with the effective masses of bodies of mechanisms."""
    if visit.m_a >= 0:
        k = inverse_masses(joints.response, visit.a, row.arm_a, row.normal, row.tangent)
        row.normal_a = float(k[0])
        row.coupling_a = wp.vec2(float(k[1]), float(k[2]))
        row.tangent_a = wp.vec3(float(k[3]), float(k[4]), float(k[5]))
    if visit.m_b >= 0:
        k = inverse_masses(joints.response, visit.b, row.arm_b, row.normal, row.tangent)
        row.normal_b = float(k[0])
        row.coupling_b = wp.vec2(float(k[1]), float(k[2]))
        row.tangent_b = wp.vec3(float(k[3]), float(k[4]), float(k[5]))
    if is_within(visit):
        k = inverse_cross_masses(joints.cross_response, visit.m_a, row)
        row.normal_a -= float(k[0])
        row.coupling_a -= wp.vec2(float(k[1]), float(k[2]))
        row.tangent_a -= wp.vec3(float(k[3]), float(k[4]), float(k[5]))
    return row


@wp.func
def linear_part(v: vec6d):
    """The first three components."""
    return wp.vec3(float(v[0]), float(v[1]), float(v[2]))


@wp.func
def angular_part(v: vec6d):
    """The last three components."""
    return wp.vec3(float(v[3]), float(v[4]), float(v[5]))


@wp.func
def with_wrenches(on_a: vec6d, on_b: vec6d, visit: Visit, joints: Joints):
    """The visit after impulses and angular impulses on those of its bodies that belong to mechanisms."""
    if visit.m_a >= 0:
        visit.on_a += on_a
        change = block_times(joints.response, visit.a, on_a)
        if is_within(visit):
            change += transposed_block_times(joints.cross_response, visit.m_a, on_b)
        visit.pair.linear_a += linear_part(change)
        visit.pair.angular_a += angular_part(change)
    if visit.m_b >= 0:
        visit.on_b += on_b
        change = block_times(joints.response, visit.b, on_b)
        if is_within(visit):
            change += block_times(joints.cross_response, visit.m_b, on_a)
        visit.pair.linear_b += linear_part(change)
        visit.pair.angular_b += angular_part(change)
    return visit


@wp.func
def pushed(row: ContactRecord, impulse: wp.vec3, visit: Visit, joints: Joints):
    """The visit after an impulse of a contact on the first body, and its opposite on the second."""
    visit.pair = with_impulse(row.arm_a, row.arm_b, impulse, visit.pair)
    return with_wrenches(wrench(row.arm_a, impulse), -wrench(row.arm_b, impulse), visit, joints)


@wp.func
def turned(angular_impulse: wp.vec3, visit: Visit, joints: Joints):
    """The visit after an angular impulse on the first body, and its opposite on the second."""
    visit.pair = with_angular_impulse(angular_impulse, visit.pair)
    moment = wp.vec3d(angular_impulse)
    zero = wp.float64(0.0)
    twist = vec6d(zero, zero, zero, moment[0], moment[1], moment[2])
    return with_wrenches(twist, -twist, visit, joints)


@wp.func
def angular_response(responses: wp.array[mat66d], at: int):
    """Angular velocity per angular impulse where the joints hold."""
    block = wp.mat33()
    for i in range(3):
        for k in range(3):
            block[i, k] = float(entry_of(responses, at, 3 + i, 3 + k))
    return block


@wp.func(inline=False)
def solve_rolling(c: int, load: float, row: ContactRecord, pair: BodyPair, contacts: Contacts):
    """Rolling and spinning friction of a contact with a normal impulse. Returns the pair after it."""
    return contact.solve_rolling(c, load, row, pair, contacts)


@wp.func
def rolling_change(start: int, c: int, row: ContactRecord, visit: Visit, contacts: Contacts, joints: Joints):
    """Change of the angular impulse by rolling and spinning friction of a contact, or its initial one (`start`)."""
    if start == 1:
        return contact.impulse_of(c, contact.ANGULAR_IMPULSE, contacts)
    pair = visit.pair
    if visit.m_a >= 0:
        pair.inverse_inertia_a = angular_response(joints.response, visit.a)
    if visit.m_b >= 0:
        pair.inverse_inertia_b = angular_response(joints.response, visit.b)
    if is_within(visit):
        cross = angular_response(joints.cross_response, visit.m_a)
        pair.inverse_inertia_a -= cross + wp.transpose(cross)
    old = contact.impulse_of(c, contact.ANGULAR_IMPULSE, contacts)
    load = contact.impulse_of(c, contact.IMPULSE, contacts)[0]
    solve_rolling(c, load, row, pair, contacts)
    return contact.impulse_of(c, contact.ANGULAR_IMPULSE, contacts) - old


@wp.func
def touch(start: int, c: int, visit: Visit, contacts: Contacts, joints: Joints):
    """The visit after the solution of a contact, or after its initial impulses (`start`)."""
    row = with_responses(contact.read_contact(c, contacts.rows), visit, joints)
    change = contact.impulse_of(c, contact.IMPULSE, contacts)
    if start == 0:
        new = contact.next_impulse(change, 1.0, 1.0, row, visit.pair)
        contact.set_impulse(c, contact.IMPULSE, new, contacts)
        change = new - change
        visit.change = wp.max(visit.change, contact.velocity_change(change, 1.0, 1.0, row))
    visit = pushed(row, world_vector(row.normal, row.tangent, change), visit, joints)
    if start == 1 or row.rolling_friction + row.spinning_friction > 0.0:
        # An angular impulse on a body of a mechanism moves its centre of mass, too.
        moment = rolling_change(start, c, row, visit, contacts, joints)
        visit = turned(world_vector(row.normal, row.tangent, moment), visit, joints)
    return visit


@wp.func
def open_visit(entry: OrderRecord, motions: Motions, joints: Joints):
    """A visit of a pair, whose bodies have their responses."""
    visit = Visit()
    visit.a = entry.body_a
    visit.b = entry.body_b
    visit.m_a = solved_mechanism(visit.a, joints)
    visit.m_b = solved_mechanism(visit.b, joints)
    mobility_a = wp.where(visit.m_a < 0, 1.0, 0.0)
    visit.pair = load_bodies(visit.a, visit.b, mobility_a, wp.where(visit.m_b < 0, 1.0, 0.0), motions)
    return visit


@wp.func
def store_impulses(visit: Visit, joints: Joints):
    """Store what a visit has applied to mechanisms, for `push_mechanisms`."""
    if visit.m_a >= 0:
        joints.pushed[visit.a] = visit.on_a
    if visit.m_b >= 0:
        joints.pushed[visit.b] = visit.on_b


@wp.func
def solve_alone(start: int, entry: OrderRecord, motions: Motions, contacts: Contacts, joints: Joints):
    """Solve a pair with its responses, or apply its initial impulses (`start`). Returns the largest change [m/s].

    One lane does this; `push_mechanisms` then applies the impulses to the mechanisms.
    """
    visit = open_visit(entry, motions, joints)
    first = float(0.0)
    if start == 1:
        distribute_contact_load(entry.begin, entry.end, contacts)
    left = int(PAIR_ITERATIONS)
    while left > 0:
        visit.change = 0.0
        for c in range(entry.begin, entry.end):
            visit = touch(start, c, visit, contacts, joints)
        first = wp.max(first, visit.change)
        left = wp.where(visit.change > CONVERGED * motions.velocity_unit[visit.a], left - 1, 0)
    store_bodies(visit.a, visit.b, visit.pair, motions)
    store_impulses(visit, joints)
    return first


@wp.func
def answer_pair(entry: OrderRecord, team: Team, joints: Joints):
    """Store the responses of the bodies of a pair that belong to mechanisms."""
    pushed_body = entry.body_a
    b = entry.body_a
    part = int(0)
    while part < 3:
        m = solved_mechanism(b, joints)
        if m >= 0 and m == solved_mechanism(pushed_body, joints):
            store_response(m, pushed_body, b, team, joints)
        pushed_body = wp.where(part == 0, entry.body_b, entry.body_a)
        b = entry.body_b
        part += 1


@wp.func
def push_mechanisms(entry: OrderRecord, which: int, team: Team, motions: Motions, joints: Joints):
    """Apply the impulses of a visit to the mechanisms of both bodies: VELOCITY or PUSH."""
    sync_warp(team.lanes)
    side = int(0)
    while side < 2:
        b = wp.where(side == 0, entry.body_a, entry.body_b)
        m = solved_mechanism(b, joints)
        if m >= 0:
            push_mechanism(m, b, which, team, motions, joints)
        side += 1


@wp.func
def visit_pair(start: int, entry: OrderRecord, team: Team, motions: Motions, contacts: Contacts, joints: Joints):
    """A team solves a pair with its responses, or applies its initial impulses (`start`).

    Returns a lane's largest change [m/s].
    """
    answer_pair(entry, team, joints)
    change = float(0.0)
    if team.lane == 0:
        change = solve_alone(start, entry, motions, contacts, joints)
    push_mechanisms(entry, VELOCITY, team, motions, joints)
    return change


@wp.func
def solve_joints(team: Team, dt: float, motions: Motions, joints: Joints):
    """Solve all mechanisms of an environment. Returns a lane's largest residual [m/s]."""
    change = float(0.0)
    part = part_of_team(team)
    parts = team.lanes / part.lanes
    first = joints.first_mechanism[team.env] + team.lane / part.lanes
    for m in range(first, joints.first_mechanism[team.env + 1], parts):
        if needs_solution(m, joints):
            change = wp.max(change, solve_mechanism(m, dt, 0, part, motions, joints))
    sync_team(team)
    return change
