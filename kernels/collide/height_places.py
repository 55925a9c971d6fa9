"""Places where a ball touches a height field.

In a valley a ball touches several triangles at once. As on a mesh (triangle_distance.py), each triangle on which the
foot of its centre lies is a place; of places in similar directions the nearest one counts.
"""

import warp as wp

from warp_rigid.kernels.collide.height_distance import node
from warp_rigid.kernels.collide.triangle_distance import (
    FAR,
    Places,
    foot_on_triangle,
    is_upright,
    keep_place,
    place_of_rank,
)
from warp_rigid.kernels.schema import Shapes
from warp_rigid.kernels.tuning import SAME_PATCH

wp.set_module_options({"enable_backward": False})


@wp.func
def keep_foot(triangle: int, p: wp.vec3, a: wp.vec3, b: wp.vec3, c: wp.vec3, within: float, places: Places):
    """Add a triangle if the foot of a point above it lies on it, within a radius."""
    foot = foot_on_triangle(p, a, b, c)
    gap = wp.length_sq(foot.offset)
    n = wp.normalize(wp.cross(b - a, c - a))
    if gap < within * within and is_upright(foot, n):
        return keep_place(triangle, gap, n, places)
    return places


@wp.func
def height_places(shapes: Shapes, part: int, p: wp.vec3, nearest: wp.vec4, within: float):
    """The triangles on which the foot of a point above lies within a radius, and the nearest point."""
    dims = shapes.parts[part].grid_dims
    size = shapes.parts[part].size
    per_x = float(dims[0] - 1) / size[0]
    per_y = float(dims[1] - 1) / size[1]
    x = (p[0] + 0.5 * size[0]) * per_x
    y = (p[1] + 0.5 * size[1]) * per_y
    places = Places()
    for i in range(wp.max(int(x - within * per_x), 0), wp.min(int(x + within * per_x), dims[0] - 2) + 1):
        for j in range(wp.max(int(y - within * per_y), 0), wp.min(int(y + within * per_y), dims[1] - 2) + 1):
            a = node(shapes, part, i, j)
            c = node(shapes, part, i + 1, j + 1)
            triangle = 2 * (i * dims[1] + j)
            places = keep_foot(triangle, p, a, node(shapes, part, i + 1, j), c, within, places)
            places = keep_foot(triangle + 1, p, a, c, node(shapes, part, i, j + 1), within, places)
    n = wp.vec3(nearest[0], nearest[1], nearest[2])
    squared = nearest[3] * nearest[3]
    for k in range(places.count):
        known = wp.vec3(places.direction[k, 0], places.direction[k, 1], places.direction[k, 2])
        # The nearest point is one of these places.
        if wp.dot(known, n) > SAME_PATCH and places.squared[k] < 1.0001 * squared:
            return places
    # Not on a triangle, but on an edge or a corner.
    return keep_place(-1, squared, n, places)


@wp.func
def ball_distance_to_heights(
    shapes: Shapes, part: int, p: wp.vec3, nearest: wp.vec4, near: float, touching: float, choice: int
):
    """Distance from the centre of a ball to one of its places on a height field; FAR if there is none.

    `nearest`: the distance to the height field, whichever place it belongs to.
    The places are ranked within `near`, if one is within `touching`. The first place is also returned if it is farther
    away, or if the centre is below the field or beyond its border.
    """
    d = nearest
    size = shapes.parts[part].size
    above = wp.abs(p[0]) < 0.5 * size[0] and wp.abs(p[1]) < 0.5 * size[1] and d[3] > 0.0
    if above and d[3] < wp.min(near, touching):
        return place_of_rank(height_places(shapes, part, p, d, near), choice, d)
    if choice > 1:
        d[3] = FAR
    return d
