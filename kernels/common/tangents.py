"""Tangent directions of a contact."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.func
def tangent_of(n: wp.vec3):
    """A unit vector perpendicular to the unit vector n, determined by n alone."""
    other = wp.vec3(1.0, 0.0, 0.0)
    if wp.abs(n[0]) > 0.7:
        other = wp.vec3(0.0, 1.0, 0.0)
    return wp.normalize(wp.cross(n, other))


@wp.func
def world_vector(n: wp.vec3, u: wp.vec3, v: wp.vec3):
    """The world vector with components v along the normal n, the first tangent u and the second tangent n x u."""
    return v[0] * n + v[1] * u + v[2] * wp.cross(n, u)
