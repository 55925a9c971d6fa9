"""Impacts of mechanisms: a body that bounces off a mechanism meets the mass of all its bodies, whose joints hold.

As an impact between single bodies, an elastic ball would leave a door near its hinge with half of its speed: the joint
takes back what the impact has given to the door. The pairs of mechanisms that have restitution are therefore solved
with the responses of the bodies (loads.py), one after another. Without restitution, impacts of mechanisms are those of
single bodies, since the contact solver follows.
"""

import warp as wp

from warp_rigid.kernels.common.solver_body import VELOCITY, BodyPair, at_rest, first_three, load_bodies, store_bodies
from warp_rigid.kernels.common.tangents import world_vector
from warp_rigid.kernels.common.team import Team, any_of_team, any_of_warp, part_of_team, sync_team, sync_warp
from warp_rigid.kernels.constraints.contact import (
    IMPACT_IMPULSE,
    read_contact,
    read_impulse,
    set_target_impulse,
    velocity_change,
)
from warp_rigid.kernels.constraints.records import is_active
from warp_rigid.kernels.enums import JointNumber
from warp_rigid.kernels.joints.arrays import Joints
from warp_rigid.kernels.joints.joint_rows import row_velocity
from warp_rigid.kernels.joints.loads import (
    Load,
    Visit,
    answer_pair,
    is_visited,
    open_visit,
    pushed,
    solved_mechanism,
    store_impulses,
    with_responses,
)
from warp_rigid.kernels.joints.mechanism import Activity
from warp_rigid.kernels.joints.poses import free_row
from warp_rigid.kernels.joints.responses import move_mechanism
from warp_rigid.kernels.schema import Constraints, Contacts, Graph, Motions, Order, OrderRecord
from warp_rigid.kernels.solve.pair_impact import (
    NO_IMPACT,
    energy_neutral_share,
    equal_impulse,
    has_restitution,
    is_impact,
    next_impact,
    note_impact,
    relative_pull,
    set_normal_impulses,
    set_targets,
)
from warp_rigid.kernels.solve.schedule import Visited, end_of_entries, entry_at, first_entry, note_change
from warp_rigid.kernels.tuning import CONVERGED, GROUP_SWEEPS, IMPACT_ITERATIONS

wp.set_module_options({"enable_backward": False, "max_unroll": 1})


@wp.func
def can_bounce(entry: OrderRecord, contacts: Contacts, joints: Joints):
    """Whether a pair belongs to a mechanism and has restitution."""
    return is_visited(entry, joints) and has_restitution(entry.begin, entry.end, contacts)


@wp.func
def leave_out_joined(team: Team, order: Order, contacts: Contacts, joints: Joints):
    """Leave the pairs of mechanisms that have restitution out of the other impacts. Returns 1 if there are any."""
    found = int(0)
    for m in range(joints.first_mechanism[team.env] + team.lane, joints.first_mechanism[team.env + 1], team.lanes):
        joints.loaded[m] = wp.where(joints.activity[m] == Activity.IN_CONTACT, Load.TOUCHED, Load.SWEPT)
    sync_team(team)
    for k in range(first_entry(team, order), end_of_entries(team.env, order), team.lanes):
        if can_bounce(entry_at(k, order), contacts, joints):
            order.entries[k].visited = Visited.SKIPPED
            found = 1
    return any_of_team(found, team)


@wp.func
def add_rotor_speeds(sign: float, team: Team, motions: Motions, joints: Joints):
    """Add the speeds of the coordinates that have an armature to those at the start of the step, or subtract them.

    Both around the impacts where the joints hold, which change the speed of the rotor as that of the coordinate.
    """
    for j in range(joints.first_joint[team.env] + team.lane, joints.first_joint[team.env + 1], team.lanes):
        if joints.numbers[j, JointNumber.ARMATURE] > 0.0 and joints.broken[j] == 0:
            speed = row_velocity(j, free_row(joints.coordinate[j]), motions, joints)
            joints.speed[j] = joints.speed[j] + wp.float64(sign) * speed
    sync_team(team)


@wp.func
def bounce_contact(c: int, visit: Visit, contacts: Contacts, joints: Joints):
    """The visit after the impact of a contact."""
    stored = read_impulse(contacts.impulses, c, IMPACT_IMPULSE)
    if stored[3] <= NO_IMPACT:
        return visit
    row = with_responses(read_contact(c, contacts.rows), visit, joints)
    new = next_impact(stored, 1.0, 1.0, row, visit.pair)
    change = new - first_three(stored)
    set_target_impulse(c, new, stored[3], contacts)
    visit.change = wp.max(visit.change, velocity_change(change, 1.0, 1.0, row))
    return pushed(row, world_vector(row.normal, row.tangent, change), visit, joints)


@wp.func
def with_equal_pushes(entry: OrderRecord, impulse: float, visit: Visit, contacts: Contacts, joints: Joints):
    """The visit after the same normal impulse at all impacts of its pair [N s]."""
    for c in range(entry.begin, entry.end):
        if is_impact(c, contacts):
            row = read_contact(c, contacts.rows)
            visit = pushed(row, impulse * row.normal, visit, joints)
    return visit


