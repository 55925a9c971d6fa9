"""Second stage: which pairs of bodies can meet in this step.

A body lists the pairs in which it comes first. Small bodies find each other through a hash grid, or, in small
environments, by trying all (faster up to hundreds of bodies). Wide bodies (statics, planes, kinematic ones, and those
much larger than the rest) never enter the grid: each is tried against every body of its environment.
Pairs are counted, the counts are summed, and the same search writes them: their order depends on nothing but the scene.

Pairs of two sleeping bodies, or of a sleeping and a fixed one, are not searched: those that touched when they fell
asleep are carried over from the last step's list as dormant pairs.
"""

import warp as wp

from warp_rigid.kernels.data import (
    ROLE_ABSENT,
    ROLE_ASLEEP,
    ROLE_DRIVEN,
    ROLE_FREE,
    Bodies,
    Cells,
    Environments,
    History,
    Motions,
    Pairs,
)

wp.set_module_options({"enable_backward": False})

ABSENT = wp.constant(ROLE_ABSENT)
ASLEEP = wp.constant(ROLE_ASLEEP)
FREE = wp.constant(ROLE_FREE)
DRIVEN_AND_ASLEEP = wp.constant(ROLE_DRIVEN | ROLE_ASLEEP)


@wp.func
def may_meet(a: int, b: int):
    """Whether bodies of two roles can come into contact anew: one moves, and one of them gives way."""
    both = a | b
    return a != ABSENT and b != ABSENT and ((both & FREE) != 0 or both == DRIVEN_AND_ASLEEP)


@wp.func
def boxes_overlap(motions: Motions, i: int, j: int):
    """Whether the swept boxes of two bodies overlap."""
    a = motions.lower[i]
    b = motions.upper[i]
    c = motions.lower[j]
    d = motions.upper[j]
    return a[0] <= d[0] and c[0] <= b[0] and a[1] <= d[1] and c[1] <= b[1] and a[2] <= d[2] and c[2] <= b[2]


@wp.func
def are_apart(i: int, j: int, bodies: Bodies):
    """Whether bodies i and j of an environment, by their numbers in it, never touch by the user's wish."""
    found = bool(False)
    for k in range(bodies.apart_start[i], bodies.apart_start[i + 1]):
        found = found or bodies.apart[k] == j
    return found


@wp.func
def visit_pair(i: int, j: int, first: int, found: int, write: int, bodies: Bodies, motions: Motions, pairs: Pairs):
    """Count the pair if its boxes overlap, and write it in the second round. Returns the new count."""
    if not boxes_overlap(motions, i, j) or are_apart(i - first, j - first, bodies):
        return found
    if write == 1:
        slot = pairs.start[i] + found
        pairs.body_a[slot] = i
        pairs.body_b[slot] = j
        pairs.dormant[slot] = 0
    return found + 1


@wp.func
def carry_dormant(i: int, found: int, write: int, motions: Motions, history: History, pairs: Pairs):
    """Keep the pairs of body i that touched in the last step and now sleep. Returns the new count."""
    total = int(found)
    for row in range(history.pair_start[i], history.pair_start[i + 1]):
        j = history.body_b[row]
        both = motions.role[i] | motions.role[j]
        present = motions.role[i] != ABSENT and motions.role[j] != ABSENT
        sleeping = present and (both & ASLEEP) != 0 and not may_meet(motions.role[i], motions.role[j])
        if sleeping and history.contact_start[row + 1] > history.contact_start[row]:
            if write == 1:
                slot = pairs.start[i] + total
                pairs.body_a[slot] = i
                pairs.body_b[slot] = j
                pairs.dormant[slot] = row + 1
            total += 1
    return total


@wp.func
def visit_wide(
    i: int, first: int, found: int, write: int, cells: Cells, bodies: Bodies, motions: Motions, pairs: Pairs
):
    """Visit the pairs of body i with the wide bodies of its environment, each pair of wide ones once."""
    total = int(found)
    for w in range(cells.large.shape[0]):
        j = first + cells.large[w]
        both_wide = bodies.wide[i] == 1
        if i != j and not (both_wide and j < i) and may_meet(motions.role[i], motions.role[j]):
            total = visit_pair(i, j, first, total, write, bodies, motions, pairs)
    return total


