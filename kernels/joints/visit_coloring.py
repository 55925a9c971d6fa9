"""Colours of visits: the order in which the pairs of mechanisms are visited.

Pairs of the same colour have no body and no mechanism in common, so the parts of a team share them, and the result does
not depend on their order. A mechanism counts as a single body, the first of its members. Colours are assigned as those
of constraints (coloring.py), and each pair takes the first colour that is free at both of its bodies. There are then
hardly more colours than the pairs of the mechanism that has most.
The priority of a pair is its place among the pairs, since sweeps that visit the pairs of a mechanism in an arbitrary
order converge more slowly, and a ragdoll that folds up gains more energy.
"""

import warp as wp

from warp_rigid.kernels.common.solver_body import inverse_mass_of
from warp_rigid.kernels.common.team import Team, any_of_team, lowest_bit, part_of_team, sync_team
from warp_rigid.kernels.graph.coloring import NO_BID
from warp_rigid.kernels.joints.arrays import COLOR_WORDS, Joints, VisitOrder
from warp_rigid.kernels.joints.loads import is_visited, solved_mechanism, visit_pair
from warp_rigid.kernels.schema import Contacts, Graph, Motions, Order
from warp_rigid.kernels.solve.schedule import Visited, end_of_entries, entry_at, first_entry

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

MARKED_COLORS = 32 * COLOR_WORDS
"""Number of colours that are marked at each body. A pair that finds none of them free comes after the last colours."""


@wp.func
def occupied(b: int, motions: Motions, joints: Joints):
    """Body that no other pair of a colour touches: the first of a mechanism, or itself; -1 if it never moves."""
    m = solved_mechanism(b, joints)
    if m >= 0:
        return joints.member[joints.first_member[m]]
    return wp.where(inverse_mass_of(b, motions) > 0.0, b, -1)


@wp.func
def bid_for(b: int, value: wp.int64, graph: Graph):
    """Bid for a colour at a body."""
    if b >= 0:
        wp.atomic_max(graph.bid, b, value)


@wp.func
def is_won(b: int, value: wp.int64, graph: Graph):
    """Whether no other bid at a body was higher."""
    return b < 0 or graph.bid[b] == value


@wp.func
def taken_colors(b: int, word: int, visits: VisitOrder):
    """The marks of 32 colours of a body."""
    if b < 0:
        return wp.uint32(0)
    return visits.taken[b, word]


@wp.func
def first_free_color(a: int, b: int, graph: Graph, visits: VisitOrder):
    """The first colour, from 0, in which no pair has touched two bodies. `changed` is the last colour of each."""
    word = int(0)
    taken = ~wp.uint32(0)
    while word < COLOR_WORDS and taken == ~wp.uint32(0):
        taken = taken_colors(a, word, visits) | taken_colors(b, word, visits)
        word += 1
    if taken != ~wp.uint32(0):
        return 32 * (word - 1) + lowest_bit(~taken)
    last = MARKED_COLORS - 1
    if a >= 0:
        last = wp.max(last, graph.changed[a])
    if b >= 0:
        last = wp.max(last, graph.changed[b])
    return last + 1


@wp.func
def note_color(b: int, color: int, graph: Graph, visits: VisitOrder):
    """Mark a colour as taken at a body."""
    if b >= 0:
        graph.changed[b] = wp.max(graph.changed[b], color)
        if color < MARKED_COLORS:
            visits.taken[b, color / 32] = visits.taken[b, color / 32] | (wp.uint32(1) << wp.uint32(color % 32))


@wp.func
def start_coloring(first: int, last: int, team: Team, order: Order, graph: Graph, joints: Joints, visits: VisitOrder):
    """No colours yet."""
    for b in range(first + team.lane, last, team.lanes):
        graph.bid[b] = NO_BID
        graph.changed[b] = 0
        for word in range(COLOR_WORDS):
            visits.taken[b, word] = wp.uint32(0)
    for k in range(first_entry(team, order), end_of_entries(team.env, order), team.lanes):
        order.entries[k].visited = wp.where(is_visited(entry_at(k, order), joints), Visited.WAITING, Visited.NONE)
    sync_team(team)


