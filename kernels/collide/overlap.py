"""Diagnostics: the deepest overlap of two bodies, apart from their contacts. Not a stage of the step.

The overlap of two bodies is the largest depth of a point of one surface inside the other body. Every piece of both
surfaces that may hold a deeper point than the deepest found so far is searched (deepest_point.py): the triangles of
meshes and height fields, and of a box around each other part. Which pieces are left out depends on the order of
threads, but the result does not: no point of these is deeper.
"""

import warp as wp

from warp_rigid.kernels.collide.deepest_point import Facet, View, climb, make_facet, probe, surface_point, true_distance
from warp_rigid.kernels.collide.distance import FAR, GRID_ERROR, analytic_distance
from warp_rigid.kernels.collide.height_distance import node
from warp_rigid.kernels.collide.triangle_distance import triangles_of
from warp_rigid.kernels.enums import PartKind
from warp_rigid.kernels.schema import Bodies, Pairs, Shapes, State
from warp_rigid.kernels.shape_arrays import read_node, read_triangle

wp.set_module_options({"enable_backward": False, "max_unroll": 4})

ROUND_ERROR = wp.constant(1.0e-5)
"""Relative allowance for rounding when pieces are left out."""


@wp.func
def may_be_deeper(shapes: Shapes, view: View, center: wp.vec3, radius: float, best: float):
    """Whether a point of a piece within a ball may be deeper in the other shape than `best`; never wrongly false."""
    x = surface_point(shapes, view, center)
    d = true_distance(shapes, view.other, wp.quat_rotate(view.turn, x) + view.shift, -FAR)
    return d[3] < (1.0 + ROUND_ERROR) * radius - best + GRID_ERROR * shapes.shapes[view.other].cell


@wp.func
def piece_of(facet: Facet, number: int):
    """A piece of a facet: each two bits of its number, after the leading 1, choose a corner or the middle of four."""
    piece = facet
    shift = int(0)
    while (number >> shift) >= 4:
        shift += 2
    while shift > 0:
        shift -= 2
        choice = (number >> shift) & 3
        ab = 0.5 * (piece.a + piece.b)
        bc = 0.5 * (piece.b + piece.c)
        ca = 0.5 * (piece.c + piece.a)
        if choice == 0:
            piece = make_facet(piece.a, ab, ca)
        elif choice == 1:
            piece = make_facet(ab, piece.b, bc)
        elif choice == 2:
            piece = make_facet(ca, bc, piece.c)
        else:
            piece = make_facet(bc, ca, ab)
    return piece


@wp.func
def next_piece(number: int, divide: bool):
    """The number of the piece that follows: the first part of this one, or the next piece beside it; 0 at the end."""
    # At most 13 levels.
    if divide and number < (1 << 26):
        return 4 * number
    while (number & 3) == 3:
        number = number >> 2
    return wp.where(number < 4, 0, number + 1)


@wp.func(inline=False)
def search_facet(shapes: Shapes, view: View, facet: Facet, env: int, deepest: wp.array2d[float]):
    """Raise the deepest overlap of an environment to that of a facet, piece by piece."""
    number = int(1)
    while number > 0:
        piece = piece_of(facet, number)
        best = deepest[env, 0]
        divide = bool(False)
        if may_be_deeper(shapes, view, piece.center, piece.radius, best):
            divide = piece.radius > view.piece
            if not divide:
                middle = probe(shapes, view, piece, piece.center)
                if middle.depth + (1.0 + ROUND_ERROR) * view.steepest * piece.radius > best:
                    # A piece whose middle is inside another part of its body is divided further.
                    divide = middle.hidden == 1 and piece.radius > 0.125 * view.piece
                    if middle.hidden == 0:
                        wp.atomic_max(deepest, env, 0, climb(shapes, view, piece, middle))
        number = next_piece(number, divide)


