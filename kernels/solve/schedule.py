"""The order in which a team visits the constraints of its environment, colour by colour.

The lanes share the constraints of a colour, which have no dynamic body in common, and synchronize before the next one.
Turns number the visits of colours, so that a constraint is skipped while neither of its bodies has changed since it was
solved.
"""

import warp as wp

from warp_rigid.kernels.common.solver_body import inverse_mass_of, read_entry
from warp_rigid.kernels.common.team import Team
from warp_rigid.kernels.graph.coloring import SERIAL
from warp_rigid.kernels.schema import Graph, Motions, Order, OrderRecord

wp.set_module_options({"enable_backward": False})

CONVERGED = wp.constant(1.0e-6)
"""Constraints are solved when no row changes a velocity by more than this [m/s]."""


@wp.func
def entry_at(k: int, order: Order):
    """An active constraint, by its place in the order of solving."""
    return read_entry(k, order.entries)


@wp.func
def first_of_color(color: int, team: Team, order: Order):
    """Where in the order a lane begins with a colour. Constraints solved one after another are the first lane's."""
    if color == SERIAL and team.lane > 0:
        return order.color_start[team.env, color + 1]
    return order.color_start[team.env, color] + team.lane


@wp.func
def stride_of_color(color: int, team: Team):
    """How far a lane goes from one constraint of a colour to its next."""
    return wp.where(color == SERIAL, 1, team.lanes)


@wp.func
def first_entry(team: Team, order: Order):
    """A lane's first constraint of all."""
    return order.color_start[team.env, 0] + team.lane


@wp.func
def end_of_entries(env: int, order: Order):
    """One past the last constraint of an environment."""
    return order.color_start[env, order.color_count[env]]


@wp.func
def forget_visits(first: int, last: int, team: Team, order: Order, graph: Graph):
    """Start counting turns: all bodies, from `first` to before `last`, have changed, no constraint was visited."""
    for b in range(first + team.lane, last, team.lanes):
        graph.changed[b] = 1
    for k in range(first_entry(team, order), end_of_entries(team.env, order), team.lanes):
        order.entries[k].visited = 0


@wp.func
def is_done(entry: OrderRecord, graph: Graph):
    """Whether a constraint was solved after its bodies last changed."""
    return entry.visited >= wp.max(graph.changed[entry.body_a], graph.changed[entry.body_b])


@wp.func
def solved_turn(color: int, turn: int):
    """The turn to note in a constraint that is solved now; of those solved serially, the next may undo it."""
    return wp.where(color == SERIAL, turn - 1, turn)


@wp.func
def note_change(b: int, turn: int, motions: Motions, graph: Graph):
    """Note the turn in which a dynamic body's velocity changed."""
    if inverse_mass_of(b, motions) > 0.0:
        graph.changed[b] = turn
