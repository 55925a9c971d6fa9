"""Accelerations of the force fields: one device function for each FieldKind.

The host classes are in `warp_rigid/scene/fields.py`. Their attributes are the columns of `fields.parameters`, in order
of declaration; a vector takes three columns.
"""

import warp as wp

from warp_rigid.kernels.enums import FieldKind
from warp_rigid.kernels.schema import FieldForces

wp.set_module_options({"enable_backward": False})


@wp.func
def vector_parameter(fields: FieldForces, f: int, column: int):
    """Vector parameter of field f that starts at a column."""
    return wp.vec3(fields.parameters[f, column], fields.parameters[f, column + 1], fields.parameters[f, column + 2])


@wp.func
def uniform_acceleration(fields: FieldForces, f: int, x: wp.vec3):
    """Parameters: acceleration."""
    return vector_parameter(fields, f, 0)


@wp.func
def point_acceleration(fields: FieldForces, f: int, x: wp.vec3):
    """Parameters: center, strength. Newton's law of gravitation: strength / distance^2 toward the centre."""
    to_center = vector_parameter(fields, f, 0) - x
    distance = wp.max(wp.length(to_center), 1.0e-6)
    return fields.parameters[f, 3] / (distance * distance * distance) * to_center


@wp.func
def drag_acceleration(fields: FieldForces, f: int, v: wp.vec3, dt: float):
    """Parameters: drag, velocity. The mean over a step of dt of an exponential approach, for any size of the drag."""
    drag = fields.parameters[f, 0]
    rate = drag
    if drag * dt > 1.0e-4:
        rate = (1.0 - wp.exp(-drag * dt)) / dt
    return rate * (vector_parameter(fields, f, 1) - v)


@wp.func
def field_acceleration(fields: FieldForces, env: int, x: wp.vec3, v: wp.vec3, dt: float):
    """Acceleration by all force fields of an environment of a body at x with velocity v [m/s^2]."""
    a = wp.vec3(0.0, 0.0, 0.0)
    for f in range(fields.start[env], fields.start[env + 1]):
        kind = fields.kind[f]
        if kind == FieldKind.UNIFORM:
            a += uniform_acceleration(fields, f, x)
        elif kind == FieldKind.POINT:
            a += point_acceleration(fields, f, x)
        elif kind == FieldKind.DRAG:
            a += drag_acceleration(fields, f, v, dt)
    return a
