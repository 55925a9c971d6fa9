"""Broad phase: pairs of bodies whose swept bounding boxes overlap in this step.

Each body lists the pairs in which it is the first body. Pairs of small bodies are found with a hash grid or, in small
environments, by testing all pairs (faster up to hundreds of bodies). Oversized bodies (static and kinematic bodies,
planes, and bodies much larger than the others) are not in the grid; they are tested against every body of their
environment. The grid of Warp is not used: all its grids share the data of a recorded build, so that of two simulators
on a GPU one would search in the cells of the other.

Pairs are counted, the counts are summed, and a second search writes the pairs. Their order is deterministic.

Pairs of two sleeping bodies, or of a sleeping and a static body, are not searched for. Pairs in contact when they fell
asleep are copied from the last step's list as dormant pairs.
"""

import warp as wp

from warp_rigid.kernels.enums import Role
from warp_rigid.kernels.schema import Bodies, Cells, Environments, History, Motions, Pairs

wp.set_module_options({"enable_backward": False})

HASH_MULTIPLIER = wp.constant(wp.uint32(0x9E3779B9))
"""2^32 divided by the golden ratio, odd (Fibonacci hashing)."""

FURTHEST_CELL = wp.constant(1.0e9)
KINEMATIC_AND_ASLEEP = wp.constant(int(Role.KINEMATIC | Role.ASLEEP))


@wp.func
def may_meet(a: int, b: int):
    """Whether bodies with these roles can come into contact: at least one moves, and at least one responds."""
    both = a | b
    return a != Role.ABSENT and b != Role.ABSENT and ((both & Role.FREE) != 0 or both == KINEMATIC_AND_ASLEEP)


@wp.func
def boxes_overlap(motions: Motions, i: int, j: int):
    """Whether the swept boxes of two bodies overlap."""
    a = motions.lower[i]
    b = motions.upper[i]
    c = motions.lower[j]
    d = motions.upper[j]
    return a[0] <= d[0] and c[0] <= b[0] and a[1] <= d[1] and c[1] <= b[1] and a[2] <= d[2] and c[2] <= b[2]


@wp.func
def is_filtered(i: int, number: int, bodies: Bodies):
    """Whether contact between body i and a body given by its index within the environment is filtered out."""
    found = bool(False)
    for k in range(bodies.filtered_start[i], bodies.filtered_start[i + 1]):
        found = found or bodies.filtered[k] == number
    return found


@wp.func
def add_pair(i: int, j: int, first: int, found: int, write: int, bodies: Bodies, motions: Motions, pairs: Pairs):
    """Count the pair if its boxes overlap and, in the second search, write it. Returns the new count."""
    if not boxes_overlap(motions, i, j) or is_filtered(i, j - first, bodies):
        return found
    if write == 1:
        slot = pairs.start[i] + found
        pairs.body_a[slot] = i
        pairs.body_b[slot] = j
        pairs.dormant[slot] = 0
    return found + 1


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
                slot = pairs.start[i] + total
                pairs.body_a[slot] = i
                pairs.body_b[slot] = j
                pairs.dormant[slot] = row + 1
            total += 1
    return total


@wp.func
def visit_oversized(
    i: int, env: int, first: int, found: int, write: int, cells: Cells, bodies: Bodies, motions: Motions, pairs: Pairs
):
    """Test body i against the oversized bodies of its environment; pairs of oversized bodies are tested once."""
    total = int(found)
    for w in range(cells.oversized_start[env], cells.oversized_start[env + 1]):
        j = first + cells.oversized[w]
        both_oversized = bodies.oversized[i] == 1
        if i != j and not (both_oversized and j < i) and may_meet(motions.role[i], motions.role[j]):
            total = add_pair(i, j, first, total, write, bodies, motions, pairs)
    return total


@wp.func
def visit_small(i: int, env: int, first: int, write: int, cells: Cells, bodies: Bodies, motions: Motions, pairs: Pairs):
    """Test body i against all later small bodies of its environment. Returns the number of pairs."""
    total = int(0)
    for s in range(cells.small_start[env], cells.small_start[env + 1]):
        j = first + cells.small[s]
        if j > i and may_meet(motions.role[i], motions.role[j]):
            total = add_pair(i, j, first, total, write, bodies, motions, pairs)
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
    """The threads share the bodies: test all later small bodies of the environment, then the oversized ones."""
    for i in range(wp.tid(), motions.role.shape[0], threads):
        env = bodies.env[i]
        first = envs.first_body[env]
        found = int(0)
        if envs.failed[env] == 0 and (write == 0 or pairs.start[i + 1] > pairs.start[i]):
            if envs.moving[env] > envs.step[env]:
                if bodies.oversized[i] == 0:
                    found = visit_small(i, env, first, write, cells, bodies, motions, pairs)
                found = visit_oversized(i, env, first, found, write, cells, bodies, motions, pairs)
            found = keep_dormant(i, found, write, motions, history, pairs)
        if write == 0:
            pairs.count[i] = found


@wp.func
def cell_along(x: float, width: float):
    """Index of the cell at a coordinate along an axis."""
    return int(wp.floor(wp.clamp(x / width, -FURTHEST_CELL, FURTHEST_CELL)))


