"""Contact point search: finds where one surface sample touches another shape.

The contact point of a point sample is the point itself; on an edge segment or an arc of a rim it is the deepest point,
or the point where it leaves a face; on the rim of a cylinder and on a sphere it is the deepest point. Each is a short
search, written as a state machine with a single call of the distance function. That function is large, and one call
site keeps the GPU code small and fast, and its compilation short.
"""

import math

import warp as wp

from warp_rigid.kernels.collide.approach import Approach
from warp_rigid.kernels.collide.contact_search import Search, SearchStage, gradient, is_segment, look_at, nowhere
from warp_rigid.kernels.collide.distance import (
    BORDER,
    FAR,
    ball_distance_to_places,
    contact_distance,
    direction_or_up,
    has_places,
)
from warp_rigid.kernels.collide.edge_search import OPPOSED, OVERLAP, EdgeStage, edge_next
from warp_rigid.kernels.collide.slide import begin_slides, may_slide, next_slide, slide_next
from warp_rigid.kernels.enums import PartKind, SampleKind
from warp_rigid.kernels.schema import RIM_ARCS, SampleRecord, Shapes
from warp_rigid.kernels.shape_arrays import read_sample
from warp_rigid.kernels.tuning import RIM_FLAT, RIM_LEAN

wp.set_module_options({"enable_backward": False, "max_unroll": 4})

MUCH_DEEPER = wp.constant(3.0)
"""The distance to the face that a point opposes may be so many times as deep as that to the nearest face, plus a tenth
of the size."""


@wp.func
def rim_next(search: Search, d: wp.vec4, radius: float, load: wp.vec3, weight: float):
    """The deepest point of a circle about `along`; where it lies flat, that to which a load points, or none."""
    if search.stage == SearchStage.RIM_FACING:
        search.stage = SearchStage.DONE
        search.direction = gradient(d)
        search.distance = d[3]
        return search
    if d[3] >= FAR:
        return nowhere(search)
    n = gradient(d)
    tilt = wp.length(wp.cross(n, search.along))
    lean = n - wp.max(RIM_LEAN - 0.5 * tilt, 0.0) * wp.normalize(load)
    down = wp.dot(lean, search.along) * search.along - lean
    if wp.length(down) < RIM_FLAT:
        return nowhere(search)
    search.query = search.start + radius * wp.normalize(down)
    search.stage += 1
    if search.stage == SearchStage.RIM_FACING:
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
    if search.stage == SearchStage.BALL_CENTER:
        search.direction = gradient(d)
        search.distance = d[3] - radius
        search.along = gradient(d)
        search.half = wp.min(size / radius, 1.0)
        search.t = search.half
        search.query = search.start - radius * search.along
        search.stage = wp.where(exact == 1 or d[3] < 0.0, SearchStage.DONE, SearchStage.BALL_FIRST)
        return search
    if search.stage == SearchStage.BALL_FIRST or d[3] < search.distance:
        if search.stage > SearchStage.BALL_FIRST:
            search.along = search.way
            search.t = wp.min(2.0 * search.t, search.half)
        search.direction = gradient(d)
        search.distance = d[3]
    else:
        search.t *= 0.5
    search.way = direction_or_up((1.0 - search.t) * search.along + search.t * search.direction)
    if search.stage == SearchStage.BALL_LAST:
        search.way = search.along
    search.query = search.start - radius * search.way
    search.stage = wp.where(search.stage == SearchStage.BALL_LAST, SearchStage.DONE, search.stage + 1)
    return search


@wp.func
def point_next(search: Search, d: wp.vec4, size: float, flat: int, thin: int):
    """Distance of a point sample. `flat` points represent a face; those of a `thin` shape may be near its far side.

    Near an edge, a flat point may lie behind a face that it does not oppose, far from one that it does. If a thin part
    of a mesh has entered slightly, the points on its other side oppose only distant faces. Both are rejected.
    """
    if search.stage == SearchStage.POINT_AGAIN:
        deepest = wp.where(flat == 1, 2.0 * d[3] - BORDER * size, MUCH_DEEPER * d[3] - 0.1 * size)
        if search.distance < deepest:
            return nowhere(search)
        search.stage = SearchStage.DONE
        return search
    search.direction = gradient(d)
    search.distance = d[3]
    search.stage = SearchStage.DONE
    if flat + thin > 0 and d[3] < -BORDER * size:
        search.stage = SearchStage.POINT_AGAIN
        search.facing = wp.vec3(0.0, 0.0, 0.0)
    return search


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
        # An edge that hardly moves along a side is not clipped to it.
        if wp.abs(along[axis]) * search.half > 1.0e-3 * (upper - lower):
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
def begin_search(sample: SampleRecord, approach: Approach, weight: float, shapes: Shapes):
    """Start the search of a sample.

    The distance at an edge's middle is used for culling; for a convex shape, the distances at its ends are enough.
    """
    turn = approach.turn
    shape = approach.shape
    search = Search()
    search.start = wp.quat_rotate(turn, sample.point) + approach.shift
    search.query = search.start
    search.normal = wp.quat_rotate(turn, sample.normal)
    kind = sample.kind
    if is_segment(kind):
        slide = wp.quat_rotate(turn, sample.slide)
        search.half = wp.length(slide)
        search.along = slide / search.half
        if kind == SampleKind.ARC:
            outward = wp.normalize(search.normal + wp.cross(search.normal, search.along))
            # The curvature is the angle from the middle of the arc to its ends over the length.
            search.curvature = wp.static(math.pi / RIM_ARCS) / search.half * outward
        search.first = -OVERLAP * search.half
        search.last = OVERLAP * search.half
        search.left = search.first
        search.right = search.last
        if shapes.shapes[shape].convex == 1:
            search.stage = EdgeStage.LOW
            search = look_at(search, search.left)
        elif sample.radius == 0.0:
            search = clip_to_grid(search, shapes, shape)
    elif kind == SampleKind.RIM:
        search.along = search.normal
    elif sample.radius > 0.0:
        search.stage = SearchStage.BALL_CENTER
    else:
        search.facing = weight * search.normal
    return search


