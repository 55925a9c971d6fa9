"""Shock propagation: weight travels through a stack in two passes instead of many sweeps.

*Up*, from the lowest level: a level's contacts are iterated with the lower bodies frozen (infinitely heavy) until
nothing changes; what the frozen bodies did not take is kept as `reaction`. With `one_pass`, the method of 2003
(section 8.2), that is all: loads are never felt below. *Down*, from the highest level (after Xiong, Leach, Thomas and
Sueda 2025): each level is iterated once more in the same way, then its lower bodies receive the reactions, so that
the level below sees the load.

What comes out is only a search direction: `line_search` decides how far to go in it.
"""

import warp as wp

from warp_rigid.kernels.data import SHOCK_OFF, SHOCK_TWO_PASS, Contacts, Environments, Graph, Motions, Order
from warp_rigid.kernels.impulses import (
    first_of_group,
    put_down,
    stride_of_group,
    take_up,
    visit_pair,
    with_impulse,
    with_twist,
)
from warp_rigid.kernels.packed import REACTION, TWIST_REACTION, carried, carry, contact_row, entry_at
from warp_rigid.kernels.team import Team, any_of_team, meet, team_of

wp.set_module_options({"enable_backward": False})

OFF = wp.constant(SHOCK_OFF)
TWO_PASS = wp.constant(SHOCK_TWO_PASS)

LAYER_ITERATIONS = wp.constant(20)
"""Most iterations of one level in one pass. With fewer, or with several rounds over a pair in each, stacks creep."""


@wp.func
def solve_level(level: int, team: Team, bodies_per_env: int, order: Order, motions: Motions, contacts: Contacts):
    """Iterate one level with its lower bodies frozen until no visit changes anything."""
    row = team.env * (bodies_per_env + 2) + level
    left = int(LAYER_ITERATIONS)
    while left > 0:
        changed = int(0)
        for group in range(order.level_start[row], order.level_start[row + 1]):
            stride = stride_of_group(group, team, order)
            for k in range(first_of_group(group, team, order), order.group_start[group + 1], stride):
                entry = entry_at(k, order.entries)
                share_a = float(entry.upper_a)
                changed |= visit_pair(entry, share_a, float(entry.upper_b), motions, contacts)
            meet(team)
        left = any_of_team(changed, team) * (left - 1)


@wp.func
def hand_down(level: int, team: Team, bodies_per_env: int, order: Order, motions: Motions, contacts: Contacts):
    """Give the frozen bodies of a level the reactions that they did not take."""
    row = team.env * (bodies_per_env + 2) + level
    for group in range(order.level_start[row], order.level_start[row + 1]):
        stride = stride_of_group(group, team, order)
        for k in range(first_of_group(group, team, order), order.group_start[group + 1], stride):
            entry = entry_at(k, order.entries)
            lower_a = float(1 - entry.upper_a)
            couple = take_up(entry.body_a, entry.body_b, lower_a, float(1 - entry.upper_b), motions)
            for c in range(entry.begin, entry.end):
                couple = with_impulse(contact_row(c, contacts), carried(c, REACTION, contacts), couple)
                couple = with_twist(carried(c, TWIST_REACTION, contacts), couple)
                carry(c, REACTION, wp.vec3(0.0, 0.0, 0.0), contacts)
                carry(c, TWIST_REACTION, wp.vec3(0.0, 0.0, 0.0), contacts)
            put_down(entry.body_a, entry.body_b, couple, motions)
        meet(team)


@wp.kernel
def propagate(
    repetition: int,
    lanes: int,
    bodies_per_env: int,
    envs: Environments,
    order: Order,
    graph: Graph,
    motions: Motions,
    contacts: Contacts,
):
    """A team an environment: the pass up, and with two_pass the pass down."""
    team = team_of(wp.tid(), lanes, graph.gate)
    env = team.env
    mode = envs.shock_propagation[env]
    if mode == OFF or repetition >= envs.shock_iterations[env] or graph.settled[env] == 1:
        return
    levels = order.level_count[env]
    passes = wp.where(mode == TWO_PASS, 2, 1)
    for k in range(passes * levels):
        level = wp.where(k < levels, k + 1, 2 * levels - k)
        solve_level(level, team, bodies_per_env, order, motions, contacts)
        if k >= levels:
            hand_down(level, team, bodies_per_env, order, motions, contacts)
