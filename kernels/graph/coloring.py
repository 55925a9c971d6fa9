"""Sixth stage: the order in which touching pairs are solved.

Pairs are coloured: no two pairs of a colour share a dynamic body, so a colour's pairs can be solved at the same time,
and in whatever order they are, the result is the same. All sweeps go colour by colour.

Pairs bid for colours (Jones and Plassmann 1993): in a round, the pair of highest priority at both its bodies takes the
lowest colour free at both. The priority is a scrambled index, so that rows of pairs are not coloured one by one. What
finds all colours taken, as on a tray that carries many, is solved one after another.
"""

import warp as wp

from warp_rigid.kernels.common.team import any_of_team, lowest_bit, sync_team, team_of
from warp_rigid.kernels.enums import Motion
from warp_rigid.kernels.graph.support import touches
from warp_rigid.kernels.schema import COLORS, Bodies, Graph, Order, PairRecord, Pairs
from warp_rigid.kernels.solve.gauss_seidel import IN_TURN

wp.set_module_options({"enable_backward": False})

MOST_COLORS = wp.constant(COLORS)

ALL_TAKEN = wp.constant(wp.uint32((1 << (COLORS - 1)) - 1))
"""Mask of a body at which every colour but the last is taken."""

UNCOLORED = wp.constant(-1)

GOLDEN = wp.constant(wp.uint32(0x9E3779B9))
"""2^32 divided by the golden ratio, odd: multiplying by it scrambles and keeps different what is different."""

NO_BID = wp.constant(-2147483648)


@wp.func
def priority(index: int):
    """A number for an index within an environment, different for different ones (Fibonacci hashing)."""
    return int(wp.uint32(index) * GOLDEN)


@wp.func
def place_bid(pair: int, begin: int, bodies: Bodies, pairs: Pairs, graph: Graph):
    """Bid for a colour at both bodies, or give up where all colours of a body are taken."""
    a = pairs.body_a[pair]
    b = pairs.body_b[pair]
    dynamic_a = bodies.motion[a] == Motion.DYNAMIC
    dynamic_b = bodies.motion[b] == Motion.DYNAMIC
    if (dynamic_a and graph.colors[a] == ALL_TAKEN) or (dynamic_b and graph.colors[b] == ALL_TAKEN):
        graph.pair_color[pair] = IN_TURN
        return
    if dynamic_a:
        wp.atomic_max(graph.bid, a, priority(pair - begin))
    if dynamic_b:
        wp.atomic_max(graph.bid, b, priority(pair - begin))


@wp.func
def take_color(pair: int, begin: int, bodies: Bodies, pairs: Pairs, graph: Graph):
    """Take the lowest colour that is free at both bodies if no other bid was higher."""
    a = pairs.body_a[pair]
    b = pairs.body_b[pair]
    own = priority(pair - begin)
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
    graph.pair_color[pair] = color
    if color == IN_TURN:
        return
    bit = wp.uint32(1) << wp.uint32(color)
    if dynamic_a:
        graph.colors[a] = graph.colors[a] | bit
    if dynamic_b:
        graph.colors[b] = graph.colors[b] | bit


@wp.kernel
def color_pairs(lanes: int, bodies_per_env: int, bodies: Bodies, pairs: Pairs, graph: Graph):
    """A team an environment: give each touching pair a colour that no other pair of its dynamic bodies has."""
    team = team_of(wp.tid(), lanes, graph.gate)
    env = team.env
    first = env * bodies_per_env
    begin = pairs.start[first]
    end = pairs.start[first + bodies_per_env]
    if graph.same[env] == 1:
        for pair in range(begin + team.lane, end, lanes):
            if touches(pair, pairs):
                graph.pair_color[pair] = graph.colored[pairs.last[pair]]
        return
    for b in range(first + team.lane, first + bodies_per_env, lanes):
        graph.colors[b] = wp.uint32(0)
        graph.bid[b] = NO_BID
    for pair in range(begin + team.lane, end, lanes):
        graph.pair_color[pair] = UNCOLORED
    left = int(1)
    while left == 1:
        sync_team(team)
        for pair in range(begin + team.lane, end, lanes):
            if touches(pair, pairs) and graph.pair_color[pair] == UNCOLORED:
                place_bid(pair, begin, bodies, pairs, graph)
        sync_team(team)
        for pair in range(begin + team.lane, end, lanes):
            if touches(pair, pairs) and graph.pair_color[pair] == UNCOLORED:
                take_color(pair, begin, bodies, pairs, graph)
        sync_team(team)
        for b in range(first + team.lane, first + bodies_per_env, lanes):
            graph.bid[b] = NO_BID
        left = int(0)
        for pair in range(begin + team.lane, end, lanes):
            if touches(pair, pairs) and graph.pair_color[pair] == UNCOLORED:
                left = 1
        left = any_of_team(left, team)


