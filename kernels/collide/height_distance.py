"""Exact distance to a height field: two triangles per cell, solid below, with vertical sides at its border.

The vertical gap is an upper bound of the distance, so the nearest triangle lies in a cell within this distance. A lower
bound is gap / sqrt(1 + L^2), with the steepest slope L. If it exceeds the reach of contacts, it is returned instead.
"""

import warp as wp

from warp_rigid.kernels.schema import Shapes

wp.set_module_options({"enable_backward": False})


@wp.struct
class Nearest:
    """The nearest point found so far: squared distance, vector from it to the query point, normal of its triangle."""

    square: float
    arm: wp.vec3
    normal: wp.vec3
    inner: int


@wp.func
def from_segment(p: wp.vec3, a: wp.vec3, b: wp.vec3):
    """Vector from the nearest point of a segment to p."""
    side = b - a
    arm = p - a
    return arm - wp.clamp(wp.dot(arm, side) / wp.dot(side, side), 0.0, 1.0) * side


@wp.func
def nearer(best: Nearest, p: wp.vec3, a: wp.vec3, b: wp.vec3, c: wp.vec3):
    """The nearest point, updated with one more triangle."""
    n = wp.normalize(wp.cross(b - a, c - a))
    height = wp.dot(p - a, n)
    ab = wp.dot(wp.cross(b - a, p - a), n)
    bc = wp.dot(wp.cross(c - b, p - b), n)
    ca = wp.dot(wp.cross(a - c, p - c), n)
    arm = height * n
    inner = int(1)
    if wp.min(wp.min(ab, bc), ca) < 0.0:
        inner = 0
        arm = from_segment(p, a, b)
        other = from_segment(p, b, c)
        if wp.length_sq(other) < wp.length_sq(arm):
            arm = other
        other = from_segment(p, c, a)
        if wp.length_sq(other) < wp.length_sq(arm):
            arm = other
    square = wp.length_sq(arm)
    if square < best.square:
        best.square = square
        best.arm = arm
        best.normal = n
        best.inner = inner
    return best


@wp.func
def node(shapes: Shapes, part: int, i: int, j: int):
    """A vertex of the field, in the part's frame."""
    dims = shapes.parts[part].grid_dims
    size = shapes.parts[part].size
    return wp.vec3(
        size[0] * (float(i) / float(dims[0] - 1) - 0.5),
        size[1] * (float(j) / float(dims[1] - 1) - 0.5),
        shapes.grid_value[shapes.parts[part].grid_start + i * dims[1] + j],
    )


@wp.func
def nearer_in_cell(best: Nearest, shapes: Shapes, part: int, i: int, j: int, p: wp.vec3):
    """The nearest point, updated with the two triangles of a cell."""
    a = node(shapes, part, i, j)
    c = node(shapes, part, i + 1, j + 1)
    k = int(0)
    while k < 2:
        side = node(shapes, part, i + 1 - k, j + k)
        best = nearer(best, p, a, wp.where(k == 0, side, c), wp.where(k == 0, c, side))
        k += 1
    return best


@wp.func
def plane_below(shapes: Shapes, part: int, i: int, j: int, x: float, y: float):
    """Height and slopes (along x, along y) of the field at the fractions x, y of a cell."""
    dims = shapes.parts[part].grid_dims
    size = shapes.parts[part].size
    at = shapes.parts[part].grid_start + i * dims[1] + j
    h00 = shapes.grid_value[at]
    h01 = shapes.grid_value[at + 1]
    h10 = shapes.grid_value[at + dims[1]]
    h11 = shapes.grid_value[at + dims[1] + 1]
    rise = wp.where(x > y, wp.vec2(h10 - h00, h11 - h10), wp.vec2(h11 - h01, h01 - h00))
    height = h00 + x * rise[0] + y * rise[1]
    return wp.vec3(height, rise[0] * float(dims[0] - 1) / size[0], rise[1] * float(dims[1] - 1) / size[1])


