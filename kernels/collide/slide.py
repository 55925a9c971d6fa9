"""Contact point search of a mesh's points, which slide along unsampled edges.

Convex edges that bend by less than 30 degrees, or are short, have no samples of their own. Where two of these cross,
the meshes are nearer than at the samples around. A point near the crossing slides there: along that of its unsampled
edges on which the distance is least, to where it is. So does one near the crossing with a box, cylinder or capsule.
"""

import warp as wp

from warp_rigid.kernels.collide.contact_search import (
    FOUND,
    Search,
    SearchStage,
    cross_faces,
    gradient,
    is_doubtful,
    look_at,
    look_beside,
    narrowed,
    slope,
)
from warp_rigid.kernels.collide.distance import FAR
from warp_rigid.kernels.enums import PartKind
from warp_rigid.kernels.schema import Shapes

wp.set_module_options({"enable_backward": False, "max_unroll": 4})

ENOUGH = wp.constant(2.0e-5)
"""A slide does not begin, or ends, when the distance may fall by less than this fraction of the size."""


@wp.func
def may_slide(own_shape: int, shape: int, shapes: Shapes):
    """Whether the points of a shape with unsampled edges slide on another one: one with such edges, or a convex one.

    They cannot come nearer to a plane than their ends; the distance to a sphere is searched for from its centre.
    """
    kind = shapes.parts[shapes.shapes[shape].part_start].kind
    if shapes.shapes[shape].convex == 1 and kind != PartKind.PLANE and kind != PartKind.SPHERE:
        return shapes.shapes[own_shape].dip > 0.0
    return shapes.shapes[own_shape].dip * shapes.shapes[shape].dip > 0.0


@wp.func
def begin_slides(search: Search, weight: float):
    """Begin the slides of a point from where it is, with the distance to the faces that its normal opposes."""
    n = search.direction
    search.before = wp.vec4(n[0], n[1], n[2], search.distance)
    search.facing = weight * search.normal
    search.start = search.query
    search.way = search.query
    search.last = FAR
    return search


@wp.func
def next_slide(search: Search, s: int, turn: wp.quat, size: float, convex: int, shapes: Shapes):
    """Slide along the edge of a point on which the distance falls most, after those before, if it may be less there."""
    steepest = float(0.0)
    edge = wp.vec3(0.0, 0.0, 0.0)
    for k in range(shapes.samples[s].edge_start, shapes.samples[s].edge_end):
        along = wp.quat_rotate(turn, shapes.unsampled_edges[k])
        fall = -wp.dot(gradient(search.before), along)
        if fall > steepest and fall < search.last:
            steepest = fall
            edge = along
    length = wp.length(edge)
    # The sample at the other end covers the rest, unless there is a kink before it. Only one end may be near a box.
    nearer = wp.where(convex == 1, 1.0, 0.75)
    fall = nearer * steepest
    search.stage = SearchStage.DONE
    search.query = search.way
    if fall <= ENOUGH * size or search.before[3] - fall > wp.min(search.distance, 0.0):
        return search
    search.stage = SearchStage.SLIDE_END
    search.last = steepest
    search.first = search.distance
    search.along = edge / length
    search.half = nearer * length
    search.left = 0.0
    search.low = search.before
    search.slope_low = -steepest / length
    search.slope_high = 0.0
    return look_at(search, search.half)


@wp.func
def end_slide(search: Search, convex: int):
    """End the slide along an edge. A crossing that was found has the normal of both edges."""
    search.stage = SearchStage.DONE
    before = gradient(search.low)
    after = gradient(search.high)
    # Only normals of faces within 60 degrees of each other, or of a convex shape, are mixed.
    if search.distance < search.first and (convex == 1 or wp.dot(before, after) > 0.5):
        search = cross_faces(search, before, after, search.slope_high, -search.slope_low)
    return search


@wp.func
def may_fall_to(search: Search):
    """Lower bound of a convex distance: where the tangents at both ends meet, which is evaluated next.

    If they meet outside, it is the lower one of both, and the distance is not convex.
    """
    from_low = search.low[3] + search.slope_low * (search.t - search.left)
    return wp.min(from_low, search.high[3] + search.slope_high * (search.t - search.right))


@wp.func
def slide_next(search: Search, d: wp.vec4, size: float, convex: int):
    """The least distance on the nearer part of an edge; none if the distance falls further on."""
    # A distance falls by the way along the edge at most. More is a jump to another face that the normal opposes.
    if search.before[3] - d[3] > 1.1 * search.t:
        search.stage = SearchStage.DONE
        return search
    if search.stage == SearchStage.SLIDE_END and slope(d, search.along) <= 0.0:
        return end_slide(search, convex)
    if d[3] < search.distance:
        search.distance = d[3]
        search.direction = gradient(d)
        search.way = search.query
    before = search.t
    search = narrowed(search, d, 0.0)
    found = may_fall_to(search) > search.distance - ENOUGH * size or wp.abs(search.t - before) <= FOUND * search.half
    if found and is_doubtful(search, before, convex):
        search = look_beside(search, before)
        found = False
    if search.stage == SearchStage.SLIDE_LAST or found:
        return end_slide(search, convex)
    search.stage += 1
    return search
