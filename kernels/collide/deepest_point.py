"""The deepest point of a flat piece of one body's surface in another body, by its true distance.

The search maximizes the depth, a point's distance to the other surface: from the middle of the piece along the
gradient, to the border or to the maximum before it, where the tangents at both ends of a bracket meet. This is exact at
once where two planes meet. On the ridge between them the direction is the shortest mixture of both slopes (the
aggregate of two cuts of a bundle method), along which the depth grows on both sides.

A round part, which has a closed form, is mapped: each point of a box around it stands for the nearest point of the
part's surface. As the part is convex, all of its surface is reached, edges and rims included, and the map never
increases a distance. Its derivative is symmetric, so that the slope on the box is the derivative applied to the slope.
"""

import warp as wp

from warp_rigid.kernels.collide.distance import FAR, GRID_ERROR, analytic_distance, farthest_by_grid, grid_distance
from warp_rigid.kernels.collide.height_distance import distance_to_heights
from warp_rigid.kernels.collide.triangle_distance import foot_on_triangle, triangle_distance
from warp_rigid.kernels.enums import PartKind
from warp_rigid.kernels.schema import Shapes

wp.set_module_options({"enable_backward": False, "max_unroll": 4})


@wp.struct
class View:
    """One body's part as seen from another body.

    Attributes:
        own: the shape whose surface is searched.
        part: the part of it.
        other: the shape in which points are deep.
        turn: rotation from the part's frame to the other shape's.
        shift: origin of the part in the other shape's frame [m].
        mapped: 1 if pieces are those of a box around the part.
        fine: gain of depth that does not matter [m].
        piece: largest radius of a piece that is searched [m].
        steepest: largest slope of the other shape's distance.
    """

    own: int
    part: int
    other: int
    turn: wp.quat
    shift: wp.vec3
    mapped: int
    fine: float
    piece: float
    steepest: float


@wp.struct
class Facet:
    """A triangle of the surface of a part, in the part's frame, and the sphere around it."""

    a: wp.vec3
    b: wp.vec3
    c: wp.vec3
    normal: wp.vec3
    center: wp.vec3
    radius: float


@wp.struct
class Probe:
    """The depth at a point of a facet, its slope in the plane of the facet, and 1 if another part hides the point."""

    point: wp.vec3
    depth: float
    slope: wp.vec3
    hidden: int


@wp.struct
class Bracket:
    """Two points between which the depth is highest, from the slopes toward each other."""

    low: Probe
    high: Probe
    closed: int


@wp.struct
class Ascent:
    """The highest point that was found, and 1 if the slope there leads nowhere."""

    top: Probe
    ended: int


@wp.func
def true_mesh_distance(shapes: Shapes, part: int, p: wp.vec3, near: float):
    """Distance to a mesh: from its triangles where it may be below `near`, else from its grid, off by GRID_ERROR cells.

    A mesh with a fault (`Mesh.fault`) has the distance of its grid everywhere.
    """
    d, bound = grid_distance(shapes, part, p)
    d[3] = wp.max(d[3], bound)
    cell = shapes.parts[part].grid_spacing
    if bound >= near or shapes.parts[part].tree_start == shapes.parts[part].tree_end:
        return d
    far = farthest_by_grid(d[3], cell)
    nowhere = wp.vec3(0.0, 0.0, 0.0)
    return triangle_distance(shapes, part, p, nowhere, far, far + GRID_ERROR * cell, d)


@wp.func
def true_distance(shapes: Shapes, shape: int, p: wp.vec3, near: float):
    """Distance from a point to a shape, and its direction, in the shape's frame; see `true_mesh_distance`.

    In a union of parts, the depth is that in the deepest part.
    """
    nearest = wp.vec4(0.0, 0.0, 1.0, FAR)
    for part in range(shapes.shapes[shape].part_start, shapes.shapes[shape].part_end):
        turn = shapes.parts[part].orientation
        local = wp.quat_rotate_inv(turn, p - shapes.parts[part].position)
        kind = shapes.parts[part].kind
        d = nearest
        if kind == PartKind.GRID:
            d = true_mesh_distance(shapes, part, local, near)
        elif kind == PartKind.HEIGHTFIELD:
            d = distance_to_heights(shapes, part, local, wp.max(near, 0.0), FAR)
        else:
            d = analytic_distance(kind, shapes.parts[part].size, local, wp.vec3(0.0, 0.0, 0.0))
        if d[3] < nearest[3]:
            n = wp.quat_rotate(turn, wp.vec3(d[0], d[1], d[2]))
            nearest = wp.vec4(n[0], n[1], n[2], d[3])
    return nearest


