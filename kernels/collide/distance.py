"""Signed distance of every kind of shape part, with its gradient.

Every function takes a point in the part's frame and returns `vec4(direction, distance)`. The distance is negative
inside. The direction is the unit outward normal of the nearest surface, which is the gradient of the distance.

The functions of analytic parts are generic over the scalar type: float32 in the simulation, float64 for
`Shape.signed_distance` on the host (see `host_distance`). Constants take the type of their operand.

At the border of a box's face the gradient is discontinuous, and two aligned boxes of equal size touch exactly there.
`contact_distance` therefore also takes the sample's outward normal and returns the distance to a face that opposes it,
unless the sample lies clearly beyond the border of that face.
"""

from typing import Any

import warp as wp

from warp_rigid.kernels.collide.height_distance import heightfield_distance
from warp_rigid.kernels.collide.height_places import ball_distance_to_heights
from warp_rigid.kernels.collide.triangle_distance import (
    BORDER,
    FAR,
    GRID_ERROR,
    OPPOSING,
    border_width,
    chosen_place,
    farthest_by_grid,
    triangle_distance,
)
from warp_rigid.kernels.common.inlining import inline_on_gpu
from warp_rigid.kernels.enums import PartKind
from warp_rigid.kernels.schema import Shapes

wp.set_module_options({"enable_backward": False})


BALL_REACH = wp.constant(1.5)
"""Places of a ball are looked for within this number of radii of its centre."""


@wp.func
def direction_or_up(v: Any):
    """Return v normalised, or +z for the zero vector."""
    length = wp.length(v)
    if length > v.dtype(0.0):
        return v / length
    return wp.vector(v.dtype(0.0), v.dtype(0.0), v.dtype(1.0))


@wp.func
def ball_distance(offset: Any, radius: Any):
    """Distance to a sphere, from the offset from its centre."""
    n = direction_or_up(offset)
    return wp.vector(n[0], n[1], n[2], wp.length(offset) - radius)


@wp.func
def sphere_distance(p: Any, size: Any):
    """Distance to a sphere of radius size[0]."""
    return ball_distance(p, size[0])


@wp.func
def capsule_distance(p: Any, size: Any):
    """Distance to a capsule of radius size[0] around the segment |z| <= size[1]."""
    return ball_distance(wp.vector(p[0], p[1], p[2] - wp.clamp(p[2], -size[1], size[1])), size[0])


@wp.func
def plane_distance(p: Any, size: Any):
    """Distance to the half-space n . x <= offset, size = (n, offset)."""
    return wp.vector(size[0], size[1], size[2], wp.dot(wp.vector(size[0], size[1], size[2]), p) - size[3])


@wp.func
def slab_distance(separation: Any, n0: Any, n1: Any, n2: Any):
    """Distance to the intersection of three slabs with orthogonal normals, given the separation from each."""
    zero = separation.dtype(0.0)
    outside = wp.vector(wp.max(separation[0], zero), wp.max(separation[1], zero), wp.max(separation[2], zero))
    length = wp.length(outside)
    n = n0
    distance = separation[0]
    if length > zero:
        n = (outside[0] * n0 + outside[1] * n1 + outside[2] * n2) / length
        distance = length
    else:
        if separation[1] > distance:
            n = n1
            distance = separation[1]
        if separation[2] > distance:
            n = n2
            distance = separation[2]
    return wp.vector(n[0], n[1], n[2], distance)


@wp.func
def facing_slab_distance(separation: Any, thickness: Any, n0: Any, n1: Any, n2: Any, sample_normal: Any, half: Any):
    """`slab_distance`, but within the border the distance to the nearest face that opposes the sample's normal.

    The opposite face of a slab, a thickness away, is a candidate too: a sample that has passed the middle of a thin
    wall is in contact with the face through which it entered. `half` is the smallest half-extent.
    """
    border = half.dtype(BORDER) * half
    beyond = int(0)
    for i in range(3):
        if separation[i] > border:
            beyond += 1
    if beyond > 1 or wp.length_sq(sample_normal) == half.dtype(0.0):
        return slab_distance(separation, n0, n1, n2)
    nearest = -half.dtype(FAR)
    result = wp.vector(n0[0], n0[1], n0[2], -nearest)
    for i in range(3):
        n = n0
        if i == 1:
            n = n1
        if i == 2:
            n = n2
        facing = wp.dot(n, sample_normal)
        behind = -separation[i] - thickness[i]
        if separation[i] > nearest and (separation[i] > border or facing < half.dtype(OPPOSING)):
            nearest = separation[i]
            result = wp.vector(n[0], n[1], n[2], nearest)
        elif beyond == 0 and behind > nearest and facing > -half.dtype(OPPOSING):
            nearest = behind
            result = wp.vector(-n[0], -n[1], -n[2], nearest)
    return result