@wp.func
def bring_to_touch(s: int, approach: wp.ref[Approach], weight: float, shapes: wp.ref[Shapes]):
    """Contact point of a sample of `own` on `other`, in the frame of `other`.

    For gaps above `searched` the result may be FAR. With weight 1 the face is chosen by distance and the sample's
    normal, with weight 0 by the distance alone.
    """
    shape = approach.shape
    sample = read_sample(s, shapes.samples)
    kind = sample.kind
    radius = sample.radius
    convex = shapes.shapes[shape].convex
    size = shapes.shapes[shape].size
    part = shapes.shapes[shape].part_start
    exact = wp.where(shapes.shapes[shape].cell == 0.0, 1, 0)
    if shapes.parts[part].tree_start < shapes.parts[part].tree_end:
        exact = 1
    choice = sample.choice
    corners = choice > 0 and has_places(shapes, shape)
    flat = wp.where(weight > 0.0 and (kind == SampleKind.FACE or kind == SampleKind.CAP), 1, 0)
    thin = wp.where(weight > 0.0 and shapes.shapes[approach.own_shape].convex == 0, 1, 0)
    search = begin_search(sample, approach, weight, shapes)
    slides = may_slide(approach.own_shape, shape, shapes) and radius == 0.0
    slides = slides and (kind == SampleKind.POINT or kind == SampleKind.FACE)
    edge = is_segment(kind)
    exact_below = radius + wp.min(approach.searched, shapes.shapes[shape].cell)
    if edge:
        exact_below = radius + shapes.shapes[shape].cell
        if radius > 0.0:
            # The axis of a rod needs exact distances along all of it if it touches: it may end outside a grid, where
            # the slope of the bound is wrong.
            exact_below += 2.2 * search.half
    while search.stage >= 0:
        to_place = corners and search.stage >= SearchStage.BALL_CENTER
        d = contact_distance(shapes, shape, search.query, search.facing, wp.where(to_place, -FAR, exact_below))
        if to_place:
            d = ball_distance_to_places(shapes, part, search.query, d, radius, approach.searched, choice)
        search.least = wp.min(search.least, d[3])
        if search.stage >= SearchStage.SLIDE_END:
            search = slide_next(search, d, size, convex)
        elif search.stage >= SearchStage.BALL_CENTER:
            search = ball_next(search, d, radius, size, exact)
        elif edge:
            search = edge_next(search, d, approach.searched, radius, size, convex, weight)
        elif kind == SampleKind.RIM:
            search = rim_next(search, d, radius, approach.load, weight)
        else:
            search = point_next(search, d, size, flat, thin)
            if slides and search.stage == SearchStage.DONE and search.distance < FAR:
                search = begin_slides(search, weight)
        if slides and search.stage == SearchStage.DONE and search.last > 0.0:
            search = next_slide(search, s, approach.turn, size, convex, shapes)
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
def is_on_side(found: Search, s: int, approach: wp.ref[Approach], shapes: wp.ref[Shapes]):
    """Whether the contact of a segment that ends at a cap is on the side, and not deeper than it is below the cap."""
    sample = read_sample(s, shapes.samples)
    cap = wp.quat_rotate(approach.turn, sample.point + wp.length(sample.slide) * sample.normal) + approach.shift
    return wp.dot(found.query - cap, found.normal) <= wp.min(found.distance, 0.0)


@wp.func
def place_sample(s: int, approach: wp.ref[Approach], weight: float, shapes: wp.ref[Shapes]):
    """Contact point of a sample; with weight 1, the distance is FAR if the sample does not oppose the surface.

    An edge that ends on a face without leaving it is not a contact: the distance to the faces that it opposes is not
    its true distance.
    """
    found = bring_to_touch(s, approach, weight, shapes)
    other = shapes.parts[shapes.shapes[approach.shape].part_start].kind
    if weight > 0.0 and not opposed(wp.dot(found.direction, found.normal), shapes.samples[s].kind, other):
        found.distance = FAR
    if shapes.samples[s].kind == SampleKind.SIDE and not is_on_side(found, s, approach, shapes):
        found.distance = FAR
    return found
