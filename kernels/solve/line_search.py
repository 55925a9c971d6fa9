"""The line search that keeps two-pass shock propagation from ever gaining energy.

The two passes give a search direction. With v0, l0 the velocities and impulses before and dv, dl their
change, the contact problem's energy f(l) = v.Mv / 2 + b.l along the segment is a parabola. Its minimum

    t = clamp(-(v0.M dv + b.dl) / (dv.M dv), 0, 1)

is taken, one t an island: the cones are convex, so the impulses stay admissible, and f never rises. Since
dv = M^-1 J^T dl, both sums run over contacts: v0.M dv = sum dl.(J v0) and dv.M dv = sum dl.(J dv).
"""

import warp as wp

from warp_rigid.kernels.common.packed import (
    ANGULAR_IMPULSE,
    IMPULSE,
    START,
    START_ANGULAR_IMPULSE,
    START_IMPULSE,
    contact_row,
    entry_at,
    first_three,
    impulse_of,
    set_impulse,
    solver_body_quad,
    store_velocity,
)
from warp_rigid.kernels.common.tangents import world_vector
from warp_rigid.kernels.common.team import sync_team, team_of
from warp_rigid.kernels.enums import ShockMode
from warp_rigid.kernels.schema import Contacts, Environments, Graph, Motions, Order, PairRecord, State
from warp_rigid.kernels.solve.gauss_seidel import load_bodies, slip_between
from warp_rigid.kernels.solve.shock import island_of, next_ineffective_steps

wp.set_module_options({"enable_backward": False})


FINE = wp.constant(wp.float64(2.0**40))
"""Into so many parts the largest summand of an island is divided: 2^22 of them fit into 63 bits."""


@wp.func
def searched(env: int, envs: Environments, graph: Graph):
    """Whether an environment's shock propagation is followed by a line search."""
    return envs.shock_propagation[env] == ShockMode.TWO_PASS and graph.converged[env] == 0


@wp.kernel
def store_start(
    state: State,
    lanes: int,
    bodies_per_env: int,
    envs: Environments,
    order: Order,
    graph: Graph,
    motions: Motions,
    contacts: Contacts,
):
    """A team an environment: keep velocities and impulses as they are before the passes."""
    team = team_of(wp.tid(), lanes, graph.gate)
    env = team.env
    if graph.converged[env] == 1 or envs.shock_propagation[env] == ShockMode.OFF:
        return
    first = env * bodies_per_env
    for b in range(first + team.lane, first + bodies_per_env, lanes):
        store_velocity(b, START, motions.solver_bodies[b].linear, motions.solver_bodies[b].angular, motions)
        graph.ineffective_steps[b] = state.shock_ineffective_steps[b]
    for k in range(order.color_start[env, 0] + team.lane, order.color_start[env, order.color_count[env]], lanes):
        for c in range(order.entries[k].begin, order.entries[k].end):
            set_impulse(c, START_IMPULSE, impulse_of(c, IMPULSE, contacts), contacts)
            set_impulse(c, START_ANGULAR_IMPULSE, impulse_of(c, ANGULAR_IMPULSE, contacts), contacts)


@wp.func
def pair_sums(entry: PairRecord, motions: Motions, contacts: Contacts):
    """A pair's part of both sums: -(v0.M dv + b.dl) and dv.M dv."""
    a = entry.body_a
    b = entry.body_b
    now = load_bodies(a, b, 0.0, 0.0, motions)
    then = now
    then.linear_a = first_three(solver_body_quad(motions.solver_bodies, a, START))
    then.angular_a = first_three(solver_body_quad(motions.solver_bodies, a, START + 1))
    then.linear_b = first_three(solver_body_quad(motions.solver_bodies, b, START))
    then.angular_b = first_three(solver_body_quad(motions.solver_bodies, b, START + 1))
    sums = wp.vec2(0.0, 0.0)
    for c in range(entry.begin, entry.end):
        row = contact_row(c, contacts)
        change = impulse_of(c, IMPULSE, contacts) - impulse_of(c, START_IMPULSE, contacts)
        impulse = world_vector(row.normal, row.tangent, change)
        turn = impulse_of(c, ANGULAR_IMPULSE, contacts) - impulse_of(c, START_ANGULAR_IMPULSE, contacts)
        angular_impulse = world_vector(row.normal, row.tangent, turn)
        before = slip_between(row, then)
        spin_before = then.angular_a - then.angular_b
        spin = now.angular_a - now.angular_b
        slope = wp.dot(impulse, before) + wp.dot(angular_impulse, spin_before) + change[0] * row.bias_velocity
        gained = wp.dot(impulse, slip_between(row, now) - before) + wp.dot(angular_impulse, spin - spin_before)
        sums += wp.vec2(-slope, gained)
    return sums


