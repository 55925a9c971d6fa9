"""Contact point search: finds where one surface sample touches another shape.

The contact point of a point sample is the point itself; on an edge segment it is the deepest point, or the point where
the edge leaves a face; on the rim of a cylinder and on a sphere it is the deepest point. Each is a short search,
written as a state machine with a single call of the distance function. That function is large, and one call site keeps
the GPU code small and fast, and its compilation short.
"""

import warp as wp

from warp_rigid.kernels.collide.distance import (
    BORDER,
    FAR,
    ball_distance_to_places,
    contact_distance,
    direction_or_up,
    has_places,
)
from warp_rigid.kernels.enums import PartKind, SampleKind
from warp_rigid.kernels.schema import Shapes

wp.set_module_options({"enable_backward": False, "max_unroll": 4})


OPPOSED = wp.constant(0.1)
"""A vertex or edge can touch only if the cosine of its normal and the contact normal is below this value; it is not
smaller because vertices and edges have wide normal cones."""

OVERLAP = wp.constant(1.05)
"""Factor by which edge segments are extended for the search."""

BEYOND = wp.constant(1.01)
"""Points beyond this many half-lengths belong to the next segment, or lie past the end of the edge."""

ALL_OF_EDGE = wp.constant(2.2)
"""If an edge touches, all of it is within this number of half-lengths of the surface, besides its radius. The axis of a
rod needs exact distances up to there: it may end outside a grid, where the slope of the bound is wrong."""

STEEP = wp.constant(0.05)
"""Slope of the distance above which an edge crosses another edge instead of lying along it."""

FLAT = wp.constant(0.01)
"""Slope of the distance along an edge below which the edge lies flat."""

MUCH_DEEPER = wp.constant(3.0)
DEEPER = wp.constant(0.1)
"""The distance to the face that a point opposes may be MUCH_DEEPER times as deep as that to the nearest face, plus
DEEPER times the size."""

CURVED = wp.constant(1.0e-3)
"""A distance that lies above its tangents by more than this fraction of the interval counts as curved, not kinked."""

FOUND = wp.constant(1.0e-4)
"""The search along an edge ends when the point moves by less than this fraction of the half-length."""

ASIDE = wp.constant(0.01)
"""Offset from a crossing at which the gradients on both sides are evaluated, as a fraction of the half-length."""

BESIDE = wp.constant(1.0e-3)
"""Offset from the point where an edge leaves a face at which the gradient is evaluated, as a fraction of the
half-length."""

PARALLEL = wp.constant(1.0e-3)
"""An edge whose half-length covers less than this fraction of a grid's side is not clipped to that side."""

DONE = wp.constant(-1)

EDGE_MIDDLE = wp.constant(0)
EDGE_LOW = wp.constant(1)
EDGE_HIGH = wp.constant(2)
EDGE_INSIDE = wp.constant(3)
EDGE_LAST_INSIDE = wp.constant(9)
EDGE_CLAMPED = wp.constant(10)
EDGE_FACING = wp.constant(11)
EDGE_BEFORE = wp.constant(12)
EDGE_AFTER = wp.constant(13)

RIM_CENTER = wp.constant(0)
RIM_LAST_TURN = wp.constant(2)
RIM_FACING = wp.constant(3)

POINT_AGAIN = wp.constant(1)

BALL_CENTER = wp.constant(20)
BALL_FIRST = wp.constant(21)
BALL_LAST = wp.constant(27)

SLIDE_END = wp.constant(30)
SLIDE_FIRST = wp.constant(31)
SLIDE_LAST = wp.constant(36)

NEARER_HALF = wp.constant(0.505)
"""A point slides along this fraction of an edge; the sample at the other end covers the rest."""

ENOUGH = wp.constant(1.0e-5)
"""A slide ends when the distance may fall by less than this fraction of the size."""

SAME_FACE = wp.constant(0.5)
"""Where an edge crosses one of another mesh, the cosine between the faces of that edge exceeds this value."""


