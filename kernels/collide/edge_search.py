"""Contact point search along the segment of an edge, or along an arc of a rim."""

from enum import IntEnum

import warp as wp

from warp_rigid.kernels.collide.contact_search import (
    ASIDE,
    FOUND,
    Search,
    SearchStage,
    cross_faces,
    direction_at,
    flat_slope,
    gradient,
    is_doubtful,
    look_at,
    look_beside,
    narrowed,
    next_inside,
    nowhere,
    place_on,
    slope_at,
)
from warp_rigid.kernels.collide.distance import BORDER
from warp_rigid.kernels.tuning import RIM_FLAT

wp.set_module_options({"enable_backward": False, "max_unroll": 4})

OPPOSED = wp.constant(0.1)
"""A vertex or edge can touch only if the cosine of its normal and the contact normal is below this value; it is not
smaller because vertices and edges have wide normal cones."""

OVERLAP = wp.constant(1.05)
"""Factor by which edge segments are extended for the search."""


class EdgeStage(IntEnum):
    """Stages of the search along an edge."""

    MIDDLE = 0
    LOW = 1
    HIGH = 2
    HALF = 3
    INSIDE = 4
    INSIDE_AGAIN = 9
    LAST_INSIDE = 15
    CLAMPED = 16
    FACING = 17
    BEFORE = 18
    AFTER = 19


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
    search.stage = EdgeStage.LOW
    return look_at(search, search.left)


@wp.func
def has_minimum(first: float, last: float, low: float, high: float, flat: float):
    """Whether a distance has a minimum between two points, or is flat at one and not at the other.

    From its slopes at the first and the last point, the distances there, and the slope that counts as flat.
    """
    falls = first <= flat or (last > flat and low > high)
    rises = last >= -flat or (first < -flat and high > low)
    return falls and rises and wp.abs(last - first) >= 2.0 * flat


@wp.func
def to_half(search: Search, t: float, middle: wp.vec4):
    """Limit the search to a part of the edge with a minimum, from t to one of its ends, unless it lies flat there.

    If both have one, as where an edge lies across two bumps, to that whose end is nearer.
    """
    flat = flat_slope(search)
    now = slope_at(search, t, middle)
    if search.left >= t or search.right <= t or wp.abs(now) <= flat:
        return search
    first = has_minimum(search.slope_low, now, search.low[3], middle[3], flat)
    last = has_minimum(now, search.slope_high, middle[3], search.high[3], flat)
    if first and (search.low[3] < search.high[3] or not last):
        search.right = t
        search.high = middle
        search.slope_high = now
    else:
        search.left = t
        search.low = middle
        search.slope_low = now
    return search


@wp.func
def edge_has_ends(search: Search):
    """With both ends known, test whether the distance has an inner minimum or the edge leaves a face."""
    flat = flat_slope(search)
    dips = search.slope_low < -RIM_FLAT and search.slope_high > RIM_FLAT
    if not dips and not has_minimum(search.slope_low, search.slope_high, search.low[3], search.high[3], flat):
        return nowhere(search)
    # The edge crosses another edge instead of lying along it.
    search.crossing = wp.where(search.slope_low < -0.05 and search.slope_high > 0.05, 1, 0)
    search.turning = 0.0
    if wp.abs(search.slope_high) <= flat and not dips:
        search.turning = -2.0 * flat
    elif wp.abs(search.slope_low) <= flat and not dips:
        search.turning = 2.0 * flat
    # The distance to faces that the normal opposes is not continuous: a search of it that does not end soon finds none.
    search.stage = wp.where(wp.length_sq(search.facing) == 0.0, EdgeStage.INSIDE, EdgeStage.INSIDE_AGAIN)
    return next_inside(search, False)


@wp.func
def stays_above(search: Search, reach: float, convex: int):
    """Whether an edge is out of reach: the distance to a convex shape lies above its tangents, which meet there."""
    return convex == 1 and search.low[3] + search.slope_low * (search.t - search.left) > reach


@wp.func
def to_flat_side(search: Search):
    """Small offset along an edge, from where it leaves a face (where two faces are equally near) onto that face."""
    left = wp.abs(search.slope_low) < wp.abs(search.slope_high)
    return wp.where(left, -1.0e-3, 1.0e-3) * search.half * direction_at(search, search.t)


@wp.func
def edge_found(search: Search, radius: float, convex: int, weight: float):
    """The point is found. Evaluate next both sides of a crossing, or the faces that a flat edge's normal opposes."""
    if radius > 0.0 and (convex == 0 or search.crossing == 0):
        # The surface of a rod may be inside another one, and its axis outside of a grid.
        search.start = search.query
        search.stage = SearchStage.BALL_CENTER
        return search
    if search.crossing == 1:
        search.stage = EdgeStage.BEFORE
        search.query = place_on(search, search.t - ASIDE * search.half)
        return search
    search.facing = weight * search.normal
    search.stage = EdgeStage.FACING
    search.query += to_flat_side(search)
    return search


