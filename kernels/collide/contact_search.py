"""State of the search for the contact point of a sample, and the steps that all of its stages share."""

from enum import IntEnum

import warp as wp

from warp_rigid.kernels.collide.distance import FAR
from warp_rigid.kernels.enums import SampleKind
from warp_rigid.kernels.tuning import RIM_FLAT

wp.set_module_options({"enable_backward": False, "max_unroll": 4})

ASIDE = wp.constant(0.01)
"""Offset from a crossing at which the gradients on both sides are evaluated, and from a doubtful point at which the
distance is, as a fraction of the half-length."""

MOST_BEYOND_FACES = wp.constant(3.0)
"""Largest distance to a crossed edge over that to its faces: at most 1.4 at a right angle, more at acute ones."""

FOUND = wp.constant(1.0e-4)
"""The search along an edge ends when the point moves by less than this fraction of the half-length."""


class SearchStage(IntEnum):
    """Stages of the search of a sample, besides those of an edge. BALL_FIRST and SLIDE_END are counted on."""

    DONE = -1
    POINT_AGAIN = 1
    RIM_FACING = 3
    BALL_CENTER = 20
    """Of a ball, also of one on the axis of a rod."""
    BALL_FIRST = 21
    BALL_LAST = 27
    SLIDE_END = 30
    SLIDE_LAST = 36


@wp.struct
class Search:
    """State of the search of a sample. The distance is evaluated next at `query`, with the sample normal `facing`.

    `least`: the least distance so far, at most 0. `along`: direction of an edge, or of an arc at its middle.
    `curvature`: of an arc, times the direction from its centre to its middle [1/m]; zero for an edge.
    """

    stage: int
    least: float
    query: wp.vec3
    facing: wp.vec3
    normal: wp.vec3
    direction: wp.vec3
    distance: float
    start: wp.vec3
    along: wp.vec3
    curvature: wp.vec3
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
    search.stage = SearchStage.DONE
    search.distance = FAR
    return search


@wp.func
def is_segment(kind: int):
    """Whether the contact point of a sample is searched for along an edge or an arc."""
    return kind == SampleKind.EDGE or kind == SampleKind.ARC or kind == SampleKind.SIDE


@wp.func
def sticks_out(kind: int):
    """Whether a ball with the radius of a sample sticks out of its shape."""
    return kind == SampleKind.RIM or kind == SampleKind.SIDE


@wp.func
def place_on(search: Search, t: float):
    """The point at parameter t [m] of an edge, or of an arc, where t is measured along the tangent at its middle.

    The distance of an arc of radius r from this tangent is r - sqrt(r^2 - t^2). The series has an error of 1e-7 r for a
    sixteenth of a circle.
    """
    squared = t * t * wp.dot(search.curvature, search.curvature)
    aside = t * t * (0.5 + squared * (0.125 + 0.0625 * squared))
    return search.start + t * search.along - aside * search.curvature


@wp.func
def direction_at(search: Search, t: float):
    """Derivative of `place_on`: the direction of the edge or arc at parameter t, up to 2 % longer than 1."""
    squared = t * t * wp.dot(search.curvature, search.curvature)
    return search.along - t * (1.0 + squared * (0.5 + 0.375 * squared)) * search.curvature


@wp.func
def slope_at(search: Search, t: float, d: wp.vec4):
    """Slope along the edge or arc of the distance d at parameter t."""
    return slope(d, direction_at(search, t))


@wp.func
def flat_slope(search: Search):
    """Slope of the distance below which an edge or arc lies flat."""
    return wp.where(wp.dot(search.curvature, search.curvature) > 0.0, RIM_FLAT, 0.01)


@wp.func
def look_at(search: Search, t: float):
    """Evaluate the distance next at parameter t of the edge."""
    search.t = t
    search.query = place_on(search, t)
    return search


