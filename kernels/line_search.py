"""The line search that keeps two-pass shock propagation from ever gaining energy.

The two passes give a search direction. With v0, l0 the velocities and impulses before and dv, dl their
change, the contact problem's energy f(l) = v.Mv / 2 + b.l along the segment is a parabola. Its minimum

    t = clamp(-(v0.M dv + b.dl) / (dv.M dv), 0, 1)

is taken, one t an island: the cones are convex, so the impulses stay admissible, and f never rises. Since
dv = M^-1 J^T dl, both sums run over contacts: v0.M dv = sum dl.(J v0) and dv.M dv = sum dl.(J dv).
"""

import warp as wp

from warp_rigid.kernels.data import (
    MOTION_DYNAMIC,
    SHOCK_TWO_PASS,
    Bodies,
    Contacts,
    Environments,
    Graph,
    Motions,
    PairRecord,
    Pairs,
    State,
)
from warp_rigid.kernels.impulses import slip_between, take_up
from warp_rigid.kernels.tangents import world_vector
from warp_rigid.kernels.team import meet

wp.set_module_options({"enable_backward": False})

DYNAMIC = wp.constant(MOTION_DYNAMIC)
TWO_PASS = wp.constant(SHOCK_TWO_PASS)


@wp.func
def searched(env: int, envs: Environments, graph: Graph):
    """Whether an environment's shock propagation is followed by a line search."""
    return envs.shock_propagation[env] == TWO_PASS and graph.settled[env] == 0


@wp.kernel
def remember_start(
    lanes: int,
    bodies_per_env: int,
    bodies: Bodies,
    motions: Motions,
    envs: Environments,
    graph: Graph,
    pairs: Pairs,
    contacts: Contacts,
    state: State,
):
    """A team an environment: keep velocities and impulses as they are before the passes."""
    env = wp.tid() / lanes
    lane = wp.tid() % lanes
    if graph.settled[env] == 1:
        return
    first = env * bodies_per_env
    for b in range(first + lane, first + bodies_per_env, lanes):
        motions.start_linear[b] = state.linear_velocity[b]
        motions.start_angular[b] = state.angular_velocity[b]
    begin = pairs.contact_start[pairs.start[first]]
    end = pairs.contact_start[pairs.start[first + bodies_per_env]]
    for c in range(begin + lane, end, lanes):
        contacts.loads[c].start_impulse = contacts.loads[c].impulse
        contacts.loads[c].start_twist = contacts.loads[c].twist
        contacts.loads[c].reaction = wp.vec3(0.0, 0.0, 0.0)
        contacts.loads[c].twist_reaction = wp.vec3(0.0, 0.0, 0.0)


@wp.func
def pair_sums(entry: PairRecord, bodies: Bodies, motions: Motions, contacts: Contacts, state: State):
    """A pair's part of both sums: -(v0.M dv + b.dl) and dv.M dv."""
    a = entry.body_a
    b = entry.body_b
    now = take_up(a, b, 0.0, 0.0, bodies, motions, state)
    then = now
    then.linear_a = motions.start_linear[a]
    then.angular_a = motions.start_angular[a]
    then.linear_b = motions.start_linear[b]
    then.angular_b = motions.start_angular[b]
    sums = wp.vec2(0.0, 0.0)
    for c in range(entry.begin, entry.end):
        row = contacts.rows[c]
        change = contacts.loads[c].impulse - contacts.loads[c].start_impulse
        impulse = world_vector(row.normal, row.tangent, change)
        twist = world_vector(row.normal, row.tangent, contacts.loads[c].twist - contacts.loads[c].start_twist)
        before = slip_between(row, then)
        spin_before = then.angular_a - then.angular_b
        spin = now.angular_a - now.angular_b
        slope = wp.dot(impulse, before) + wp.dot(twist, spin_before) + change[0] * row.closing
        gained = wp.dot(impulse, slip_between(row, now) - before) + wp.dot(twist, spin - spin_before)
        sums += wp.vec2(-slope, gained)
    return sums


@wp.kernel
def sum_energy(
    lanes: int,
    bodies_per_env: int,
    bodies: Bodies,
    motions: Motions,
    envs: Environments,
    graph: Graph,
    pairs: Pairs,
    contacts: Contacts,
    state: State,
):
    """A team an environment: both sums of the line search, island by island, in the order of the pairs.

    Each pair's part is found by whichever lane; then an island's parts are added up by one lane.
    """
    env = wp.tid() / lanes
    lane = wp.tid() % lanes
    if not searched(env, envs, graph):
        return
    first = env * bodies_per_env
    for b in range(first + lane, first + bodies_per_env, lanes):
        graph.numerator[b] = 0.0
        graph.denominator[b] = 0.0
    rows = env * (bodies_per_env + 2)
    begin = graph.group_start[graph.level_start[rows]]
    end = graph.group_start[graph.level_start[rows + graph.level_count[env] + 1]]
    for k in range(begin + lane, end, lanes):
        sums = pair_sums(graph.order[k], bodies, motions, contacts, state)
        graph.pair_numerator[graph.order[k].pair] = sums[0]
        graph.pair_denominator[graph.order[k].pair] = sums[1]
    meet(lanes)
    for pair in range(pairs.start[first], pairs.start[first + bodies_per_env]):
        if pairs.contact_start[pair + 1] > pairs.contact_start[pair]:
            a = pairs.body_a[pair]
            island = wp.where(bodies.motion[a] == DYNAMIC, graph.island[a], graph.island[pairs.body_b[pair]])
            if island % lanes == lane:
                graph.numerator[island] = graph.numerator[island] + graph.pair_numerator[pair]
                graph.denominator[island] = graph.denominator[island] + graph.pair_denominator[pair]


@wp.func
def accepted_share(island: int, graph: Graph):
    """The line search's t of an island."""
    if graph.denominator[island] <= 0.0:
        return 1.0
    return wp.clamp(graph.numerator[island] / graph.denominator[island], 0.0, 1.0)


@wp.kernel
def accept(
    lanes: int,
    bodies_per_env: int,
    bodies: Bodies,
    motions: Motions,
    envs: Environments,
    graph: Graph,
    pairs: Pairs,
    contacts: Contacts,
    state: State,
):
    """A team an environment: go the accepted share of the way."""
    env = wp.tid() / lanes
    lane = wp.tid() % lanes
    if not searched(env, envs, graph):
        return
    first = env * bodies_per_env
    for b in range(first + lane, first + bodies_per_env, lanes):
        t = accepted_share(graph.island[b], graph)
        state.linear_velocity[b] = motions.start_linear[b] + t * (state.linear_velocity[b] - motions.start_linear[b])
        state.angular_velocity[b] = motions.start_angular[b] + t * (
            state.angular_velocity[b] - motions.start_angular[b]
        )
    begin = pairs.contact_start[pairs.start[first]]
    end = pairs.contact_start[pairs.start[first + bodies_per_env]]
    for c in range(begin + lane, end, lanes):
        a = contacts.rows[c].body_a
        island = wp.where(bodies.motion[a] == DYNAMIC, graph.island[a], graph.island[contacts.rows[c].body_b])
        t = accepted_share(island, graph)
        start = contacts.loads[c].start_impulse
        contacts.loads[c].impulse = start + t * (contacts.loads[c].impulse - start)
        turn = contacts.loads[c].start_twist
        contacts.loads[c].twist = turn + t * (contacts.loads[c].twist - turn)
