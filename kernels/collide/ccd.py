"""Continuous collision detection: the motion of fast bodies is limited so that they cannot pass through other bodies.

The narrow phase finds contacts near the pose at the start of a step. Further along the motion, neither the position nor
the normal of a contact is known. Therefore, before the bodies move, pairs whose motion in the step is large compared
with the smaller of both sizes are traced with the velocities computed by the solver: first the bounding sphere of a
body, then the bounding spheres of its clusters, then its samples and its centre, each against the signed distance of
the other body (trace.py). From its time of impact on, a pair moves together for the rest of the step, with the slower
of both velocities, and without rotation. The next step finds the contact there, with the true normal and the full
speed, so that the bodies rebound correctly. If the bodies stopped instead, those that fall behind them in a heap would
run into them: by up to 0.6 sizes where 4096 boxes land at 10 m/s with two steps per frame.
"""

import warp as wp

from warp_rigid.kernels.collide.course import (
    DEPTH,
    FAST,
    Course,
    course_of,
    largest_motion,
    passage_of,
    place_at,
    relative_motion,
    stays_clear,
)
from warp_rigid.kernels.collide.culling import out_of_box
from warp_rigid.kernels.collide.trace import ball_of, trace_ball, trace_reached
from warp_rigid.kernels.common.crowd import is_crowded
from warp_rigid.kernels.common.team import ballot
from warp_rigid.kernels.enums import Role
from warp_rigid.kernels.schema import Bodies, Environments, Motions, Pairs, Shapes, State
from warp_rigid.kernels.update.predict import UNBOUNDED_EXTENT, smaller_size

wp.set_module_options({"enable_backward": False, "max_unroll": 4})


TURNS = wp.constant(2)
"""Rounds of impacts. In a round, the impacts of the previous one reach the next body of a chain."""
TURNS_IN_CROWDS = wp.constant(4)
"""Rounds in crowded environments, where heaps land: 4096 boxes then overlap half as much as with two rounds."""

NO_IMPACT = wp.constant(wp.int64(2**62))
"""Value of `first_impact` without an impact; it is the time in units, times MOST_PAIRS, plus the pair otherwise."""
MOST_PAIRS = wp.constant(wp.int64(2**31))
UNITS_OF_TIME = wp.constant(2.0**20)
"""Units of the time of an impact in a step; rounded down, it is early by half a millionth of the step."""


@wp.func
def traced_size(a: int, b: int, shapes: Shapes, bodies: Bodies):
    """Size of the smaller body of a pair [m], or twice the thickness of the thinner walls if that is less."""
    wall = wp.min(shapes.shapes[bodies.shape[a]].wall, shapes.shapes[bodies.shape[b]].wall)
    return wp.min(smaller_size(a, b, shapes, bodies), 2.0 * wall)


@wp.func
def first_touch(
    shapes: Shapes,
    own: Course,
    other: Course,
    dt: float,
    end: float,
    size: float,
    touching: bool,
    group: int,
    groups: int,
    lane: int,
    lanes: int,
):
    """First time at which a sample, an edge or the centre of one body penetrates the other too deep, at most `end`.

    The lanes of a team share the clusters of every `groups`-th group, from `group` on. The cluster before the first one
    is the body itself, with its centre as a sample.
    """
    earliest = float(end)
    if own.radius > UNBOUNDED_EXTENT:
        return earliest
    passage = passage_of(own, other, dt, size, touching, shapes)
    cluster = int(-1)
    while cluster < shapes.shapes[own.shape].cluster_end:
        own_cluster = wp.where(cluster < 0, -1, wp.min(cluster + lane, shapes.shapes[own.shape].cluster_end - 1))
        ball = ball_of(own, own_cluster, shapes)
        at = float(earliest)
        if cluster < 0 or cluster + lane < shapes.shapes[own.shape].cluster_end:
            at = trace_ball(shapes, own, other, own_cluster, ball, earliest, passage)
        if cluster < 0 and at >= end:
            return earliest
        reached = ballot(wp.where(at < earliest and (cluster >= 0 or lane + group == 0), 1, 0), lanes)
        earliest = trace_reached(shapes, own, other, reached, ball, at, earliest, passage, lane, lanes)
        first = shapes.shapes[own.shape].cluster_start + group * lanes
        cluster = wp.where(cluster < 0, first, cluster + groups * lanes)
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
    sharing: int,
    teams: int,
    lanes: int,
    dt: float,
    shapes: Shapes,
    bodies: Bodies,
    state: State,
    pairs: Pairs,
    motions: Motions,
):
    """The teams share the listed pairs: the first impact of each body.

    A pair is traced by one team, or by an even number `sharing` of teams: half of them for the samples of each body.
    """
    lane = wp.tid() % lanes
    for k in range(wp.tid() / lanes, pairs.fast_count[0] * sharing, teams):
        pair = pairs.fast[k / sharing]
        member = k % sharing
        a = pairs.body_a[pair]
        b = pairs.body_b[pair]
        size = traced_size(a, b, shapes, bodies)
        touching = pairs.contact_count[pair] > 0
        first = course_of(a, bodies, state, motions)
        second = course_of(b, bodies, state, motions)
        group = member / 2
        groups = wp.max(sharing / 2, 1)
        t = float(dt)
        side = int(0)
        while side < 2:
            if sharing == 1 or member % 2 == side:
                t = first_touch(shapes, first, second, dt, t, size, touching, group, groups, lane, lanes)
            swapped = first
            first = second
            second = swapped
            side += 1
        if t < dt and lane == 0:
            note_impact(pair, a, b, t / dt, motions)


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
