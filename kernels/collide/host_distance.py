"""Distances to analytic parts in float64, for the host."""

import warp as wp

from warp_rigid.kernels.collide.distance import analytic_distance

wp.set_module_options({"enable_backward": False})


@wp.kernel
def part_distances(kind: int, size: wp.vec4d, points: wp.array[wp.vec3d], found: wp.array[wp.vec4d]):
    """One thread per point: direction and distance, in the part's frame."""
    i = wp.tid()
    found[i] = analytic_distance(kind, size, points[i], wp.vec3d())
