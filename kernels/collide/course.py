"""Courses: the motion of two bodies within a step, with the velocities computed by the solver.

From an impact on, two bodies move as one: each point of either has a velocity between those that the two bodies have
there. Of these motions it is the slowest one, so that a body at rest stops the other, and bodies that meet head-on both
stop. A kinematic body keeps its motion, and so does a body that a kinematic one carries: other bodies that hit it later
in the step would otherwise move it into the kinematic body. A kinematic body that spins about its axis of symmetry
does not turn others with it, as its surface stays in place.
"""

from enum import IntEnum

import warp as wp

from warp_rigid.kernels.collide.convex import are_solid, gap_along, solids_of_shapes
from warp_rigid.kernels.common.symmetry import rotation_after, spin_of_surface
from warp_rigid.kernels.enums import Role
from warp_rigid.kernels.schema import Bodies, Motions, Shapes, State
from warp_rigid.kernels.tuning import ALLOWED_DEPTH, DEPTH_OF_CONTACTS, FAST_TRAVEL, NEAR_REACH

wp.set_module_options({"enable_backward": False, "max_unroll": 4})


TURNING_ARM = wp.constant(0.5)
"""A rotation counts as the velocity at this fraction of the radius, which is close to the radius of gyration."""


class Lead(IntEnum):
    """Numbers of bodies in `lead_of` that no other body carries; a body has one less than the one that carries it."""

    KINEMATIC = 2**20
    """A kinematic body."""
    HOLDER = 2**19
    """An immovable body in the late iterations."""


@wp.struct
class Course:
    """Motion of a body in a step: constant linear velocity, and constant angular velocity about the centre of mass.

    `joined`: 1 if it is a body of a mechanism. `roll`: the part of the angular velocity at the start that leaves the
    surface of a round body in place.
    """

    center: wp.vec3
    turn: wp.quat
    local_center: wp.vec3
    linear: wp.vec3
    angular: wp.vec3
    roll: wp.vec3
    radius: float
    shape: int
    joined: int


@wp.struct
class Passage:
    """Relative motion of a body with samples in the frame of the body with the distance, over the whole step.

    `start`, `middle`, `end`: pose of the shape at the start, in the middle and at the end of the step.
    `reach`: upper bound of the motion of points that can meet the other body.
    `size`: the smaller size of the two bodies, or twice the thickness of their walls if that is less.
    `near`: samples that start closer are handled by the solver, and may penetrate as deep as this [m].
    `rotation`: angle by which both bodies together turn in the step.
    """

    start: wp.transform
    middle: wp.transform
    end: wp.transform
    reach: float
    size: float
    near: float
    dt: float
    rotation: float


@wp.func
def placed_course(b: int, bodies: Bodies, state: State, motions: Motions):
    """A body at the start of the step, without its motion."""
    course = Course()
    course.center = motions.center[b]
    course.turn = state.orientation[b]
    course.local_center = bodies.center_of_mass[b]
    course.radius = motions.radius[b]
    course.shape = bodies.shape[b]
    return course


@wp.func
def course_of(b: int, shapes: Shapes, bodies: Bodies, state: State, motions: Motions):
    """The mean motion of a body in the step, after the impacts of the previous iterations.

    A kinematic body that spins about its axis of symmetry does not turn, as its surface stays in place.
    """
    course = placed_course(b, bodies, state, motions)
    course.linear = motions.course[b]
    course.joined = motions.joined[b]
    if motions.role[b] == Role.FREE or motions.role[b] == Role.KINEMATIC:
        course.angular = motions.time_of_impact[b] * motions.solver_bodies[b].angular + motions.shared_spin[b]
    if motions.role[b] == Role.KINEMATIC:
        turning = spin_of_surface(b, course.angular, shapes, bodies, state)
        # Rounding errors are far below. If the axis turned, too, the surface would not turn as by the rest alone.
        if wp.length_sq(turning) < 1.0e-6 * wp.length_sq(course.angular):
            course.angular = turning
    return course


@wp.func
def onward_course(b: int, shapes: Shapes, bodies: Bodies, state: State, motions: Motions):
    """The motion that a body would continue: its course, or that of its whole mechanism, without rotation."""
    course = course_of(b, shapes, bodies, state, motions)
    if course.joined == 1:
        course.linear = motions.onward[b]
        course.angular = wp.vec3(0.0, 0.0, 0.0)
    return course


