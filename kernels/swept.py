"""Swept detection: what moves far in a step is followed along its way, so that it cannot pass through anything.

Contacts are looked for near the pose at the start of a step: further on, neither the place nor the direction of a touch
is known. So before the bodies move, pairs whose motion in the step is large against the smaller of both sizes are
followed with the velocities that the solver has given them: the ball around a body, then the balls around its clusters,
then its samples and its centre, each traced in the other body's distance (conservative advancement). A pair moves only
up to where it would touch; the next step finds the contact there, with the true normal and the full speed, so that it
rebounds as it should.

In a convex distance the way ahead is bounded by the tangent of the distance and by how fast the motion can curve, so a
few rounds are enough, and what moves along a surface is not held up; elsewhere by the speed alone.
"""

import warp as wp

from warp_rigid.kernels.data import Bodies, Motions, Pairs, Shapes, State
from warp_rigid.kernels.distance import HEIGHTFIELD, signed_distance
from warp_rigid.kernels.narrowphase import NEAR, matters
from warp_rigid.kernels.predict import DRIVEN, FREE, UNBOUNDED
from warp_rigid.kernels.samples import RIM

wp.set_module_options({"enable_backward": False, "max_unroll": 4})


FAST = wp.constant(0.25)
"""A pair is followed if it moves further in a step than this part of the smaller size."""

DEPTH = wp.constant(0.02)
"""How deep others may go when they are stopped, as a part of the size."""

CLOSE_ENOUGH = wp.constant(2.0e-3)
"""A trace ends when this part of the size is left."""

ROUNDS = wp.constant(64)
"""Most rounds of a trace; one that needs more is taken to touch where it has come to."""


@wp.struct
class Course:
    """How a body moves in a step: uniformly, about its centre of mass."""

    center: wp.vec3
    turn: wp.quat
    local_center: wp.vec3
    linear: wp.vec3
    angular: wp.vec3
    radius: float
    shape: int


@wp.func
def course_of(b: int, share: float, bodies: Bodies, state: State, motions: Motions):
    """The course of a body that moves a share of its step."""
    course = Course()
    course.center = motions.center[b]
    course.turn = state.orientation[b]
    course.local_center = bodies.center_of_mass[b]
    course.radius = motions.radius[b]
    course.shape = bodies.shape[b]
    if motions.role[b] == FREE or motions.role[b] == DRIVEN:
        course.linear = share * state.linear_velocity[b]
        course.angular = share * state.angular_velocity[b]
    return course


@wp.func
def rotation_after(angular: wp.vec3, t: float):
    """Rotation by an angular velocity in a time."""
    speed = wp.length(angular)
    if speed == 0.0:
        return wp.quat_identity()
    return wp.quat_from_axis_angle(angular / speed, speed * t)


@wp.func
def lead(shapes: Shapes, shape: int, x: wp.vec3, left: float, ball: float):
    """How far a ball about x can surely go until nothing is left of its distance.

    The height over a heightfield holds for its own neighbourhood only, the way down to its highest place everywhere.
    """
    part = shapes.shapes[shape].part_start
    if shapes.parts[part].kind != HEIGHTFIELD:
        return left
    size = shapes.parts[part].size
    dims = shapes.parts[part].grid_dims
    cell = wp.min(size[0] / float(dims[0] - 1), size[1] / float(dims[1] - 1))
    return wp.max(x[2] - ball - shapes.shapes[shape].upper[2], wp.min(left, 0.5 * cell))


@wp.func
def place_at(own: Course, other: Course, arm: wp.vec3, t: float):
    """Where a point at an arm from a body's centre is after a time, in the frame of the other body's shape."""
    offset = own.center - other.center + t * (own.linear - other.linear)
    offset = offset + wp.quat_rotate(rotation_after(own.angular, t), arm)
    turn = rotation_after(other.angular, t) * other.turn
    return wp.quat_rotate(wp.quat_inverse(turn), offset) + other.local_center


@wp.func
def closing_speed(own: Course, other: Course, arm: wp.vec3, x: wp.vec3, n: wp.vec3, t: float):
    """Speed at which a point comes nearer to the other body along its normal n; x and n in that one's frame."""
    turn = rotation_after(other.angular, t) * other.turn
    v = own.linear + wp.cross(own.angular, wp.quat_rotate(rotation_after(own.angular, t), arm))
    w = other.linear + wp.cross(other.angular, wp.quat_rotate(turn, x - other.local_center))
    return wp.dot(w - v, wp.quat_rotate(turn, n))


