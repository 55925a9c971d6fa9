"""The list of constraints of a step: the two bodies and the contacts of each pair. One without contacts is not active.

Graph, colours, islands and the solver read this list.
"""

import warp as wp

from warp_rigid.kernels.schema import Constraints, Environments, Graph, Pairs

wp.set_module_options({"enable_backward": False})


@wp.func
def is_active(k: int, constraints: Constraints):
    """Whether a constraint has rows in this step."""
    return constraints.row_count[k] > 0


@wp.kernel
def list_pairs(threads: int, envs: Environments, pairs: Pairs, constraints: Constraints):
    """The threads share the pairs and the environments: first constraints of environments, and contact constraints."""
    count = pairs.start[pairs.start.shape[0] - 1]
    ends = constraints.start.shape[0]
    for i in range(wp.tid(), wp.max(count, ends), threads):
        if i < ends:
            constraints.start[i] = pairs.start[envs.first_body[i]]
        if i < count:
            constraints.body_a[i] = pairs.body_a[i]
            constraints.body_b[i] = pairs.body_b[i]
            constraints.first_row[i] = pairs.contact_start[i]
            constraints.row_count[i] = pairs.contact_start[i + 1] - pairs.contact_start[i]
            constraints.last[i] = pairs.last[i]


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
