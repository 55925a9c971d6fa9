"""Continuous collision detection: the motion of fast bodies is limited so that they cannot pass through other bodies.

The narrow phase finds contacts near the pose at the start of a step. Further along the motion, neither the position nor
the normal of a contact is known. Therefore, before the bodies move, pairs whose motion in the step is large compared
with the smaller of both sizes are traced with the velocities computed by the solver: first the bounding sphere of a
body, then the bounding spheres of its clusters, then its samples and its centre, each against the signed distance of
the other body (conservative advancement). Edges are traced as whole segments, at their deepest point, because no sample
point need be close to where two edges cross. From its time of impact on, a pair moves together for the rest of the
step, with the slower of both velocities, and without rotation. The next step finds the contact there, with the true
normal and the full speed, so that the bodies rebound correctly. If the bodies stopped instead, those that fall behind
them in a heap would run into them: by up to 0.6 sizes where 4096 boxes land at 10 m/s with two steps per frame.

For a convex distance, the safe step is bounded by the tangent of the distance and the curvature of the motion. A few
rounds are enough, and motion along a surface is not limited. For other distances it is bounded by the speed alone.
"""

import warp as wp

from warp_rigid.kernels.collide.course import (
    DEPTH,
    FAST,
    Course,
    Passage,
    closing_speed,
    course_of,
    largest_motion,
    passage_of,
    place_at,
    relative_motion,
    stays_clear,
)
from warp_rigid.kernels.collide.culling import matters, out_of_box
from warp_rigid.kernels.collide.distance import FAR, signed_distance
from warp_rigid.kernels.collide.samples import gradient, slope
from warp_rigid.kernels.collide.triangle_distance import GRID_ERROR
from warp_rigid.kernels.common.crowd import is_crowded
from warp_rigid.kernels.common.team import ballot, broadcast, lowest_bit, min_of_lanes
from warp_rigid.kernels.enums import PartKind, Role, SampleKind
from warp_rigid.kernels.schema import Bodies, Environments, Motions, Pairs, Shapes, State
from warp_rigid.kernels.update.predict import UNBOUNDED_EXTENT, smaller_size

wp.set_module_options({"enable_backward": False, "max_unroll": 4})


CLOSE_ENOUGH = wp.constant(2.0e-3)
"""A trace ends when the remaining distance is below this fraction of the smaller size."""

ROUNDS = wp.constant(64)
"""Maximum rounds of a trace; a trace that needs more counts as touching at the point reached."""


EDGE_ROUNDS = wp.constant(4)
"""Rounds of the search for the deepest point of an edge; a V-shaped distance takes one."""

TURNS = wp.constant(2)
"""Rounds of impacts. In a round, the impacts of the previous one reach the next body of a chain."""
TURNS_IN_CROWDS = wp.constant(4)
"""Rounds in crowded environments, where heaps land: 4096 boxes then overlap half as much as with two rounds."""

NO_IMPACT = wp.constant(wp.int64(2**62))
"""Value of `first_impact` without an impact; it is the time in units, times MOST_PAIRS, plus the pair otherwise."""
MOST_PAIRS = wp.constant(wp.int64(2**31))
UNITS_OF_TIME = wp.constant(2.0**20)
"""Units of the time of an impact in a step; rounded down, it is early by half a millionth of the step."""


@wp.struct
class Ball:
    """A bounding sphere in the frame of the shape, and its samples; the sample -1 is the centre of the body."""

    center: wp.vec3
    radius: float
    sample_start: int
    sample_end: int


