"""Axes between convex solids: directions that separate two solids, or along which they overlap least.

All of it rests on support functions: the furthest point of a solid in a direction. For a unit direction n from the
second solid B to the first solid A, `n . (p_A - p_B)`, with p_A the furthest point of A against n and p_B that of B
along n, is a lower bound of the distance of the solids. If it is positive, n separates them. If they overlap, its
negative is the length of the move along n that separates them; the least of these lengths is the depth of penetration.

The set D of all differences p_B - p_A is convex, and contains the origin if the solids overlap. A ray from a point
inside D leaves it through a face, whose normal is found by refining a triangle of points on the boundary of D (a
portal; G. Snethen, "XenoCollide: Complex Collision Made Simple", Game Programming Gems 7, 2008). A ray from a
difference of inner points through the origin gives an axis that separates the solids if they are apart. Otherwise,
rays from the origin along the axis found last reduce the depth, until the face that is hit is perpendicular to the ray.
"""

from enum import IntEnum

import warp as wp

from warp_rigid.kernels.collide.distance import FAR
from warp_rigid.kernels.common.inlining import inline_on_gpu
from warp_rigid.kernels.enums import PartKind
from warp_rigid.kernels.schema import Shapes

wp.set_module_options({"enable_backward": False, "max_unroll": 4})


FLAT_ENOUGH = wp.constant(1.0e-4)
"""A portal is a face of the difference if no point lies beyond it by more than this fraction of the smaller size."""

HULL = wp.constant(-1)
"""Kind of a solid that is given by the vertices of a convex mesh."""


class PortalStage(IntEnum):
    """Stages of the search for a portal: its three points, its refinement, and its end."""

    RAY = 0
    SIDE = 1
    CONE = 2
    FACE = 3
    FOUND = 4


@wp.struct
class Solid:
    """A convex solid in a common frame: all that its support function reads, so that a search reads it once.

    `kind`: a PartKind, or HULL. `turn`, `shift`: pose of the part, or of the mesh. `inside`: a point in it, in its
    frame.
    """

    kind: int
    size: wp.vec4
    hull_start: int
    hull_end: int
    turn: wp.quat
    shift: wp.vec3
    inside: wp.vec3


@wp.struct
class Solids:
    """Two convex solids in a common frame. `size`: that of the smaller one [m]."""

    a: Solid
    b: Solid
    size: float


@wp.struct
class Corner:
    """A point of the boundary of D, relative to the start of the ray, and the point of A that belongs to it."""

    point: wp.vec3
    of_a: wp.vec3


@wp.struct
class Portal:
    """State of the search for the face through which a ray leaves D; the next point is the one along `normal`."""

    stage: int
    normal: wp.vec3
    first: Corner
    second: Corner
    third: Corner


@wp.func
def is_solid(shapes: Shapes, shape: int):
    """Whether a shape is bounded and convex, and has a support function."""
    if shapes.shapes[shape].hull_end > shapes.shapes[shape].hull_start:
        return True
    kind = shapes.parts[shapes.shapes[shape].part_start].kind
    round = kind == PartKind.SPHERE or kind == PartKind.CAPSULE or kind == PartKind.CYLINDER
    return shapes.shapes[shape].convex == 1 and (round or kind == PartKind.BOX)


@wp.func
def may_have_many_corners(shapes: Shapes, shape: int):
    """Whether a shape has faces that are round or may have many corners: a cylinder or a convex mesh."""
    kind = shapes.parts[shapes.shapes[shape].part_start].kind
    return shapes.shapes[shape].hull_end > shapes.shapes[shape].hull_start or (
        shapes.shapes[shape].convex == 1 and kind == PartKind.CYLINDER
    )


@wp.func
def are_solid(a: int, b: int, shapes: Shapes):
    """Whether two shapes are convex solids."""
    return is_solid(shapes, a) and is_solid(shapes, b)


@wp.func
def signed(x: float, toward: float):
    """A length with the sign of `toward`."""
    return wp.where(toward < 0.0, -x, x)


@wp.func
def pose_of_solid(shapes: Shapes, shape: int):
    """Pose of a solid's part in the frame of its shape; the vertices of a mesh are in this frame."""
    part = shapes.shapes[shape].part_start
    if shapes.shapes[shape].hull_end > shapes.shapes[shape].hull_start or shapes.parts[part].placed == 0:
        return wp.transform_identity()
    return wp.transformation(shapes.parts[part].position, shapes.parts[part].orientation)


@wp.func
def placed_solid(solid: Solid, pose: wp.transform, local: wp.transform):
    """The solid with its shape at a pose; `local`: its pose in the frame of the shape."""
    placed = pose * local
    solid.turn = wp.transform_get_rotation(placed)
    solid.shift = wp.transform_get_translation(placed)
    return solid


