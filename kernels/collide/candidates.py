"""Candidate pairs of large environments: pairs of bodies whose fat boxes overlap.

A *fat box* encloses the swept box of a body with a margin, and with the motion of the next steps. While all swept boxes
of an environment lie within their fat boxes, every pair with overlapping swept boxes is among the candidates, and the
broad phase only tests these. When a body has left its fat box, all fat boxes and candidates of its environment are
computed again. This decides only what the search costs: the pairs that it finds, and their order, depend on the swept
boxes alone.

Fat boxes are sorted into a hash grid of several levels. The cells of a level are twice as wide as those of the level
below, and a body belongs to the first level whose cells are as wide as its fat box. It is searched for by the bodies of
its own and of lower levels, in the few cells around each of them. A plane or a fast body thus adds one level for the
other bodies to search, and does not widen the cells of the others. Static bodies are in the grid as well.

The order in which the bodies are entered in a cell, and the candidates in a list, depends on the threads. The lists are
sorted at the end. A body with very many candidates, such as one that crosses the whole scene in a step, has no list:
all later bodies of its environment count as candidates.

The grid of Warp is not used: all its grids share the data of a recorded build, so that of two simulators on a GPU one
would search in the cells of the other.
"""

import warp as wp

from warp_rigid.kernels.enums import Motion
from warp_rigid.kernels.schema import Bodies, Cells, Environments, Motions, Shapes

wp.set_module_options({"enable_backward": False})

FAT_MARGIN = wp.constant(0.2)
"""Distance between the swept box and the fat box, as a fraction of the body's size."""

LEVELS = 24
TOP = LEVELS - 1
"""The highest level, of bodies too large for any other. It has one cell, since a box of it may have any extent."""

FINER_LEVELS = 8
"""Levels below that of ordinary bodies."""

ALL_LATER = wp.constant(-1)
"""Length of the list of a body whose candidates are all later bodies."""


@wp.func
def cell_width(level: int, smallest: float):
    """Width of the cells of a level below the highest [m]."""
    return smallest * float(1 << level)


@wp.func
def cell_along(x: float, level: int, smallest: float):
    """Index of the cell of a level at a coordinate along an axis."""
    if level == TOP:
        return int(0)
    # Within 32 bits.
    return int(wp.floor(wp.clamp(x / cell_width(level, smallest), -1.0e9, 1.0e9)))


@wp.func
def bucket_of(env: int, cell: wp.vec4i, cells: Cells):
    """The bucket of a cell (x, y, z, level), among those of its environment (Teschner et al. 2003)."""
    first = cells.first_bucket[env]
    buckets = cells.first_bucket[env + 1] - first
    mixed = wp.uint32(cell[0]) * wp.uint32(73856093)
    mixed = mixed ^ (wp.uint32(cell[1]) * wp.uint32(19349663))
    mixed = mixed ^ (wp.uint32(cell[2]) * wp.uint32(83492791))
    mixed = mixed ^ (wp.uint32(cell[3]) * wp.uint32(50331653))
    mixed = (mixed ^ (mixed >> wp.uint32(15))) * wp.static(wp.uint32(0x9E3779B9))
    return first + int((mixed >> wp.uint32(8)) & wp.uint32(buckets - 1))


@wp.func
def cell_at(p: wp.vec3, level: int, smallest: float):
    """The cell (x, y, z, level) of a level at a point."""
    return wp.vec4i(
        cell_along(p[0], level, smallest), cell_along(p[1], level, smallest), cell_along(p[2], level, smallest), level
    )


@wp.func
def level_of(lower: wp.vec3, upper: wp.vec3, smallest: float):
    """The first level whose cells are as wide as a box, with room for the rounding of its centre.

    A box that is not finite, as of a body with an infinite velocity, belongs to the highest level.
    """
    rounding = 1.0e-6 * wp.max(wp.max(wp.abs(lower)), wp.max(wp.abs(upper)))
    extents = upper - lower
    extent = wp.max(extents) + 2.0 * rounding
    if not wp.isfinite(extents[0] + extents[1] + extents[2]):
        return TOP
    level = int(0)
    while level < TOP and cell_width(level, smallest) < extent:
        level += 1
    return level


@wp.kernel
def find_stale(bodies: Bodies, envs: Environments, motions: Motions, cells: Cells):
    """One thread per body: mark its environment if it has a grid and the swept box is not within the fat box."""
    i = wp.tid()
    env = bodies.env[i]
    if cells.first_bucket[env + 1] == cells.first_bucket[env]:
        return
    if envs.failed[env] == 1 or envs.moving[env] <= envs.step[env]:
        return
    below = motions.lower[i] - cells.lower[i]
    above = cells.upper[i] - motions.upper[i]
    if not wp.min(wp.min(below), wp.min(above)) >= 0.0:
        cells.stale[env] = 1


