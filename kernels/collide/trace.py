"""Traces: the time in a step at which a sample, an edge or a bounding sphere of a body reaches another body.

A trace is conservative advancement: the distance of the other body bounds how far the point can move without reaching
it. For a convex distance, the safe step is bounded by the tangent of the distance and the curvature of the motion. A
few iterations are enough, and motion along a surface is not limited. For other distances it is bounded by the speed
alone. Edges are traced as whole segments, at their deepest point, because no sample point need be close to where two
edges cross.

A team of lanes tests the samples of the clusters that reach the other body. Most of them stay clear at the first
test. The others are listed, for all pairs together, and one thread traces each of them: traces take most of
the time, and pairs have very different numbers of them.
"""

from enum import IntEnum

import warp as wp

from warp_rigid.kernels.collide.contact_search import gradient, slope, sticks_out
from warp_rigid.kernels.collide.course import Course, Passage, closing_speed, place_at
from warp_rigid.kernels.collide.culling import matters, out_of_box
from warp_rigid.kernels.collide.distance import FAR, signed_distance
from warp_rigid.kernels.collide.near_samples import Suspects
from warp_rigid.kernels.collide.triangle_distance import GRID_ERROR
from warp_rigid.kernels.common.team import next_place
from warp_rigid.kernels.enums import PartKind, SampleKind
from warp_rigid.kernels.schema import Shapes
from warp_rigid.kernels.shape_arrays import read_cluster, read_sample
from warp_rigid.kernels.tuning import ALLOWED_DEPTH, CLOSE_ENOUGH, FAST_TRAVEL

wp.set_module_options({"enable_backward": False, "max_unroll": 4})


TRACE_ITERATIONS = wp.constant(64)
"""Maximum iterations of a trace; a trace that needs more counts as touching at the point reached."""


class NoSample(IntEnum):
    """Indices of a suspect that is no sample."""

    CENTER = -1
    """The centre of the body."""
    CLEAR = -2
    """It need not be traced."""


@wp.struct
class Ball:
    """A bounding sphere in the frame of the shape, and its samples; the sample -1 is the centre of the body."""

    center: wp.vec3
    radius: float
    sample_start: int
    sample_end: int


@wp.struct
class Suspect:
    """A sample that must be traced from a time on, and may penetrate the other body as deep as `allowed` [m]."""

    sample: int
    begin: float
    allowed: float


@wp.struct
class TraceTask:
    """A lane that tests samples of a pair's first (`side` 0) or second (1) body, with the others of its team."""

    pair: int
    side: int
    lane: int
    lanes: int


@wp.func
def lead(shapes: Shapes, shape: int, x: wp.vec3, left: float, ball: float):
    """Distance that a sphere about x can move in any direction without touching the shape.

    The height above a height field is valid only near the point; the distance to its highest point is valid everywhere.
    """
    part = shapes.shapes[shape].part_start
    if shapes.parts[part].kind != PartKind.HEIGHTFIELD:
        return left
    size = shapes.parts[part].size
    dims = shapes.parts[part].grid_dims
    cell = wp.min(size[0] / float(dims[0] - 1), size[1] / float(dims[1] - 1))
    return wp.max(x[2] - ball - shapes.shapes[shape].upper[2], wp.min(left, 0.5 * cell))


@wp.func
def trace(
    shapes: Shapes,
    own: Course,
    other: Course,
    arm: wp.vec3,
    radius: float,
    allowed: float,
    slack: float,
    tolerance: float,
    begin: float,
    end: float,
):
    """First time after `begin` at which a sphere at `arm` penetrates the other body deeper than allowed, or `end`.

    With a `slack` other than zero, which is that of a bounding sphere, the distance to a mesh is that of its grid, and
    may be that much too large; few iterations are enough.
    """
    other_spin = wp.length(other.angular)
    away = wp.length(own.center + arm - other.center)
    speed = wp.length(own.linear - other.linear) + wp.length(own.angular) * wp.length(arm) + other_spin * away
    curve = wp.length_sq(own.angular) * wp.length(arm) + other_spin * (2.0 * speed + other_spin * away)
    near = wp.where(slack > 0.0, -FAR, radius + shapes.shapes[other.shape].cell)
    t = float(begin)
    # In a pile of bunnies, 99 of 100 bounding spheres need fewer. The others move along a surface, and count as
    # touching at the point reached, so that their samples are tested from there on.
    for _ in range(wp.where(slack > 0.0, 8, TRACE_ITERATIONS)):
        x = place_at(own, other, arm, t)
        d = signed_distance(shapes, other.shape, x, near)
        left = d[3] - slack - radius + allowed
        if left < tolerance:
            return t
        if shapes.shapes[other.shape].convex == 1:
            closing = closing_speed(own, other, arm, x, wp.vec3(d[0], d[1], d[2]), t)
            t += 2.0 * left / wp.max(closing + wp.sqrt(closing * closing + 2.0 * curve * left), 1.0e-12)
        else:
            t += lead(shapes, other.shape, x, left, radius - allowed) / wp.max(speed, 1.0e-12)
        if t >= end:
            return end
    return t