@wp.func
def velocity_at(p: wp.vec3, course: Course):
    """Velocity of a point that moves with a body [m/s]."""
    return course.linear + wp.cross(course.angular, p - course.center)


@wp.func
def mean_velocity_at(p: wp.vec3, course: Course, duration: float):
    """Mean velocity of a point that moves with a body for a time: along the chord of its arc [m/s]."""
    # Motion by such a small angle [rad] counts as straight.
    if duration * wp.length(course.angular) < 1.0e-3:
        return velocity_at(p, course)
    arm = p - course.center
    return course.linear + (wp.quat_rotate(rotation_after(course.angular, duration), arm) - arm) / duration


@wp.func
def lead_of(b: int, motions: Motions):
    """Which body of a pair keeps its motion at an impact: the one with the larger number. Most bodies have 0."""
    return wp.where(motions.role[b] == Role.KINEMATIC, Lead.KINEMATIC, motions.carried[b])


@wp.func
def is_driven(a: int, b: int, motions: Motions):
    """Whether a kinematic body moves a pair, directly or through others."""
    return wp.max(lead_of(a, motions), lead_of(b, motions)) > Lead.HOLDER


@wp.func
def common_share(a: int, b: int, first: Course, second: Course, motions: Motions):
    """Where the common motion of a pair lies between those of both bodies, as a fraction of their difference.

    It is the slowest such motion, unless a kinematic body leads.
    """
    ahead = lead_of(b, motions) - lead_of(a, motions)
    if ahead != 0:
        return wp.where(ahead > 0, 1.0, 0.0)
    middle = 0.5 * (first.center + second.center)
    arm = TURNING_ARM * wp.min(first.radius, second.radius)
    v = velocity_at(middle, first)
    apart = v - velocity_at(middle, second)
    turning = arm * (first.angular - second.angular)
    along = wp.dot(v, apart) + arm * wp.dot(first.angular, turning)
    return wp.clamp(along / wp.max(wp.length_sq(apart) + wp.length_sq(turning), 1.0e-30), 0.0, 1.0)


@wp.func
def common_motion(
    own: int, a: int, b: int, t: float, dt: float, shapes: Shapes, bodies: Bodies, state: State, motions: Motions
):
    """The motion of a body after an impact at time t of a pair to which it belongs: the mean one until the end dt.

    Unless a kinematic body leads, the body becomes no faster, so that chains of impacts come to an end.
    """
    first = onward_course(a, shapes, bodies, state, motions)
    second = onward_course(b, shapes, bodies, state, motions)
    share = common_share(a, b, first, second, motions)
    after = onward_course(own, shapes, bodies, state, motions)
    arm = TURNING_ARM * after.radius
    before = wp.length_sq(after.linear) + arm * arm * wp.length_sq(after.angular)
    place = after.center + t * after.linear
    by_first = mean_velocity_at(place - t * first.linear, first, dt - t)
    after.linear = wp.lerp(by_first, mean_velocity_at(place - t * second.linear, second, dt - t), share)
    after.angular = wp.lerp(first.angular, second.angular, share)
    if not is_driven(a, b, motions):
        speed = wp.length_sq(after.linear) + arm * arm * wp.length_sq(after.angular)
        slower = wp.min(1.0, wp.sqrt(before / wp.max(speed, 1.0e-30)))
        after.linear *= slower
        after.angular *= slower
    return after


@wp.func
def relative_motion(a: Course, b: Course, dt: float):
    """Upper bound of the relative motion of two bodies in a step [m], at the surface of the smaller one."""
    small = a
    if b.radius < a.radius:
        small = b
    v = a.linear + wp.cross(a.angular, small.center - a.center)
    w = b.linear + wp.cross(b.angular, small.center - b.center)
    return dt * (wp.length(v - w) + wp.length(a.angular - b.angular) * small.radius)


@wp.func
def largest_motion(a: Course, b: Course, dt: float):
    """`relative_motion`, with the increase by the rotation of the larger body within the step."""
    return relative_motion(a, b, dt) * (1.0 + dt * (wp.length(a.angular) + wp.length(b.angular)))


@wp.func
def pose_in(own: Course, other: Course, t: float):
    """Pose of a body's shape at time t in the frame of the other body's shape."""
    back = wp.quat_inverse(rotation_after(other.angular, t) * other.turn)
    turn = back * rotation_after(own.angular, t) * own.turn
    apart = own.center - other.center + t * (own.linear - other.linear)
    shift = wp.quat_rotate(back, apart) + other.local_center - wp.quat_rotate(turn, own.local_center)
    return wp.transformation(shift, turn)