@wp.kernel
def enlarge_boxes(dt: float, shapes: Shapes, bodies: Bodies, motions: Motions, cells: Cells):
    """One thread per body of a marked environment: its fat box and its cell, which are counted."""
    i = wp.tid()
    env = bodies.env[i]
    if cells.stale[env] == 0:
        return
    lower = motions.lower[i]
    upper = motions.upper[i]
    if bodies.motion[i] != Motion.STATIC:
        margin = FAT_MARGIN * shapes.shapes[bodies.shape[i]].size
        # Room for the present step and three more.
        travel = 3.0 * dt * motions.solver_bodies[i].linear
        nothing = wp.vec3(0.0, 0.0, 0.0)
        lower += wp.min(travel, nothing) - wp.vec3(margin, margin, margin)
        upper += wp.max(travel, nothing) + wp.vec3(margin, margin, margin)
    cells.lower[i] = lower
    cells.upper[i] = upper
    smallest = cells.width[env]
    level = level_of(lower, upper, smallest)
    cell = cell_at(0.5 * (lower + upper), level, smallest)
    cells.cell[i] = cell
    cells.listed[i] = 0
    bit = 1 << level
    wp.atomic_or(cells.levels, env, bit)
    if bodies.motion[i] == Motion.DYNAMIC:
        wp.atomic_or(cells.dynamic_levels, env, bit)
    wp.atomic_add(cells.bucket_count, bucket_of(env, cell, cells), 1)


@wp.kernel
def fill_buckets(bodies: Bodies, cells: Cells):
    """One thread per body of a marked environment: enter it in its bucket; the counts end at 0."""
    i = wp.tid()
    env = bodies.env[i]
    if cells.stale[env] == 1:
        bucket = bucket_of(env, cells.cell[i], cells)
        place = wp.atomic_sub(cells.bucket_count, bucket, 1) - 1
        cells.member[cells.bucket_start[bucket] + place] = i


@wp.func
def boxes_overlap(i: int, j: int, lower: wp.array[wp.vec3], upper: wp.array[wp.vec3]):
    """Whether two boxes overlap."""
    a = lower[i]
    b = upper[i]
    c = lower[j]
    d = upper[j]
    return a[0] <= d[0] and c[0] <= b[0] and a[1] <= d[1] and c[1] <= b[1] and a[2] <= d[2] and c[2] <= b[2]


@wp.func
def precedes(a: wp.vec4i, b: wp.vec4i):
    """Whether a cell comes before another cell of its level."""
    if a[0] != b[0]:
        return a[0] < b[0]
    if a[1] != b[1]:
        return a[1] < b[1]
    return a[2] < b[2]


@wp.func
def visit_cell(i: int, cell: wp.vec4i, bucket: int, room: int, bodies: Bodies, cells: Cells):
    """List the pairs of body i with those in a cell, of which one of two is dynamic.

    The first of the two in the order of pairs lists the pair. In its own cell, body i is only tested with later bodies.
    """
    own = cells.cell[i] == cell
    dynamic = bodies.motion[i] == Motion.DYNAMIC
    for k in range(cells.bucket_start[bucket], cells.bucket_start[bucket + 1]):
        j = cells.member[k]
        either = dynamic or bodies.motion[j] == Motion.DYNAMIC
        if cells.cell[j] == cell and either and not (own and j <= i) and boxes_overlap(i, j, cells.lower, cells.upper):
            owner = wp.where(cells.rank[i] < cells.rank[j], i, j)
            place = wp.atomic_add(cells.listed, owner, 1)
            if place < room:
                cells.candidates[room * owner + place] = i + j - owner


@wp.kernel
def search_cells(room: int, lanes: int, bodies: Bodies, cells: Cells):
    """A team of lanes for each body of a marked environment searches the cells around it, of its own and higher levels.

    Of two cells of a level, only the bodies of the first search the other. Static and kinematic bodies only search
    levels with dynamic bodies.
    """
    i = wp.tid() / lanes
    env = bodies.env[i]
    if cells.stale[env] == 0:
        return
    here = cells.cell[i]
    smallest = cells.width[env]
    levels = wp.where(bodies.motion[i] == Motion.DYNAMIC, cells.levels[env], cells.dynamic_levels[env])
    for level in range(here[3], LEVELS):
        if ((levels >> level) & 1) == 1:
            half = 0.5 * cell_width(level, smallest)
            first = cell_at(cells.lower[i] - wp.vec3(half, half, half), level, smallest)
            last = cell_at(cells.upper[i] + wp.vec3(half, half, half), level, smallest)
            wide = last[1] - first[1] + 1
            high = last[2] - first[2] + 1
            for k in range(wp.tid() % lanes, (last[0] - first[0] + 1) * wide * high, lanes):
                cell = wp.vec4i(first[0] + k / (wide * high), first[1] + k / high % wide, first[2] + k % high, level)
                if level > here[3] or not precedes(cell, here):
                    visit_cell(i, cell, bucket_of(env, cell, cells), room, bodies, cells)


@wp.kernel
def finish_lists(
    which: int, room: int, bodies: Bodies, wanted_row: wp.array[int], cells: Cells, wanted: wp.array2d[int]
):
    """One thread per body of a marked environment: record the required capacity, and sort the list (Shell sort).

    A list for which there is no room is emptied.
    """
    i = wp.tid()
    if cells.stale[bodies.env[i]] == 0:
        return
    count = cells.listed[i]
    # The candidates of all bodies together must be counted in 32 bits.
    if count > wp.min(256, (1 << 30) / cells.listed.shape[0]):
        cells.listed[i] = ALL_LATER
        return
    if count > room:
        wp.atomic_max(wanted, wanted_row[0], which, count * cells.listed.shape[0])
        cells.listed[i] = 0
        return
    start = room * i
    gap = count / 2
    while gap > 0:
        for k in range(gap, count):
            j = cells.candidates[start + k]
            place = int(k)
            while place >= gap and cells.rank[cells.candidates[start + place - gap]] > cells.rank[j]:
                cells.candidates[start + place] = cells.candidates[start + place - gap]
                place -= gap
            cells.candidates[start + place] = j
        gap /= 2