@wp.struct
class Search:
    """State of the search of a sample. The distance is evaluated next at `query`, with the sample normal `facing`.

    `evaluations`: number of distances so far, for measurements. `least`: the least of them, at most 0.
    """

    stage: int
    evaluations: int
    least: float
    query: wp.vec3
    facing: wp.vec3
    normal: wp.vec3
    direction: wp.vec3
    distance: float
    start: wp.vec3
    along: wp.vec3
    half: float
    first: float
    last: float
    crossing: int
    t: float
    left: float
    right: float
    low: wp.vec4
    high: wp.vec4
    slope_low: float
    slope_high: float
    turning: float
    before: wp.vec4
    way: wp.vec3


@wp.func
def slope(d: wp.vec4, along: wp.vec3):
    """Slope of a distance along a direction."""
    return d[0] * along[0] + d[1] * along[1] + d[2] * along[2]


@wp.func
def gradient(d: wp.vec4):
    """The direction of a distance, its gradient."""
    return wp.vec3(d[0], d[1], d[2])


@wp.func
def nowhere(search: Search):
    """End the search without a contact point."""
    search.stage = DONE
    search.distance = FAR
    return search


@wp.func
def look_at(search: Search, t: float):
    """Evaluate the distance next at parameter t of the edge."""
    search.t = t
    search.query = search.start + t * search.along
    return search


@wp.func
def next_inside(search: Search, curved: bool):
    """Evaluate next where the tangents at both ends meet or, for a curved distance, where the slope becomes zero."""
    bend = wp.max(search.slope_high - search.slope_low, 1.0e-6)
    rise = search.slope_high * search.right - search.slope_low * search.left
    t = (search.low[3] - search.high[3] + rise) / bend
    if curved:
        t = search.left - search.slope_low * (search.right - search.left) / bend
    return look_at(search, wp.clamp(t, search.left, search.right))


@wp.func
def came_elsewhere(search: Search, distance: float, direction: wp.vec3, size: float, weight: float):
    """Whether an edge is deep inside, and nearest to a face that it cannot have entered through."""
    deep = distance < -BORDER * size and wp.dot(direction, search.normal) >= OPPOSED
    return deep and weight > 0.0 and wp.length_sq(search.facing) == 0.0


@wp.func
def edge_again(search: Search):
    """Restart an edge's search with the distance to the faces that its normal opposes."""
    search.facing = search.normal
    search.crossing = 0
    search.left = search.first
    search.right = search.last
    search.stage = EDGE_LOW
    return look_at(search, search.left)


@wp.func
def edge_has_ends(search: Search, d: wp.vec4):
    """With both ends known, test whether the distance has an inner minimum or the edge leaves a face."""
    search.high = d
    search.slope_high = slope(d, search.along)
    search.slope_low = slope(search.low, search.along)
    low = search.slope_low
    high = search.slope_high
    if low > FLAT or high < -FLAT or high - low < 2.0 * FLAT:
        return nowhere(search)
    search.turning = 0.5 * (wp.min(low + FLAT, 0.0) + wp.max(high - FLAT, 0.0))
    if low < -STEEP and high > STEEP:
        search.turning = 0.0
        search.crossing = 1
    search.stage = EDGE_INSIDE
    return next_inside(search, False)


@wp.func
def stays_above(search: Search, reach: float, convex: int):
    """Whether an edge is out of reach: the distance to a convex shape lies above its tangents, which meet there."""
    return convex == 1 and search.low[3] + search.slope_low * (search.t - search.left) > reach


@wp.func
def to_flat_side(search: Search):
    """Small offset along an edge, from where it leaves a face (where two faces are equally near) onto that face."""
    left = wp.abs(search.slope_low) < wp.abs(search.slope_high)
    return wp.where(left, -BESIDE, BESIDE) * search.half * search.along


@wp.func
def edge_found(search: Search, radius: float, convex: int, weight: float):
    """The point is found. Evaluate next both sides of a crossing, or the faces that a flat edge's normal opposes."""
    if radius > 0.0 and convex == 0:
        # The axis of a rod may lie outside a grid where its surface does not.
        search.start = search.query
        search.stage = BALL_CENTER
        return search
    if search.crossing == 1 and convex == 1:
        search.stage = EDGE_BEFORE
        search.query = search.start + (search.t - ASIDE * search.half) * search.along
        return search
    search.facing = weight * search.normal
    search.distance -= radius
    search.query -= radius * search.direction
    search.stage = DONE
    if search.crossing == 0:
        search.stage = EDGE_FACING
        search.query += to_flat_side(search)
    return search


