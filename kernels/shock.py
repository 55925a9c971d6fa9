"""Shock propagation: weight travels through a stack in two passes instead of many sweeps.

*Up*, from the lowest level: a level's contacts are iterated with the lower bodies frozen (infinitely heavy) until
nothing changes; what the frozen bodies did not take is kept as `reaction`. With `one_pass`, the method of 2003
(section 8.2), that is all: loads are never felt below. *Down*, from the highest level (after Xiong, Leach, Thomas and
Sueda 2025): each level is iterated once more in the same way, then its lower bodies receive the reactions, so that
the level below sees the load.

What comes out is only a search direction: `line_search` decides how far to go in it.
"""

import warp as wp

from warp_rigid.kernels.data import (
    SHOCK_OFF,
    SHOCK_TWO_PASS,
    Bodies,
    Contacts,
    Environments,
    Graph,
    Motions,
    Pairs,
    State,
)
from warp_rigid.kernels.impulses import (
    first_of_group,
    put_down,
    stride_of_group,
    take_up,
    visit_pair,
    with_impulse,
    with_twist,
)
from warp_rigid.kernels.team import any_of_team, meet

wp.set_module_options({"enable_backward": False})

OFF = wp.constant(SHOCK_OFF)
TWO_PASS = wp.constant(SHOCK_TWO_PASS)

LAYER_ITERATIONS = wp.constant(20)
"""Most iterations of one level in one pass."""


@wp.func
def solve_level(
    level: int,
    env: int,
    lane: int,
    lanes: int,
    bodies_per_env: int,
    bodies: Bodies,
    motions: Motions,
    graph: Graph,
    contacts: Contacts,
    state: State,
):
    """Iterate one level with its lower bodies frozen until no visit changes anything."""
    row = env * (bodies_per_env + 2) + level
    left = int(LAYER_ITERATIONS)
    while left > 0:
        changed = int(0)
        for group in range(graph.level_start[row], graph.level_start[row + 1]):
            stride = stride_of_group(group, lanes, graph)
            for k in range(first_of_group(group, lane, graph), graph.group_start[group + 1], stride):
                entry = graph.order[k]
                share_a = float(entry.upper_a)
                changed |= visit_pair(entry, share_a, float(entry.upper_b), bodies, motions, contacts, state)
            meet(lanes)
        left = any_of_team(changed, lanes) * (left - 1)


@wp.func
def hand_down(
    level: int,
    env: int,
    lane: int,
    lanes: int,
    bodies_per_env: int,
    bodies: Bodies,
    motions: Motions,
    graph: Graph,
    contacts: Contacts,
    state: State,
):
    """Give the frozen bodies of a level the reactions that they did not take."""
    row = env * (bodies_per_env + 2) + level
    for group in range(graph.level_start[row], graph.level_start[row + 1]):
        stride = stride_of_group(group, lanes, graph)
        for k in range(first_of_group(group, lane, graph), graph.group_start[group + 1], stride):
            entry = graph.order[k]
            lower_a = float(1 - entry.upper_a)
            couple = take_up(entry.body_a, entry.body_b, lower_a, float(1 - entry.upper_b), bodies, motions, state)
            for c in range(entry.begin, entry.end):
                couple = with_impulse(contacts.rows[c], contacts.loads[c].reaction, couple)
                couple = with_twist(contacts.loads[c].twist_reaction, couple)
                contacts.loads[c].reaction = wp.vec3(0.0, 0.0, 0.0)
                contacts.loads[c].twist_reaction = wp.vec3(0.0, 0.0, 0.0)
            put_down(entry.body_a, entry.body_b, couple, state)
        meet(lanes)


@wp.kernel
def propagate(
    repetition: int,
    lanes: int,
    bodies_per_env: int,
    bodies: Bodies,
    motions: Motions,
    envs: Environments,
    graph: Graph,
    pairs: Pairs,
    contacts: Contacts,
    state: State,
):
    """A team an environment: the pass up, and with two_pass the pass down."""
    env = wp.tid() / lanes
    lane = wp.tid() % lanes
    mode = envs.shock_propagation[env]
    if mode == OFF or repetition >= envs.shock_iterations[env] or graph.settled[env] == 1:
        return
    levels = graph.level_count[env]
    passes = wp.where(mode == TWO_PASS, 2, 1)
    for k in range(passes * levels):
        level = wp.where(k < levels, k + 1, 2 * levels - k)
        solve_level(level, env, lane, lanes, bodies_per_env, bodies, motions, graph, contacts, state)
        if k >= levels:
            hand_down(level, env, lane, lanes, bodies_per_env, bodies, motions, graph, contacts, state)