@wp.func
def bid_or_take(
    takes: int,
    first_row: int,
    team: Team,
    order: Order,
    graph: Graph,
    motions: Motions,
    joints: Joints,
    visits: VisitOrder,
):
    """All waiting pairs bid for a colour, or those that won take theirs (`takes`). Returns 1 if a lane's pair waits."""
    waits = int(0)
    for k in range(first_entry(team, order), end_of_entries(team.env, order), team.lanes):
        entry = entry_at(k, order)
        if entry.visited == Visited.WAITING:
            a = occupied(entry.body_a, motions, joints)
            b = occupied(entry.body_b, motions, joints)
            value = wp.int64(first_row - entry.begin)
            if takes == 0:
                bid_for(a, value, graph)
                bid_for(b, value, graph)
            elif is_won(a, value, graph) and is_won(b, value, graph):
                color = first_free_color(a, b, graph, visits)
                note_color(a, color, graph, visits)
                note_color(b, color, graph, visits)
                order.entries[k].visited = 1 + color
            else:
                waits = 1
    sync_team(team)
    return waits


@wp.func
def list_by_color(team: Team, order: Order, visits: VisitOrder):
    """List the visited pairs colour by colour; the order within a colour is arbitrary."""
    begin = order.color_start[team.env, 0]
    end = end_of_entries(team.env, order)
    for k in range(begin + team.lane, end, team.lanes):
        visits.end[k] = 0
    sync_team(team)
    for k in range(begin + team.lane, end, team.lanes):
        if entry_at(k, order).visited > 0:
            wp.atomic_add(visits.end, begin + entry_at(k, order).visited - 1, 1)
    sync_team(team)
    if team.lane == 0:
        visits.count[team.env] = first_places(begin, end, visits)
    sync_team(team)
    for k in range(begin + team.lane, end, team.lanes):
        if entry_at(k, order).visited > 0:
            visits.entries[wp.atomic_add(visits.end, begin + entry_at(k, order).visited - 1, 1)] = k
    sync_team(team)


@wp.func
def first_places(begin: int, end: int, visits: VisitOrder):
    """One lane: replace the number of pairs of each colour by its first place. Returns the number of colours."""
    place = int(begin)
    at = int(begin)
    while at < end:
        pairs = visits.end[at]
        if pairs == 0:
            return at - begin
        visits.end[at] = place
        place += pairs
        at += 1
    return end - begin


@wp.func
def color_visits(
    first: int,
    last: int,
    first_row: int,
    team: Team,
    order: Order,
    graph: Graph,
    motions: Motions,
    joints: Joints,
    visits: VisitOrder,
):
    """Assign colours to the pairs of mechanisms of an environment, and list the pairs colour by colour.

    Its bodies are `first` to `last` - 1, and its rows begin with `first_row`. Pairs with lower rows come first.
    """
    start_coloring(first, last, team, order, graph, joints, visits)
    left = int(1)
    while left == 1:
        bid_or_take(0, first_row, team, order, graph, motions, joints, visits)
        waits = bid_or_take(1, first_row, team, order, graph, motions, joints, visits)
        for b in range(first + team.lane, last, team.lanes):
            graph.bid[b] = NO_BID
        left = any_of_team(waits, team)
    list_by_color(team, order, visits)


@wp.func
def begin_of_visits(env: int, color: int, order: Order, visits: VisitOrder):
    """Place of the first pair of a colour in `VisitOrder.entries`."""
    begin = order.color_start[env, 0]
    if color == 0:
        return begin
    return visits.end[begin + color - 1]


@wp.func
def end_of_visits(env: int, color: int, order: Order, visits: VisitOrder):
    """One past the last pair of a colour."""
    return visits.end[order.color_start[env, 0] + color]


@wp.func
def visited_pair(place: int, order: Order, visits: VisitOrder):
    """The pair at a place of `VisitOrder.entries`."""
    return entry_at(visits.entries[place], order)


@wp.func
def solve_touching(
    start: int, team: Team, order: Order, motions: Motions, contacts: Contacts, joints: Joints, visits: VisitOrder
):
    """Visit all contacts of mechanisms, colour by colour. Returns a lane's largest change [m/s].

    `start`: 1 to apply the initial impulses.
    """
    change = float(0.0)
    part = part_of_team(team)
    for color in range(visits.count[team.env]):
        first = begin_of_visits(team.env, color, order, visits) + team.lane / part.lanes
        for place in range(first, end_of_visits(team.env, color, order, visits), team.lanes / part.lanes):
            entry = visited_pair(place, order, visits)
            change = wp.max(change, visit_pair(start, entry, part, motions, contacts, joints))
        sync_team(team)
    return change
