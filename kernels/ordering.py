"""Sixth stage: the order in which touching pairs are solved.

Pairs are coloured: no two pairs of a colour share a dynamic body, so a colour's pairs can be solved at the same time,
and in whatever order they are, the result is the same. Sweeps over all pairs go colour by colour. For shock propagation
and push-out, which go from level to level, pairs are sorted by level, that of the upper body, and coloured within each:
one level and one colour make a group.

Pairs bid for colours (Jones and Plassmann 1993): in a round, the pair of highest priority at both its bodies takes the
lowest colour free at both. The priority is a scrambled index, so that rows of pairs are not coloured one by one. What
finds all colours taken, as on a tray that carries many, is solved one after another.
"""

import warp as wp

from warp_rigid.kernels.data import COLORS, Bodies, Graph, Order, PairRecord, Pairs
from warp_rigid.kernels.impulses import IN_TURN
from warp_rigid.kernels.support import DYNAMIC, touches
from warp_rigid.kernels.team import Team, any_of_team, lowest_bit, meet, team_of

wp.set_module_options({"enable_backward": False})

MOST_COLORS = wp.constant(COLORS)

ALL_TAKEN = wp.constant(wp.uint32((1 << (COLORS - 1)) - 1))
"""Mask of a body at which every colour but the last is taken."""

UNCOLORED = wp.constant(-1)

GOLDEN = wp.constant(wp.uint32(2654435769))
"""2^32 divided by the golden ratio, odd: multiplying by it scrambles and keeps different what is different."""

NO_BID = wp.constant(-2147483648)


@wp.func
def priority(index: int):
    """A number for an index within an environment, different for different ones (Fibonacci hashing)."""
    return int(wp.uint32(index) * GOLDEN)


@wp.func
def side_of(body: int, pair: int, graph: Graph):
    """0 for a body in the pair's own level, 1 for one below it. Pairs on different sides of a body never meet."""
    return wp.where(graph.level[body] < graph.pair_level[pair], 1, 0)


@wp.func
def place_bid(pair: int, begin: int, bodies: Bodies, pairs: Pairs, graph: Graph):
    """Bid for a colour at both bodies, or give up where all colours of a body are taken."""
    a = pairs.body_a[pair]
    b = pairs.body_b[pair]
    side_a = side_of(a, pair, graph)
    side_b = side_of(b, pair, graph)
    dynamic_a = bodies.motion[a] == DYNAMIC
    dynamic_b = bodies.motion[b] == DYNAMIC
    if (dynamic_a and graph.colors[a, side_a] == ALL_TAKEN) or (dynamic_b and graph.colors[b, side_b] == ALL_TAKEN):
        graph.pair_color[pair] = IN_TURN
        return
    if dynamic_a:
        wp.atomic_max(graph.bid, a, side_a, priority(pair - begin))
    if dynamic_b:
        wp.atomic_max(graph.bid, b, side_b, priority(pair - begin))


@wp.func
def take_color(pair: int, begin: int, bodies: Bodies, pairs: Pairs, graph: Graph):
    """Take the lowest colour that is free at both bodies if no other bid was higher."""
    a = pairs.body_a[pair]
    b = pairs.body_b[pair]
    side_a = side_of(a, pair, graph)
    side_b = side_of(b, pair, graph)
    own = priority(pair - begin)
    dynamic_a = bodies.motion[a] == DYNAMIC
    dynamic_b = bodies.motion[b] == DYNAMIC
    if (dynamic_a and graph.bid[a, side_a] != own) or (dynamic_b and graph.bid[b, side_b] != own):
        return
    taken = wp.uint32(0)
    if dynamic_a:
        taken = taken | graph.colors[a, side_a]
    if dynamic_b:
        taken = taken | graph.colors[b, side_b]
    color = lowest_bit(~taken)
    graph.pair_color[pair] = color
    if color == IN_TURN:
        return
    bit = wp.uint32(1) << wp.uint32(color)
    if dynamic_a:
        graph.colors[a, side_a] = graph.colors[a, side_a] | bit
    if dynamic_b:
        graph.colors[b, side_b] = graph.colors[b, side_b] | bit


@wp.kernel
def color_pairs(layered: int, lanes: int, bodies_per_env: int, bodies: Bodies, pairs: Pairs, graph: Graph):
    """A team an environment: give each touching pair a colour that no other pair of its dynamic bodies has.

    If the order is layered, no other pair of the same level; otherwise all pairs count to level 0.
    """
    team = team_of(wp.tid(), lanes, graph.gate)
    env = team.env
    first = env * bodies_per_env
    begin = pairs.start[first]
    end = pairs.start[first + bodies_per_env]
    for b in range(first + team.lane, first + bodies_per_env, lanes):
        for side in range(2):
            graph.colors[b, side] = wp.uint32(0)
            graph.bid[b, side] = NO_BID
    for pair in range(begin + team.lane, end, lanes):
        graph.pair_color[pair] = UNCOLORED
        upper = wp.max(graph.level[pairs.body_a[pair]], graph.level[pairs.body_b[pair]])
        graph.pair_level[pair] = layered * upper
    left = int(1)
    while left == 1:
        meet(team)
        for pair in range(begin + team.lane, end, lanes):
            if touches(pair, pairs) and graph.pair_color[pair] == UNCOLORED:
                place_bid(pair, begin, bodies, pairs, graph)
        meet(team)
        for pair in range(begin + team.lane, end, lanes):
            if touches(pair, pairs) and graph.pair_color[pair] == UNCOLORED:
                take_color(pair, begin, bodies, pairs, graph)
        meet(team)
        for b in range(first + team.lane, first + bodies_per_env, lanes):
            graph.bid[b, 0] = NO_BID
            graph.bid[b, 1] = NO_BID
        left = int(0)
        for pair in range(begin + team.lane, end, lanes):
            if touches(pair, pairs) and graph.pair_color[pair] == UNCOLORED:
                left = 1
        left = any_of_team(left, team)