@wp.func
def with_share(share: float, before: BodyPair, visit: Visit):
    """The visit after a share of its impulses."""
    visit.pair.linear_a = before.linear_a + share * (visit.pair.linear_a - before.linear_a)
    visit.pair.angular_a = before.angular_a + share * (visit.pair.angular_a - before.angular_a)
    visit.pair.linear_b = before.linear_b + share * (visit.pair.linear_b - before.linear_b)
    visit.pair.angular_b = before.angular_b + share * (visit.pair.angular_b - before.angular_b)
    visit.on_a = wp.float64(share) * visit.on_a
    visit.on_b = wp.float64(share) * visit.on_b
    return visit


@wp.func
def bounce_alone(entry: OrderRecord, dt: float, pull: wp.vec3, motions: Motions, contacts: Contacts, joints: Joints):
    """One lane solves the impacts of a pair with its responses, as `after_impact`."""
    visit = open_visit(entry, motions, joints)
    before = visit.pair
    trial = visit
    trial.pair = at_rest(before)
    trial = with_equal_pushes(entry, 1.0, trial, contacts, joints)
    impulse = equal_impulse(entry.begin, entry.end, before, trial.pair, contacts)[0]
    set_normal_impulses(entry.begin, entry.end, impulse, contacts)
    visit = with_equal_pushes(entry, impulse, visit, contacts, joints)
    unit = motions.velocity_unit[visit.a]
    # As many iterations as a pair of a group gets in all its sweeps.
    left = int(GROUP_SWEEPS * IMPACT_ITERATIONS)
    while left > 0:
        visit.change = 0.0
        for c in range(entry.begin, entry.end):
            visit = bounce_contact(c, visit, contacts, joints)
        left = wp.where(visit.change > CONVERGED * unit, left - 1, 0)
    share = energy_neutral_share(entry.begin, entry.end, before, visit.pair, 0.5 * dt * pull, contacts)
    note_impact(entry.begin, entry.end, share, contacts)
    visit = with_share(share, before, visit)
    store_bodies(visit.a, visit.b, visit.pair, motions)
    store_impulses(visit, joints)


@wp.func
def move_mechanisms(entry: OrderRecord, stamp: int, part: Team, graph: Graph, motions: Motions, joints: Joints):
    """Apply the impulses of a visit to the mechanisms of both bodies, and note that all their bodies have changed."""
    side = int(0)
    while side < 2:
        b = wp.where(side == 0, entry.body_a, entry.body_b)
        m = solved_mechanism(b, joints)
        if part.lane == 0:
            note_change(b, stamp, motions, graph)
        if m >= 0:
            move_mechanism(m, b, VELOCITY, part, motions, joints)
            for i in range(joints.first_member[m] + part.lane, joints.first_member[m + 1], part.lanes):
                note_change(joints.member[i], stamp, motions, graph)
        side += 1


@wp.func
def bounce_pair(
    entry: OrderRecord,
    stamp: int,
    dt: float,
    first: int,
    part: Team,
    graph: Graph,
    motions: Motions,
    contacts: Contacts,
    joints: Joints,
):
    """Lanes solve the impacts of a pair where the joints hold. Returns 1 if there was any."""
    pull = relative_pull(entry, first, motions)
    unit = motions.velocity_unit[entry.body_a]
    hit = int(0)
    if part.lane == 0:
        pair = load_bodies(entry.body_a, entry.body_b, 0.0, 0.0, motions)
        hit = set_targets(entry.begin, entry.end, unit, pair, pull, dt, contacts)
    if any_of_warp(hit, part.lanes) == 0:
        return 0
    answer_pair(entry, part, joints)
    if part.lane == 0:
        bounce_alone(entry, dt, pull, motions, contacts, joints)
    sync_warp(part.lanes)
    move_mechanisms(entry, stamp, part, graph, motions, joints)
    return 1


@wp.func
def bounce_pairs(
    stamp: int,
    dt: float,
    first: int,
    team: Team,
    constraints: Constraints,
    graph: Graph,
    motions: Motions,
    contacts: Contacts,
    joints: Joints,
):
    """Solve the impacts of all pairs of mechanisms that have restitution, one after another. Returns 1 if any."""
    part = part_of_team(team)
    collided = int(0)
    for k in range(constraints.start[team.env], constraints.start[team.env + 1]):
        if is_active(k, constraints):
            entry = OrderRecord()
            entry.body_a = constraints.body_a[k]
            entry.body_b = constraints.body_b[k]
            entry.begin = constraints.first_row[k]
            entry.end = entry.begin + constraints.row_count[k]
            if can_bounce(entry, contacts, joints):
                if team.lane < part.lanes:
                    collided |= bounce_pair(entry, stamp, dt, first, part, graph, motions, contacts, joints)
                sync_team(team)
    return any_of_team(collided, team)