@wp.func
def trace(
    shapes: Shapes,
    own: Course,
    other: Course,
    arm: wp.vec3,
    radius: float,
    allowed: float,
    tolerance: float,
    begin: float,
    end: float,
):
    """Time from `begin` at which a ball at an arm enters the other body deeper than allowed, or `end`."""
    other_spin = wp.length(other.angular)
    away = wp.length(own.center + arm - other.center)
    speed = wp.length(own.linear - other.linear) + wp.length(own.angular) * wp.length(arm) + other_spin * away
    curve = wp.length_sq(own.angular) * wp.length(arm) + other_spin * (2.0 * speed + other_spin * away)
    t = float(begin)
    for _round in range(ROUNDS):
        x = place_at(own, other, arm, t)
        d = signed_distance(shapes, other.shape, x)
        left = d[3] - radius + allowed
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
def trace_sample(
    shapes: Shapes,
    own: Course,
    other: Course,
    p: wp.vec3,
    radius: float,
    near: float,
    begin: float,
    end: float,
    size: float,
):
    """Time at which a sample would enter the other body too deep, or `end`; it cannot before `begin`.

    A sample that starts nearer than `near` is the solver's, and may go so much deeper.
    """
    arm = wp.quat_rotate(own.turn, p - own.local_center)
    d = signed_distance(shapes, other.shape, place_at(own, other, arm, 0.0))
    gap = d[3] - radius
    if gap < near:
        allowed = near - wp.min(gap, 0.0)
        return trace(shapes, own, other, arm, radius, allowed, CLOSE_ENOUGH * size, 0.0, end)
    return trace(shapes, own, other, arm, radius, DEPTH * size, CLOSE_ENOUGH * size, begin, end)


@wp.func
def first_touch(shapes: Shapes, own: Course, other: Course, end: float, size: float):
    """Time at which a sample or the centre of one body would first enter the other too deep, at most `end`."""
    earliest = float(end)
    if own.radius > UNBOUNDED:
        return earliest
    tolerance = CLOSE_ENOUGH * size
    begin = trace(shapes, own, other, wp.vec3(0.0, 0.0, 0.0), own.radius, 0.0, tolerance, 0.0, end)
    if begin >= end:
        return earliest
    if shapes.shapes[own.shape].convex == 1:
        earliest = trace_sample(shapes, own, other, own.local_center, 0.0, DEPTH * size, begin, earliest, size)
    for cluster in range(shapes.shapes[own.shape].cluster_start, shapes.shapes[own.shape].cluster_end):
        if matters(shapes.clusters[cluster].kind, own.shape, other.shape, 1, shapes):
            arm = wp.quat_rotate(own.turn, shapes.clusters[cluster].center - own.local_center)
            ball = shapes.clusters[cluster].radius
            at = trace(shapes, own, other, arm, ball, 0.0, tolerance, 0.0, earliest)
            if at < earliest:
                for s in range(shapes.clusters[cluster].sample_start, shapes.clusters[cluster].sample_end):
                    if shapes.samples[s].kind != RIM:
                        p = shapes.samples[s].point
                        ball = shapes.samples[s].radius
                        earliest = trace_sample(shapes, own, other, p, ball, NEAR * size, at, earliest, size)
    return earliest


@wp.func
def is_fast(a: Course, b: Course, dt: float, size: float):
    """Whether two bodies move so far against each other in a step that they must be followed."""
    small = a
    if b.radius < a.radius:
        small = b
    v = a.linear + wp.cross(a.angular, small.center - a.center)
    w = b.linear + wp.cross(b.angular, small.center - b.center)
    return dt * (wp.length(v - w) + wp.length(a.angular - b.angular) * small.radius) > FAST * size


@wp.kernel
def limit_way(dt: float, state: State, motions: Motions):
    """One thread a body: it may move no further than other bodies were looked for."""
    b = wp.tid()
    way = dt * wp.length(state.linear_velocity[b])
    share = wp.min(1.0, motions.room[b] / wp.max(way, 1.0e-12))
    motions.share[b] = share
    motions.next_share[b] = share


@wp.kernel
def follow(
    again: int, threads: int, dt: float, shapes: Shapes, bodies: Bodies, state: State, motions: Motions, pairs: Pairs
):
    """The threads share the pairs: how much of the step's motion its two bodies may make.

    Who is stopped may be run into by who follows: a second round does the pairs of all that were stopped once more.
    """
    for pair in range(wp.tid(), pairs.start[pairs.start.shape[0] - 1], threads):
        a = pairs.body_a[pair]
        b = pairs.body_b[pair]
        share_a = motions.share[a]
        share_b = motions.share[b]
        if again == 0 or share_a < 1.0 or share_b < 1.0:
            size = wp.min(shapes.shapes[bodies.shape[a]].size, shapes.shapes[bodies.shape[b]].size)
            first = course_of(a, share_a, bodies, state, motions)
            second = course_of(b, share_b, bodies, state, motions)
            if is_fast(first, second, dt, size):
                t = first_touch(shapes, first, second, dt, size)
                t = first_touch(shapes, second, first, t, size)
                if t < dt:
                    wp.atomic_min(motions.next_share, a, share_a * t / dt)
                    wp.atomic_min(motions.next_share, b, share_b * t / dt)


@wp.kernel
def settle(motions: Motions):
    """One thread a body: what the first round allows holds for the second."""
    b = wp.tid()
    motions.share[b] = motions.next_share[b]