@wp.func
def count_groups(row: int, graph: Graph, order: Order):
    """How many groups and how many pairs a level has."""
    groups = int(0)
    count = int(0)
    for color in range(MOST_COLORS):
        if graph.tally[row, color] > 0:
            groups += 1
            count += graph.tally[row, color]
    order.level_start[row] = groups
    graph.level_pairs[row] = count


@wp.func
def add_levels(env: int, rows: int, begin: int, graph: Graph, order: Order):
    """One lane: where each level's groups and pairs begin."""
    group = begin + env
    at = int(begin)
    for row in range(rows, rows + order.level_count[env] + 1):
        groups = order.level_start[row]
        count = graph.level_pairs[row]
        order.level_start[row] = group
        graph.level_pairs[row] = at
        group += groups
        at += count
    order.level_start[rows + order.level_count[env] + 1] = group
    order.group_start[group] = at


@wp.func
def list_groups(row: int, graph: Graph, order: Order):
    """Turn a level's tally of pairs by colour into its groups and where each begins."""
    group = order.level_start[row]
    at = graph.level_pairs[row]
    for color in range(MOST_COLORS):
        count = graph.tally[row, color]
        if count > 0:
            graph.tally[row, color] = at
            order.group_start[group] = at
            order.group_color[group] = color
            group += 1
            at += count


@wp.func
def write_in_order(pair: int, rows: int, pairs: Pairs, graph: Graph, order: Order):
    """Give a pair the next place of its group."""
    entry = PairRecord()
    entry.pair = pair
    entry.body_a = pairs.body_a[pair]
    entry.body_b = pairs.body_b[pair]
    entry.begin = pairs.contact_start[pair]
    entry.end = pairs.contact_start[pair + 1]
    entry.upper_a = 1 - side_of(entry.body_a, pair, graph)
    entry.upper_b = 1 - side_of(entry.body_b, pair, graph)
    slot = wp.atomic_add(graph.tally, rows + graph.pair_level[pair], graph.pair_color[pair], 1)
    order.entries[slot] = entry


@wp.func
def tally_pairs(team: Team, begin: int, end: int, rows: int, pairs: Pairs, graph: Graph, order: Order):
    """Count the levels, and the touching pairs of each level and colour. Returns 1 if any is to be solved in turn."""
    if team.lane == 0:
        order.level_count[team.env] = 0
    meet(team)
    for pair in range(begin + team.lane, end, team.lanes):
        if touches(pair, pairs):
            wp.atomic_max(order.level_count, team.env, graph.pair_level[pair])
    meet(team)
    for level in range(team.lane, order.level_count[team.env] + 1, team.lanes):
        for color in range(MOST_COLORS):
            graph.tally[rows + level, color] = 0
    meet(team)
    in_turn = int(0)
    for pair in range(begin + team.lane, end, team.lanes):
        if touches(pair, pairs):
            wp.atomic_add(graph.tally, rows + graph.pair_level[pair], graph.pair_color[pair], 1)
            in_turn |= wp.where(graph.pair_color[pair] == IN_TURN, 1, 0)
    return any_of_team(in_turn, team)


@wp.kernel
def group_pairs(lanes: int, bodies_per_env: int, pairs: Pairs, graph: Graph, order: Order):
    """A team an environment: sort the touching pairs by level and colour. Within a group their order is free."""
    team = team_of(wp.tid(), lanes, graph.gate)
    rows = team.env * (bodies_per_env + 2)
    begin = pairs.start[team.env * bodies_per_env]
    end = pairs.start[(team.env + 1) * bodies_per_env]
    in_turn = tally_pairs(team, begin, end, rows, pairs, graph, order)
    for row in range(rows + team.lane, rows + order.level_count[team.env] + 1, lanes):
        count_groups(row, graph, order)
    meet(team)
    if team.lane == 0:
        add_levels(team.env, rows, begin, graph, order)
    meet(team)
    for row in range(rows + team.lane, rows + order.level_count[team.env] + 1, lanes):
        list_groups(row, graph, order)
    meet(team)
    for pair in range(begin + team.lane, end, lanes):
        if touches(pair, pairs) and graph.pair_color[pair] != IN_TURN:
            write_in_order(pair, rows, pairs, graph, order)
    if in_turn == 1 and team.lane == 0:
        for pair in range(begin, end):
            if touches(pair, pairs) and graph.pair_color[pair] == IN_TURN:
                write_in_order(pair, rows, pairs, graph, order)
