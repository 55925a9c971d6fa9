"""Graph colouring: the order in which constraints are solved.

No two constraints of a colour share a dynamic body. The constraints of a colour can therefore be solved in parallel,
and the result does not depend on their order. All sweeps process the constraints colour by colour.

Colours are assigned in parallel iterations (Jones and Plassmann 1993): in each, a constraint that has the highest
priority at both its bodies takes the lowest colour that is free at both. Constraints with more rows come first, since a
colour takes as long as its longest constraint: it is best if the long ones share colours. Among those with as many
rows, the priority is a hashed index, so that chains of neighbouring constraints are not coloured one by one.
Constraints at a body with all colours in use, such as a tray with many bodies on it, are solved serially.
"""

from enum import IntEnum

import warp as wp

from warp_rigid.kernels.common.team import Team, any_of_team, lowest_bit, sync_team, team_of
from warp_rigid.kernels.enums import Motion
from warp_rigid.kernels.graph.support import is_swept
from warp_rigid.kernels.schema import COLORS, Bodies, Constraints, Environments, Graph, Order, OrderRecord

wp.set_module_options({"enable_backward": False})

NO_BID = wp.constant(wp.int64(-(2**62)))


class Color(IntEnum):
    """Colours that are none of those whose constraints are solved side by side."""

    NONE = -1
    SERIAL = COLORS - 1
    """Its constraints are solved serially."""


@wp.func
def priority(k: int, begin: int, constraints: Constraints):
    """Priority of a constraint: its rows, then its hashed index within the environment (Fibonacci hashing).

    Distinct constraints have distinct priorities.
    """
    # Multiplication by 2^32 over the golden ratio, odd, is a bijective hash.
    hashed = wp.int64(int(wp.uint32(k - begin) * wp.static(wp.uint32(0x9E3779B9))))
    # The number of rows counts more than all differences of hashed indices.
    return wp.int64(constraints.row_count[k]) * wp.int64(0x100000000) + hashed


@wp.func
def place_bid(k: int, begin: int, bodies: Bodies, constraints: Constraints, graph: Graph):
    """Bid for a colour at both bodies, or take the serial colour if all colours of a body are in use."""
    a = constraints.body_a[k]
    b = constraints.body_b[k]
    dynamic_a = bodies.motion[a] == Motion.DYNAMIC
    dynamic_b = bodies.motion[b] == Motion.DYNAMIC
    all_taken = wp.static(wp.uint32((1 << (COLORS - 1)) - 1))  # all but the serial one
    if (dynamic_a and graph.colors[a] == all_taken) or (dynamic_b and graph.colors[b] == all_taken):
        graph.color[k] = Color.SERIAL
        return
    if dynamic_a:
        wp.atomic_max(graph.bid, a, priority(k, begin, constraints))
    if dynamic_b:
        wp.atomic_max(graph.bid, b, priority(k, begin, constraints))


@wp.func
def take_color(k: int, begin: int, bodies: Bodies, constraints: Constraints, graph: Graph):
    """Take the lowest colour that is free at both bodies, if no other bid was higher."""
    a = constraints.body_a[k]
    b = constraints.body_b[k]
    own = priority(k, begin, constraints)
    dynamic_a = bodies.motion[a] == Motion.DYNAMIC
    dynamic_b = bodies.motion[b] == Motion.DYNAMIC
    if (dynamic_a and graph.bid[a] != own) or (dynamic_b and graph.bid[b] != own):
        return
    taken = wp.uint32(0)
    if dynamic_a:
        taken = taken | graph.colors[a]
    if dynamic_b:
        taken = taken | graph.colors[b]
    color = lowest_bit(~taken)
    graph.color[k] = color
    if color == Color.SERIAL:
        return
    bit = wp.uint32(1) << wp.uint32(color)
    if dynamic_a:
        graph.colors[a] = graph.colors[a] | bit
    if dynamic_b:
        graph.colors[b] = graph.colors[b] | bit


