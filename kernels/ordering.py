"""Sixth stage: the order in which touching pairs are solved.

Pairs are sorted by level, the level of the upper body, so that a sweep runs from the ground up. Within a level they
are coloured: no two pairs of a colour share a dynamic body, so a colour's pairs can be solved at the same time, and
in whatever order they are, the result is the same. One level and one colour make a group.

One thread does an environment; the greedy colouring goes by the order of the pairs.
"""

import warp as wp

from warp_rigid.kernels.data import Bodies, Graph, Pairs
from warp_rigid.kernels.support import DYNAMIC, touches

wp.set_module_options({"enable_backward": False})

MOST_COLORS = wp.constant(30)
"""Colours kept apart in a bit mask; a pair that finds none free makes a group of its own."""


@wp.kernel
def sort_by_level(bodies_per_env: int, bodies: Bodies, pairs: Pairs, graph: Graph):
    """One thread an environment: touching pairs in the order of their level (counting sort)."""
    env = wp.tid()
    first = env * bodies_per_env
    rows = bodies_per_env + 2
    begin = pairs.start[first]
    end = pairs.start[first + bodies_per_env]
    for level in range(rows):
        graph.level_start[env * rows + level] = 0
    highest = int(0)
    for pair in range(begin, end):
        level = int(-1)
        if touches(pair, pairs):
            level = wp.max(graph.level[pairs.body_a[pair]], graph.level[pairs.body_b[pair]])
            highest = wp.max(highest, level)
            graph.level_start[env * rows + level + 1] = graph.level_start[env * rows + level + 1] + 1
        graph.pair_level[pair] = level
    graph.level_count[env] = highest
    at = begin
    for level in range(rows):
        at += graph.level_start[env * rows + level]
        graph.level_start[env * rows + level] = at
    for pair in range(begin, end):
        if graph.pair_level[pair] >= 0:
            slot = env * rows + graph.pair_level[pair]
            graph.order[graph.level_start[slot]] = pair
            graph.level_start[slot] = graph.level_start[slot] + 1
    for back in range(rows - 1):
        level = rows - 1 - back
        graph.level_start[env * rows + level] = graph.level_start[env * rows + level - 1]
    graph.level_start[env * rows] = begin


@wp.func
def color_level(begin: int, end: int, bodies: Bodies, pairs: Pairs, graph: Graph):
    """Give each pair of a level the first colour that is free at both bodies. Returns how many colours are in use."""
    for k in range(begin, end):
        graph.colors[pairs.body_a[graph.order[k]]] = 0
        graph.colors[pairs.body_b[graph.order[k]]] = 0
    used = int(0)
    for k in range(begin, end):
        pair = graph.order[k]
        a = pairs.body_a[pair]
        b = pairs.body_b[pair]
        taken = int(0)
        if bodies.motion[a] == DYNAMIC:
            taken = taken | graph.colors[a]
        if bodies.motion[b] == DYNAMIC:
            taken = taken | graph.colors[b]
        color = int(0)
        while color < MOST_COLORS and (taken & (1 << color)) != 0:
            color += 1
        if color == MOST_COLORS:
            color = wp.max(used, MOST_COLORS)
        else:
            graph.colors[a] = graph.colors[a] | (1 << color)
            graph.colors[b] = graph.colors[b] | (1 << color)
        graph.pair_color[pair] = color
        used = wp.max(used, color + 1)
    return used


@wp.kernel
def group_by_color(bodies_per_env: int, bodies: Bodies, pairs: Pairs, graph: Graph, scratch: wp.array[int]):
    """One thread an environment: colour each level, sort it by colour, and list the groups."""
    env = wp.tid()
    first = env * bodies_per_env
    rows = bodies_per_env + 2
    group = pairs.start[first] + env
    for level in range(graph.level_count[env] + 1):
        begin = graph.level_start[env * rows + level]
        end = graph.level_start[env * rows + level + 1]
        used = color_level(begin, end, bodies, pairs, graph)
        at = begin
        graph.level_start[env * rows + level] = group
        for color in range(used):
            here = at
            for k in range(begin, end):
                if graph.pair_color[graph.order[k]] == color:
                    scratch[at] = graph.order[k]
                    at += 1
            if at > here:
                graph.group_start[group] = here
                group += 1
        for k in range(begin, end):
            graph.order[k] = scratch[k]
    graph.group_start[group] = graph.level_start[env * rows + graph.level_count[env] + 1]
    graph.level_start[env * rows + graph.level_count[env] + 1] = group