@wp.func
def level_tangent(low: wp.vec4, left: float, high: wp.vec4, right: float, slide: wp.vec3):
    """Lower bound of a convex distance along a segment that is constant: its direction, and the distance.

    It is the combination of the tangents at two places, one that falls and one that rises, whose slopes cancel.
    """
    fall = -slope(low, slide)
    rise = slope(high, slide)
    share = fall / wp.max(fall + rise, 1.0e-20)
    bound = (1.0 - share) * (low[3] + fall * left) + share * (high[3] - rise * right)
    n = (1.0 - share) * gradient(low) + share * gradient(high)
    return wp.vec4(n[0], n[1], n[2], bound)


@wp.func
def deepest_place(shapes: Shapes, shape: int, middle: wp.vec3, slide: wp.vec3):
    """Deepest point of a segment, middle +- slide, in a convex shape: its distance, and a tangent there.

    Each iteration replaces one end of the interval by the intersection of the tangents at both ends. The tangent
    the distance from below at parameters from -1 to 1: where edges cross, it is one without slope.
    """
    low = wp.vec4(0.0, 0.0, 0.0, 0.0)
    high = wp.vec4(0.0, 0.0, 0.0, 0.0)
    left = float(-1.0)
    right = float(1.0)
    place = float(0.0)
    deepest = wp.vec4(0.0, 0.0, 1.0, FAR)
    crossed = int(1)
    t = float(left)
    iterations = int(0)
    while iterations < 6:
        d = signed_distance(shapes, shape, middle + t * slide, -FAR)
        if d[3] < deepest[3]:
            place = t
            deepest = d
        if iterations == 0:
            low = d
            t = right
        else:
            if iterations == 1 or slope(d, slide) >= 0.0:
                right = t
                high = d
            else:
                left = t
                low = d
            fall = slope(low, slide)
            rise = slope(high, slide)
            if fall >= 0.0 or rise <= 0.0:
                iterations = 6
                crossed = 0
            t = (low[3] - high[3] + rise * right - fall * left) / wp.max(rise - fall, 1.0e-12)
            t = wp.clamp(t, left, right)
        iterations += 1
    tangent = deepest
    tangent[3] -= wp.max((place - 1.0) * slope(deepest, slide), (place + 1.0) * slope(deepest, slide))
    if crossed == 1:
        level = level_tangent(low, left, high, right, slide)
        if level[3] > tangent[3]:
            tangent = level
    return deepest[3], tangent


