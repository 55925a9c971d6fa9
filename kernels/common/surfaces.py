"""Surfaces that run along their bodies, such as conveyor belts, turntables and treadmills."""

import warp as wp

from warp_rigid.kernels.schema import Bodies, State

wp.set_module_options({"enable_backward": False})


@wp.func
def runs(b: int, bodies: Bodies):
    """Whether the surface of a body runs."""
    return wp.length_sq(bodies.surface_velocity[b]) + wp.length_sq(bodies.surface_angular_velocity[b]) > 0.0


@wp.func
def running_velocity(b: int, x: wp.vec3, bodies: Bodies, state: State):
    """Velocity of a body's surface relative to the body, at a world point [m/s]."""
    turn = state.orientation[b]
    local = wp.quat_rotate_inv(turn, x - state.position[b])
    return wp.quat_rotate(turn, bodies.surface_velocity[b] + wp.cross(bodies.surface_angular_velocity[b], local))


@wp.func
def tangential_running(a: int, b: int, x: wp.vec3, normal: wp.vec3, bodies: Bodies, state: State):
    """Velocity with which the first body's surface runs relative to the second's, in the tangent plane [m/s].

    A surface runs along itself: the part along the normal would open or close gaps.
    """
    v = running_velocity(a, x, bodies, state) - running_velocity(b, x, bodies, state)
    return v - wp.dot(v, normal) * normal