@wp.func
def solid_of(shapes: Shapes, shape: int, pose: wp.transform):
    """A shape that is a solid, at a pose."""
    solid = Solid()
    solid.hull_start = shapes.shapes[shape].hull_start
    solid.hull_end = shapes.shapes[shape].hull_end
    solid.kind = HULL
    if solid.hull_end > solid.hull_start:
        solid.inside = shapes.shapes[shape].inside
    else:
        solid.kind = shapes.parts[shapes.shapes[shape].part_start].kind
        solid.size = shapes.parts[shapes.shapes[shape].part_start].size
    return placed_solid(solid, pose, pose_of_solid(shapes, shape))


@wp.func
def solids_of_shapes(a: int, b: int, pose: wp.transform, size: float, shapes: Shapes):
    """Two shapes as convex solids in the frame of the second one; `pose`: that of the first one in it."""
    solids = Solids()
    solids.a = solid_of(shapes, a, pose)
    solids.b = solid_of(shapes, b, wp.transform_identity())
    solids.size = size
    return solids


@wp.func
def center_of(solid: Solid):
    """The point in a solid, in the common frame."""
    return wp.quat_rotate(solid.turn, solid.inside) + solid.shift


@wp.func
def furthest_vertex(solid: Solid, shapes: Shapes, n: wp.vec3):
    """The vertex of a convex mesh that is furthest along n; the first of several."""
    best = shapes.hull[solid.hull_start]
    most = wp.dot(n, best)
    for k in range(solid.hull_start + 1, solid.hull_end):
        along = wp.dot(n, shapes.hull[k])
        if along > most:
            most = along
            best = shapes.hull[k]
    return best


@wp.func
def furthest_of_part(kind: int, size: wp.vec4, n: wp.vec3):
    """The furthest point of an analytic part along n, in its own frame."""
    if kind == PartKind.BOX:
        return wp.vec3(signed(size[0], n[0]), signed(size[1], n[1]), signed(size[2], n[2]))
    if kind == PartKind.CYLINDER:
        across = wp.max(wp.sqrt(n[0] * n[0] + n[1] * n[1]), 1.0e-20)
        return wp.vec3(size[0] * n[0] / across, size[0] * n[1] / across, signed(size[1], n[2]))
    height = wp.where(kind == PartKind.CAPSULE, signed(size[1], n[2]), 0.0)
    return size[0] / wp.max(wp.length(n), 1.0e-20) * n + wp.vec3(0.0, 0.0, height)


@wp.func
def furthest_point(solid: Solid, shapes: Shapes, n: wp.vec3):
    """The furthest point of a solid along n, in the common frame."""
    local = wp.quat_rotate_inv(solid.turn, n)
    furthest = wp.vec3(0.0, 0.0, 0.0)
    if solid.kind == HULL:
        furthest = furthest_vertex(solid, shapes, local)
    else:
        furthest = furthest_of_part(solid.kind, solid.size, local)
    return wp.quat_rotate(solid.turn, furthest) + solid.shift


@wp.func
def difference(solids: Solids, shapes: Shapes, n: wp.vec3):
    """The point of D that is furthest along n, and the point of A that belongs to it."""
    corner = Corner()
    corner.of_a = furthest_point(solids.a, shapes, -n)
    corner.point = furthest_point(solids.b, shapes, n) - corner.of_a
    return corner


@wp.func
def gap_along(solids: Solids, shapes: Shapes, n: wp.vec3):
    """Extent of the gap between the solids along the unit vector n; negative if they overlap along it [m]."""
    return -wp.dot(difference(solids, shapes, n).point, n)


@wp.func
def unit_or(v: wp.vec3, otherwise: wp.vec3):
    """The vector v normalised, or another vector if v is zero."""
    length = wp.length(v)
    if length > 1.0e-20:
        return v / length
    return otherwise


@wp.func
def next_corner(portal: Portal, corner: Corner, ray: wp.vec3, flat: float):
    """Take up the point found, and choose the direction of the next one.

    The first three points enclose the ray in a cone. Then the triangle is replaced by one that is further out, through
    which the ray passes as well, until no point is further out.
    """
    v = corner.point
    if portal.stage == PortalStage.RAY:
        portal.first = corner
        portal.normal = wp.cross(v, ray)
        portal.stage = wp.where(wp.length_sq(portal.normal) > 0.0, PortalStage.SIDE, PortalStage.FOUND)
    elif portal.stage == PortalStage.SIDE:
        portal.second = corner
        portal.normal = wp.cross(portal.first.point, v)
        portal.stage = PortalStage.CONE
        if wp.dot(portal.normal, ray) < 0.0:
            portal.second = portal.first
            portal.first = corner
            portal.normal = -portal.normal
    elif portal.stage == PortalStage.CONE:
        if wp.dot(wp.cross(portal.first.point, v), ray) > 0.0:
            portal.second = corner
            portal.normal = wp.cross(portal.first.point, v)
        elif wp.dot(wp.cross(v, portal.second.point), ray) > 0.0:
            portal.first = corner
            portal.normal = wp.cross(v, portal.second.point)
        else:
            portal.third = corner
            portal.stage = PortalStage.FACE
    elif wp.dot(v - portal.first.point, portal.normal) <= flat:
        portal.stage = PortalStage.FOUND
    else:
        before = wp.dot(wp.cross(v, portal.first.point), ray) >= 0.0
        if before and wp.dot(wp.cross(v, portal.second.point), ray) <= 0.0:
            portal.third = corner
        elif not before and wp.dot(wp.cross(v, portal.third.point), ray) >= 0.0:
            portal.second = corner
        else:
            portal.first = corner
    if portal.stage == PortalStage.FACE:
        side = portal.second.point - portal.first.point
        portal.normal = wp.cross(side, portal.third.point - portal.first.point)
    return portal


