"""Line searches: ensure that neither two-pass shock propagation nor the impulses of a step increase the energy.

The two passes give a search direction. With v0, l0 the velocities and impulses before the passes and dv, dl their
change, the contact problem's energy f(l) = v.Mv / 2 + b.l along the segment is a parabola. Its minimum

    t = clamp(-(v0.M dv + b.dl) / (dv.M dv), 0, 1)

is computed for each island. The friction cones are convex, so impulses stay admissible, and f never increases. Since
dv = M^-1 J^T dl, both sums can be computed over the contacts: v0.M dv = sum dl.(J v0) and dv.M dv = sum dl.(J dv).

The impulses of a step that have not converged may increase the energy. An example is the step after an impact: the
initial impulses are those of the impact, many times larger than what the step requires, and few sweeps do not reduce
all of them. A second search therefore starts at the velocities before the contact solver, where all impulses are 0. At
its end, the work of an island's impulses at the velocities that they lead to is not positive. It is executed with two
passes and warm starting, for islands that move and have no joints. Mechanisms have a search of their own, heaps none.
"""

import warp as wp

from warp_rigid.kernels.common.solver_body import (
    BEFORE_CONTACTS,
    START,
    load_bodies,
    load_velocity,
    store_velocity,
    with_velocities,
)
from warp_rigid.kernels.common.team import Team, any_of_team, sync_team
from warp_rigid.kernels.constraints.contact import blend_row, energy_terms, scale_row, store_start
from warp_rigid.kernels.enums import ShockMode
from warp_rigid.kernels.schema import Contacts, Environments, Graph, Motions, Order, OrderRecord
from warp_rigid.kernels.solve.schedule import end_of_entries, entry_at, first_entry
from warp_rigid.kernels.solve.shock import is_propagated, island_of
from warp_rigid.kernels.tuning import HARDLY

wp.set_module_options({"enable_backward": False})


FIXED_POINT = wp.constant(wp.float64(2.0**40))
"""Fixed-point resolution relative to the largest summand of an island; 2^22 summands fit into 63 bits."""


@wp.func
def searched(env: int, envs: Environments, graph: Graph):
    """Whether an environment's shock propagation is followed by a line search."""
    return envs.shock_propagation[env] == ShockMode.TWO_PASS and is_propagated(env, envs, graph)


@wp.func
def store_before_shock(team: Team, envs: Environments, order: Order, motions: Motions, contacts: Contacts):
    """Store the velocities and impulses before the passes."""
    env = team.env
    first = envs.first_body[env]
    last = envs.first_body[env + 1]
    for b in range(first + team.lane, last, team.lanes):
        store_velocity(b, START, motions.solver_bodies[b].linear, motions.solver_bodies[b].angular, motions)
    for k in range(first_entry(team, order), end_of_entries(env, order), team.lanes):
        entry = entry_at(k, order)
        for row in range(entry.begin, entry.end):
            store_start(row, contacts)


@wp.func
def energy_of(entry: OrderRecord, since: int, motions: Motions, contacts: Contacts):
    """Contribution of a constraint to the two sums [J]: -(v0.M dv + b.dl) and dv.M dv.

    `since`: the velocities v0, START or BEFORE_CONTACTS.
    """
    now = load_bodies(entry.body_a, entry.body_b, 0.0, 0.0, motions)
    then = with_velocities(entry.body_a, entry.body_b, since, now, motions)
    sums = wp.vec2(0.0, 0.0)
    for row in range(entry.begin, entry.end):
        sums += energy_terms(row, since == START, then, now, contacts)
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
def store_terms(since: int, team: Team, order: Order, graph: Graph, motions: Motions, contacts: Contacts):
    """Store the summands of all constraints, and the largest one of each island; `since`: as for `energy_of`."""
    for k in range(first_entry(team, order), end_of_entries(team.env, order), team.lanes):
        entry = entry_at(k, order)
        sums = energy_of(entry, since, motions, contacts)
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