@wp.func
def next_inside(search: Search, curved: bool):
    """Evaluate next where the tangents at both ends meet or, for a curved distance, where the slope becomes zero.

    The middle is evaluated instead if the tangents meet outside, or if the slopes at the ends show no minimum.
    """
    bend = wp.max(search.slope_high - search.slope_low, 1.0e-6)
    width = search.right - search.left
    rise = search.slope_high * search.right - search.slope_low * search.left
    t = (search.low[3] - search.high[3] + rise) / bend
    if curved:
        t = search.left - search.slope_low * width / bend
    # Tangents that meet just outside, through rounding, count as meeting at the end.
    outside = t < search.left - 1.0e-3 * width or t > search.right + 1.0e-3 * width
    flat = flat_slope(search)
    if outside or search.slope_low > flat or search.slope_high < -flat:
        t = 0.5 * (search.left + search.right)
    return look_at(search, wp.clamp(t, search.left, search.right))


@wp.func
def is_curved(search: Search, d: wp.vec4, now: float):
    """Whether the distance is curved before the present point, and not kinked.

    Along an edge, it then lies above its tangent. Along an arc, its slope `now` is that of neither end.
    """
    # By more than a thousandth, beyond rounding errors.
    if wp.dot(search.curvature, search.curvature) == 0.0:
        rise = d[3] - search.low[3] - search.slope_low * (search.t - search.left)
        return rise > 1.0e-3 * (search.right - search.left)
    aside = wp.min(wp.abs(now - search.slope_low), wp.abs(search.slope_high - now))
    return aside > 1.0e-3 * wp.abs(search.slope_high - search.slope_low)


@wp.func
def replace_end(search: Search, d: wp.vec4, turning: float):
    """Replace one end by the present point: the left one if the slope there is below `turning`.

    If the slope at the other end shows no minimum between them, the distances at both decide.
    """
    now = slope_at(search, search.t, d)
    flat = flat_slope(search)
    falls = now < turning
    if falls and search.slope_high < -flat:
        falls = d[3] < search.low[3]
    elif not falls and search.slope_low > flat:
        falls = d[3] > search.high[3]
    if falls:
        search.left = search.t
        search.low = d
        search.slope_low = now
    else:
        search.right = search.t
        search.high = d
        search.slope_high = now
    return search


@wp.func
def narrowed(search: Search, d: wp.vec4, turning: float):
    """Replace an end by the present point, whose distance is d, and evaluate next inside the smaller interval.

    For a curved distance, this is where the slope reaches zero if it changes linearly. If the slope has not halved, the
    distance also has a kink, as where an edge leaves the side of a cylinder for its cap. Where an edge leaves a face on
    which it lies flat, only tangents lead there.
    """
    now = slope_at(search, search.t, d)
    end = wp.where(now < turning, search.slope_low, search.slope_high)
    halved = 2.0 * wp.abs(now - turning) <= wp.abs(end - turning)
    curved = is_curved(search, d, now)
    return next_inside(replace_end(search, d, turning), curved and halved and turning == 0.0)


@wp.func
def is_doubtful(search: Search, t: float, convex: int):
    """Whether the point t may be no minimum, since tangents of a bumpy surface can meet at any point.

    t is an end of the interval. A point with a slope of zero is a minimum; at another one, the other side is unknown.
    An edge may be flat at one end and rise at t, with a dip between them. A crossing of edges is a minimum, too; the
    distance beside it shows this.
    """
    if convex == 1 or search.right - search.left < 2.0 * ASIDE * search.half:
        return False
    return wp.abs(wp.where(t == search.left, search.slope_low, search.slope_high)) > flat_slope(search)


@wp.func
def look_beside(search: Search, t: float):
    """Evaluate the distance next beside t, an end of the interval."""
    return look_at(search, t + wp.where(t == search.left, ASIDE, -ASIDE) * search.half)


@wp.func
def cross_faces(search: Search, before: wp.vec3, after: wp.vec3, rise: float, fall: float):
    """The contact normal where an edge crosses an edge, from the normals of the two faces that meet there.

    The combination a f + b g of the normals with zero slope along the crossing edge is perpendicular to both edges. At
    the deepest point of this edge, both faces are at a distance d, so that the edges are (a + b) d apart.
    """
    mixture = rise * before + fall * after
    length = wp.length(mixture)
    if length > 0.0:
        search.direction = mixture / length
        if search.distance < 0.0:
            search.distance *= wp.min((rise + fall) / length, MOST_BEYOND_FACES)
    return search
