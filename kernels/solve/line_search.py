"""Line search: ensures that two-pass shock propagation never increases the energy.

The two passes give a search direction. With v0, l0 the velocities and impulses before the passes and dv, dl their
change, the contact problem's energy f(l) = v.Mv / 2 + b.l along the segment is a parabola. Its minimum

    t = clamp(-(v0.M dv + b.dl) / (dv.M dv), 0, 1)

is computed for each island. The friction cones are convex, so impulses stay admissible, and f never increases. Since
dv = M^-1 J^T dl, both sums can be computed over the contacts: v0.M dv = sum dl.(J v0) and dv.M dv = sum dl.(J dv).
"""

import warp as wp

from warp_rigid.kernels.common.solver_body import START, load_bodies, store_velocity, with_velocities
from warp_rigid.kernels.common.team import Team, sync_team, team_of
from warp_rigid.kernels.constraints.contact import blend_row, energy_terms, store_start
from warp_rigid.kernels.enums import ShockMode
from warp_rigid.kernels.schema import Contacts, Environments, Graph, Motions, Order, OrderRecord
from warp_rigid.kernels.solve.schedule import end_of_entries, entry_at, first_entry
from warp_rigid.kernels.solve.shock import is_propagated, island_of

wp.set_module_options({"enable_backward": False})


FIXED_POINT = wp.constant(wp.float64(2.0**40))
"""Fixed-point resolution relative to the largest summand of an island; 2^22 summands fit into 63 bits."""


@wp.func
def searched(env: int, envs: Environments, graph: Graph):
    """Whether an environment's shock propagation is followed by a line search."""
    return envs.shock_propagation[env] == ShockMode.TWO_PASS and is_propagated(env, envs, graph)


@wp.kernel
def store_before_shock(
    lanes: int,
    envs: Environments,
    order: Order,
    graph: Graph,
    motions: Motions,
    contacts: Contacts,
):
    """One team per environment: store the velocities and impulses before the passes."""
    team = team_of(wp.tid(), lanes)
    env = team.env
    if not is_propagated(env, envs, graph):
        return
    first = envs.first_body[env]
    last = envs.first_body[env + 1]
    for b in range(first + team.lane, last, lanes):
        store_velocity(b, START, motions.solver_bodies[b].linear, motions.solver_bodies[b].angular, motions)
    for k in range(first_entry(team, order), end_of_entries(env, order), lanes):
        entry = entry_at(k, order)
        for row in range(entry.begin, entry.end):
            store_start(row, contacts)


@wp.func
def energy_of(entry: OrderRecord, motions: Motions, contacts: Contacts):
    """Contribution of a constraint to the two sums [J]: -(v0.M dv + b.dl) and dv.M dv."""
    now = load_bodies(entry.body_a, entry.body_b, 0.0, 0.0, motions)
    then = with_velocities(entry.body_a, entry.body_b, START, now, motions)
    sums = wp.vec2(0.0, 0.0)
    for row in range(entry.begin, entry.end):
        sums += energy_terms(row, then, now, contacts)
    return sums


@wp.func
def add_up(island: int, numerator: wp.int64, denominator: wp.int64, graph: Graph):
    """Add to both sums of an island; the sums are integers, so the result does not depend on the order of lanes."""
    if island >= 0:
        wp.atomic_add(graph.numerator, island, numerator)
        wp.atomic_add(graph.denominator, island, denominator)


@wp.func
def clear_sums(first: int, last: int, team: Team, graph: Graph):
    """Clear the sums of all islands."""
    for body in range(first + team.lane, last, team.lanes):
        graph.numerator[body] = wp.int64(0)
        graph.denominator[body] = wp.int64(0)
        graph.largest[body] = 1.0e-30
    sync_team(team)


@wp.func
def store_terms(team: Team, order: Order, graph: Graph, motions: Motions, contacts: Contacts):
    """Store the summands of all constraints, and the largest one of each island."""
    for k in range(first_entry(team, order), end_of_entries(team.env, order), team.lanes):
        entry = entry_at(k, order)
        sums = energy_of(entry, motions, contacts)
        graph.energy_terms[k] = sums
        island = island_of(entry, motions, graph)
        wp.atomic_max(graph.largest, island, wp.max(wp.abs(sums[0]), wp.abs(sums[1])))
    sync_team(team)


@wp.func
def add_terms(team: Team, order: Order, graph: Graph, motions: Motions):
    """Add the summands of all constraints, as integer multiples of 2^-40 times the island's largest summand."""
    summed = int(-1)
    numerator = wp.int64(0)
    denominator = wp.int64(0)
    for k in range(first_entry(team, order), end_of_entries(team.env, order), team.lanes):
        island = island_of(entry_at(k, order), motions, graph)
        if island != summed:
            add_up(summed, numerator, denominator, graph)
            numerator = wp.int64(0)
            denominator = wp.int64(0)
            summed = island
        scale = FIXED_POINT / wp.float64(graph.largest[island])
        numerator += wp.int64(scale * wp.float64(graph.energy_terms[k][0]))
        denominator += wp.int64(scale * wp.float64(graph.energy_terms[k][1]))
    add_up(summed, numerator, denominator, graph)


@wp.kernel
def sum_energy(
    lanes: int,
    envs: Environments,
    order: Order,
    graph: Graph,
    motions: Motions,
    contacts: Contacts,
):
    """One team per environment: the two sums of the line search for each island, and its largest velocity change."""
    team = team_of(wp.tid(), lanes)
    env = team.env
    if not searched(env, envs, graph):
        return
    first = envs.first_body[env]
    last = envs.first_body[env + 1]
    for body in range(first + team.lane, last, lanes):
        graph.max_velocity_change[body] = 0.0
    clear_sums(first, last, team, graph)
    for body in range(first + team.lane, last, lanes):
        solver_body = motions.solver_bodies[body]
        wp.atomic_max(
            graph.max_velocity_change, graph.island[body], wp.length(solver_body.linear - solver_body.start_linear)
        )
    store_terms(team, order, graph, motions, contacts)
    add_terms(team, order, graph, motions)


@wp.func
def accepted_share(island: int, graph: Graph):
    """Step length t of an island, from 0 to 1."""
    if graph.denominator[island] <= wp.int64(0):
        return 1.0
    return wp.clamp(float(graph.numerator[island]) / float(graph.denominator[island]), 0.0, 1.0)


@wp.kernel
def accept(lanes: int, envs: Environments, order: Order, graph: Graph, motions: Motions, contacts: Contacts):
    """One team per environment: apply the accepted step length of each island."""
    team = team_of(wp.tid(), lanes)
    env = team.env
    if not searched(env, envs, graph):
        return
    for b in range(envs.first_body[env] + team.lane, envs.first_body[env + 1], lanes):
        t = accepted_share(graph.island[b], graph)
        solver_body = motions.solver_bodies[b]
        motions.solver_bodies[b].linear = solver_body.start_linear + t * (solver_body.linear - solver_body.start_linear)
        motions.solver_bodies[b].angular = solver_body.start_angular + t * (
            solver_body.angular - solver_body.start_angular
        )
    for k in range(first_entry(team, order), end_of_entries(env, order), lanes):
        entry = entry_at(k, order)
        t = accepted_share(island_of(entry, motions, graph), graph)
        for row in range(entry.begin, entry.end):
            blend_row(row, t, contacts)
