"""Diagnostics: the distance to a shape as contacts see it. Not a stage of the step."""

import warp as wp

from warp_rigid.kernels.collide.distance import signed_distance
from warp_rigid.kernels.schema import Shapes

wp.set_module_options({"enable_backward": False})


@wp.kernel
def probe_distances(shape: int, near: float, shapes: Shapes, points: wp.array[wp.vec3], found: wp.array[wp.vec4]):
    """One thread per point: direction and distance, in the shape's frame; exact below `near`."""
    i = wp.tid()
    found[i] = signed_distance(shapes, shape, points[i], near)
