"""Symmetry of shapes: rotations that leave a surface in place, although they move its material points."""

from enum import IntEnum

import warp as wp

from warp_rigid.kernels.enums import PartKind
from warp_rigid.kernels.schema import Bodies, Shapes, State

wp.set_module_options({"enable_backward": False})


class Symmetry(IntEnum):
    """Symmetry about the centre of mass: none, about the axis of a cylinder or capsule, or about every axis."""

    NONE = 0
    ROUND = 1
    BALL = 2


@wp.func
def rotation_after(angular: wp.vec3, t: float):
    """Rotation by an angular velocity in a time t."""
    speed = wp.length(angular)
    if speed == 0.0 or t == 0.0:
        return wp.quat_identity()
    return wp.quat_from_axis_angle(angular / speed, speed * t)


@wp.func
def chord_velocity(angular: wp.vec3, arm: wp.vec3, t: float):
    """Velocity along the chord of the arc on which a point at `arm` turns in a time t, without that along its tangent.

    Rodrigues' rotation formula, without the difference of nearly equal positions.
    """
    speed = wp.length(angular)
    angle = speed * t
    if angle == 0.0:
        return wp.vec3(0.0, 0.0, 0.0)
    axis = angular / speed
    tangent = wp.cross(axis, arm)
    lag = wp.sin(angle) - angle
    # The series is more accurate than the sine.
    if angle < 0.1:
        lag = -angle * angle * angle * (1.0 / 6.0 - angle * angle / 120.0)
    half = wp.sin(0.5 * angle)
    return (lag * tangent + 2.0 * half * half * wp.cross(axis, tangent)) / t


@wp.func
def symmetry_of(b: int, shapes: Shapes, bodies: Bodies):
    """Symmetry of a body about its centre of mass: NONE, ROUND or BALL."""
    shape = bodies.shape[b]
    part = shapes.shapes[shape].part_start
    kind = shapes.parts[part].kind
    ball = kind == PartKind.SPHERE
    round = ball or kind == PartKind.CAPSULE or kind == PartKind.CYLINDER
    if shapes.shapes[shape].convex == 0 or not round:
        return Symmetry.NONE
    offset = bodies.center_of_mass[b] - shapes.parts[part].position
    if not ball:
        axis = wp.quat_rotate(shapes.parts[part].orientation, wp.vec3(0.0, 0.0, 1.0))
        offset -= wp.dot(offset, axis) * axis
    # The centre of mass is not on the axis.
    if wp.length(offset) > 1.0e-3 * shapes.shapes[shape].size:
        return Symmetry.NONE
    return wp.where(ball, Symmetry.BALL, Symmetry.ROUND)


@wp.func
def axis_of(b: int, shapes: Shapes, bodies: Bodies, state: State):
    """The axis of a body of revolution in the world frame."""
    local = shapes.parts[shapes.shapes[bodies.shape[b]].part_start].orientation
    return wp.quat_rotate(state.orientation[b] * local, wp.vec3(0.0, 0.0, 1.0))


@wp.func
def spin_of_surface(b: int, spin: wp.vec3, shapes: Shapes, bodies: Bodies, state: State):
    """The angular velocity of a body's surface: that of the body, without the part that leaves the surface in place."""
    symmetry = symmetry_of(b, shapes, bodies)
    if symmetry == Symmetry.BALL:
        return wp.vec3(0.0, 0.0, 0.0)
    if symmetry == Symmetry.ROUND:
        axis = axis_of(b, shapes, bodies, state)
        return spin - wp.dot(spin, axis) * axis
    return spin


@wp.func
def turn_of_surface(b: int, spin: wp.vec3, dt: float, shapes: Shapes, bodies: Bodies, state: State):
    """The rotation of a body's surface in a step: that of the body, without the part that leaves the surface in place.

    A body of revolution is first turned back about its axis, which changes nothing, and then with the body.
    """
    symmetry = symmetry_of(b, shapes, bodies)
    angle = dt * wp.length(spin)
    # Smaller rotations are rounding errors of bodies at rest.
    if symmetry == Symmetry.BALL or angle < 1.0e-6:
        return wp.quat_identity()
    turn = wp.quat_from_axis_angle(wp.normalize(spin), angle)
    if symmetry == Symmetry.ROUND:
        axis = axis_of(b, shapes, bodies, state)
        turn = turn * wp.quat_from_axis_angle(axis, -dt * wp.dot(spin, axis))
    return turn


@wp.func
def rim_after(arm: wp.vec3, normal: wp.vec3, axis: wp.vec3, turned: wp.vec3):
    """Where the rim of a cylinder touches a plane after its axis has turned; it touches it at `arm` now.

    Both are relative to the middle of the cylinder. Where `arm` is not the end of the rim, or where that moves fast, as
    on a coin that lies nearly flat, the point of the rim turns with the axis.
    """
    along = wp.dot(arm, axis)
    out = wp.normalize(arm - along * axis)
    down = wp.normalize(wp.dot(normal, turned) * turned - normal)
    lowest = wp.dot(out, wp.normalize(wp.dot(normal, axis) * axis - normal)) > 0.99
    if lowest and wp.dot(out, down) > 0.9:
        return along * turned + wp.length(arm - along * axis) * down
    return wp.quat_rotate(wp.quat_between_vectors(axis, turned), arm)


@wp.func
def arm_after(b: int, arm: wp.vec3, normal: wp.vec3, turn: wp.quat, shapes: Shapes, bodies: Bodies, state: State):
    """Where a body of one part touches a plane after a rotation, from its centre of mass [m]; `arm` is the place now.

    A corner turns with the body; a ball, a capsule and the rim of a cylinder roll.
    """
    part = shapes.parts[shapes.shapes[bodies.shape[b]].part_start]
    if part.kind != PartKind.SPHERE and part.kind != PartKind.CAPSULE and part.kind != PartKind.CYLINDER:
        return wp.quat_rotate(turn, arm)
    middle = wp.quat_rotate(state.orientation[b], part.position - bodies.center_of_mass[b])
    after = arm + wp.quat_rotate(turn, middle) - middle
    axis = axis_of(b, shapes, bodies, state)
    turned = wp.quat_rotate(turn, axis)
    if part.kind == PartKind.CAPSULE:
        after += wp.dot(arm + part.size[0] * normal - middle, axis) * (turned - axis)
    elif part.kind == PartKind.CYLINDER:
        after += rim_after(arm - middle, normal, axis, turned) - (arm - middle)
    return after