@wp.func
def make_facet(a: wp.vec3, b: wp.vec3, c: wp.vec3):
    """A triangle with its normal and the sphere around it."""
    facet = Facet()
    facet.a = a
    facet.b = b
    facet.c = c
    facet.normal = wp.normalize(wp.cross(b - a, c - a))
    facet.center = (a + b + c) / 3.0
    facet.radius = wp.max(wp.length(a - facet.center), wp.length(b - facet.center))
    facet.radius = wp.max(facet.radius, wp.length(c - facet.center))
    return facet


@wp.func
def surface_point(shapes: Shapes, view: View, p: wp.vec3):
    """The point of the part's surface for which a point of a facet stands."""
    if view.mapped == 0:
        return p
    part = view.part
    d = analytic_distance(shapes.parts[part].kind, shapes.parts[part].size, p, wp.vec3(0.0, 0.0, 0.0))
    return p - d[3] * wp.vec3(d[0], d[1], d[2])


@wp.func
def is_hidden(shapes: Shapes, view: View, x: wp.vec3):
    """Whether a point of a part's surface lies inside another part of the same shape."""
    if shapes.shapes[view.own].part_end == shapes.shapes[view.own].part_start + 1:
        return False
    p = wp.quat_rotate(shapes.parts[view.part].orientation, x) + shapes.parts[view.part].position
    d = true_distance(shapes, view.own, p, 0.0)
    # A point so deep in another part is not on the surface.
    return d[3] < -1.0e-4 * shapes.shapes[view.own].size


@wp.func(inline=False)
def probe(shapes: Shapes, view: View, facet: Facet, p: wp.vec3):
    """The depth at a point of a facet."""
    found = Probe()
    found.point = p
    x = surface_point(shapes, view, p)
    d = true_distance(shapes, view.other, wp.quat_rotate(view.turn, x) + view.shift, 2.0 * facet.radius)
    found.depth = -d[3]
    slope = -wp.quat_rotate_inv(view.turn, wp.vec3(d[0], d[1], d[2]))
    if view.mapped == 1:
        # The derivative of the map.
        step = 1.0e-3 * facet.radius
        slope = (surface_point(shapes, view, p + step * slope) - x) / step
    found.slope = slope - wp.dot(slope, facet.normal) * facet.normal
    if is_hidden(shapes, view, x):
        found.hidden = 1
    return found


@wp.func
def way_out(facet: Facet, p: wp.vec3, u: wp.vec3):
    """Distance from a point of a facet to its border along a direction in its plane."""
    length = 2.0 * facet.radius
    for k in range(3):
        start = wp.where(k == 0, facet.a, wp.where(k == 1, facet.b, facet.c))
        end = wp.where(k == 0, facet.b, wp.where(k == 1, facet.c, facet.a))
        inward = wp.normalize(wp.cross(facet.normal, end - start))
        approach = -wp.dot(u, inward)
        if approach > 1.0e-3:
            length = wp.min(length, wp.max(wp.dot(p - start, inward), 0.0) / approach)
    return length


@wp.func
def on_facet(facet: Facet, p: wp.vec3):
    """The nearest point of a facet."""
    foot = foot_on_triangle(p, facet.a, facet.b, facet.c)
    return p - foot.offset


@wp.func
def least_gain(fine: float, depth: float):
    """A smaller gain ends the search [m]."""
    return fine + 1.0e-3 * wp.max(depth, 0.0)


