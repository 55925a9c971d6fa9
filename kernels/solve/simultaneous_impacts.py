"""Simultaneous impacts: all pairs with restitution that approach at the same time are solved together.

Solved one after another, the first of two floor tiles would throw a box that lands on both to the side. The target
velocities of a group of impacts therefore belong to the velocities before all of them, and their impulses accumulate in
sweeps until no velocity changes any more. Pairs that approach only after a group, such as the next sphere of a row, are
the next group. The impulses of an island are scaled down if they would increase its energy, as those of a pair in
pair_impact.py.
"""

import warp as wp

from warp_rigid.kernels.common.solver_body import START, load_bodies, store_bodies, store_velocity, with_velocities
from warp_rigid.kernels.common.team import Team, any_of_team, sync_team
from warp_rigid.kernels.schema import Contacts, Graph, Motions, Order
from warp_rigid.kernels.solve.line_search import accepted_share, add_terms, clear_sums, scale_change
from warp_rigid.kernels.solve.pair_impact import (
    energy_of_impact,
    has_restitution,
    note_impact,
    relative_pull,
    set_targets,
    with_equal_start,
    with_impacts,
)
from warp_rigid.kernels.solve.schedule import (
    Visited,
    end_of_entries,
    entry_at,
    first_entry,
    first_of_color,
    note_change,
    stride_of_color,
)
from warp_rigid.kernels.solve.shock import island_of
from warp_rigid.kernels.tuning import CONVERGED, GROUP_SWEEPS

wp.set_module_options({"enable_backward": False})


@wp.func
def find_bouncing(team: Team, order: Order, contacts: Contacts):
    """Leave the pairs with restitution out of the other impacts. Returns 1 if there are any."""
    found = int(0)
    for k in range(first_entry(team, order), end_of_entries(team.env, order), team.lanes):
        entry = entry_at(k, order)
        if entry.visited == 0 and has_restitution(entry.begin, entry.end, contacts):
            order.entries[k].visited = Visited.BOUNCING
            found = 1
    return any_of_team(found, team)


@wp.func
def open_group(
    dt: float, first: int, begin: int, end: int, team: Team, order: Order, motions: Motions, contacts: Contacts
):
    """Set the targets of all pairs with restitution that approach, and store the velocities. Returns 1 if any do."""
    found = int(0)
    for b in range(begin + team.lane, end, team.lanes):
        body = motions.solver_bodies[b]
        store_velocity(b, START, body.linear, body.angular, motions)
    for k in range(first_entry(team, order), end_of_entries(team.env, order), team.lanes):
        entry = entry_at(k, order)
        if entry.visited >= Visited.BOUNCING:
            pair = load_bodies(entry.body_a, entry.body_b, 0.0, 0.0, motions)
            unit = motions.velocity_unit[entry.body_a]
            pull = relative_pull(entry, first, motions)
            hit = set_targets(entry.begin, entry.end, unit, pair, pull, dt, contacts)
            order.entries[k].visited = Visited.BOUNCING + hit
            found |= hit
    return any_of_team(found, team)


@wp.func
def sweep_group(starts: bool, unit: float, team: Team, order: Order, motions: Motions, contacts: Contacts):
    """Solve all pairs of the group once. Returns a lane's largest velocity change by a contact [m/s].

    `starts`: the first sweep of the group.
    """
    change = float(0.0)
    for color in range(order.color_count[team.env]):
        stride = stride_of_color(color, team)
        for k in range(first_of_color(color, team, order), order.color_start[team.env, color + 1], stride):
            entry = entry_at(k, order)
            if entry.visited == Visited.BOUNCING + 1:
                pair = load_bodies(entry.body_a, entry.body_b, 1.0, 1.0, motions)
                if starts:
                    pair = with_equal_start(entry.begin, entry.end, pair, contacts)
                pair = with_impacts(entry.begin, entry.end, 1.0, 1.0, unit, pair, contacts)
                store_bodies(entry.body_a, entry.body_b, pair, motions)
                change = wp.max(change, pair.change)
        sync_team(team)
    return change


@wp.func
def sum_impact_energy(
    dt: float,
    first: int,
    begin: int,
    end: int,
    team: Team,
    order: Order,
    graph: Graph,
    motions: Motions,
    contacts: Contacts,
):
    """The change of the energy of each island by the group, as the two sums of a line search."""
    clear_sums(begin, end, team, graph)
    for k in range(first_entry(team, order), end_of_entries(team.env, order), team.lanes):
        entry = entry_at(k, order)
        terms = wp.vec2(0.0, 0.0)
        if entry.visited == Visited.BOUNCING + 1:
            after = load_bodies(entry.body_a, entry.body_b, 0.0, 0.0, motions)
            before = with_velocities(entry.body_a, entry.body_b, START, after, motions)
            lag = 0.5 * dt * relative_pull(entry, first, motions)
            terms = energy_of_impact(entry.begin, entry.end, before, after, lag, contacts)
        graph.energy_terms[k] = wp.vec2(-terms[0], terms[1])
        wp.atomic_max(graph.largest, island_of(entry, motions, graph), wp.max(wp.abs(terms[0]), terms[1]))
    sync_team(team)
    add_terms(team, order, graph, motions)
    sync_team(team)


@wp.func
def close_group(
    stamp: int, begin: int, end: int, team: Team, order: Order, graph: Graph, motions: Motions, contacts: Contacts
):
    """Scale the impulses of islands whose energy has increased, and note the impacts and the bodies that changed."""
    for b in range(begin + team.lane, end, team.lanes):
        t = accepted_share(graph.island[b], graph)
        if t < 1.0:
            scale_change(b, t, START, motions)
    for k in range(first_entry(team, order), end_of_entries(team.env, order), team.lanes):
        entry = entry_at(k, order)
        if entry.visited == Visited.BOUNCING + 1:
            note_impact(entry.begin, entry.end, accepted_share(island_of(entry, motions, graph), graph), contacts)
            note_change(entry.body_a, stamp, motions, graph)
            note_change(entry.body_b, stamp, motions, graph)
    sync_team(team)


@wp.func
def bounce_together(
    stamp: int,
    dt: float,
    first: int,
    begin: int,
    end: int,
    team: Team,
    order: Order,
    graph: Graph,
    motions: Motions,
    contacts: Contacts,
):
    """Solve a group of simultaneous impacts of the bodies from `begin` to `end` - 1. Returns 1 if there was any."""
    if open_group(dt, first, begin, end, team, order, motions, contacts) == 0:
        return 0
    unit = motions.velocity_unit[begin]
    left = int(GROUP_SWEEPS)
    while left > 0:
        change = sweep_group(left == int(GROUP_SWEEPS), unit, team, order, motions, contacts)
        left = any_of_team(wp.where(change > CONVERGED * unit, 1, 0), team) * (left - 1)
    sum_impact_energy(dt, first, begin, end, team, order, graph, motions, contacts)
    close_group(stamp, begin, end, team, order, graph, motions, contacts)
    return 1