@wp.func
def outward(coordinate: Any, axis: Any):
    """The axis with the sign of the coordinate."""
    return wp.where(coordinate < coordinate.dtype(0.0), coordinate.dtype(-1.0), coordinate.dtype(1.0)) * axis


@wp.func
def box_distance(p: Any, size: Any, sample_normal: Any):
    """Distance to a box with half-extents size[0:3]."""
    half = wp.vector(size[0], size[1], size[2])
    zero = p.dtype(0.0)
    one = p.dtype(1.0)
    nx = outward(p[0], wp.vector(one, zero, zero))
    ny = outward(p[1], wp.vector(zero, one, zero))
    nz = outward(p[2], wp.vector(zero, zero, one))
    separation = wp.vector(wp.abs(p[0]), wp.abs(p[1]), wp.abs(p[2])) - half
    return facing_slab_distance(separation, p.dtype(2.0) * half, nx, ny, nz, sample_normal, wp.min(half))


@wp.func
def cylinder_distance(p: Any, size: Any, sample_normal: Any):
    """Distance to a cylinder of radius size[0] and half height size[1] along z."""
    radial = wp.vector(p[0], p[1], p.dtype(0.0))
    side = direction_or_up(radial)
    if side[2] > p.dtype(0.5):
        side = wp.vector(p.dtype(1.0), p.dtype(0.0), p.dtype(0.0))
    cap = outward(p[2], wp.vector(p.dtype(0.0), p.dtype(0.0), p.dtype(1.0)))
    far = p.dtype(FAR)
    # There is no face around the axis, on either side.
    separation = wp.vector(wp.length(radial) - size[0], -far, wp.abs(p[2]) - size[1])
    thickness = wp.vector(far, p.dtype(2.0) * far, p.dtype(2.0) * size[1])
    around = wp.cross(cap, side)
    return facing_slab_distance(separation, thickness, side, around, cap, sample_normal, wp.min(size[0], size[1]))


@wp.func
def analytic_distance(kind: int, size: Any, p: Any, sample_normal: Any):
    """Distance to a part of any kind except GRID and HEIGHTFIELD, in the part's own frame."""
    if kind == PartKind.BOX:
        return box_distance(p, size, sample_normal)
    if kind == PartKind.PLANE:
        return plane_distance(p, size)
    if kind == PartKind.SPHERE:
        return sphere_distance(p, size)
    if kind == PartKind.CYLINDER:
        return cylinder_distance(p, size, sample_normal)
    return capsule_distance(p, size)