@wp.func
def edge_crossed(search: Search, before: wp.vec4, after: wp.vec4, radius: float):
    """The contact normal where an edge crosses an edge of a convex shape, from the gradients on both sides of it.

    The combination of the gradients with zero slope along the edge is perpendicular to both edges. If both faces are at
    a distance d, the edge moving along this normal n leaves the shape through the face that it meets first, after
    d / (g . n). If the search is not close enough to the crossing to sample both sides, its two ends are used instead.
    """
    if slope(before, search.along) >= 0.0 or slope(after, search.along) <= 0.0:
        before = search.low
        after = search.high
    rise = wp.max(slope(after, search.along), 0.0)
    fall = wp.max(-slope(before, search.along), 0.0)
    mixture = rise * gradient(before) + fall * gradient(after)
    if wp.length_sq(mixture) > 0.0:
        search.direction = wp.normalize(mixture)
        if search.distance < 0.0:
            n = search.direction
            search.distance /= wp.max(wp.max(wp.dot(gradient(before), n), wp.dot(gradient(after), n)), 0.3)
    search.stage = DONE
    search.distance -= radius
    search.query = search.start + search.t * search.along - radius * search.direction
    return search


@wp.func
def edge_inside(search: Search, d: wp.vec4, radius: float, convex: int, weight: float):
    """One more round of the search between the ends of an edge segment, or its end."""
    search.distance = d[3]
    search.direction = gradient(d)
    if search.stage == EDGE_CLAMPED:
        return edge_found(search, radius, convex, weight)
    before = search.t
    curved = d[3] - search.low[3] - search.slope_low * (before - search.left) > CURVED * (search.right - search.left)
    if slope(d, search.along) < search.turning:
        search.left = before
        search.low = d
        search.slope_low = slope(d, search.along)
    else:
        search.right = before
        search.high = d
        search.slope_high = slope(d, search.along)
    after = next_inside(search, curved)
    if search.stage < EDGE_LAST_INSIDE and wp.abs(after.t - before) > FOUND * search.half:
        after.stage = search.stage + 1
        return after
    if wp.abs(before) > BEYOND * search.half:
        return nowhere(search)
    if wp.abs(before) > search.half:
        search.stage = EDGE_CLAMPED
        return look_at(search, wp.clamp(before, -search.half, search.half))
    return edge_found(search, radius, convex, weight)


@wp.func
def edge_next(search: Search, d: wp.vec4, reach: float, radius: float, size: float, convex: int, weight: float):
    """Contact point of an edge segment, between its ends.

    This is the inner minimum of the distance or, for an edge that lies flat, the point where it leaves the face. In
    both cases the slope along the edge is discontinuous there. The tangents at both ends meet below the curve; the
    point below which they meet replaces the end on its side. This is exact after one round if two straight edges
    cross, where the distance is V-shaped. Neighbouring segments overlap slightly, so that there are no gaps between
    them.
    """
    if search.stage == EDGE_MIDDLE:
        if d[3] > OVERLAP * search.half + reach + radius:
            return nowhere(search)
        search.stage = EDGE_LOW
        return look_at(search, search.left)
    if search.stage == EDGE_LOW:
        search.low = d
        search.stage = EDGE_HIGH
        return look_at(search, search.right)
    if search.stage == EDGE_HIGH:
        deepest = wp.where(d[3] < search.low[3], d, search.low)
        search = edge_has_ends(search, d)
        if search.stage == DONE and came_elsewhere(search, deepest[3], gradient(deepest), size, weight):
            return edge_again(search)
        if search.stage == EDGE_INSIDE and stays_above(search, reach + radius, convex):
            return nowhere(search)
        return search
    if search.stage == EDGE_BEFORE:
        search.before = d
        search.stage = EDGE_AFTER
        search.query = search.start + (search.t + ASIDE * search.half) * search.along
        return search
    if search.stage == EDGE_AFTER:
        search = edge_crossed(search, search.before, d, radius)
        if came_elsewhere(search, search.distance, search.direction, size, weight):
            search = edge_again(search)
        return search
    if search.stage == EDGE_FACING:
        if d[3] < search.distance - BORDER * size:
            return nowhere(search)
        search.stage = DONE
        search.query -= to_flat_side(search)
        search.direction = gradient(d)
        search.distance = d[3]
        return search
    return edge_inside(search, d, radius, convex, weight)


