"""Conservative advancement of two convex solids: the time in a step at which they overlap too much.

Along an axis that is fixed to the second solid, the gap of the solids (convex.py) closes at most as fast as the fastest
point of the first one moves along it. So the solids can move until that point has covered the gap along an axis. Then
an axis with a larger gap is searched for, until there is none (B. Mirtich, "Impulse-based Dynamic Simulation of Rigid
Body Systems", 1996, section 2.3). Samples would miss solids whose corners and edges run along each other, such as cubes
that fall one above the other.
"""

import warp as wp

from warp_rigid.kernels.collide.convex import find_axis, gap_along
from warp_rigid.kernels.collide.course import CLOSE_ENOUGH, DEPTH, Course, rotation_after, solids_at
from warp_rigid.kernels.collide.distance import FAR
from warp_rigid.kernels.schema import Shapes

wp.set_module_options({"enable_backward": False, "max_unroll": 4})

ADVANCES = wp.constant(32)
"""Maximum number of advances. A pair that needs more counts as touching at the time reached."""


@wp.func
def fastest_closing(axis: wp.vec3, first: Course, second: Course, t: float):
    """Largest speed at which a point of the first body approaches the second one along an axis in its frame [m/s]."""
    n = wp.quat_rotate(rotation_after(second.angular, t) * second.turn, axis)
    apart = first.center - second.center + t * (first.linear - second.linear)
    linear = first.linear - second.linear - wp.cross(second.angular, apart)
    return wp.length(wp.cross(n, first.angular - second.angular)) * first.radius - wp.dot(n, linear)


@wp.func
def time_to_close(left: float, closing: float, first: Course, second: Course, t: float):
    """Time in which a gap cannot close, if it closes at a speed that may rise, as the motion is curved."""
    away = wp.length(first.center - second.center + t * (first.linear - second.linear)) + first.radius
    own, turning = wp.length(first.angular), wp.length(second.angular)
    speed = wp.length(first.linear - second.linear) + own * first.radius + turning * away
    curve = own * own * first.radius + turning * (2.0 * speed + turning * away)
    return 2.0 * left / wp.max(closing + wp.sqrt(closing * closing + 2.0 * curve * left), 1.0e-12)


@wp.func
def impact_of_solids(first: Course, second: Course, axis: wp.vec3, near: float, dt: float, size: float, shapes: Shapes):
    """Time at which two convex solids overlap by more than DEPTH sizes; `dt` if they do not.

    Solids that start closer than `near` are handled by the solver, and may overlap by as much more than at the start.
    `axis`: one along which they may have a gap at the start of the step, in the frame of the second body.
    """
    solids = solids_at(first, second, 0.0, size)
    n = find_axis(solids, shapes, axis, near)
    gap = gap_along(solids, shapes, n)
    allowed = wp.where(gap < near, near - wp.min(gap, 0.0), DEPTH * size)
    t = float(0.0)
    advances = int(0)
    while advances < ADVANCES:
        left = gap + allowed
        if left < CLOSE_ENOUGH * size:
            return t
        t += time_to_close(left, fastest_closing(n, first, second, t), first, second, t)
        if t >= dt:
            return dt
        solids = solids_at(first, second, t, size)
        n = find_axis(solids, shapes, n, FAR)
        gap = gap_along(solids, shapes, n)
        advances += 1
    return t