@wp.func
def visit_small(i: int, first: int, write: int, cells: Cells, bodies: Bodies, motions: Motions, pairs: Pairs):
    """Visit the pairs of body i with all later small bodies of its environment."""
    total = int(0)
    for s in range(cells.small.shape[0]):
        j = first + cells.small[s]
        if j > i and may_meet(motions.role[i], motions.role[j]):
            total = visit_pair(i, j, first, total, write, bodies, motions, pairs)
    return total


@wp.kernel
def pairs_by_trying_all(
    write: int,
    threads: int,
    cells: Cells,
    bodies: Bodies,
    motions: Motions,
    envs: Environments,
    history: History,
    pairs: Pairs,
):
    """The threads share the bodies: try all later small bodies of the environment, then the wide ones."""
    bodies_per_env = bodies.shape.shape[0] / envs.failed.shape[0]
    for i in range(wp.tid(), motions.role.shape[0], threads):
        env = i / bodies_per_env
        first = env * bodies_per_env
        found = int(0)
        if envs.failed[env] == 0 and (write == 0 or pairs.start[i + 1] > pairs.start[i]):
            if envs.moving[env] > envs.step[env]:
                if bodies.wide[i] == 0:
                    found = visit_small(i, first, write, cells, bodies, motions, pairs)
                found = visit_wide(i, first, found, write, cells, bodies, motions, pairs)
            found = carry_dormant(i, found, write, motions, history, pairs)
        if write == 0:
            pairs.count[i] = found


@wp.kernel
def grid_points(bodies_per_env: int, motions: Motions, cells: Cells):
    """Centres of the small bodies' swept boxes, their environment as the grid's group, its largest half-diagonal."""
    k = wp.tid()
    small = cells.small.shape[0]
    env = k / small
    b = env * bodies_per_env + cells.small[k - env * small]
    cells.points[k] = 0.5 * (motions.lower[b] + motions.upper[b])
    cells.groups[k] = env
    wp.atomic_max(cells.reach, env, 0.5 * wp.length(motions.upper[b] - motions.lower[b]))


@wp.kernel
def pairs_by_grid(
    write: int,
    threads: int,
    grid: wp.uint64,
    cell: float,
    cells: Cells,
    bodies: Bodies,
    motions: Motions,
    envs: Environments,
    history: History,
    pairs: Pairs,
):
    """The threads share the bodies: small bodies look around in the hash grid, then try the wide ones.

    Where something moves so fast that there are more cells to look into than bodies, all are tried instead.
    """
    bodies_per_env = bodies.shape.shape[0] / envs.failed.shape[0]
    for i in range(wp.tid(), motions.role.shape[0], threads):
        env = i / bodies_per_env
        first = env * bodies_per_env
        found = int(0)
        if envs.failed[env] == 0 and (write == 0 or pairs.start[i + 1] > pairs.start[i]):
            if envs.moving[env] > envs.step[env]:
                if bodies.wide[i] == 0:
                    middle = 0.5 * (motions.lower[i] + motions.upper[i])
                    around = 0.5 * wp.length(motions.upper[i] - motions.lower[i]) + cells.reach[env]
                    across = 2.0 * around / cell + 1.0
                    if across * across * across <= float(cells.small.shape[0]):
                        neighbour = int(0)
                        for neighbour in wp.hash_grid_query(grid, middle, around, env):
                            j = first + cells.small[neighbour - env * cells.small.shape[0]]
                            if j > i and may_meet(motions.role[i], motions.role[j]):
                                found = visit_pair(i, j, first, found, write, bodies, motions, pairs)
                    else:
                        found = visit_small(i, first, write, cells, bodies, motions, pairs)
                found = visit_wide(i, first, found, write, cells, bodies, motions, pairs)
            found = carry_dormant(i, found, write, motions, history, pairs)
        if write == 0:
            pairs.count[i] = found
