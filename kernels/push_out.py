"""Push-out: separate what still overlaps after the velocities are solved, without touching the velocities.

Contacts that would end the step deeper than the slop get a pseudo-velocity that moves the bodies in this step only.
Levels go from the ground up with the lower bodies frozen (Guendelman et al. 2003, section 8.3), so a deep stack
is set right in one pass.
"""

import warp as wp

from warp_rigid.kernels.data import Bodies, Contacts, Environments, Graph, Motions, PairRecord, Pairs, Shapes, State
from warp_rigid.kernels.impulses import (
    SETTLED,
    Couple,
    first_of_group,
    slip_between,
    stride_of_group,
    take_up,
    with_impulse,
)
from warp_rigid.kernels.team import any_of_team, meet

wp.set_module_options({"enable_backward": False})

LEVEL_ITERATIONS = wp.constant(6)

SLOP = wp.constant(1.0e-4)
"""Overlap left alone, as a part of the smaller body's size."""

RECOVERY = wp.constant(0.25)
"""Part of the overlap taken out in one step."""

FASTEST = wp.constant(2.0)
"""Largest speed at which bodies are pushed apart [m/s]."""


@wp.func
def wanted_speed(c: int, dt: float, shapes: Shapes, bodies: Bodies, motions: Motions, contacts: Contacts, state: State):
    """Separation speed that the contact needs [m/s], 0 if none."""
    row = contacts.rows[c]
    size = wp.min(shapes.shapes[bodies.shape[row.body_a]].size, shapes.shapes[bodies.shape[row.body_b]].size)
    couple = take_up(row.body_a, row.body_b, 0.0, 0.0, bodies, motions, state)
    left = row.gap + dt * wp.dot(slip_between(row, couple), row.normal) + SLOP * size
    return wp.min(RECOVERY * wp.max(-left, 0.0) / dt, FASTEST)


@wp.func
def push_contact(c: int, share_a: float, share_b: float, couple: Couple, contacts: Contacts):
    """One visit: bring the pseudo-velocity of separation to its target; reaction[0] is the pseudo-impulse."""
    row = contacts.rows[c]
    k = share_a * row.normal_a + share_b * row.normal_b
    if k < 1.0e-12 or contacts.loads[c].target <= 0.0:
        return couple
    old = contacts.loads[c].reaction[0]
    missing = contacts.loads[c].target - wp.dot(slip_between(row, couple), row.normal)
    new = wp.max(old + missing / k, 0.0)
    contacts.loads[c].reaction = wp.vec3(new, 0.0, 0.0)
    couple = with_impulse(row, (new - old) * row.normal, couple)
    couple.change = wp.max(couple.change, k * wp.abs(new - old))
    return couple


@wp.func
def push_pair(entry: PairRecord, bodies: Bodies, motions: Motions, contacts: Contacts, state: State):
    """Visit the contacts of a pair; the bodies' pseudo-velocities stand in for their velocities."""
    a = entry.body_a
    b = entry.body_b
    share_a = float(entry.upper_a)
    share_b = float(entry.upper_b)
    couple = take_up(a, b, share_a, share_b, bodies, motions, state)
    couple.linear_a = motions.push_linear[a]
    couple.angular_a = motions.push_angular[a]
    couple.linear_b = motions.push_linear[b]
    couple.angular_b = motions.push_angular[b]
    for c in range(entry.begin, entry.end):
        couple = push_contact(c, share_a, share_b, couple, contacts)
    if couple.inverse_mass_a > 0.0:
        motions.push_linear[a] = couple.linear_a
        motions.push_angular[a] = couple.angular_a
    if couple.inverse_mass_b > 0.0:
        motions.push_linear[b] = couple.linear_b
        motions.push_angular[b] = couple.angular_b
    return wp.where(couple.change > SETTLED, 1, 0)


@wp.kernel
def find_overlaps(
    dt: float,
    lanes: int,
    bodies_per_env: int,
    shapes: Shapes,
    bodies: Bodies,
    motions: Motions,
    envs: Environments,
    graph: Graph,
    pairs: Pairs,
    contacts: Contacts,
    state: State,
):
    """A team an environment: the separation speed that each contact needs, and whether any needs one."""
    env = wp.tid() / lanes
    lane = wp.tid() % lanes
    first = env * bodies_per_env
    begin = pairs.contact_start[pairs.start[first]]
    end = pairs.contact_start[pairs.start[first + bodies_per_env]]
    found = int(0)
    for c in range(begin + lane, end, lanes):
        target = wanted_speed(c, dt, shapes, bodies, motions, contacts, state)
        contacts.loads[c].target = target
        contacts.loads[c].reaction = wp.vec3(0.0, 0.0, 0.0)
        if target > 0.0 and envs.contact_iterations[env] > 0:
            found = 1
    found = any_of_team(found, lanes)
    if lane == 0:
        graph.overlapping[env] = found


@wp.kernel
def push_apart(
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
    """A team an environment: separate level by level, each against the frozen level below."""
    env = wp.tid() / lanes
    lane = wp.tid() % lanes
    if graph.overlapping[env] == 0:
        return
    for level in range(1, graph.level_count[env] + 1):
        row = env * (bodies_per_env + 2) + level
        left = int(LEVEL_ITERATIONS)
        while left > 0:
            changed = int(0)
            for group in range(graph.level_start[row], graph.level_start[row + 1]):
                stride = stride_of_group(group, lanes, graph)
                for k in range(first_of_group(group, lane, graph), graph.group_start[group + 1], stride):
                    changed |= push_pair(graph.order[k], bodies, motions, contacts, state)
                meet(lanes)
            left = any_of_team(changed, lanes) * (left - 1)