@wp.func
def trace_edge(
    shapes: Shapes,
    own: Course,
    other: Course,
    arm: wp.vec3,
    slide: wp.vec3,
    radius: float,
    near: float,
    begin: float,
    end: float,
    size: float,
):
    """`trace` for a whole segment, arm +- slide, against a convex shape; see `handled_gap` for `near`.

    A tangent at the deepest point bounds the distance of both ends, and so of all points between them.
    """
    other_spin = wp.length(other.angular)
    reach = wp.max(wp.length(arm - slide), wp.length(arm + slide))
    away = wp.length(own.center - other.center) + reach
    speed = wp.length(own.linear - other.linear) + wp.length(own.angular) * reach + other_spin * away
    curve = wp.length_sq(own.angular) * reach + other_spin * (2.0 * speed + other_spin * away)
    allowed = ALLOWED_DEPTH * size
    t = float(0.0)
    for iteration in range(TRACE_ITERATIONS):
        low = place_at(own, other, arm - slide, t)
        high = place_at(own, other, arm + slide, t)
        half = 0.5 * (high - low)
        depth, tangent = deepest_place(shapes, other.shape, low + half, half)
        if iteration == 0:
            # The gap at the start of the step decides how deep the segment may penetrate.
            if depth - radius < near:
                allowed = near - wp.min(depth - radius, 0.0)
            elif begin > 0.0:
                t = begin
                continue
        left = depth - radius + allowed
        if left < CLOSE_ENOUGH * size:
            return t
        bound = tangent[3] - radius + allowed
        if bound > 0.5 * left:
            closing = wp.max(
                closing_speed(own, other, arm - slide, low, gradient(tangent), t),
                closing_speed(own, other, arm + slide, high, gradient(tangent), t),
            )
            t += 2.0 * bound / wp.max(closing + wp.sqrt(closing * closing + 2.0 * curve * bound), 1.0e-12)
        else:
            t += left / wp.max(speed, 1.0e-12)
        if t >= end:
            return end
    return t


@wp.func
def path_length(own: Course, other: Course, arm: wp.vec3, passage: Passage):
    """Upper bound of the motion of a point at `arm` relative to the material of the other body [m]."""
    away = own.center + arm - other.center
    v = own.linear + wp.cross(own.angular, arm) - other.linear - wp.cross(other.angular, away)
    return wp.min(passage.reach, passage.dt * wp.length(v) + 0.5 * passage.rotation * passage.reach)


@wp.func
def gap_of(shapes: Shapes, shape: int, p: wp.vec3, radius: float, path: float, passage: Passage):
    """Distance of a sample from the other body at the start; FAR if the sample need not be traced.

    This is so if it moves little and is not too deep at places of its path less than FAST_TRAVEL sizes apart. Pairs
    that move less than that in a step are not traced either.
    """
    gap = float(FAR)
    place = wp.where(path < 2.0 * FAST_TRAVEL * passage.size, 2, 0)
    while place >= 0:
        pose = wp.where(place == 2, passage.end, wp.where(place == 1, passage.middle, passage.start))
        near = wp.where(place == 0, radius + shapes.shapes[shape].cell, radius - ALLOWED_DEPTH * passage.size)
        d = signed_distance(shapes, shape, wp.transform_point(pose, p), near)
        gap = d[3] - radius
        if place == 0:
            place = -1
        elif gap <= -ALLOWED_DEPTH * passage.size:
            place = 0
        elif place == 1 or path < FAST_TRAVEL * passage.size:
            return FAR
        else:
            place = 1
    return gap


@wp.func
def arm_of(own: Course, p: wp.vec3):
    """A point of a body's shape relative to its centre of mass, in the world frame."""
    return wp.quat_rotate(own.turn, p - own.local_center)


@wp.func
def is_traced_edge(s: int, other: Course, shapes: Shapes):
    """Whether a sample is traced as an edge: against a convex shape."""
    return s >= 0 and shapes.samples[s].kind == SampleKind.EDGE and shapes.shapes[other.shape].convex == 1


@wp.func
def handled_depth(s: int, near: float, size: float):
    """Samples that start closer than this are handled by the solver, and may penetrate as deep as this [m]."""
    return wp.where(s >= 0, near, ALLOWED_DEPTH * size)


@wp.func
def look_at(shapes: Shapes, own: Course, other: Course, s: int, begin: float, passage: Passage):
    """Whether a sample must be traced, from which time, and how deep it may penetrate.

    It cannot penetrate before `begin`. A sample that is deeper than the solver handles may not get deeper by more
    than any other one: it would pass the middle of a wall within a few steps. A sample that moves little is not
    traced if it is clear. An edge and a convex shape are traced first with the bounding sphere of the edge.
    """
    suspect = Suspect()
    suspect.sample = s
    suspect.begin = begin
    if s >= 0 and sticks_out(shapes.samples[s].kind):
        suspect.sample = NoSample.CLEAR
        return suspect
    if is_traced_edge(s, other, shapes):
        edge = read_sample(s, shapes.samples)
        p = wp.transform_point(passage.start, edge.point)
        margin = edge.radius + wp.length(edge.slide) + CLOSE_ENOUGH * passage.size
        if out_of_box(p, margin + passage.reach, other.shape, shapes):
            suspect.sample = NoSample.CLEAR
        return suspect
    p = own.local_center
    radius = float(0.0)
    if s >= 0:
        sample = read_sample(s, shapes.samples)
        p = sample.point
        radius = sample.radius
    path = path_length(own, other, arm_of(own, p), passage)
    if path < ALLOWED_DEPTH * passage.size:
        suspect.sample = NoSample.CLEAR
        return suspect
    gap = gap_of(shapes, other.shape, p, radius, path, passage)
    suspect.allowed = ALLOWED_DEPTH * passage.size
    handled = handled_depth(s, passage.near, passage.size)
    if gap < handled:
        suspect.allowed = wp.max(handled, ALLOWED_DEPTH * passage.size - wp.min(gap, 0.0))
        suspect.begin = 0.0
    if gap + suspect.allowed > path:
        suspect.sample = NoSample.CLEAR
    return suspect