@wp.func
def rim_next(search: Search, d: wp.vec4, radius: float, weight: float):
    """The deepest point of a circle about `along`; none if it lies flat on the surface."""
    if search.stage == RIM_FACING:
        search.stage = DONE
        search.direction = gradient(d)
        search.distance = d[3]
        return search
    if d[3] >= FAR:
        return nowhere(search)
    n = gradient(d)
    down = wp.dot(n, search.along) * search.along - n
    if wp.length(down) < 0.05:
        return nowhere(search)
    search.query = search.start + radius * wp.normalize(down)
    search.stage += 1
    if search.stage > RIM_LAST_TURN:
        # Halfway between side and cap, as at a box's corner: either face may be in contact.
        search.normal = wp.normalize((search.query - search.start) / radius + search.along)
        search.facing = weight * search.normal
    return search


@wp.func
def ball_next(search: Search, d: wp.vec4, radius: float, size: float, exact: int):
    """The deepest point of a sphere.

    Outside a grid the distance is only a bound. The centre of a sphere may lie there, but not its deepest point. This
    point is found by descent over the sphere's surface: along the gradient while the distance decreases, by at most the
    width of the shape. Corners and edges of the shape need no search, as their own samples find the sphere. A sphere
    whose centre is inside needs none either: beyond the middle of the shape, the descent would end at its far side.
    """
    if search.stage == BALL_CENTER:
        search.direction = gradient(d)
        search.distance = d[3] - radius
        search.along = gradient(d)
        search.half = wp.min(size / radius, 1.0)
        search.t = search.half
        search.query = search.start - radius * search.along
        search.stage = wp.where(exact == 1 or d[3] < 0.0, DONE, BALL_FIRST)
        return search
    if search.stage == BALL_FIRST or d[3] < search.distance:
        if search.stage > BALL_FIRST:
            search.along = search.way
            search.t = wp.min(2.0 * search.t, search.half)
        search.direction = gradient(d)
        search.distance = d[3]
    else:
        search.t *= 0.5
    search.way = direction_or_up((1.0 - search.t) * search.along + search.t * search.direction)
    if search.stage == BALL_LAST:
        search.way = search.along
    search.query = search.start - radius * search.way
    search.stage = wp.where(search.stage == BALL_LAST, DONE, search.stage + 1)
    return search


@wp.func
def point_next(search: Search, d: wp.vec4, size: float, flat: int, thin: int):
    """Distance of a point sample. `flat` points represent a face; those of a `thin` shape may be near its far side.

    Near an edge, a flat point may lie behind a face that it does not oppose, far from one that it does. If a thin part
    of a mesh has entered slightly, the points on its other side oppose only distant faces. Both are rejected.
    """
    if search.stage == POINT_AGAIN:
        deepest = wp.where(flat == 1, 2.0 * d[3] - BORDER * size, MUCH_DEEPER * d[3] - DEEPER * size)
        if search.distance < deepest:
            return nowhere(search)
        search.stage = DONE
        return search
    search.direction = gradient(d)
    search.distance = d[3]
    search.stage = DONE
    if flat + thin > 0 and d[3] < -BORDER * size:
        search.stage = POINT_AGAIN
        search.facing = wp.vec3(0.0, 0.0, 0.0)
    return search


@wp.func
def begin_slide(search: Search, s: int, turn: wp.quat, weight: float, shapes: Shapes):
    """Slide a point along the edge on which the distance falls most, if the other shape may be touched there."""
    lowest = float(0.0)
    along = wp.vec3(0.0, 0.0, 0.0)
    for k in range(shapes.samples[s].edge_start, shapes.samples[s].edge_end):
        way = wp.quat_rotate(turn, shapes.mild_edges[k])
        fall = wp.dot(search.direction, way)
        if fall < lowest:
            lowest = fall
            along = way
    length = wp.length(along)
    if lowest > -FLAT * length or search.distance + NEARER_HALF * lowest > 0.0:
        return search
    search.stage = SLIDE_END
    search.facing = weight * search.normal
    search.start = search.query
    search.way = search.query
    search.along = along / length
    search.half = NEARER_HALF * length
    search.left = 0.0
    n = search.direction
    search.low = wp.vec4(n[0], n[1], n[2], search.distance)
    search.slope_low = lowest / length
    return look_at(search, search.half)