@wp.func
def traced_size(a: int, b: int, shapes: Shapes, bodies: Bodies):
    """Size of the smaller body of a pair [m], or twice the thickness of the thinner walls if that is less."""
    wall = wp.min(shapes.shapes[bodies.shape[a]].wall, shapes.shapes[bodies.shape[b]].wall)
    return wp.min(smaller_size(a, b, shapes, bodies), 2.0 * wall)


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

    With a `slack` other than zero, the distance to a mesh is that of its grid, which may be that much too large.
    """
    other_spin = wp.length(other.angular)
    away = wp.length(own.center + arm - other.center)
    speed = wp.length(own.linear - other.linear) + wp.length(own.angular) * wp.length(arm) + other_spin * away
    curve = wp.length_sq(own.angular) * wp.length(arm) + other_spin * (2.0 * speed + other_spin * away)
    near = wp.where(slack > 0.0, -FAR, radius + shapes.shapes[other.shape].cell)
    t = float(begin)
    for _round in range(ROUNDS):
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
def deepest_place(shapes: Shapes, shape: int, middle: wp.vec3, slide: wp.vec3):
    """Deepest point of a segment, middle +- slide, in a convex shape: parameter from -1 to 1, and distance.

    Each round replaces one end of the interval by the intersection of the tangents at both ends, as in samples.py.
    """
    low = wp.vec4(0.0, 0.0, 0.0, 0.0)
    high = wp.vec4(0.0, 0.0, 0.0, 0.0)
    left = float(-1.0)
    right = float(1.0)
    place = float(0.0)
    deepest = wp.vec4(0.0, 0.0, 1.0, FAR)
    t = float(left)
    rounds = int(0)
    while rounds < 2 + EDGE_ROUNDS:
        d = signed_distance(shapes, shape, middle + t * slide, -FAR)
        if d[3] < deepest[3]:
            place = t
            deepest = d
        if rounds == 0:
            low = d
            t = right
        else:
            if rounds == 1 or slope(d, slide) >= 0.0:
                right = t
                high = d
            else:
                left = t
                low = d
            fall = slope(low, slide)
            rise = slope(high, slide)
            if fall >= 0.0 or rise <= 0.0:
                rounds = 2 + EDGE_ROUNDS
            t = (low[3] - high[3] + rise * right - fall * left) / wp.max(rise - fall, 1.0e-12)
            t = wp.clamp(t, left, right)
        rounds += 1
    return place, deepest


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
    """`trace` for a whole segment, arm +- slide, against a convex shape; see `trace_sample` for `near` and `begin`.

    The tangent at the deepest point bounds the distance of both ends, and so of all points between them, if its slope
    along the segment is small. The slope is large where edges cross below the surface; there, the speed alone is used.
    """
    other_spin = wp.length(other.angular)
    reach = wp.max(wp.length(arm - slide), wp.length(arm + slide))
    away = wp.length(own.center - other.center) + reach
    speed = wp.length(own.linear - other.linear) + wp.length(own.angular) * reach + other_spin * away
    curve = wp.length_sq(own.angular) * reach + other_spin * (2.0 * speed + other_spin * away)
    allowed = DEPTH * size
    t = float(0.0)
    for round in range(ROUNDS):
        low = place_at(own, other, arm - slide, t)
        high = place_at(own, other, arm + slide, t)
        half = 0.5 * (high - low)
        place, d = deepest_place(shapes, other.shape, low + half, half)
        if round == 0:
            # The gap at the start of the step decides how deep the segment may penetrate.
            if d[3] - radius < near:
                allowed = near - wp.min(d[3] - radius, 0.0)
            elif begin > 0.0:
                t = begin
                continue
        left = d[3] - radius + allowed
        if left < CLOSE_ENOUGH * size:
            return t
        rise = slope(d, half)
        bound = left - wp.max((place - 1.0) * rise, (place + 1.0) * rise)
        if bound > 0.5 * left:
            closing = wp.max(
                closing_speed(own, other, arm - slide, low, gradient(d), t),
                closing_speed(own, other, arm + slide, high, gradient(d), t),
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

    This is so if it moves little and is not too deep at places of its path less than FAST sizes apart. Pairs that move
    less than that in a step are not traced either.
    """
    gap = float(FAR)
    place = wp.where(path < 2.0 * FAST * passage.size, 2, 0)
    while place >= 0:
        pose = wp.where(place == 2, passage.end, wp.where(place == 1, passage.middle, passage.start))
        d = signed_distance(shapes, shape, wp.transform_point(pose, p), radius + shapes.shapes[shape].cell)
        gap = d[3] - radius
        if place == 0:
            place = -1
        elif gap <= -DEPTH * passage.size:
            place = 0
        elif place == 1 or path < FAST * passage.size:
            return FAR
        else:
            place = 1
    return gap


