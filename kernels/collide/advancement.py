"""Conservative advancement of two convex solids: the time in a step at which they overlap too much.

Along an axis that is fixed to the second solid, the gap of the solids (convex.py) closes at most as fast as the fastest
point of the first one moves along it, and it is bounded by its values now and at a later time. So the solids can
move until the gap may have closed. Then an axis with a larger gap is searched for, until there is none (B. Mirtich,
"Impulse-based Dynamic Simulation of Rigid Body Systems", 1996, section 2.3). Samples would miss solids whose corners
and edges run along each other, such as cubes that fall one above the other.
"""

import warp as wp

from warp_rigid.kernels.collide.convex import find_axis, gap_along, placed_solid, pose_of_solid
from warp_rigid.kernels.collide.course import Course, pose_in, solids_at
from warp_rigid.kernels.common.symmetry import rotation_after
from warp_rigid.kernels.schema import Shapes
from warp_rigid.kernels.tuning import ALLOWED_DEPTH, CLOSE_ENOUGH

wp.set_module_options({"enable_backward": False, "max_unroll": 4})


@wp.func
def fastest_closing(axis: wp.vec3, first: Course, second: Course, t: float):
    """Largest speed at which a point of the first body approaches the second one along an axis in its frame [m/s]."""
    n = wp.quat_rotate(rotation_after(second.angular, t) * second.turn, axis)
    apart = first.center - second.center + t * (first.linear - second.linear)
    linear = first.linear - second.linear - wp.cross(second.angular, apart)
    turning = first.angular - wp.quat_rotate(rotation_after(first.angular, t), first.roll) - second.angular
    return wp.length(wp.cross(n, turning)) * first.radius - wp.dot(n, linear)


@wp.func
def curvature(first: Course, second: Course, t: float, end: float):
    """Upper bound of the acceleration of a point of the first body in the frame of the second one until `end` [m/s^2].

    The distance of the centres is largest at one of both times.
    """
    apart = first.center - second.center
    passing = first.linear - second.linear
    away = wp.max(wp.length(apart + t * passing), wp.length(apart + end * passing)) + first.radius
    own, turning = wp.length(first.angular - first.roll), wp.length(second.angular)
    speed = wp.length(passing) + own * first.radius + turning * away
    return own * (own + wp.length(first.roll)) * first.radius + turning * (2.0 * speed + turning * away)


@wp.func
def first_root(left: float, closing: float, curve: float, span: float):
    """The first zero of `left - closing s + curve s^2 / 2` for s below `span`, or `span`."""
    square = closing * closing - 2.0 * curve * left
    if closing <= 0.0 or square < 0.0:
        return span
    return wp.min(2.0 * left / (closing + wp.sqrt(square)), span)


@wp.func
def time_to_close(left: float, left_at_end: float, closing: float, curve: float, span: float):
    """Time in which a gap cannot close, of which `left_at_end` is left after a time `span`.

    The gap is the least of many functions, one for each pair of points, whose second derivatives are below the
    curvature. Each of them, and so the gap, lies above its chord less the parabola of this curvature. It also closes
    no faster than the fastest point moves.
    """
    by_speed = 2.0 * left / wp.max(closing + wp.sqrt(closing * closing + 2.0 * curve * left), 1.0e-12)
    by_chord = first_root(left, (left - left_at_end) / span + 0.5 * curve * span, curve, span)
    return wp.max(by_speed, by_chord)


@wp.func
def impact_of_solids(
    first: Course, second: Course, axis: wp.vec3, near: float, begin: float, end: float, size: float, shapes: Shapes
):
    """Time from `begin` on at which two convex solids overlap by more than ALLOWED_DEPTH sizes; `end` if they do not.

    Solids that start the step closer than `near` are handled by the solver, and may overlap by as much more than then.
    `axis`: one along which they may have a gap at the start of the step, in the frame of the second body.
    """
    local = pose_of_solid(shapes, first.shape)
    solids = solids_at(first, second, 0.0, size, shapes)
    last = solids_at(first, second, end, size, shapes)
    n = find_axis(solids, shapes, axis, near)
    gap = gap_along(solids, shapes, n)
    at_end = gap_along(last, shapes, n)
    allowed = wp.where(gap < near, near - wp.min(gap, 0.0), ALLOWED_DEPTH * size)
    found = gap + allowed
    t = begin
    if begin > 0.0:
        solids.a = placed_solid(solids.a, pose_in(first, second, begin), local)
        gap = gap_along(solids, shapes, n)
    advances = int(0)
    # A pair that needs more counts as touching at the time reached.
    while advances < 64:
        # The tolerance grows, and has doubled after 16 advances: solids that brush past each other near the allowed
        # depth would need many.
        excess = float(advances) / 16.0
        close = CLOSE_ENOUGH * size * (1.0 + excess * excess)
        # Axes turn with the second solid: another one is searched for when a quarter is left of the gap to the allowed
        # depth.
        if gap + allowed < wp.max(0.25 * found, close):
            n = find_axis(solids, shapes, n, -0.5 * allowed)
            gap = gap_along(solids, shapes, n)
            at_end = gap_along(last, shapes, n)
            found = gap + allowed
        if gap + allowed < close:
            return t
        closing = fastest_closing(n, first, second, t)
        t += time_to_close(gap + allowed, at_end + allowed, closing, curvature(first, second, t, end), end - t)
        if t >= end:
            return end
        solids.a = placed_solid(solids.a, pose_in(first, second, t), local)
        gap = gap_along(solids, shapes, n)
        advances += 1
    return t