@wp.func
def end_slide(search: Search):
    """End a slide at the least distance that was found, with the normal of the two faces that meet there."""
    search.stage = DONE
    search.query = search.way
    if search.distance < search.first and wp.dot(gradient(search.low), gradient(search.high)) > SAME_FACE:
        mixture = search.slope_high * gradient(search.low) - search.slope_low * gradient(search.high)
        search.direction = wp.normalize(mixture)
        if search.distance < 0.0:
            n = search.direction
            search.distance /= wp.max(wp.dot(gradient(search.low), n), wp.dot(gradient(search.high), n))
    return search


@wp.func
def slide_next(search: Search, d: wp.vec4, size: float):
    """The least distance on an edge between the two samples at its ends; none if it falls up to the other end."""
    curved = False
    before = search.t
    if search.stage == SLIDE_END:
        search.first = search.distance
        search.right = before
        search.high = d
        search.slope_high = slope(d, search.along)
        if search.slope_high < FLAT:
            return end_slide(search)
    else:
        if d[3] < search.distance:
            search.distance = d[3]
            search.direction = gradient(d)
            search.way = search.query
        curved = d[3] - search.low[3] - search.slope_low * (before - search.left) > CURVED * (
            search.right - search.left
        )
        if slope(d, search.along) < 0.0:
            search.left = before
            search.low = d
            search.slope_low = slope(d, search.along)
        else:
            search.right = before
            search.high = d
            search.slope_high = slope(d, search.along)
    after = next_inside(search, curved)
    bound = search.low[3] + search.slope_low * (after.t - search.left)
    if search.stage == SLIDE_LAST or bound > search.distance - ENOUGH * size:
        return end_slide(search)
    after.stage = search.stage + 1
    return after


@wp.func
def clip_to_grid(search: Search, shapes: Shapes, shape: int):
    """Limit an edge's search to the grid of a shape that consists of one: outside, the distance is only a bound.

    Its slope points to the grid and not to the surface, so an edge that ends there would seem to have no inner minimum.
    """
    part = shapes.shapes[shape].part_start
    if shapes.parts[part].kind != PartKind.GRID or shapes.shapes[shape].part_end > part + 1:
        return search
    turn = shapes.parts[part].orientation
    start = wp.quat_rotate_inv(turn, search.start - shapes.parts[part].position)
    along = wp.quat_rotate_inv(turn, search.along)
    for axis in range(3):
        lower = shapes.parts[part].grid_origin[axis]
        upper = lower + shapes.parts[part].grid_spacing * float(shapes.parts[part].grid_dims[axis] - 1)
        if wp.abs(along[axis]) * search.half > PARALLEL * (upper - lower):
            one = (lower - start[axis]) / along[axis]
            other = (upper - start[axis]) / along[axis]
            search.first = wp.max(search.first, wp.min(one, other))
            search.last = wp.min(search.last, wp.max(one, other))
    search.left = search.first
    search.right = search.last
    if search.first >= search.last:
        return nowhere(search)
    return search


@wp.func
def begin_search(shapes: Shapes, s: int, shape: int, turn: wp.quat, shift: wp.vec3, weight: float):
    """Start the search of a sample; `turn` and `shift` map its shape's frame to that of the other shape.

    The distance at an edge's middle is used for culling; for a convex shape, the distances at its ends are enough.
    """
    search = Search()
    search.start = wp.quat_rotate(turn, shapes.samples[s].point) + shift
    search.query = search.start
    search.normal = wp.quat_rotate(turn, shapes.samples[s].normal)
    if shapes.samples[s].kind == SampleKind.EDGE:
        slide = wp.quat_rotate(turn, shapes.samples[s].slide)
        search.half = wp.length(slide)
        search.along = slide / search.half
        search.first = -OVERLAP * search.half
        search.last = OVERLAP * search.half
        search.left = search.first
        search.right = search.last
        if shapes.shapes[shape].convex == 1:
            search.stage = EDGE_LOW
            search = look_at(search, search.left)
        elif shapes.samples[s].radius == 0.0:
            search = clip_to_grid(search, shapes, shape)
    elif shapes.samples[s].kind == SampleKind.RIM:
        search.along = search.normal
    elif shapes.samples[s].radius > 0.0:
        search.stage = BALL_CENTER
    else:
        search.facing = weight * search.normal
    return search