@wp.func(inline=False)
def leave(solids: Solids, shapes: Shapes, start: wp.vec3, ray: wp.vec3, reach: float):
    """The face through which a ray from a point inside D leaves it, or the first direction with a gap above `reach`."""
    inline_on_gpu()
    portal = Portal()
    portal.stage = PortalStage.RAY
    portal.normal = ray
    iterations = int(0)
    # At most 40 points.
    while portal.stage != PortalStage.FOUND and iterations < 40:
        n = unit_or(portal.normal, ray)
        portal.normal = n
        corner = difference(solids, shapes, n)
        if wp.dot(corner.point, n) < -reach:
            return portal
        corner.point -= start
        portal = next_corner(portal, corner, ray, FLAT_ENOUGH * solids.size)
        iterations += 1
    portal.normal = unit_or(portal.normal, ray)
    return portal


@wp.func
def axis_of(turn: wp.quat, k: int, along: wp.vec3):
    """One of the three axes of a frame, with the sign of `along`."""
    n = wp.vec3(0.0, 0.0, 0.0)
    n[k] = 1.0
    n = wp.quat_rotate(turn, n)
    return wp.where(wp.dot(n, along) < 0.0, -n, n)


@wp.func(inline=False)
def find_axis(solids: Solids, shapes: Shapes, axis: wp.vec3, reach: float):
    """An axis with a gap above `reach`, or with the largest gap that was found; if the solids overlap, a local maximum.

    Tried are the last axis, if there is one, the axes of both solids (the face normals of boxes and the ends of
    cylinders) and the ray through the origin.
    """
    inline_on_gpu()
    start = center_of(solids.b) - center_of(solids.a)
    toward = unit_or(-start, wp.vec3(0.0, 0.0, 1.0))
    best = toward
    largest = float(-FAR)
    k = int(0)
    while k < 8 and largest <= reach:
        n = axis
        if k > 0 and k < 4:
            n = axis_of(solids.a.turn, k - 1, toward)
        elif k > 3 and k < 7:
            n = axis_of(solids.b.turn, k - 4, toward)
        elif k == 7:
            n = toward
        gap = gap_along(solids, shapes, n)
        if gap > largest and wp.length_sq(n) > 0.0:
            largest = gap
            best = n
        k += 1
    ray = toward
    k = int(0)
    while k <= 8 and largest <= reach:
        n = leave(solids, shapes, start, ray, reach).normal
        gap = gap_along(solids, shapes, n)
        better = gap > largest + FLAT_ENOUGH * solids.size
        if gap > largest:
            largest = gap
            best = n
        # Once it is known that the solids are apart, or that no ray leads further, the search is over.
        k = wp.where(largest > 0.0 or (k > 0 and not better), 9, k + 1)
        start = wp.vec3(0.0, 0.0, 0.0)
        ray = best
    return best


@wp.func
def deepest_point(solids: Solids, shapes: Shapes, n: wp.vec3):
    """The point of A that would be the last one in touch with B if A moved along the axis n.

    The ray from the origin along n passes through the portal; its place between the three corners is that of the point
    between the three points of A.
    """
    portal = leave(solids, shapes, wp.vec3(0.0, 0.0, 0.0), n, FAR)
    weight = wp.vec3(
        wp.max(wp.dot(wp.cross(portal.second.point, portal.third.point), n), 0.0),
        wp.max(wp.dot(wp.cross(portal.third.point, portal.first.point), n), 0.0),
        wp.max(wp.dot(wp.cross(portal.first.point, portal.second.point), n), 0.0),
    )
    total = weight[0] + weight[1] + weight[2]
    if wp.length_sq(portal.third.point) == 0.0 or total == 0.0:
        return portal.first.of_a
    return (weight[0] * portal.first.of_a + weight[1] * portal.second.of_a + weight[2] * portal.third.of_a) / total
