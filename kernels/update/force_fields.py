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
def drag_acceleration(fields: FieldForces, f: int, v: wp.vec3):
    """Parameters: drag, velocity."""
    return fields.parameters[f, 0] * (vector_parameter(fields, f, 1) - v)


@wp.func
def field_acceleration(fields: FieldForces, env: int, x: wp.vec3, v: wp.vec3):
    """Acceleration by all force fields of an environment of a body at x with velocity v [m/s^2]."""
    a = wp.vec3(0.0, 0.0, 0.0)
    for f in range(fields.start[env], fields.start[env + 1]):
        kind = fields.kind[f]
        if kind == FieldKind.UNIFORM:
            a += uniform_acceleration(fields, f, x)
        elif kind == FieldKind.POINT:
            a += point_acceleration(fields, f, x)
        elif kind == FieldKind.DRAG:
            a += drag_acceleration(fields, f, v)
    return a


@wp.func
def drag_of(fields: FieldForces, env: int):
    """Sum of the drags of the media of an environment [1/s]."""
    drag = float(0.0)
    for f in range(fields.start[env], fields.start[env + 1]):
        if fields.kind[f] == FieldKind.DRAG:
            drag += fields.parameters[f, 0]
    return drag


@wp.func
def response_in_drag(fields: FieldForces, env: int, dt: float):
    """Change of velocity by a force in a step of dt in the media of an environment, over that without them.

    It is (1 - exp(-x)) / x with x = drag dt. Where masses are divided by it and the drag is a
    force, a step is the exact solution for constant forces: no drag overshoots, and the velocity approaches the one
    at which forces and drag balance.
    """
    x = dt * drag_of(fields, env)
    if x < 0.1:
        # The difference from 1 would lose digits.
        return 1.0 - x / 2.0 * (1.0 - x / 3.0 * (1.0 - x / 4.0 * (1.0 - x / 5.0)))
    return (1.0 - wp.exp(-x)) / x
