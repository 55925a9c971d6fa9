"""The list of constraints of a step: the two bodies and the contacts of each pair. One without contacts is not active.

Graph, colours, islands and the solver read this list.
"""

import warp as wp

from warp_rigid.kernels.schema import Constraints, Graph, Pairs

wp.set_module_options({"enable_backward": False})


@wp.func
def is_active(k: int, constraints: Constraints):
    """Whether a constraint has rows in this step."""
    return constraints.row_count[k] > 0


@wp.func
def list_constraint(pair: int, pairs: Pairs, constraints: Constraints):
    """Store the contact constraint of a pair."""
    constraints.body_a[pair] = pairs.body_a[pair]
    constraints.body_b[pair] = pairs.body_b[pair]
    constraints.first_row[pair] = pairs.contact_start[pair]
    constraints.row_count[pair] = pairs.contact_start[pair + 1] - pairs.contact_start[pair]
    constraints.last[pair] = pairs.last[pair]


@wp.func
def store_constraint(k: int, constraints: Constraints, graph: Graph):
    """Store the number of rows, supports, colour and start index of constraints, for comparison in the next step."""
    last = constraints.start.shape[0] - 1
    if k < constraints.start[last]:
        constraints.row_count_before[k] = constraints.row_count[k]
        graph.supports_before[k] = graph.supports[k]
        graph.color_before[k] = graph.color[k]
    if k <= last:
        constraints.start_before[k] = constraints.start[k]
