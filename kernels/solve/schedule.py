"""The order in which a team solves the constraints of its environment, colour by colour.

The lanes share the constraints of a colour, which have no dynamic body in common, and synchronize before the next
colour. Visits of colours are numbered (stamps), so that a constraint is skipped if neither of its bodies has changed
since it was last solved.
"""

from enum import IntEnum

import warp as wp

from warp_rigid.kernels.common.solver_body import inverse_mass_of, read_entry
from warp_rigid.kernels.common.team import Team
from warp_rigid.kernels.graph.coloring import Color
from warp_rigid.kernels.schema import Graph, Motions, Order, OrderRecord

wp.set_module_options({"enable_backward": False})


class Visited(IntEnum):
    """Values of `OrderRecord.visited` that are not the number of a visit."""

    WAITING = -1
    """No place in the order of visits yet."""
    NONE = 0
    SKIPPED = 2**30
    """Later than all visits."""
    BOUNCING = 2**30 + 1
    """Of a pair with restitution; one more if it belongs to the present group."""


@wp.func
def entry_at(k: int, order: Order):
    """An active constraint, by its index in the solving order."""
    return read_entry(k, order.entries)


@wp.func
def first_of_color(color: int, team: Team, order: Order):
    """A lane's first entry of a colour. Constraints that are solved serially belong to the first lane."""
    if color == Color.SERIAL and team.lane > 0:
        return order.color_start[team.env, color + 1]
    return order.color_start[team.env, color] + team.lane


@wp.func
def stride_of_color(color: int, team: Team):
    """Index increment from one constraint of a lane to its next one in a colour."""
    return wp.where(color == Color.SERIAL, 1, team.lanes)


@wp.func
def first_entry(team: Team, order: Order):
    """A lane's first entry, over all colours."""
    return order.color_start[team.env, 0] + team.lane


@wp.func
def end_of_entries(env: int, order: Order):
    """One past the last entry of an environment."""
    return order.color_start[env, order.color_count[env]]


@wp.func
def forget_visits(first: int, last: int, team: Team, order: Order, graph: Graph):
    """Reset the stamps: mark all bodies from `first` to `last` - 1 as changed, and all constraints as not visited."""
    for b in range(first + team.lane, last, team.lanes):
        graph.changed[b] = 1
    for k in range(first_entry(team, order), end_of_entries(team.env, order), team.lanes):
        order.entries[k].visited = 0


@wp.func
def is_done(entry: OrderRecord, graph: Graph):
    """Whether a constraint was solved after its bodies last changed."""
    return entry.visited >= wp.max(graph.changed[entry.body_a], graph.changed[entry.body_b])


@wp.func
def solved_stamp(color: int, stamp: int):
    """Stamp to record for a constraint solved now; a serial one counts as older, as later ones may share its bodies."""
    return wp.where(color == Color.SERIAL, stamp - 1, stamp)


@wp.func
def note_change(b: int, stamp: int, motions: Motions, graph: Graph):
    """Record the stamp in which a dynamic body's velocity changed."""
    if inverse_mass_of(b, motions) > 0.0:
        graph.changed[b] = stamp
