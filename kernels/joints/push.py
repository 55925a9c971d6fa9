"""Push-out of mechanisms: contacts are separated where the joints hold, as their velocities are solved (loads.py).

The push-out of single bodies moves the body that is touched alone. Where the joints of a figure of 45 kg then move a
foot of 1 kg back, a twentieth of the correction is left.
"""

import warp as wp

from warp_rigid.kernels.common.arithmetic import quotient
from warp_rigid.kernels.common.solver_body import PUSH, BodyPair, store_velocities, with_velocities
from warp_rigid.kernels.common.team import Team, part_of_team, sync_team
from warp_rigid.kernels.constraints import contact
from warp_rigid.kernels.joints.arrays import Joints, VisitOrder
from warp_rigid.kernels.joints.loads import (
    Visit,
    answer_pair,
    open_visit,
    push_mechanisms,
    pushed,
    store_impulses,
    with_responses,
)
from warp_rigid.kernels.joints.visit_coloring import begin_of_visits, end_of_visits, visited_pair
from warp_rigid.kernels.schema import Contacts, Motions, Order, OrderRecord
from warp_rigid.kernels.tuning import PAIR_ITERATIONS, PUSH_OUT_CONVERGED

wp.set_module_options({"enable_backward": False, "max_unroll": 1})


@wp.func
def wants_push(entry: OrderRecord, contacts: Contacts):
    """Whether a contact of a pair requires a separation speed."""
    for c in range(entry.begin, entry.end):
        if contact.read_impulse(contacts.impulses, c, contact.IMPACT_IMPULSE)[3] > 0.0:
            return True
    return False


@wp.func
def targets_of(entry: OrderRecord, along: BodyPair, contacts: Contacts):
    """Sum over the contacts of a pair of the squares of required separation speeds, and of these times present ones."""
    sums = wp.vec2(0.0, 0.0)
    for c in range(entry.begin, entry.end):
        target = contact.read_impulse(contacts.impulses, c, contact.IMPACT_IMPULSE)[3]
        row = contact.read_contact(c, contacts.rows)
        sums += target * wp.vec2(target, contact.separation_speed(row, along))
    return sums


@wp.func
def push_all(entry: OrderRecord, share: float, visit: Visit, contacts: Contacts, joints: Joints):
    """The visit after pseudo-impulses of all contacts of a pair: `share` [kg] times the speeds that they require."""
    for c in range(entry.begin, entry.end):
        target = contact.read_impulse(contacts.impulses, c, contact.IMPACT_IMPULSE)[3]
        if target > 0.0:
            row = contact.read_contact(c, contacts.rows)
            visit = pushed(row, share * target * row.normal, visit, joints)
    return visit


@wp.func
def push_together(entry: OrderRecord, visit: Visit, contacts: Contacts, joints: Joints):
    """The visit after the best pseudo-impulses in proportion to the required speeds, as in a method of descent.

    One contact after the other would turn a light foot to and fro below a heavy leg.
    """
    before = targets_of(entry, visit.pair, contacts)
    trial = push_all(entry, 1.0, visit, contacts, joints)
    gained = targets_of(entry, trial.pair, contacts)[1] - before[1]
    share = wp.max(quotient(before[0] - before[1], wp.max(gained, 1.0e-30)), 0.0)
    for c in range(entry.begin, entry.end):
        stored = contact.read_impulse(contacts.impulses, c, contact.IMPACT_IMPULSE)
        new = stored[0] + share * stored[3]
        contact.set_target_impulse(c, wp.vec3(new, 0.0, 0.0), stored[3], contacts)
    return push_all(entry, share, visit, contacts, joints)


@wp.func
def push_touch(c: int, visit: Visit, contacts: Contacts, joints: Joints):
    """The visit after the pseudo-impulse of a contact, as `push_contact`."""
    stored = contact.read_impulse(contacts.impulses, c, contact.IMPACT_IMPULSE)
    if stored[3] <= 0.0:
        return visit
    row = with_responses(contact.read_contact(c, contacts.rows), visit, joints)
    k = row.normal_a + row.normal_b
    if k <= 0.0:
        return visit
    missing = stored[3] - contact.separation_speed(row, visit.pair)
    new = wp.max(stored[0] + quotient(missing, k), 0.0)
    contact.set_target_impulse(c, wp.vec3(new, 0.0, 0.0), stored[3], contacts)
    visit.change = wp.max(visit.change, k * wp.abs(new - stored[0]))
    return pushed(row, (new - stored[0]) * row.normal, visit, joints)


@wp.func
def push_alone(entry: OrderRecord, motions: Motions, contacts: Contacts, joints: Joints):
    """Separate a pair with its responses, as `solve_alone`. Returns the largest change of a pseudo-velocity [m/s]."""
    visit = open_visit(entry, motions, joints)
    visit.pair = with_velocities(visit.a, visit.b, PUSH, visit.pair, motions)
    visit = push_together(entry, visit, contacts, joints)
    first = float(0.0)
    left = int(PAIR_ITERATIONS)
    while left > 0:
        visit.change = 0.0
        for c in range(entry.begin, entry.end):
            visit = push_touch(c, visit, contacts, joints)
        first = wp.max(first, visit.change)
        left = wp.where(visit.change > PUSH_OUT_CONVERGED * motions.velocity_unit[visit.a], left - 1, 0)
    store_velocities(visit.a, visit.b, PUSH, visit.pair, motions)
    store_impulses(visit, joints)
    return first


@wp.func
def push_visited(entry: OrderRecord, team: Team, motions: Motions, contacts: Contacts, joints: Joints):
    """A team separates a pair with its responses. Returns a lane's largest change of a pseudo-velocity [m/s]."""
    answer_pair(entry, team, joints)
    change = float(0.0)
    if team.lane == 0:
        change = push_alone(entry, motions, contacts, joints)
    push_mechanisms(entry, PUSH, team, motions, joints)
    return change


@wp.func
def push_touching(team: Team, order: Order, motions: Motions, contacts: Contacts, joints: Joints, visits: VisitOrder):
    """Separate all pairs of mechanisms, in the order of `solve_touching`. Returns a lane's largest change [m/s]."""
    change = float(0.0)
    part = part_of_team(team)
    for color in range(visits.count[team.env]):
        first = begin_of_visits(team.env, color, order, visits) + team.lane / part.lanes
        for place in range(first, end_of_visits(team.env, color, order, visits), team.lanes / part.lanes):
            entry = visited_pair(place, order, visits)
            if wants_push(entry, contacts):
                change = wp.max(change, push_visited(entry, part, motions, contacts, joints))
        sync_team(team)
    return change