@wp.func
def color_constraints(team: Team, envs: Environments, bodies: Bodies, constraints: Constraints, graph: Graph):
    """Assign each swept constraint a colour that no other one of its dynamic bodies has."""
    env = team.env
    first = envs.first_body[env]
    last = envs.first_body[env + 1]
    begin = constraints.start[env]
    end = constraints.start[env + 1]
    if graph.unchanged[env] == 1:
        for k in range(begin + team.lane, end, team.lanes):
            if is_swept(k, constraints, graph):
                graph.color[k] = graph.color_before[constraints.last[k]]
        return
    for b in range(first + team.lane, last, team.lanes):
        graph.colors[b] = wp.uint32(0)
        graph.bid[b] = NO_BID
    for k in range(begin + team.lane, end, team.lanes):
        graph.color[k] = Color.NONE
    left = int(1)
    while left == 1:
        sync_team(team)
        for k in range(begin + team.lane, end, team.lanes):
            if is_swept(k, constraints, graph) and graph.color[k] == Color.NONE:
                place_bid(k, begin, bodies, constraints, graph)
        sync_team(team)
        for k in range(begin + team.lane, end, team.lanes):
            if is_swept(k, constraints, graph) and graph.color[k] == Color.NONE:
                take_color(k, begin, bodies, constraints, graph)
        sync_team(team)
        for b in range(first + team.lane, last, team.lanes):
            graph.bid[b] = NO_BID
        left = int(0)
        for k in range(begin + team.lane, end, team.lanes):
            if is_swept(k, constraints, graph) and graph.color[k] == Color.NONE:
                left = 1
        left = any_of_team(left, team)


@wp.func
def add_colors(env: int, begin: int, graph: Graph, order: Order):
    """One lane: first entry of each colour, and the number of colours. Used colours are consecutive, except SERIAL."""
    at = int(begin)
    count = int(0)
    for color in range(COLORS):
        order.color_start[env, color] = at
        members = graph.tally[env, color]
        graph.tally[env, color] = at
        at += members
        if members > 0:
            count = color + 1
    order.color_start[env, COLORS] = at
    order.color_count[env] = count


@wp.func
def write_in_order(k: int, env: int, constraints: Constraints, graph: Graph, order: Order):
    """Write a constraint to the next free place of its colour."""
    entry = OrderRecord()
    entry.body_a = constraints.body_a[k]
    entry.body_b = constraints.body_b[k]
    entry.begin = constraints.first_row[k]
    entry.end = entry.begin + constraints.row_count[k]
    entry.upper_a = wp.where(graph.level[entry.body_a] < graph.level[entry.body_b], 0, 1)
    entry.upper_b = wp.where(graph.level[entry.body_b] < graph.level[entry.body_a], 0, 1)
    wp.atomic_add(graph.support_count, entry.body_a, entry.upper_a)
    wp.atomic_add(graph.support_count, entry.body_b, entry.upper_b)
    slot = wp.atomic_add(graph.tally, env, graph.color[k], 1)
    order.entries[slot] = entry


@wp.func
def group_constraints(team: Team, envs: Environments, constraints: Constraints, graph: Graph, order: Order):
    """Sort the constraints that are solved in sweeps by colour, and find the highest level.

    Within a colour the order is arbitrary, except for constraints that are solved serially.
    """
    env = team.env
    begin = constraints.start[env]
    end = constraints.start[env + 1]
    for b in range(envs.first_body[env] + team.lane, envs.first_body[env + 1], team.lanes):
        graph.support_count[b] = 0
    for color in range(team.lane, COLORS, team.lanes):
        graph.tally[env, color] = 0
    if team.lane == 0:
        graph.level_count[env] = 0
    sync_team(team)
    in_turn = int(0)
    for k in range(begin + team.lane, end, team.lanes):
        if is_swept(k, constraints, graph):
            wp.atomic_add(graph.tally, env, graph.color[k], 1)
            in_turn |= wp.where(graph.color[k] == Color.SERIAL, 1, 0)
            upper = wp.max(graph.level[constraints.body_a[k]], graph.level[constraints.body_b[k]])
            wp.atomic_max(graph.level_count, env, upper)
    in_turn = any_of_team(in_turn, team)
    if team.lane == 0:
        add_colors(env, begin, graph, order)
    sync_team(team)
    for k in range(begin + team.lane, end, team.lanes):
        if is_swept(k, constraints, graph) and graph.color[k] != Color.SERIAL:
            write_in_order(k, env, constraints, graph, order)
    if in_turn == 1 and team.lane == 0:
        for k in range(begin, end):
            if is_swept(k, constraints, graph) and graph.color[k] == Color.SERIAL:
                write_in_order(k, env, constraints, graph, order)


@wp.kernel
def order_constraints(
    lanes: int, envs: Environments, bodies: Bodies, constraints: Constraints, graph: Graph, order: Order
):
    """One team per environment: the constraints that are solved in sweeps, colour by colour."""
    team = team_of(wp.tid(), lanes)
    env = team.env
    if graph.swept[env] == 1:
        color_constraints(team, envs, bodies, constraints, graph)
        sync_team(team)
        group_constraints(team, envs, constraints, graph, order)
    elif team.lane == 0:
        order.color_start[env, 0] = constraints.start[env]
        order.color_count[env] = 0
        graph.level_count[env] = 0