@wp.func
def bucket_of(x: int, y: int, z: int, first: int, buckets: int):
    """The bucket of a cell, among the `buckets` of its environment, a power of two (Teschner et al. 2003)."""
    mixed = wp.uint32(x) * wp.uint32(73856093)
    mixed = mixed ^ (wp.uint32(y) * wp.uint32(19349663))
    mixed = mixed ^ (wp.uint32(z) * wp.uint32(83492791))
    mixed = (mixed ^ (mixed >> wp.uint32(15))) * HASH_MULTIPLIER
    return first + int((mixed >> wp.uint32(8)) & wp.uint32(buckets - 1))


@wp.kernel
def choose_buckets(envs: Environments, motions: Motions, cells: Cells):
    """One thread per small body: the bucket of its swept box's centre, and the environment's largest half-extent."""
    k = wp.tid()
    env = cells.small_env[k]
    b = envs.first_body[env] + cells.small[k]
    first = cells.first_bucket[env]
    buckets = cells.first_bucket[env + 1] - first
    cells.member[k] = b
    if buckets == 0:
        cells.key[k] = cells.start.shape[0] - 1
        return
    width = cells.width[env]
    x = 0.5 * (motions.lower[b] + motions.upper[b])
    across = cell_along(x[0], width)
    cells.key[k] = bucket_of(across, cell_along(x[1], width), cell_along(x[2], width), first, buckets)
    wp.atomic_max(cells.reach, env, 0.5 * wp.max(motions.upper[b] - motions.lower[b]))


@wp.kernel
def find_bucket_starts(count: int, cells: Cells):
    """One thread per entry of the sorted list, and one past its end: store the start of the buckets that begin here."""
    k = wp.tid()
    last = int(-1)
    if k > 0:
        last = cells.key[k - 1]
    bucket = cells.start.shape[0] - 1
    if k < count:
        bucket = cells.key[k]
    for begun in range(last + 1, bucket + 1):
        cells.start[begun] = k


@wp.func
def visit_cell(
    i: int,
    first: int,
    found: int,
    write: int,
    at: wp.vec3i,
    width: float,
    bucket: int,
    cells: Cells,
    bodies: Bodies,
    motions: Motions,
    pairs: Pairs,
):
    """Test body i against the later small bodies of a cell. Returns the new count."""
    total = int(found)
    for k in range(cells.start[bucket], cells.start[bucket + 1]):
        j = cells.member[k]
        if j > i and may_meet(motions.role[i], motions.role[j]):
            x = 0.5 * (motions.lower[j] + motions.upper[j])
            here = cell_along(x[0], width) == at[0] and cell_along(x[1], width) == at[1]
            if here and cell_along(x[2], width) == at[2]:
                total = add_pair(i, j, first, total, write, bodies, motions, pairs)
    return total


@wp.func
def visit_around(
    i: int,
    env: int,
    first: int,
    write: int,
    cells: Cells,
    bodies: Bodies,
    motions: Motions,
    pairs: Pairs,
):
    """Test body i against the later small bodies in the cells around it. Returns the number of pairs.

    All bodies are tested instead if the environment has no grid, or if a body moves so fast that there are more cells
    to search than bodies.
    """
    buckets = cells.first_bucket[env + 1] - cells.first_bucket[env]
    if buckets == 0:
        return visit_small(i, env, first, write, cells, bodies, motions, pairs)
    width = cells.width[env]
    around = wp.vec3(cells.reach[env], cells.reach[env], cells.reach[env])
    lower = motions.lower[i] - around
    upper = motions.upper[i] + around
    across = (upper - lower) / width + wp.vec3(1.0, 1.0, 1.0)
    if not across[0] * across[1] * across[2] <= float(cells.small_start[env + 1] - cells.small_start[env]):
        return visit_small(i, env, first, write, cells, bodies, motions, pairs)
    total = int(0)
    for x in range(cell_along(lower[0], width), cell_along(upper[0], width) + 1):
        for y in range(cell_along(lower[1], width), cell_along(upper[1], width) + 1):
            for z in range(cell_along(lower[2], width), cell_along(upper[2], width) + 1):
                bucket = bucket_of(x, y, z, cells.first_bucket[env], buckets)
                at = wp.vec3i(x, y, z)
                total = visit_cell(i, first, total, write, at, width, bucket, cells, bodies, motions, pairs)
    return total


@wp.kernel
def pairs_by_grid(
    write: int,
    threads: int,
    cells: Cells,
    bodies: Bodies,
    motions: Motions,
    envs: Environments,
    history: History,
    pairs: Pairs,
):
    """The threads share the bodies: search the hash grid for small bodies, then test the oversized ones."""
    for i in range(wp.tid(), motions.role.shape[0], threads):
        env = bodies.env[i]
        first = envs.first_body[env]
        found = int(0)
        if envs.failed[env] == 0 and (write == 0 or pairs.start[i + 1] > pairs.start[i]):
            if envs.moving[env] > envs.step[env]:
                if bodies.oversized[i] == 0:
                    found = visit_around(i, env, first, write, cells, bodies, motions, pairs)
                found = visit_oversized(i, env, first, found, write, cells, bodies, motions, pairs)
            found = keep_dormant(i, found, write, motions, history, pairs)
        if write == 0:
            pairs.count[i] = found