@wp.func
def solids_at(own: Course, other: Course, t: float, size: float, shapes: Shapes):
    """Two bodies as convex solids at time t, in the frame of the second one's shape."""
    return solids_of_shapes(own.shape, other.shape, pose_in(own, other, t), size, shapes)


@wp.func
def stays_clear(own: Course, other: Course, axis: wp.vec3, dt: float, size: float, shapes: Shapes):
    """Whether an axis in the frame of the other body shows that two convex solids do not penetrate in the step.

    As in `gap_of` (ccd.py), this is tested in the middle and at the end of a motion below half the size.
    """
    if wp.length_sq(axis) == 0.0 or relative_motion(own, other, dt) > 2.0 * FAST_TRAVEL * size:
        return False
    if not are_solid(own.shape, other.shape, shapes):
        return False
    allowed = float(0.0)
    halves = int(0)
    while halves < 3:
        gap = gap_along(solids_at(own, other, 0.5 * float(halves) * dt, size, shapes), shapes, axis)
        if halves == 0:
            allowed = wp.min(gap, 0.0) - ALLOWED_DEPTH * size
        elif gap < allowed:
            return False
        halves += 1
    return True


@wp.func
def handled_gap_of_solids(own: Course, other: Course, size: float, touching: bool):
    """`handled_gap` of two convex solids."""
    return wp.where(touching and own.joined + other.joined > 0, DEPTH_OF_CONTACTS, ALLOWED_DEPTH) * size


@wp.func
def handled_gap(own: Course, other: Course, dt: float, size: float, touching: bool, shapes: Shapes):
    """Samples of a body that start closer to the other are handled by the solver [m]; `touching`: it has contacts."""
    if touching and shapes.shapes[other.shape].convex == 0 and relative_motion(own, other, dt) > FAST_TRAVEL * size:
        return NEAR_REACH * wp.min(size, shapes.shapes[other.shape].wall)
    return handled_gap_of_solids(own, other, size, touching)


@wp.func
def passage_of(own: Course, other: Course, dt: float, size: float, touching: bool, shapes: Shapes):
    """The relative motion of a body in the frame of another over the step; `touching`: the pair has contacts."""
    passage = Passage()
    passage.start = pose_in(own, other, 0.0)
    passage.middle = pose_in(own, other, 0.5 * dt)
    passage.end = pose_in(own, other, dt)
    passage.reach = largest_motion(own, other, dt)
    passage.size = size
    passage.near = handled_gap(own, other, dt, size, touching, shapes)
    passage.dt = dt
    passage.rotation = dt * (wp.length(own.angular) + wp.length(other.angular))
    return passage


@wp.func
def place_at(own: Course, other: Course, arm: wp.vec3, t: float):
    """Position at time t of a point at `arm` from a body's centre, in the frame of the other body's shape."""
    offset = own.center - other.center + t * (own.linear - other.linear)
    offset = offset + wp.quat_rotate(rotation_after(own.angular, t), arm)
    turn = rotation_after(other.angular, t) * other.turn
    return wp.quat_rotate(wp.quat_inverse(turn), offset) + other.local_center


@wp.func
def closing_speed(own: Course, other: Course, arm: wp.vec3, x: wp.vec3, n: wp.vec3, t: float):
    """Approach speed of a point to the other body along its normal n; x and n are in the other body's frame."""
    turn = rotation_after(other.angular, t) * other.turn
    v = own.linear + wp.cross(own.angular, wp.quat_rotate(rotation_after(own.angular, t), arm))
    w = other.linear + wp.cross(other.angular, wp.quat_rotate(turn, x - other.local_center))
    return wp.dot(w - v, wp.quat_rotate(turn, n))


@wp.func
def curvature_of(own: Course, other: Course, arm: wp.vec3):
    """Upper bound of the acceleration of a point at `arm` from a body's centre, in the other body's frame [m/s^2]."""
    spin = wp.length(other.angular)
    away = wp.length(own.center + arm - other.center)
    speed = wp.length(own.linear - other.linear) + wp.length(own.angular) * wp.length(arm) + spin * away
    return wp.length_sq(own.angular) * wp.length(arm) + spin * (2.0 * speed + spin * away)