@wp.func
def trace_sample(shapes: Shapes, own: Course, other: Course, s: int, begin: float, end: float, passage: Passage):
    """Time at which a sample would penetrate the other body too deep, or `end`; this cannot happen before `begin`.

    A sample that starts closer than `near` is handled by the solver, and may penetrate deeper by `near`. A sample that
    moves little is not traced if it is clear. An edge and a convex shape are traced first with the bounding sphere of
    the edge.
    """
    p = own.local_center
    radius = float(0.0)
    near = DEPTH * passage.size
    kind = int(SampleKind.POINT)
    if s >= 0:
        p = shapes.samples[s].point
        radius = shapes.samples[s].radius
        near = passage.near
        kind = shapes.samples[s].kind
    if kind == SampleKind.RIM:
        return end
    arm = wp.quat_rotate(own.turn, p - own.local_center)
    slide = wp.vec3(0.0, 0.0, 0.0)
    allowed = float(0.0)
    earliest = float(begin)
    if kind == SampleKind.EDGE and shapes.shapes[other.shape].convex == 1:
        slide = wp.quat_rotate(own.turn, shapes.samples[s].slide)
    else:
        path = path_length(own, other, arm, passage)
        gap = gap_of(shapes, other.shape, p, radius, path, passage)
        allowed = DEPTH * passage.size
        if gap < near:
            allowed = near - wp.min(gap, 0.0)
            earliest = 0.0
        if gap + allowed > path:
            return end
    reach = wp.length(slide)
    at = trace(shapes, own, other, arm, radius + reach, allowed, 0.0, CLOSE_ENOUGH * passage.size, earliest, end)
    if reach > 0.0 and at < end:
        at = trace_edge(shapes, own, other, arm, slide, radius, near, at, end, passage.size)
    return at


@wp.func
def trace_samples(
    shapes: Shapes,
    own: Course,
    other: Course,
    ball: Ball,
    begin: float,
    end: float,
    passage: Passage,
    lane: int,
    lanes: int,
):
    """Time at which a sample of a ball would penetrate the other body too deep, not before `begin`, or `end`.

    The lanes of a team share the samples.
    """
    earliest = float(end)
    for s in range(ball.sample_start + lane, ball.sample_end, lanes):
        earliest = trace_sample(shapes, own, other, s, begin, earliest, passage)
    return earliest


@wp.func
def ball_of(own: Course, cluster: int, shapes: Shapes):
    """The bounding sphere of a cluster; for the cluster -1, that of the body. Its sample is the centre if convex."""
    ball = Ball()
    if cluster < 0:
        ball.center = own.local_center
        ball.radius = own.radius
        ball.sample_start = -1
        ball.sample_end = shapes.shapes[own.shape].convex - 1
    else:
        ball.center = shapes.clusters[cluster].center
        ball.radius = shapes.clusters[cluster].radius
        ball.sample_start = shapes.clusters[cluster].sample_start
        ball.sample_end = shapes.clusters[cluster].sample_end
    return ball


@wp.func
def trace_ball(shapes: Shapes, own: Course, other: Course, cluster: int, end: float, passage: Passage):
    """Time at which the bounding sphere of a cluster, or of the body for the cluster -1, touches the other body."""
    ball = ball_of(own, cluster, shapes)
    kind = shapes.clusters[wp.max(cluster, 0)].kind
    if cluster >= 0 and (kind == SampleKind.CORNER or not matters(kind, own.shape, other.shape, 1, shapes)):
        return end
    margin = ball.radius + passage.reach
    if out_of_box(wp.transform_point(passage.start, ball.center), margin, other.shape, shapes):
        return end
    arm = wp.quat_rotate(own.turn, ball.center - own.local_center)
    slack = GRID_ERROR * shapes.shapes[other.shape].cell
    return trace(shapes, own, other, arm, ball.radius, 0.0, slack, CLOSE_ENOUGH * passage.size, 0.0, end)