@wp.func
def bring_to_touch(
    shapes: Shapes, s: int, own_shape: int, shape: int, turn: wp.quat, shift: wp.vec3, reach: float, weight: float
):
    """Contact point of sample s of `own_shape` on `shape`, in the frame of `shape`.

    For gaps above `reach` the result may be FAR. With weight 1 the face is chosen by distance and the sample's normal,
    with weight 0 by the distance alone.
    """
    kind = shapes.samples[s].kind
    radius = shapes.samples[s].radius
    convex = shapes.shapes[shape].convex
    size = shapes.shapes[shape].size
    part = shapes.shapes[shape].part_start
    exact = wp.where(shapes.shapes[shape].cell == 0.0, 1, 0)
    if shapes.parts[part].tree_start < shapes.parts[part].tree_end:
        exact = 1
    choice = shapes.samples[s].choice
    corners = choice > 0 and has_places(shapes, shape)
    near = radius + wp.min(reach, shapes.shapes[shape].cell)
    along_edge = radius + shapes.shapes[shape].cell
    flat = wp.where(weight > 0.0 and (kind == SampleKind.FACE or kind == SampleKind.CAP), 1, 0)
    thin = wp.where(weight > 0.0 and shapes.shapes[own_shape].convex == 0, 1, 0)
    search = begin_search(shapes, s, shape, turn, shift, weight)
    mild = shapes.shapes[own_shape].sag * shapes.shapes[shape].sag > 0.0
    if radius > 0.0:
        along_edge += ALL_OF_EDGE * search.half
    while search.stage >= 0:
        # The middle of an edge only shows whether the edge may touch.
        exact_below = wp.where(kind == SampleKind.EDGE and search.stage > EDGE_MIDDLE, along_edge, near)
        to_place = corners and (search.stage >= BALL_CENTER or (kind == SampleKind.RIM and search.stage == RIM_CENTER))
        d = contact_distance(shapes, shape, search.query, search.facing, wp.where(to_place, -FAR, exact_below))
        if to_place:
            d = ball_distance_to_places(shapes, part, search.query, d, radius, reach, choice)
        search.evaluations += 1
        search.least = wp.min(search.least, d[3])
        if search.stage >= SLIDE_END:
            search = slide_next(search, d, size)
        elif search.stage >= BALL_CENTER:
            search = ball_next(search, d, radius, size, exact)
        elif kind == SampleKind.EDGE:
            search = edge_next(search, d, reach, radius, size, convex, weight)
        elif kind == SampleKind.RIM:
            search = rim_next(search, d, radius, weight)
        else:
            search = point_next(search, d, size, flat, thin)
            if mild and search.stage == DONE and search.distance < FAR:
                search = begin_slide(search, s, turn, weight, shapes)
    return search


@wp.func
def opposed(cosine: float, kind: int, other: int):
    """Whether a sample can touch, from the cosine of its normal and the contact normal.

    CAP points represent a cylinder's cap only if it lies nearly flat; otherwise the RIM, which has no corners, does.
    Points below a plane always touch, as a plane has no opposite side.
    """
    if kind == SampleKind.CAP:
        return cosine < -0.95
    if kind == SampleKind.FACE:
        return cosine < -0.5
    return cosine < OPPOSED or other == PartKind.PLANE


@wp.func
def place_sample(
    shapes: Shapes, s: int, own_shape: int, shape: int, turn: wp.quat, shift: wp.vec3, reach: float, weight: float
):
    """Contact point of sample s; with weight 1, the distance is FAR if the sample does not oppose the surface.

    An edge that ends on a face without leaving it is not a contact: the distance to the faces that it opposes is not
    its true distance.
    """
    found = bring_to_touch(shapes, s, own_shape, shape, turn, shift, reach, weight)
    other = shapes.parts[shapes.shapes[shape].part_start].kind
    if weight > 0.0 and not opposed(wp.dot(found.direction, found.normal), shapes.samples[s].kind, other):
        found.distance = FAR
    return found
