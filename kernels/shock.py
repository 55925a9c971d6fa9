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
from warp_rigid.kernels.impulses import meet, push, twist_both, visit_contact

wp.set_module_options({"enable_backward": False})

OFF = wp.constant(SHOCK_OFF)
TWO_PASS = wp.constant(SHOCK_TWO_PASS)

LAYER_ITERATIONS = wp.constant(20)
"""Most iterations of one level in one pass."""

SETTLED = wp.constant(1.0e-6)
"""A level is solved when no visit changes a velocity by more than this [m/s]."""


@wp.func
def solve_level(
    env: int,
    lane: int,
    level: int,
    bodies_per_env: int,
    bodies: Bodies,
    motions: Motions,
    graph: Graph,
    pairs: Pairs,
    contacts: Contacts,
    state: State,
):
    """Iterate one level with its lower bodies frozen until no visit changes anything."""
    row = env * (bodies_per_env + 2) + level
    for iteration in range(LAYER_ITERATIONS):
        if lane == 0:
            graph.residual[env, (iteration + 1) % 3] = 0.0
            if iteration == 0:
                graph.residual[env, 0] = 0.0
        meet()
        largest = float(0.0)
        for group in range(graph.level_start[row], graph.level_start[row + 1]):
            for k in range(graph.group_start[group] + lane, graph.group_start[group + 1], wp.block_dim()):
                pair = graph.order[k]
                share_a = wp.where(graph.level[pairs.body_a[pair]] == level, 1.0, 0.0)
                share_b = wp.where(graph.level[pairs.body_b[pair]] == level, 1.0, 0.0)
                for c in range(pairs.contact_start[pair], pairs.contact_start[pair + 1]):
                    change = visit_contact(c, share_a, share_b, bodies, motions, contacts, state)
                    largest = wp.max(largest, change)
            meet()
        wp.atomic_max(graph.residual, env, iteration % 3, largest)
        meet()
        if graph.residual[env, iteration % 3] < SETTLED:
            return


@wp.func
def hand_down(
    env: int,
    lane: int,
    level: int,
    bodies_per_env: int,
    bodies: Bodies,
    motions: Motions,
    graph: Graph,
    pairs: Pairs,
    contacts: Contacts,
    state: State,
):
    """Give the frozen bodies of a level the reactions that they did not take."""
    row = env * (bodies_per_env + 2) + level
    for group in range(graph.level_start[row], graph.level_start[row + 1]):
        for k in range(graph.group_start[group] + lane, graph.group_start[group + 1], wp.block_dim()):
            pair = graph.order[k]
            for c in range(pairs.contact_start[pair], pairs.contact_start[pair + 1]):
                if graph.level[pairs.body_a[pair]] < level:
                    push(pairs.body_a[pair], contacts.arm_a[c], contacts.reaction[c], bodies, motions, state)
                    twist_both(c, contacts.twist_reaction[c], 1.0, 0.0, motions, contacts, state)
                elif graph.level[pairs.body_b[pair]] < level:
                    push(pairs.body_b[pair], contacts.arm_b[c], -contacts.reaction[c], bodies, motions, state)
                    twist_both(c, contacts.twist_reaction[c], 0.0, 1.0, motions, contacts, state)
                contacts.reaction[c] = wp.vec3(0.0, 0.0, 0.0)
                contacts.twist_reaction[c] = wp.vec3(0.0, 0.0, 0.0)
        meet()


@wp.kernel
def propagate(
    repetition: int,
    bodies_per_env: int,
    bodies: Bodies,
    motions: Motions,
    envs: Environments,
    graph: Graph,
    pairs: Pairs,
    contacts: Contacts,
    state: State,
):
    """One block an environment: the pass up, and with two_pass the pass down."""
    env, lane = wp.tid()
    mode = envs.shock_propagation[env]
    if mode == OFF or repetition >= envs.shock_iterations[env]:
        return
    levels = graph.level_count[env]
    for level in range(1, levels + 1):
        solve_level(env, lane, level, bodies_per_env, bodies, motions, graph, pairs, contacts, state)
    if mode == TWO_PASS:
        for up in range(levels):
            level = levels - up
            solve_level(env, lane, level, bodies_per_env, bodies, motions, graph, pairs, contacts, state)
            hand_down(env, lane, level, bodies_per_env, bodies, motions, graph, pairs, contacts, state)
