"""The list of constraints of a step: the kind, the two bodies and the rows of each constraint.

Each environment has a slot for every pair of bodies, then one for each constraint of another kind. A slot without rows
is not active. Graph, colours, islands and the solver read this list and do not depend on the kinds of constraints.
"""

import warp as wp

from warp_rigid.kernels.constraints.contact import KIND as CONTACT
from warp_rigid.kernels.schema import Bodies, Constraints, Environments, Graph, Pairs

wp.set_module_options({"enable_backward": False})


@wp.func
def is_active(k: int, constraints: Constraints):
    """Whether a constraint has rows in this step."""
    return constraints.row_count[k] > 0


@wp.func
def set_constraint(
    k: int, kind: int, body_a: int, body_b: int, first_row: int, row_count: int, last: int, constraints: Constraints
):
    """Write a constraint to its slot."""
    constraints.kind[k] = kind
    constraints.body_a[k] = body_a
    constraints.body_b[k] = body_b
    constraints.first_row[k] = first_row
    constraints.row_count[k] = row_count
    constraints.last[k] = last


@wp.func
def slot_of_pair(pair: int, env: int, constraints: Constraints):
    """The slot of a pair of bodies; for a row of the history, its slot in the last step."""
    return pair + constraints.other_start[env]


@wp.func
def slot_of_other(index: int, env: int, constraints: Constraints):
    """The slot of a constraint of another kind, by its index among those of its environment."""
    return constraints.start[env + 1] - (constraints.other_start[env + 1] - constraints.other_start[env]) + index


@wp.func
def last_slot_of_other(index: int, env: int, constraints: Constraints):
    """The slot that the same constraint had in the last step; negative if there was none."""
    return constraints.start_before[env + 1] - (constraints.other_start[env + 1] - constraints.other_start[env]) + index


@wp.kernel
def list_pairs(threads: int, envs: Environments, bodies: Bodies, pairs: Pairs, constraints: Constraints):
    """The threads share the pairs and the environments: first constraints of environments, and contact constraints."""
    count = pairs.start[pairs.start.shape[0] - 1]
    ends = constraints.start.shape[0]
    for i in range(wp.tid(), wp.max(count, ends), threads):
        if i < ends:
            constraints.start[i] = slot_of_pair(pairs.start[envs.first_body[i]], i, constraints)
        if i < count:
            a = pairs.body_a[i]
            env = bodies.env[a]
            first = pairs.contact_start[i]
            last = int(-1)
            if pairs.last[i] >= 0:
                last = slot_of_pair(pairs.last[i], env, constraints)
            rows = pairs.contact_start[i + 1] - first
            k = slot_of_pair(i, env, constraints)
            set_constraint(k, CONTACT, a, pairs.body_b[i], first, rows, last, constraints)


@wp.func
def store_constraint(k: int, constraints: Constraints, graph: Graph):
    """Store the supports, colour and start index of constraints, for comparison in the next step."""
    last = constraints.start.shape[0] - 1
    if k < constraints.start[last]:
        graph.supports_before[k] = wp.where(is_active(k, constraints), graph.supports[k], -1)
        graph.color_before[k] = graph.color[k]
    if k <= last:
        constraints.start_before[k] = constraints.start[k]