@wp.func
def grid_distance(shapes: Shapes, part: int, p: wp.vec3):
    """Trilinear interpolation in a part's grid with its gradient, and a lower bound of the distance.

    A distance changes by at most the displacement, so it is at least that of any node less the length to the node. The
    node of the cell towards which the distance grows gives a bound that is a quarter of a cell below, in the mean.

    Outside the grid, let c be the grid's nearest point, d the distance at c and a the length to c. As the grid's box is
    convex, every surface point is at least sqrt(d^2 + a^2) away. The distance there is such a bound, too.
    """
    dims = shapes.parts[part].grid_dims
    top = wp.vec3(float(dims[0] - 1), float(dims[1] - 1), float(dims[2] - 1))
    q = (p - shapes.parts[part].grid_origin) / shapes.parts[part].grid_spacing
    inside = wp.vec3(wp.clamp(q[0], 0.0, top[0]), wp.clamp(q[1], 0.0, top[1]), wp.clamp(q[2], 0.0, top[2]))
    i = wp.min(int(inside[0]), dims[0] - 2)
    j = wp.min(int(inside[1]), dims[1] - 2)
    k = wp.min(int(inside[2]), dims[2] - 2)
    x = inside[0] - float(i)
    y = inside[1] - float(j)
    z = inside[2] - float(k)
    row = dims[2]
    slab = dims[1] * dims[2]
    at = shapes.parts[part].grid_start + i * slab + j * row + k
    v = shapes.grid_value
    z00 = v[at + 1] - v[at]
    z01 = v[at + row + 1] - v[at + row]
    z10 = v[at + slab + 1] - v[at + slab]
    z11 = v[at + slab + row + 1] - v[at + slab + row]
    v00 = v[at] + z * z00
    v01 = v[at + row] + z * z01
    v10 = v[at + slab] + z * z10
    v11 = v[at + slab + row] + z * z11
    v0 = v00 + y * (v01 - v00)
    v1 = v10 + y * (v11 - v10)
    gx = v1 - v0
    gy = (1.0 - x) * (v01 - v00) + x * (v11 - v10)
    gz = (1.0 - x) * ((1.0 - y) * z00 + y * z01) + x * ((1.0 - y) * z10 + y * z11)
    n = direction_or_up(wp.vec3(gx, gy, gz))
    distance = v0 + x * gx
    node = at + wp.where(gx > 0.0, slab, 0) + wp.where(gy > 0.0, row, 0) + wp.where(gz > 0.0, 1, 0)
    to_node = wp.vec3(
        x - wp.where(gx > 0.0, 1.0, 0.0), y - wp.where(gy > 0.0, 1.0, 0.0), z - wp.where(gz > 0.0, 1.0, 0.0)
    )
    spacing = shapes.parts[part].grid_spacing
    bound = wp.max(distance - GRID_ERROR * spacing, v[node] - spacing * wp.length(to_node))
    away = (q - inside) * spacing
    if wp.length_sq(away) > 0.0:
        for axis in range(3):
            n[axis] = wp.where(away[axis] != 0.0, away[axis], distance * n[axis])
        n = direction_or_up(n)
        distance = wp.sqrt(wp.max(distance, 0.0) * wp.max(distance, 0.0) + wp.length_sq(away))
        bound = wp.sqrt(wp.max(bound, 0.0) * wp.max(bound, 0.0) + wp.length_sq(away))
    return wp.vec4(n[0], n[1], n[2], distance), bound


@wp.func
def mesh_distance(shapes: Shapes, part: int, p: wp.vec3, sample_normal: wp.vec3, near: float):
    """Distance to a mesh: from its grid or, where it may be below `near`, from its triangles.

    More than a cell inside, the grid decides.
    """
    d, bound = grid_distance(shapes, part, p)
    cell = shapes.parts[part].grid_spacing
    if d[3] < -cell or shapes.parts[part].tree_start == shapes.parts[part].tree_end:
        return d
    clear = near + 0.01 * cell
    beside = wp.where(wp.length_sq(sample_normal) > 0.0, border_width(shapes, part), 0.0)
    if bound >= wp.max(clear, beside):
        d[3] = wp.max(d[3], clear)
        return d
    error = GRID_ERROR * cell
    far = farthest_by_grid(d[3], cell)
    within = far + error
    if d[3] > 0.0:
        within = wp.min(within, wp.max(clear, error))
        d[3] = wp.max(d[3], clear)
    return triangle_distance(shapes, part, p, sample_normal, far, within, d)


@wp.func
def has_triangles(shapes: Shapes, shape: int):
    """Whether a shape is one mesh with exact distances."""
    part = shapes.shapes[shape].part_start
    alone = shapes.shapes[shape].part_end == part + 1 and shapes.parts[part].placed == 0
    return alone and shapes.parts[part].tree_start < shapes.parts[part].tree_end


@wp.func
def has_places(shapes: Shapes, shape: int):
    """Whether a ball can touch a shape at several places: a mesh with exact distances, or a height field."""
    return has_triangles(shapes, shape) or shapes.parts[shapes.shapes[shape].part_start].kind == PartKind.HEIGHTFIELD