@wp.func
def close_in(shapes: Shapes, view: View, facet: Facet, here: Probe, there: Probe):
    """The bracket of the highest point on the segment from `here` to `there`.

    In turn the point below which the tangents at both ends meet, and the one where the slope becomes zero if it changes
    evenly. Tangents bound a concave depth; otherwise the midpoint is tried.
    """
    bracket = Bracket()
    bracket.low = here
    bracket.high = there
    u = wp.normalize(there.point - here.point)
    cut = int(0)
    while cut < 12:
        low = bracket.low.depth
        high = bracket.high.depth
        rise = wp.dot(bracket.low.slope, u)
        fall = -wp.dot(bracket.high.slope, u)
        if rise <= 0.0 or fall <= 0.0:
            return bracket
        bracket.closed = 1
        span = wp.dot(bracket.high.point - bracket.low.point, u)
        gain = least_gain(view.fine, low)
        way = 0.5 * span
        if wp.min(high + fall * span - low, low + rise * span - high) > -gain:
            way = (high - low + fall * span) / (rise + fall)
            if low + rise * way - wp.max(low, high) < gain:
                return bracket
            if cut % 2 == 1:
                way = span * rise / (rise + fall)
        elif rise * span < gain:
            return bracket
        middle = probe(shapes, view, facet, bracket.low.point + wp.clamp(way, 0.0, span) * u)
        if middle.hidden == 0 and wp.dot(middle.slope, u) > 0.0:
            bracket.low = middle
        else:
            bracket.high = middle
        cut += 1
    return bracket


@wp.func
def shortest_mixture(g: wp.vec3, h: wp.vec3):
    """The point of the segment between two vectors that is nearest to zero."""
    side = g - h
    return h + wp.clamp(-wp.dot(h, side) / wp.max(wp.length_sq(side), 1.0e-12), 0.0, 1.0) * side


@wp.func
def higher(first: Probe, second: Probe):
    """The deeper one of two visible points, or the first one."""
    if second.hidden == 0 and second.depth > first.depth:
        return second
    return first


@wp.func
def ascend(shapes: Shapes, view: View, facet: Facet, start: Probe):
    """The highest point that is found on a facet from one of its points, and whether the depth cannot grow there."""
    found = Ascent()
    found.top = start
    direction = start.slope
    failures = int(0)
    for _ in range(6):
        here = found.top
        gain = least_gain(view.fine, here.depth)
        # This step finds the direction in which the border can be followed.
        step = 0.25 * facet.radius / wp.max(wp.length(direction), 1.0e-12)
        along = (on_facet(facet, here.point + step * direction) - here.point) / step
        slope = wp.length(along)
        length = way_out(facet, here.point, along / wp.max(slope, 1.0e-12))
        if slope * length < gain:
            found.ended = 1
            return found
        there = probe(shapes, view, facet, on_facet(facet, here.point + length / slope * along))
        bracket = close_in(shapes, view, facet, here, there)
        found.top = higher(higher(here, bracket.low), bracket.high)
        failures = wp.where(found.top.depth < here.depth + gain, failures + 1, 0)
        if failures == 2:
            return found
        direction = found.top.slope
        if bracket.closed == 1:
            direction = shortest_mixture(bracket.low.slope, bracket.high.slope)
    return found


@wp.func
def climb(shapes: Shapes, view: View, facet: Facet, start: Probe):
    """The highest depth that is found on a facet: from its middle and, if that path reaches the border, on its sides.

    Where edges cross, the depth has a narrow top on the side of a facet, toward which the slopes turn to and fro.
    """
    found = ascend(shapes, view, facet, start)
    if found.ended == 1:
        return found.top.depth
    corner = probe(shapes, view, facet, facet.a)
    side = int(0)
    while side < 3:
        last = corner
        corner = probe(shapes, view, facet, wp.where(side == 0, facet.b, wp.where(side == 1, facet.c, facet.a)))
        bracket = close_in(shapes, view, facet, last, corner)
        found.top = higher(higher(found.top, bracket.low), bracket.high)
        side += 1
    found = ascend(shapes, view, facet, found.top)
    return found.top.depth