@wp.func
def nearest_around(shapes: Shapes, part: int, i: int, j: int, p: wp.vec3):
    """The nearest point of the field, in the cell (i, j) and all cells within the distance found there."""
    dims = shapes.parts[part].grid_dims
    size = shapes.parts[part].size
    cell_x = size[0] / float(dims[0] - 1)
    cell_y = size[1] / float(dims[1] - 1)
    best = Nearest()
    best.square = 1.0e20
    low_i = int(i)
    low_j = int(j)
    high_i = int(i)
    high_j = int(j)
    around = int(0)
    while around < 2:
        for m in range(low_i, high_i + 1):
            middle = size[0] * ((float(m) + 0.5) / float(dims[0] - 1) - 0.5)
            away_x = wp.max(wp.abs(p[0] - middle) - 0.5 * cell_x, 0.0)
            for n in range(low_j, high_j + 1):
                middle = size[1] * ((float(n) + 0.5) / float(dims[1] - 1) - 0.5)
                away_y = wp.max(wp.abs(p[1] - middle) - 0.5 * cell_y, 0.0)
                if around == 0 or ((m != i or n != j) and away_x * away_x + away_y * away_y < best.square):
                    best = nearer_in_cell(best, shapes, part, m, n, p)
        reach = wp.sqrt(best.square)
        low_i = wp.max(int((p[0] - reach + 0.5 * size[0]) / cell_x), 0)
        low_j = wp.max(int((p[1] - reach + 0.5 * size[1]) / cell_y), 0)
        high_i = wp.min(int((p[0] + reach + 0.5 * size[0]) / cell_x), dims[0] - 2)
        high_j = wp.min(int((p[1] + reach + 0.5 * size[1]) / cell_y), dims[1] - 2)
        around += 1
    return best


@wp.func
def heightfield_distance(shapes: Shapes, part: int, p: wp.vec3):
    """Distance to the solid below a height field; size = (x, y, steepest slope, distance up to which it is exact)."""
    reach = shapes.parts[part].size[3]
    return distance_to_heights(shapes, part, p, reach, reach)


@wp.func
def distance_to_heights(shapes: Shapes, part: int, p: wp.vec3, near: float, deep: float):
    """Distance to the solid below a height field, exact up to `near` above it and `deep` below it.

    Beside the solid it is the distance to the vertical side; beside and above the solid it is a bound as in
    `grid_distance`.
    """
    dims = shapes.parts[part].grid_dims
    size = shapes.parts[part].size
    inside = wp.vec3(wp.clamp(p[0], -0.5 * size[0], 0.5 * size[0]), wp.clamp(p[1], -0.5 * size[1], 0.5 * size[1]), p[2])
    qx = (inside[0] / size[0] + 0.5) * float(dims[0] - 1)
    qy = (inside[1] / size[1] + 0.5) * float(dims[1] - 1)
    i = wp.min(int(qx), dims[0] - 2)
    j = wp.min(int(qy), dims[1] - 2)
    below = plane_below(shapes, part, i, j, qx - float(i), qy - float(j))
    gap = p[2] - below[0]
    n = wp.normalize(wp.vec3(-below[1], -below[2], 1.0))
    distance = gap / wp.sqrt(1.0 + size[2] * size[2])
    if distance < near and -distance < deep:
        best = nearest_around(shapes, part, i, j, inside)
        n = best.normal
        distance = wp.dot(best.arm, n)
        length = wp.sqrt(best.square)
        # Very close to an edge, rounding errors dominate the vector from it; the face's normal is more accurate.
        if best.inner == 0 and length > 1.0e-5 * (size[0] + size[1]):
            distance = wp.where(gap < 0.0, -length, length)
            n = best.arm / distance
    away = p - inside
    # A point that is hardly beyond the border counts as above the field.
    margin = wp.min(2.0e-3 * deep, 1.0e-3 * size[0] / float(dims[0] - 1))
    if wp.length_sq(away) > margin * margin:
        above = wp.max(distance, 0.0)
        reach = wp.sqrt(above * above + wp.length_sq(away))
        n = wp.normalize(away + above * n)
        return wp.vec4(n[0], n[1], n[2], reach)
    side_x = wp.abs(p[0]) - 0.5 * size[0]
    side_y = wp.abs(p[1]) - 0.5 * size[1]
    if wp.max(side_x, side_y) > distance and distance < 0.0:
        if side_x > side_y:
            return wp.vec4(wp.sign(p[0]), 0.0, 0.0, side_x)
        return wp.vec4(0.0, wp.sign(p[1]), 0.0, side_y)
    return wp.vec4(n[0], n[1], n[2], distance)