@wp.func
def first_touch(
    shapes: Shapes,
    own: Course,
    other: Course,
    dt: float,
    end: float,
    size: float,
    touching: bool,
    lane: int,
    lanes: int,
):
    """First time at which a sample, an edge or the centre of one body penetrates the other too deep, at most `end`.

    The lanes of a team share the clusters, and the samples of each cluster that is reached. The earliest of their times
    is that of the pair. The cluster before the first one is the body itself, with its centre as a sample.
    """
    earliest = float(end)
    if own.radius > UNBOUNDED_EXTENT:
        return earliest
    passage = passage_of(own, other, dt, size, touching, shapes)
    cluster = int(-1)
    while cluster < shapes.shapes[own.shape].cluster_end:
        at = float(earliest)
        if cluster < 0 or cluster + lane < shapes.shapes[own.shape].cluster_end:
            at = trace_ball(shapes, own, other, wp.where(cluster < 0, -1, cluster + lane), earliest, passage)
        if cluster < 0 and at >= end:
            return earliest
        reached = ballot(wp.where(at < earliest and (cluster >= 0 or lane == 0), 1, 0), lanes)
        while reached != wp.uint32(0):
            k = lowest_bit(reached)
            reached = reached & (reached - wp.uint32(1))
            ball = ball_of(own, wp.where(cluster < 0, -1, cluster + k), shapes)
            begin = broadcast(at, k, lanes)
            earliest = trace_samples(shapes, own, other, ball, begin, earliest, passage, lane, lanes)
        earliest = min_of_lanes(earliest, lanes)
        cluster = wp.where(cluster < 0, shapes.shapes[own.shape].cluster_start, cluster + lanes)
    return earliest


@wp.func
def may_touch(shapes: Shapes, a: Course, b: Course, dt: float):
    """Whether the bounding sphere of the smaller of two bodies can reach the bounding box of the other in this step."""
    small = a
    large = b
    if b.radius < a.radius:
        small = b
        large = a
    center = place_at(small, large, wp.vec3(0.0, 0.0, 0.0), 0.0)
    return not out_of_box(center, small.radius + largest_motion(a, b, dt), large.shape, shapes)


@wp.kernel
def limit_travel(dt: float, motions: Motions):
    """One thread per body: limit its displacement to the distance covered by the broad phase. No body has been hit."""
    b = wp.tid()
    moves = motions.role[b] == Role.FREE or motions.role[b] == Role.KINEMATIC
    way = dt * wp.length(motions.solver_bodies[b].linear)
    share = wp.min(1.0, motions.max_travel[b] / wp.max(way, 1.0e-12))
    motions.time_of_impact[b] = share
    motions.next_time_of_impact[b] = share
    motions.course[b] = share * wp.where(moves, motions.solver_bodies[b].linear, wp.vec3(0.0, 0.0, 0.0))
    motions.first_impact[b] = NO_IMPACT


@wp.func
def change_of(b: int, course: Course, state: State):
    """The change of a body's velocities in this step, as a motion."""
    change = course
    change.linear = course.linear - state.linear_velocity[b]
    change.angular = course.angular - state.angular_velocity[b]
    return change


@wp.func
def was_hit(a: int, b: int, first: Course, second: Course, size: float, dt: float, state: State):
    """Whether a body of a pair was hit in this step, so that it moves otherwise than the narrow phase expected."""
    return relative_motion(change_of(a, first, state), change_of(b, second, state), dt) > DEPTH * size