@wp.func
def add_colors(env: int, begin: int, graph: Graph, order: Order):
    """One lane: where each colour begins. The colours in use follow each other, but for those solved in turn."""
    at = int(begin)
    count = int(0)
    for color in range(MOST_COLORS):
        order.color_start[env, color] = at
        pairs = graph.tally[env, color]
        graph.tally[env, color] = at
        at += pairs
        if pairs > 0:
            count = color + 1
    order.color_start[env, MOST_COLORS] = at
    order.color_count[env] = count


@wp.func
def write_in_order(pair: int, env: int, pairs: Pairs, graph: Graph, order: Order):
    """Give a pair the next place of its colour."""
    entry = PairRecord()
    entry.pair = pair
    entry.body_a = pairs.body_a[pair]
    entry.body_b = pairs.body_b[pair]
    entry.begin = pairs.contact_start[pair]
    entry.end = pairs.contact_start[pair + 1]
    entry.upper_a = wp.where(graph.level[entry.body_a] < graph.level[entry.body_b], 0, 1)
    entry.upper_b = wp.where(graph.level[entry.body_b] < graph.level[entry.body_a], 0, 1)
    wp.atomic_add(graph.support_count, entry.body_a, entry.upper_a)
    wp.atomic_add(graph.support_count, entry.body_b, entry.upper_b)
    slot = wp.atomic_add(graph.tally, env, graph.pair_color[pair], 1)
    order.entries[slot] = entry


@wp.kernel
def group_pairs(lanes: int, bodies_per_env: int, pairs: Pairs, graph: Graph, order: Order):
    """A team an environment: sort the touching pairs by colour, and find the highest level.

    Within a colour their order is free, but for pairs that are solved in turn.
    """
    team = team_of(wp.tid(), lanes, graph.gate)
    env = team.env
    begin = pairs.start[env * bodies_per_env]
    end = pairs.start[(env + 1) * bodies_per_env]
    for b in range(env * bodies_per_env + team.lane, (env + 1) * bodies_per_env, lanes):
        graph.support_count[b] = 0
    for color in range(team.lane, MOST_COLORS, lanes):
        graph.tally[env, color] = 0
    if team.lane == 0:
        graph.level_count[env] = 0
    sync_team(team)
    in_turn = int(0)
    for pair in range(begin + team.lane, end, lanes):
        if touches(pair, pairs):
            wp.atomic_add(graph.tally, env, graph.pair_color[pair], 1)
            in_turn |= wp.where(graph.pair_color[pair] == IN_TURN, 1, 0)
            upper = wp.max(graph.level[pairs.body_a[pair]], graph.level[pairs.body_b[pair]])
            wp.atomic_max(graph.level_count, env, upper)
    in_turn = any_of_team(in_turn, team)
    if team.lane == 0:
        add_colors(env, begin, graph, order)
    sync_team(team)
    for pair in range(begin + team.lane, end, lanes):
        if touches(pair, pairs) and graph.pair_color[pair] != IN_TURN:
            write_in_order(pair, env, pairs, graph, order)
    if in_turn == 1 and team.lane == 0:
        for pair in range(begin, end):
            if touches(pair, pairs) and graph.pair_color[pair] == IN_TURN:
                write_in_order(pair, env, pairs, graph, order)