@wp.func
def search_mesh(shapes: Shapes, view: View, lane: int, lanes: int, env: int, deepest: wp.array2d[float]):
    """Search the triangles of a mesh that a team of lanes shares."""
    at = shapes.parts[view.part].tree_start
    while at < shapes.parts[view.part].surface_end:
        box = read_node(at, shapes.tree)
        middle = 0.5 * (box.lower + box.upper)
        if may_be_deeper(shapes, view, middle, 0.5 * wp.length(box.upper - box.lower), deepest[env, 0]):
            first, end = triangles_of(box.leaf)
            for t in range(first, end):
                if t % lanes == lane:
                    triangle = read_triangle(t, shapes.triangles)
                    facet = make_facet(triangle.corner_0, triangle.corner_1, triangle.corner_2)
                    search_facet(shapes, view, facet, env, deepest)
            at += 1
        else:
            at = box.skip


@wp.func
def extents_of(shapes: Shapes, part: int):
    """Half extents of a box around an analytic part, in its frame; exact for a box."""
    size = shapes.parts[part].size
    half = wp.vec3(size[0], size[1], size[2])
    if shapes.parts[part].kind == PartKind.BOX:
        return half
    # The extents are taken from the distance a thousand sizes away, and enlarged by a quarter.
    away = 1000.0 * wp.max(wp.max(half), size[3])
    for axis in range(3):
        p = wp.vec3(0.0, 0.0, 0.0)
        p[axis] = away
        d = analytic_distance(shapes.parts[part].kind, size, p, wp.vec3(0.0, 0.0, 0.0))
        e = analytic_distance(shapes.parts[part].kind, size, -p, wp.vec3(0.0, 0.0, 0.0))
        half[axis] = 1.25 * (away - wp.min(d[3], e[3]))
    return half


@wp.func
def search_box(shapes: Shapes, view: View, lane: int, lanes: int, env: int, deepest: wp.array2d[float]):
    """Search the twelve triangles of the box around an analytic part."""
    half = extents_of(shapes, view.part)
    for k in range(lane, 12, lanes):
        axis = k / 4
        first = wp.vec3(0.0, 0.0, 0.0)
        second = wp.vec3(0.0, 0.0, 0.0)
        middle = wp.vec3(0.0, 0.0, 0.0)
        first[(axis + 1) % 3] = half[(axis + 1) % 3]
        second[(axis + 2) % 3] = half[(axis + 2) % 3]
        middle[axis] = wp.where(k % 4 < 2, half[axis], -half[axis])
        third = wp.where(k % 2 == 0, first - second, second - first)
        facet = make_facet(middle - first - second, middle + first + second, middle + third)
        search_facet(shapes, view, facet, env, deepest)


@wp.func
def search_field(shapes: Shapes, view: View, lane: int, lanes: int, env: int, deepest: wp.array2d[float]):
    """Search the triangles of a height field in the cells below and above the other shape."""
    lower = shapes.shapes[view.other].lower
    upper = shapes.shapes[view.other].upper
    center = wp.quat_rotate_inv(view.turn, 0.5 * (lower + upper) - view.shift)
    radius = 0.5 * wp.length(upper - lower)
    dims = shapes.parts[view.part].grid_dims
    size = shapes.parts[view.part].size
    last = wp.vec2(float(dims[0] - 1), float(dims[1] - 1))
    start = wp.vec2i(0, 0)
    end = wp.vec2i(0, 0)
    for axis in range(2):
        start[axis] = int(wp.max(last[axis] * ((center[axis] - radius) / size[axis] + 0.5), 0.0))
        end[axis] = int(wp.min(last[axis] * ((center[axis] + radius) / size[axis] + 0.5) + 1.0, last[axis]))
    width = wp.max(end[1] - start[1], 0)
    for k in range(lane, 2 * wp.max(end[0] - start[0], 0) * width, lanes):
        i = start[0] + (k / 2) / width
        j = start[1] + (k / 2) % width
        side = node(shapes, view.part, i + 1 - k % 2, j + k % 2)
        facet = make_facet(node(shapes, view.part, i, j), side, node(shapes, view.part, i + 1, j + 1))
        search_facet(shapes, view, facet, env, deepest)


@wp.func
def diagonal(shapes: Shapes, shape: int):
    """Length of the diagonal of a shape's bounding box [m]."""
    return wp.length(shapes.shapes[shape].upper - shapes.shapes[shape].lower)