@wp.func
def edge_crossed(search: Search, before: wp.vec4, after: wp.vec4, radius: float):
    """The contact where an edge crosses another edge, from the gradients on both sides of it.

    If the search is not close enough to the crossing to sample both sides, its two ends are used instead.
    """
    fall = -slope_at(search, search.t - ASIDE * search.half, before)
    rise = slope_at(search, search.t + ASIDE * search.half, after)
    if fall <= 0.0 or rise <= 0.0:
        before = search.low
        after = search.high
        fall = -search.slope_low
        rise = search.slope_high
    search = cross_faces(search, gradient(before), gradient(after), wp.max(rise, 0.0), wp.max(fall, 0.0))
    search.stage = SearchStage.DONE
    search.distance -= radius
    search.query = place_on(search, search.t) - radius * search.direction
    return search


@wp.func
def edge_inside(search: Search, d: wp.vec4, radius: float, convex: int, weight: float):
    """One more iteration of the search between the ends of an edge segment, or its end."""
    search.distance = d[3]
    search.direction = gradient(d)
    if search.stage == EdgeStage.CLAMPED:
        return edge_found(search, radius, convex, weight)
    before = search.t
    after = narrowed(search, d, search.turning)
    search = look_at(after, before)
    level = search.turning == 0.0 and wp.abs(slope_at(search, before, d)) < 0.01 * RIM_FLAT
    found = level or wp.abs(after.t - before) <= FOUND * search.half
    if found and is_doubtful(search, before, convex):
        after = look_beside(search, before)
        found = False
    if search.stage < EdgeStage.LAST_INSIDE and not found:
        after.stage = search.stage + 1
        return after
    # The point belongs to the next segment, or lies past the end of the edge, where the distance is not that of a face
    # which the edge leaves.
    if wp.abs(before) > wp.where(search.turning == 0.0, 1.01, 1.001) * search.half:
        return nowhere(search)
    if wp.abs(before) > search.half:
        search.stage = EdgeStage.CLAMPED
        return look_at(search, wp.clamp(before, -search.half, search.half))
    return edge_found(search, radius, convex, weight)


@wp.func
def edge_next(search: Search, d: wp.vec4, reach: float, radius: float, size: float, convex: int, weight: float):
    """Contact point of an edge segment, between its ends.

    This is the inner minimum of the distance or, for an edge that lies flat, the point where it leaves the face. In
    both cases the slope along the edge is discontinuous there. The tangents at both ends meet below the curve; the
    point below which they meet replaces the end on its side. This is exact after one iteration if two straight edges
    cross, where the distance is V-shaped. Neighbouring segments overlap slightly, so that there are no gaps between
    them.
    """
    if search.stage == EdgeStage.MIDDLE:
        if d[3] > OVERLAP * search.half + reach + radius:
            return nowhere(search)
        search.before = d
        search.stage = EdgeStage.LOW
        return look_at(search, search.left)
    if search.stage == EdgeStage.LOW:
        search.low = d
        search.stage = EdgeStage.HIGH
        return look_at(search, search.right)
    if search.stage == EdgeStage.HIGH:
        search.high = d
        search.slope_low = slope_at(search, search.left, search.low)
        search.slope_high = slope_at(search, search.right, search.high)
        if convex == 0 and wp.length_sq(search.facing) == 0.0:
            search = to_half(search, 0.0, search.before)
            search.stage = EdgeStage.HALF
            return look_at(search, 0.5 * (search.left + search.right))
    if search.stage == EdgeStage.HALF:
        search = to_half(search, search.t, d)
    if search.stage == EdgeStage.HIGH or search.stage == EdgeStage.HALF:
        deepest = wp.where(search.high[3] < search.low[3], search.high, search.low)
        search = edge_has_ends(search)
        if search.stage == SearchStage.DONE and came_elsewhere(search, deepest[3], gradient(deepest), size, weight):
            return edge_again(search)
        if search.stage != SearchStage.DONE and stays_above(search, reach + radius, convex):
            return nowhere(search)
        return search
    if search.stage == EdgeStage.BEFORE:
        search.before = d
        search.stage = EdgeStage.AFTER
        search.query = place_on(search, search.t + ASIDE * search.half)
        return search
    if search.stage == EdgeStage.AFTER:
        search = edge_crossed(search, search.before, d, radius)
        if came_elsewhere(search, search.distance, search.direction, size, weight):
            search = edge_again(search)
        return search
    if search.stage == EdgeStage.FACING:
        if d[3] < search.distance - BORDER * size:
            return nowhere(search)
        search.stage = SearchStage.DONE
        search.query -= to_flat_side(search)
        search.direction = gradient(d)
        search.distance = d[3]
        return search
    return edge_inside(search, d, radius, convex, weight)