@wp.func
def add_up(island: int, numerator: wp.int64, denominator: wp.int64, graph: Graph):
    """Add to both sums of an island; whole numbers, so the order in which lanes come makes no difference."""
    if island >= 0:
        wp.atomic_add(graph.numerator, island, numerator)
        wp.atomic_add(graph.denominator, island, denominator)


@wp.kernel
def sum_energy(
    lanes: int,
    bodies_per_env: int,
    envs: Environments,
    order: Order,
    graph: Graph,
    motions: Motions,
    contacts: Contacts,
):
    """A team an environment: both sums of the line search for each island, and how far it would change a velocity.

    The parts of the pairs are added as multiples of a 2^40th of the island's largest part.
    """
    team = team_of(wp.tid(), lanes, graph.gate)
    env = team.env
    if not searched(env, envs, graph):
        return
    first = env * bodies_per_env
    for body in range(first + team.lane, first + bodies_per_env, lanes):
        graph.numerator[body] = wp.int64(0)
        graph.denominator[body] = wp.int64(0)
        graph.largest[body] = 1.0e-30
        graph.max_velocity_change[body] = 0.0
    sync_team(team)
    for body in range(first + team.lane, first + bodies_per_env, lanes):
        solver_body = motions.solver_bodies[body]
        wp.atomic_max(
            graph.max_velocity_change, graph.island[body], wp.length(solver_body.linear - solver_body.start_linear)
        )
    begin = order.color_start[env, 0]
    end = order.color_start[env, order.color_count[env]]
    for k in range(begin + team.lane, end, lanes):
        entry = entry_at(k, order.entries)
        sums = pair_sums(entry, motions, contacts)
        graph.pair_sums[k] = sums
        island = island_of(entry, motions, graph)
        wp.atomic_max(graph.largest, island, wp.max(wp.abs(sums[0]), wp.abs(sums[1])))
    sync_team(team)
    last = int(-1)
    numerator = wp.int64(0)
    denominator = wp.int64(0)
    for k in range(begin + team.lane, end, lanes):
        island = island_of(entry_at(k, order.entries), motions, graph)
        if island != last:
            add_up(last, numerator, denominator, graph)
            numerator = wp.int64(0)
            denominator = wp.int64(0)
            last = island
        scale = FINE / wp.float64(graph.largest[island])
        numerator += wp.int64(scale * wp.float64(graph.pair_sums[k][0]))
        denominator += wp.int64(scale * wp.float64(graph.pair_sums[k][1]))
    add_up(last, numerator, denominator, graph)


@wp.func
def accepted_share(island: int, graph: Graph):
    """The line search's t of an island."""
    if graph.denominator[island] <= wp.int64(0):
        return 1.0
    return wp.clamp(float(graph.numerator[island]) / float(graph.denominator[island]), 0.0, 1.0)


@wp.kernel
def accept(
    repetition: int,
    lanes: int,
    bodies_per_env: int,
    envs: Environments,
    order: Order,
    graph: Graph,
    motions: Motions,
    contacts: Contacts,
    state: State,
):
    """A team an environment: go the accepted share of the way, and note whether the first repetition was of use."""
    team = team_of(wp.tid(), lanes, graph.gate)
    env = team.env
    if not searched(env, envs, graph):
        return
    first = env * bodies_per_env
    for b in range(first + team.lane, first + bodies_per_env, lanes):
        island = graph.island[b]
        t = accepted_share(island, graph)
        if repetition == 0:
            state.shock_ineffective_steps[b] = next_ineffective_steps(
                graph.ineffective_steps[island], graph.max_velocity_change[island], t
            )
        solver_body = motions.solver_bodies[b]
        motions.solver_bodies[b].linear = solver_body.start_linear + t * (solver_body.linear - solver_body.start_linear)
        motions.solver_bodies[b].angular = solver_body.start_angular + t * (
            solver_body.angular - solver_body.start_angular
        )
    for k in range(order.color_start[env, 0] + team.lane, order.color_start[env, order.color_count[env]], lanes):
        entry = entry_at(k, order.entries)
        t = accepted_share(island_of(entry, motions, graph), graph)
        for c in range(entry.begin, entry.end):
            start = impulse_of(c, START_IMPULSE, contacts)
            set_impulse(c, IMPULSE, start + t * (impulse_of(c, IMPULSE, contacts) - start), contacts)
            turn = impulse_of(c, START_ANGULAR_IMPULSE, contacts)
            set_impulse(c, ANGULAR_IMPULSE, turn + t * (impulse_of(c, ANGULAR_IMPULSE, contacts) - turn), contacts)