@wp.func
def is_near_grid(shapes: Shapes, shape: int, p: wp.vec3, margin: float):
    """Whether a mesh with exact distances may be nearer to a point than a margin, by its grid; never wrongly false.

    A point above the border of a face (`border_width`) is as near as the plane of the face.
    """
    part = shapes.shapes[shape].part_start
    _d, bound = grid_distance(shapes, part, p)
    return bound < margin + border_width(shapes, part)


@wp.func
def ball_distance_to_mesh(
    shapes: Shapes, part: int, p: wp.vec3, by_grid: wp.vec4, radius: float, reach: float, choice: int
):
    """Distance from the centre of a ball to one of its places on a mesh; FAR if there is none.

    The places are ranked within a distance that does not depend on the reach, so that a rank means the same face when
    a contact is found and when it is built. The first place is also returned if it is farther away, or more than a cell
    inside; the grid then decides.
    """
    d = by_grid
    cell = shapes.parts[part].grid_spacing
    near = BALL_REACH * radius + cell
    error = GRID_ERROR * cell
    if d[3] < wp.min(near, radius + reach) + error and d[3] > -cell:
        within = wp.where(d[3] < error, error + wp.abs(d[3]), 0.0)
        d[3] = wp.max(d[3], near + 0.01 * cell)
        return chosen_place(shapes, part, p, wp.max(within, near), choice, d)
    if choice > 1:
        d[3] = FAR
    return d


@wp.func
def ball_distance_to_places(
    shapes: Shapes, part: int, p: wp.vec3, bound: wp.vec4, radius: float, reach: float, choice: int
):
    """Distance from the centre of a ball to one of its places on a shape with `has_places`; FAR if there is none.

    `bound`: the distance of the shape there, from the grid of a mesh.
    """
    if shapes.parts[part].kind == PartKind.HEIGHTFIELD:
        return ball_distance_to_heights(shapes, part, p, bound, BALL_REACH * radius, radius + reach, choice)
    return ball_distance_to_mesh(shapes, part, p, bound, radius, reach, choice)


@wp.func(inline=False)
def part_distance(shapes: wp.ref[Shapes], part: int, p: wp.vec3, sample_normal: wp.vec3, near: float):
    """Distance to one part, in the part's own frame."""
    inline_on_gpu()
    kind = shapes.parts[part].kind
    if kind == PartKind.GRID:
        return mesh_distance(shapes, part, p, sample_normal, near)
    # The order matters: with the height field first, the compiled code of ccd.py is 18 % longer.
    if kind != PartKind.HEIGHTFIELD:
        return analytic_distance(kind, shapes.parts[part].size, p, sample_normal)
    return heightfield_distance(shapes, part, p)


@wp.func
def contact_distance(shapes: Shapes, shape: int, p: wp.vec3, sample_normal: wp.vec3, near: float):
    """Distance from a sample with its outward normal to a shape (the union of its parts), in the shape's frame.

    Distances to a mesh are exact below `near`. Above, they are off by up to GRID_ERROR cells.
    """
    nearest = wp.vec4(0.0, 0.0, 1.0, FAR)
    for part in range(shapes.shapes[shape].part_start, shapes.shapes[shape].part_end):
        placed = shapes.parts[part].placed == 1
        turn = shapes.parts[part].orientation
        local = p
        normal = sample_normal
        if placed:
            local = wp.quat_rotate_inv(turn, p - shapes.parts[part].position)
            normal = wp.quat_rotate_inv(turn, sample_normal)
        d = part_distance(shapes, part, local, normal, near)
        if d[3] < nearest[3]:
            nearest = d
            if placed:
                n = wp.quat_rotate(turn, wp.vec3(d[0], d[1], d[2]))
                nearest = wp.vec4(n[0], n[1], n[2], d[3])
    return nearest


@wp.func
def signed_distance(shapes: Shapes, shape: int, p: wp.vec3, near: float):
    """Distance from a point to a shape, in the shape's frame; see `contact_distance`."""
    return contact_distance(shapes, shape, p, wp.vec3(0.0, 0.0, 0.0), near)


@wp.func
def is_nearer(shapes: Shapes, shape: int, p: wp.vec3, margin: float):
    """Whether a shape may be nearer to a point than a margin; never wrongly false."""
    d = signed_distance(shapes, shape, p, -FAR)
    return d[3] < margin + GRID_ERROR * shapes.shapes[shape].cell