@wp.func
def trace_suspect(shapes: Shapes, own: Course, other: Course, suspect: Suspect, near: float, size: float, end: float):
    """Time at which a sample penetrates the other body too deep, or `end`; see `Passage` for `near` and `size`."""
    s = suspect.sample
    p = own.local_center
    radius = float(0.0)
    if s >= 0:
        sample = read_sample(s, shapes.samples)
        p = sample.point
        radius = sample.radius
    slide = wp.vec3(0.0, 0.0, 0.0)
    if is_traced_edge(s, other, shapes):
        slide = wp.quat_rotate(own.turn, shapes.samples[s].slide)
    arm = arm_of(own, p)
    length = wp.length(slide)
    at = trace(shapes, own, other, arm, radius + length, suspect.allowed, 0.0, CLOSE_ENOUGH * size, suspect.begin, end)
    if length > 0.0 and at < end:
        at = trace_edge(shapes, own, other, arm, slide, radius, handled_depth(s, near, size), at, end, size)
    return at


@wp.func
def ball_of(own: Course, cluster: int, shapes: Shapes):
    """The bounding sphere of a cluster; for the cluster -1, that of the body. Its sample is the centre if convex."""
    ball = Ball()
    if cluster < 0:
        ball.center = own.local_center
        ball.radius = own.radius
        ball.sample_start = NoSample.CENTER
        ball.sample_end = shapes.shapes[own.shape].convex - 1
    else:
        known = read_cluster(cluster, shapes.clusters)
        ball.center = known.center
        ball.radius = known.radius
        ball.sample_start = known.sample_start
        ball.sample_end = known.sample_end
    return ball


@wp.func
def trace_ball(shapes: Shapes, own: Course, other: Course, cluster: int, ball: Ball, end: float, passage: Passage):
    """Time at which the bounding sphere of a cluster, or of the body for the cluster -1, touches the other body."""
    kind = shapes.clusters[wp.max(cluster, 0)].kind
    if cluster >= 0 and (
        kind == SampleKind.CORNER or kind == SampleKind.ARC or not matters(kind, own.shape, other.shape, 1, shapes)
    ):
        return end
    margin = ball.radius + passage.reach
    if out_of_box(wp.transform_point(passage.start, ball.center), margin, other.shape, shapes):
        return end
    arm = wp.quat_rotate(own.turn, ball.center - own.local_center)
    slack = GRID_ERROR * shapes.shapes[other.shape].cell
    return trace(shapes, own, other, arm, ball.radius, 0.0, slack, CLOSE_ENOUGH * passage.size, 0.0, end)


@wp.func
def look_at_samples(
    shapes: Shapes,
    own: Course,
    other: Course,
    ball: Ball,
    begin: float,
    passage: Passage,
    task: TraceTask,
    suspects: Suspects,
):
    """List the samples of a ball that must be traced; those that do not fit are only counted."""
    for s in range(ball.sample_start + task.lane, ball.sample_end, task.lanes):
        found = look_at(shapes, own, other, s, begin, passage)
        if found.sample != NoSample.CLEAR:
            k = next_place(suspects.count, 0)
            if k >= 0 and k < suspects.pair.shape[0]:
                suspects.pair[k] = task.pair
                suspects.side[k] = task.side
                suspects.sample[k] = found.sample
                suspects.begin[k] = found.begin
                suspects.allowed[k] = found.allowed
