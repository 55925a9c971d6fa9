"""Sixth stage: the order in which touching pairs are solved.

Pairs are sorted by level, the level of the upper body, so that a sweep runs from the ground up, and they are coloured:
no two pairs of a colour share a dynamic body, so a colour's pairs can be solved at the same time, and in whatever order
they are, the result is the same. One level and one colour make a group.

Pairs bid for colours (Jones and Plassmann 1993): in a round, the pair of highest priority at both its bodies takes the
lowest colour free at both. The priority is a scrambled index, so that rows of pairs are not coloured one by one. What
finds all colours taken, as on a tray that carries many, is solved one after another.
"""

import warp as wp

from warp_rigid.kernels.data import COLORS, Bodies, Graph, Pairs
from warp_rigid.kernels.impulses import IN_TURN
from warp_rigid.kernels.support import DYNAMIC, touches
from warp_rigid.kernels.team import any_of_team, lowest_bit, meet

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
def place_bid(pair: int, begin: int, bodies: Bodies, pairs: Pairs, graph: Graph):
    """Bid for a colour at both bodies, or give up where all colours of a body are taken."""
    a = pairs.body_a[pair]
    b = pairs.body_b[pair]
    dynamic_a = bodies.motion[a] == DYNAMIC
    dynamic_b = bodies.motion[b] == DYNAMIC
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
    dynamic_a = bodies.motion[a] == DYNAMIC
    dynamic_b = bodies.motion[b] == DYNAMIC
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
    env = wp.tid() / lanes
    lane = wp.tid() % lanes
    first = env * bodies_per_env
    begin = pairs.start[first]
    end = pairs.start[first + bodies_per_env]
    for b in range(first + lane, first + bodies_per_env, lanes):
        graph.colors[b] = wp.uint32(0)
        graph.bid[b] = NO_BID
    for pair in range(begin + lane, end, lanes):
        graph.pair_color[pair] = UNCOLORED
    left = int(1)
    while left == 1:
        meet(lanes)
        for pair in range(begin + lane, end, lanes):
            if touches(pair, pairs) and graph.pair_color[pair] == UNCOLORED:
                place_bid(pair, begin, bodies, pairs, graph)
        meet(lanes)
        for pair in range(begin + lane, end, lanes):
            if touches(pair, pairs) and graph.pair_color[pair] == UNCOLORED:
                take_color(pair, begin, bodies, pairs, graph)
        meet(lanes)
        for b in range(first + lane, first + bodies_per_env, lanes):
            graph.bid[b] = NO_BID
        left = int(0)
        for pair in range(begin + lane, end, lanes):
            if touches(pair, pairs) and graph.pair_color[pair] == UNCOLORED:
                left = 1
        left = any_of_team(left, lanes)


@wp.func
def list_groups(env: int, rows: int, begin: int, graph: Graph):
    """One lane: turn the tally of pairs by level and colour into the groups and where each begins."""
    group = begin + env
    at = int(begin)
    for level in range(graph.level_count[env] + 1):
        graph.level_start[rows + level] = group
        for color in range(MOST_COLORS):
            count = graph.tally[rows + level, color]
            if count > 0:
                graph.tally[rows + level, color] = at
                graph.group_start[group] = at
                graph.group_color[group] = color
                group += 1
                at += count
    graph.level_start[rows + graph.level_count[env] + 1] = group
    graph.group_start[group] = at


@wp.kernel
def group_pairs(lanes: int, bodies_per_env: int, pairs: Pairs, graph: Graph):
    """A team an environment: sort the touching pairs by level and colour. Within a group their order is free."""
    env = wp.tid() / lanes
    lane = wp.tid() % lanes
    first = env * bodies_per_env
    rows = env * (bodies_per_env + 2)
    begin = pairs.start[first]
    end = pairs.start[first + bodies_per_env]
    if lane == 0:
        graph.level_count[env] = 0
    meet(lanes)
    for pair in range(begin + lane, end, lanes):
        level = wp.max(graph.level[pairs.body_a[pair]], graph.level[pairs.body_b[pair]])
        graph.pair_level[pair] = level
        if touches(pair, pairs):
            wp.atomic_max(graph.level_count, env, level)
    meet(lanes)
    for level in range(lane, graph.level_count[env] + 1, lanes):
        for color in range(MOST_COLORS):
            graph.tally[rows + level, color] = 0
    meet(lanes)
    for pair in range(begin + lane, end, lanes):
        if touches(pair, pairs):
            wp.atomic_add(graph.tally, rows + graph.pair_level[pair], graph.pair_color[pair], 1)
    meet(lanes)
    if lane == 0:
        list_groups(env, rows, begin, graph)
    meet(lanes)
    for pair in range(begin + lane, end, lanes):
        if touches(pair, pairs) and graph.pair_color[pair] != IN_TURN:
            slot = wp.atomic_add(graph.tally, rows + graph.pair_level[pair], graph.pair_color[pair], 1)
            graph.order[slot] = pair
    if lane == 0:
        for pair in range(begin, end):
            if touches(pair, pairs) and graph.pair_color[pair] == IN_TURN:
                slot = wp.atomic_add(graph.tally, rows + graph.pair_level[pair], IN_TURN, 1)
                graph.order[slot] = pair