@wp.func
def largest_piece(shapes: Shapes, own: int, other: int):
    """Largest radius of a piece of one shape that can have only one deepest point in the other, roughly [m]."""
    if shapes.shapes[other].convex == 1 or shapes.shapes[other].hull_end > shapes.shapes[other].hull_start:
        return FAR
    # A fraction of a size, or of a cell, but at most 32 pieces along the diagonal of the smaller body.
    feature = 0.125 * shapes.shapes[other].size
    part = shapes.shapes[other].part_start
    if shapes.parts[part].kind == PartKind.HEIGHTFIELD:
        feature = 0.25 * shapes.parts[part].grid_spacing
    return wp.max(feature, wp.min(diagonal(shapes, own), diagonal(shapes, other)) / 32.0)


@wp.func
def view_of(own: int, other: int, part: int, shapes: Shapes, bodies: Bodies, state: State):
    """A part of one body as seen from another body."""
    view = View()
    view.own = bodies.shape[own]
    view.other = bodies.shape[other]
    view.part = part
    back = wp.quat_inverse(state.orientation[other])
    turn = back * state.orientation[own]
    view.turn = turn * shapes.parts[part].orientation
    view.shift = wp.quat_rotate(turn, shapes.parts[part].position) + wp.quat_rotate(
        back, state.position[own] - state.position[other]
    )
    kind = shapes.parts[part].kind
    view.mapped = wp.where(kind == PartKind.GRID or kind == PartKind.HEIGHTFIELD or kind == PartKind.BOX, 0, 1)
    view.fine = 2.0e-6 * wp.min(shapes.shapes[view.own].size, shapes.shapes[view.other].size)
    view.piece = largest_piece(shapes, view.own, view.other)
    view.steepest = 1.0
    for k in range(shapes.shapes[view.other].part_start, shapes.shapes[view.other].part_end):
        if shapes.parts[k].kind == PartKind.GRID and shapes.parts[k].tree_start == shapes.parts[k].tree_end:
            # The slope of an interpolated distance is at most sqrt(3).
            view.steepest = 1.7321
    return view


@wp.func
def inner_ball_depth(own: int, other: int, shapes: Shapes, bodies: Bodies, state: State):
    """Deepest overlap of an inner ball of one body with another that contains its centre [m], else 0.

    Of two bodies at the same place, no point of either surface is deep inside the other.
    """
    shape = bodies.shape[own]
    deepest = float(0.0)
    for k in range(shapes.shapes[shape].ball_start, shapes.shapes[shape].ball_end):
        ball = shapes.balls[k]
        x = wp.quat_rotate(state.orientation[own], wp.vec3(ball[0], ball[1], ball[2])) + state.position[own]
        local = wp.quat_rotate_inv(state.orientation[other], x - state.position[other])
        d = true_distance(shapes, bodies.shape[other], local, 0.0)
        if d[3] < 0.0 and ball[3] > 0.0:
            deepest = wp.max(deepest, ball[3] - d[3])
    return deepest


@wp.kernel
def deepest_overlap(lanes: int, shapes: Shapes, bodies: Bodies, state: State, pairs: Pairs, deepest: wp.array2d[float]):
    """A team of lanes per pair: the environment's deepest overlap [m], (envs, 1).

    `deepest` has two dimensions because Warp compiles a kernel with 1D array arguments twice for the CPU, the second
    time for contiguous arrays.
    """
    lane = wp.tid() % lanes
    pair = wp.tid() / lanes
    if pair >= pairs.start[pairs.start.shape[0] - 1]:
        return
    a = pairs.body_a[pair]
    b = pairs.body_b[pair]
    env = bodies.env[a]
    side = int(0)
    while side < 2:
        own = wp.where(side == 0, a, b)
        other = a + b - own
        if lane == 0:
            wp.atomic_max(deepest, env, 0, inner_ball_depth(own, other, shapes, bodies, state))
        shape = bodies.shape[own]
        for part in range(shapes.shapes[shape].part_start, shapes.shapes[shape].part_end):
            view = view_of(own, other, part, shapes, bodies, state)
            kind = shapes.parts[part].kind
            if kind == PartKind.GRID:
                search_mesh(shapes, view, lane, lanes, env, deepest)
            elif kind == PartKind.HEIGHTFIELD:
                search_field(shapes, view, lane, lanes, env, deepest)
            elif kind != PartKind.PLANE:
                search_box(shapes, view, lane, lanes, env, deepest)
        side += 1
