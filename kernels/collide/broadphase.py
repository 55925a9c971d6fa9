"""Broad phase: pairs of bodies whose swept bounding boxes overlap in this step.

The bodies of an environment have an order: ordinary dynamic bodies, then static and kinematic bodies and those much
larger than the others, each group by index. Each body lists its pairs with later bodies, in this order. It tests its
candidates (candidates.py); in small environments, where this is faster, all later bodies are candidates.

Pairs are counted, the counts are summed, and a second search writes the pairs. Their order is deterministic. A team of
lanes processes a body and tests one candidate per lane at a time.

Pairs of two sleeping bodies, or of a sleeping and a static body, are not searched for. Pairs in contact when they fell
asleep are copied from the last step's list as dormant pairs.
"""

import warp as wp

from warp_rigid.kernels.collide.candidates import ALL_LATER, boxes_overlap
from warp_rigid.kernels.common.team import ballot, bits_below
from warp_rigid.kernels.enums import Role
from warp_rigid.kernels.schema import Bodies, Cells, Environments, History, Motions, Pairs, Shapes

wp.set_module_options({"enable_backward": False})


@wp.func
def may_meet(a: int, b: int):
    """Whether bodies with these roles can come into contact: at least one moves, and at least one responds."""
    both = a | b
    return a != Role.ABSENT and b != Role.ABSENT and ((both & Role.FREE) != 0 or both == (Role.KINEMATIC | Role.ASLEEP))


@wp.func
def has_colliders(i: int, shapes: Shapes, bodies: Bodies):
    """Whether a body can touch others: its shape has at least one distance function."""
    return shapes.shapes[bodies.shape[i]].part_end > shapes.shapes[bodies.shape[i]].part_start


@wp.func
def is_filtered(i: int, number: int, bodies: Bodies):
    """Whether contact between body i and a body given by its index within the environment is filtered out."""
    found = bool(False)
    for k in range(bodies.filtered_start[i], bodies.filtered_start[i + 1]):
        found = found or bodies.filtered[k] == number
    return found


@wp.func
def write_pair(slot: int, i: int, j: int, dormant: int, pairs: Pairs):
    """Write a pair to its place in the list."""
    pairs.body_a[slot] = i
    pairs.body_b[slot] = j
    pairs.dormant[slot] = dormant


@wp.func
def keep_dormant(i: int, found: int, write: int, motions: Motions, history: History, pairs: Pairs):
    """Keep the pairs of body i that were in contact in the last step and now sleep. Returns the new count."""
    total = int(found)
    for row in range(history.pair_start[i], history.pair_start[i + 1]):
        j = history.body_b[row]
        both = motions.role[i] | motions.role[j]
        present = motions.role[i] != Role.ABSENT and motions.role[j] != Role.ABSENT
        sleeping = present and (both & Role.ASLEEP) != 0 and not may_meet(motions.role[i], motions.role[j])
        if sleeping and history.contact_start[row + 1] > history.contact_start[row]:
            if write == 1:
                write_pair(pairs.start[i] + total, i, j, row + 1, pairs)
            total += 1
    return total


@wp.func
def candidate(i: int, k: int, room: int, bodies: Bodies, envs: Environments, cells: Cells):
    """The k-th candidate of body i; -1 if there are not so many."""
    env = bodies.env[i]
    first = envs.first_body[env]
    if cells.listed[i] == ALL_LATER:
        place = first + cells.rank[i] + 1 + k
        if place < envs.first_body[env + 1]:
            return first + cells.order[place]
        return -1
    if k < cells.listed[i]:
        return cells.candidates[room * i + k]
    return -1


@wp.func
def visit_candidates(
    i: int,
    lane: int,
    lanes: int,
    write: int,
    room: int,
    cells: Cells,
    shapes: Shapes,
    bodies: Bodies,
    motions: Motions,
    envs: Environments,
    pairs: Pairs,
):
    """Test the candidates of body i, one per lane at a time. Returns the number of pairs."""
    env = bodies.env[i]
    first = envs.first_body[env]
    count = cells.listed[i]
    if count == ALL_LATER:
        count = envs.first_body[env + 1] - first - cells.rank[i] - 1
    found = int(0)
    for base in range(0, count, lanes):
        j = candidate(i, base + lane, room, bodies, envs, cells)
        meets = int(0)
        if j >= 0 and may_meet(motions.role[i], motions.role[j]) and boxes_overlap(i, j, motions.lower, motions.upper):
            meets = wp.where(has_colliders(j, shapes, bodies) and not is_filtered(i, j - first, bodies), 1, 0)
        hits = ballot(meets, lanes)
        if write == 1 and meets == 1:
            write_pair(pairs.start[i] + found + bits_below(hits, lane), i, j, 0, pairs)
        found += bits_below(hits, lanes)
    return found


@wp.kernel
def list_pairs_of_bodies(
    write: int,
    teams: int,
    lanes: int,
    room: int,
    cells: Cells,
    shapes: Shapes,
    bodies: Bodies,
    motions: Motions,
    envs: Environments,
    history: History,
    pairs: Pairs,
):
    """The teams share the bodies: count or write the pairs of a body with its candidates, then its dormant pairs."""
    lane = wp.tid() % lanes
    for i in range(wp.tid() / lanes, motions.role.shape[0], teams):
        env = bodies.env[i]
        found = int(0)
        if envs.failed[env] == 0 and (write == 0 or pairs.start[i + 1] > pairs.start[i]):
            if envs.moving[env] > envs.step[env] and has_colliders(i, shapes, bodies):
                found = visit_candidates(i, lane, lanes, write, room, cells, shapes, bodies, motions, envs, pairs)
            if lane == 0:
                found = keep_dormant(i, found, write, motions, history, pairs)
        if write == 0 and lane == 0:
            pairs.count[i] = found