@wp.kernel
def list_fast_pairs(
    turn: int,
    threads: int,
    dt: float,
    shapes: Shapes,
    bodies: Bodies,
    state: State,
    envs: Environments,
    motions: Motions,
    pairs: Pairs,
):
    """The threads share the pairs: list those that must be traced, in any order.

    A body that has been hit moves otherwise, so further rounds repeat the pairs of all bodies that were hit.
    """
    for pair in range(wp.tid(), pairs.start[pairs.start.shape[0] - 1], threads):
        a = pairs.body_a[pair]
        b = pairs.body_b[pair]
        if turn >= TURNS and not is_crowded(bodies.env[a], envs):
            continue
        if turn == 0 or motions.time_of_impact[a] < 1.0 or motions.time_of_impact[b] < 1.0:
            size = traced_size(a, b, shapes, bodies)
            first = course_of(a, bodies, state, motions)
            second = course_of(b, bodies, state, motions)
            way = relative_motion(first, second, dt)
            if way < DEPTH * size or not may_touch(shapes, first, second, dt):
                continue
            if turn == 0 and way <= FAST * size and not was_hit(a, b, first, second, size, dt, state):
                continue
            if not stays_clear(first, second, pairs.axis[pair], dt, size, shapes):
                pairs.fast[wp.atomic_add(pairs.fast_count, 0, 1)] = pair


@wp.func
def common_velocity(a: int, b: int, motions: Motions):
    """The slowest velocity between those of two bodies, as a fraction of the way from the first to the second.

    A kinematic body keeps its velocity.
    """
    if motions.role[a] == Role.KINEMATIC:
        return 0.0
    if motions.role[b] == Role.KINEMATIC:
        return 1.0
    apart = motions.course[a] - motions.course[b]
    return wp.clamp(wp.dot(motions.course[a], apart) / wp.max(wp.length_sq(apart), 1.0e-30), 0.0, 1.0)


@wp.func
def note_impact(pair: int, a: int, b: int, t: float, motions: Motions):
    """Note an impact at a fraction of the step: of both rotations, and of the bodies that change their velocity."""
    common = common_velocity(a, b, motions)
    impact = wp.int64(t * UNITS_OF_TIME) * MOST_PAIRS + wp.int64(pair)
    if motions.role[a] == Role.FREE:
        wp.atomic_min(motions.next_time_of_impact, a, motions.time_of_impact[a] * t)
        if common > 0.0:
            wp.atomic_min(motions.first_impact, a, impact)
    if motions.role[b] == Role.FREE:
        wp.atomic_min(motions.next_time_of_impact, b, motions.time_of_impact[b] * t)
        if common < 1.0:
            wp.atomic_min(motions.first_impact, b, impact)


@wp.kernel
def limit_motion(
    teams: int, lanes: int, dt: float, shapes: Shapes, bodies: Bodies, state: State, pairs: Pairs, motions: Motions
):
    """The teams share the listed pairs: the first impact of each body."""
    lane = wp.tid() % lanes
    for k in range(wp.tid() / lanes, pairs.fast_count[0], teams):
        a = pairs.body_a[pairs.fast[k]]
        b = pairs.body_b[pairs.fast[k]]
        size = traced_size(a, b, shapes, bodies)
        touching = pairs.contact_count[pairs.fast[k]] > 0
        first = course_of(a, bodies, state, motions)
        second = course_of(b, bodies, state, motions)
        t = float(dt)
        side = int(0)
        while side < 2:
            t = first_touch(shapes, first, second, dt, t, size, touching, lane, lanes)
            swapped = first
            first = second
            second = swapped
            side += 1
        if t < dt and lane == 0:
            note_impact(pairs.fast[k], a, b, t / dt, motions)


@wp.kernel
def change_courses(pairs: Pairs, motions: Motions):
    """One thread per body: from its first impact on, it moves with the common velocity of both bodies."""
    b = wp.tid()
    impact = motions.first_impact[b]
    course = motions.course[b]
    if impact != NO_IMPACT:
        pair = int(impact % MOST_PAIRS)
        t = float(impact / MOST_PAIRS) / UNITS_OF_TIME
        first = pairs.body_a[pair]
        second = pairs.body_b[pair]
        common = common_velocity(first, second, motions)
        course = t * course + (1.0 - t) * wp.lerp(motions.course[first], motions.course[second], common)
    motions.next_course[b] = course


@wp.kernel
def close_round(motions: Motions):
    """One thread per body: the next round starts from the result of this one."""
    b = wp.tid()
    motions.time_of_impact[b] = motions.next_time_of_impact[b]
    motions.course[b] = motions.next_course[b]
    motions.first_impact[b] = NO_IMPACT