@wp.func
def sum_energy(team: Team, envs: Environments, order: Order, graph: Graph, motions: Motions, contacts: Contacts):
    """The two sums of the line search for each island."""
    clear_sums(envs.first_body[team.env], envs.first_body[team.env + 1], team, graph)
    store_terms(START, team, order, graph, motions, contacts)
    add_terms(team, order, graph, motions)


@wp.func
def accepted_share(island: int, graph: Graph):
    """Step length t of an island, from 0 to 1."""
    if graph.denominator[island] <= wp.int64(0):
        return 1.0
    return wp.clamp(float(graph.numerator[island]) / float(graph.denominator[island]), 0.0, 1.0)


@wp.func
def scale_change(b: int, t: float, since: int, motions: Motions):
    """Scale the change of a body's velocities since START or BEFORE_CONTACTS."""
    body = motions.solver_bodies[b]
    linear = load_velocity(b, since, motions)
    angular = load_velocity(b, since + 1, motions)
    motions.solver_bodies[b].linear = linear + t * (body.linear - linear)
    motions.solver_bodies[b].angular = angular + t * (body.angular - angular)


@wp.func
def accept(team: Team, envs: Environments, order: Order, graph: Graph, motions: Motions, contacts: Contacts):
    """Apply the accepted step length of each island."""
    env = team.env
    for b in range(envs.first_body[env] + team.lane, envs.first_body[env + 1], team.lanes):
        t = accepted_share(graph.island[b], graph)
        graph.accepted[b] = t
        scale_change(b, t, START, motions)
    for k in range(first_entry(team, order), end_of_entries(env, order), team.lanes):
        entry = entry_at(k, order)
        t = accepted_share(island_of(entry, motions, graph), graph)
        for row in range(entry.begin, entry.end):
            blend_row(row, t, contacts)


@wp.func
def leave_joined(first: int, last: int, team: Team, graph: Graph):
    """Leave the islands with joints as they are: they have line searches of their own (initial_impulses.py)."""
    sync_team(team)
    for b in range(first + team.lane, last, team.lanes):
        if graph.tied[b] == 1:
            graph.denominator[graph.island[b]] = wp.int64(0)
    sync_team(team)


@wp.func
def final_step_length(island: int, graph: Graph):
    """Factor on all impulses of an island: the step length of the second search if the island moves, otherwise 1."""
    return wp.where(graph.island_speed[island] > HARDLY, accepted_share(island, graph), 1.0)


@wp.func
def is_searched_again(team: Team, envs: Environments, order: Order, graph: Graph):
    """Whether an environment has a second search: with two passes and warm starting, if an island moves."""
    env = team.env
    if envs.shock_propagation[env] != ShockMode.TWO_PASS or envs.warm_starting[env] == 0:
        return False
    if order.color_count[env] == 0 or graph.converged[env] == 1:
        return False
    moving = int(0)
    for b in range(envs.first_body[env] + team.lane, envs.first_body[env + 1], team.lanes):
        if graph.island_speed[graph.island[b]] > HARDLY:
            moving = 1
    return any_of_team(moving, team) == 1


@wp.func
def scale_to_minimum(team: Team, envs: Environments, order: Order, graph: Graph, motions: Motions, contacts: Contacts):
    """Scale the impulses of the islands that move to the minimum of the energy."""
    env = team.env
    if not is_searched_again(team, envs, order, graph):
        return
    first = envs.first_body[env]
    last = envs.first_body[env + 1]
    clear_sums(first, last, team, graph)
    store_terms(BEFORE_CONTACTS, team, order, graph, motions, contacts)
    add_terms(team, order, graph, motions)
    leave_joined(first, last, team, graph)
    for b in range(first + team.lane, last, team.lanes):
        t = final_step_length(graph.island[b], graph)
        if t < 1.0:
            scale_change(b, t, BEFORE_CONTACTS, motions)
    for k in range(first_entry(team, order), end_of_entries(env, order), team.lanes):
        entry = entry_at(k, order)
        t = final_step_length(island_of(entry, motions, graph), graph)
        if t < 1.0:
            for row in range(entry.begin, entry.end):
                scale_row(row, t, contacts)
