"""Surfaces that run along their bodies, such as conveyor belts, turntables and treadmills."""

import warp as wp

from warp_rigid.kernels.common.symmetry import chord_velocity
from warp_rigid.kernels.schema import Bodies, Motions, State
from warp_rigid.kernels.tuning import CARRIED

wp.set_module_options({"enable_backward": False})


@wp.func
def runs(b: int, bodies: Bodies):
    """Whether the surface of a body runs."""
    return wp.length_sq(bodies.surface_velocity[b]) + wp.length_sq(bodies.surface_angular_velocity[b]) > 0.0


@wp.func
def running_spin(b: int, bodies: Bodies, state: State):
    """Angular velocity of a body's surface relative to the body, in the world frame [rad/s]."""
    return wp.quat_rotate(state.orientation[b], bodies.surface_angular_velocity[b])


@wp.func
def running_velocity(b: int, x: wp.vec3, bodies: Bodies, state: State):
    """Velocity of a body's surface relative to the body, at a world point [m/s]."""
    turn = state.orientation[b]
    local = wp.quat_rotate_inv(turn, x - state.position[b])
    return wp.quat_rotate(turn, bodies.surface_velocity[b] + wp.cross(bodies.surface_angular_velocity[b], local))


@wp.func
def carried_share(b: int, spin: wp.vec3, motions: Motions):
    """Degree to which a body turns with a spin, and is carried around by what has this spin, 0 to 1."""
    turning = wp.dot(motions.solver_bodies[b].angular, spin) / wp.max(wp.length_sq(spin), 1.0e-30)
    return wp.clamp(turning / CARRIED, 0.0, 1.0)


@wp.func
def along_own_way(carrier: int, b: int, spin: wp.vec3, normal: wp.vec3, dt: float, motions: Motions):
    """Mean velocity of a surface with a spin below a body that moves over it, less that below it at the start [m/s]."""
    way = 0.5 * dt * (motions.solver_bodies[b].linear - motions.solver_bodies[carrier].linear)
    return wp.dot(spin, normal) * wp.cross(normal, way)


@wp.func
def running_chord(carrier: int, b: int, normal: wp.vec3, dt: float, bodies: Bodies, state: State, motions: Motions):
    """Mean velocity of a surface that turns below a body in a step, less that at its start [m/s].

    A body that turns with the surface moves along a chord, another one, such as a ball, on its own way.
    """
    spin = running_spin(carrier, bodies, state)
    way = wp.cross(spin, wp.quat_rotate(state.orientation[carrier], bodies.surface_velocity[carrier]))
    middle = state.position[carrier] + way / wp.max(wp.length_sq(spin), 1.0e-30)
    share = carried_share(b, spin, motions)
    chord = chord_velocity(spin, motions.center[b] - middle, dt)
    return share * chord + (1.0 - share) * along_own_way(carrier, b, spin, normal, dt, motions)


@wp.func
def tangential_running(
    a: int, b: int, x: wp.vec3, normal: wp.vec3, dt: float, bodies: Bodies, state: State, motions: Motions
):
    """Mean velocity with which the first body's surface runs relative to the second's in a step, in the tangent plane.

    A surface runs along itself: the part along the normal would open or close gaps [m/s].
    """
    v = running_velocity(a, x, bodies, state) - running_velocity(b, x, bodies, state)
    v += running_chord(a, b, normal, dt, bodies, state, motions)
    v -= running_chord(b, a, normal, dt, bodies, state, motions)
    return v - wp.dot(v, normal) * normal
