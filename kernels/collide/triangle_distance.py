"""Exact distance to the triangles of a mesh, found through a tree of bounding boxes.

The distance grid of a mesh is exact at its nodes, and off by at most `GRID_ERROR` cells between them. It selects the
points near the surface; for these the triangles decide. A wall thinner than a cell has no node inside it, and at a
crease the interpolated gradient is a mixture of the normals of its faces: both are exact here.

The nodes of the tree are stored depth first. Each states the node that follows its subtree, so that a traversal needs
no stack and visits the triangles in the same order on every device.

A ball in an inner corner touches several faces at once. Each face that contains the projection of its centre is a
contact candidate; of those in similar directions the nearest is used. Convex edges and corners are not candidates: they
are samples of the mesh.

The sign is that of the angle-weighted pseudonormal of the nearest face, side or corner (J. A. Baerentzen and H. Aanaes,
"Signed distance computation using the angle weighted pseudonormal", IEEE TVCG 11(3), 2005).
"""

from enum import IntEnum

import warp as wp

from warp_rigid.kernels.common.branching import keep_branch
from warp_rigid.kernels.schema import BALL_PLACES, Shapes, TriangleRecord
from warp_rigid.kernels.shape_arrays import MOST_OF_LEAF, read_node, read_triangle
from warp_rigid.kernels.tuning import SAME_PATCH

wp.set_module_options({"enable_backward": False})

FAR = wp.constant(1.0e10)
"""Distance returned if there is no contact [m]."""

OPPOSING = wp.constant(-0.1)
"""Two outward normals with a scalar product below this oppose each other."""

BORDER = wp.constant(0.005)
"""A sample counts as above a face up to this fraction of the smallest half-extent beyond the face's border."""

GRID_ERROR = wp.constant(0.8661)
"""Largest error of a grid's distance between its nodes, in cells: a distance changes by at most the displacement,
and the mean distance of the eight nodes of a cell, with the weights of the interpolation, is at most sqrt(3) / 2."""


class Feature(IntEnum):
    """Feature of a triangle: SIDE + k is the side from corner k to the next, CORNER + k is corner k."""

    FACE = 0
    SIDE = 1
    CORNER = 4


class Look(IntEnum):
    """What is looked for: any triangle within the likely radius, any triangle, or one that opposes the sample."""

    LIKELY = 0
    ALL = 1
    OPPOSING = 2
    DONE = 3


@wp.struct
class Foot:
    """The point of a triangle nearest to a point.

    `feature`: FACE, SIDE + k or CORNER + k.
    """

    offset: wp.vec3
    feature: int


@wp.struct
class NearestTriangle:
    """The nearest triangle, -1 if there is none, its feature, and the offset from it to the point."""

    triangle: int
    feature: int
    squared: float
    offset: wp.vec3


@wp.struct
class Places:
    """Places where a ball touches a mesh: triangles, squared distances, and directions to the centre."""

    count: int
    triangle: wp.vec4i
    squared: wp.vec4
    direction: wp.mat44


@wp.func
def triangles_of(leaf: int):
    """The first triangle of a leaf, and one past its last (`TreeRecord.leaf`); both are equal for other nodes."""
    first = leaf / MOST_OF_LEAF
    return first, first + leaf % MOST_OF_LEAF


@wp.func
def next_leaf(node: int, end: int, p: wp.vec3, squared: float, shapes: Shapes):
    """The next leaf of a tree within a squared distance of a point, from a node on, and the node that follows it.

    It has no triangles if there is none. The lanes of a GPU look for their leaves together, then they test triangles
    together: the test is much longer, and would otherwise be executed for one lane after another.
    """
    leaf = int(0)
    while node < end and leaf % MOST_OF_LEAF == 0:
        box = read_node(node, shapes.tree)
        if box_gap_squared(p, box.lower, box.upper) >= squared:
            keep_branch()
            node = box.skip
        else:
            leaf = box.leaf
            node += 1
    return leaf, node


@wp.func
def face_normal(triangle: TriangleRecord):
    """The outward unit normal of a triangle."""
    return wp.vec3(triangle.normal_x, triangle.normal_y, triangle.normal_z)


@wp.func
def foot_on_triangle(p: wp.vec3, a: wp.vec3, b: wp.vec3, c: wp.vec3):
    """The nearest point of a triangle, by the Voronoi regions of its features (Ericson 2005, section 5.1.5)."""
    ab = b - a
    ac = c - a
    foot = Foot()
    d1 = wp.dot(ab, p - a)
    d2 = wp.dot(ac, p - a)
    foot.offset = p - a
    foot.feature = Feature.CORNER
    if d1 <= 0.0 and d2 <= 0.0:
        return foot
    d3 = wp.dot(ab, p - b)
    d4 = wp.dot(ac, p - b)
    if d3 >= 0.0 and d4 <= d3:
        foot.offset = p - b
        foot.feature = Feature.CORNER + 1
        return foot
    d5 = wp.dot(ab, p - c)
    d6 = wp.dot(ac, p - c)
    if d6 >= 0.0 and d5 <= d6:
        foot.offset = p - c
        foot.feature = Feature.CORNER + 2
        return foot
    start = a
    side = ab
    foot.feature = Feature.FACE
    if d1 * d4 - d3 * d2 <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        foot.feature = Feature.SIDE
    elif d5 * d2 - d1 * d6 <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        foot.feature = Feature.SIDE + 2
        start = c
        side = a - c
    elif d3 * d6 - d5 * d4 <= 0.0 and d4 >= d3 and d5 >= d6:
        foot.feature = Feature.SIDE + 1
        start = b
        side = c - b
    if foot.feature == Feature.FACE:
        n = wp.normalize(wp.cross(ab, ac))
        foot.offset = wp.dot(p - a, n) * n
    else:
        foot.offset = p - start - wp.dot(p - start, side) / wp.dot(side, side) * side
    return foot


@wp.func
def box_gap_squared(p: wp.vec3, lower: wp.vec3, upper: wp.vec3):
    """Squared distance from a point to a box, 0 inside."""
    gap = wp.max(wp.max(lower - p, p - upper), wp.vec3(0.0, 0.0, 0.0))
    return wp.dot(gap, gap)


@wp.func
def feature_normal(shapes: Shapes, triangle: int, feature: int):
    """Pseudonormal of a feature of a triangle."""
    if feature == Feature.FACE:
        return face_normal(read_triangle(triangle, shapes.triangles))
    if feature == Feature.SIDE:
        return shapes.triangles[triangle].side_0
    if feature == Feature.SIDE + 1:
        return shapes.triangles[triangle].side_1
    if feature == Feature.SIDE + 2:
        return shapes.triangles[triangle].side_2
    if feature == Feature.CORNER:
        return shapes.triangles[triangle].vertex_0
    if feature == Feature.CORNER + 1:
        return shapes.triangles[triangle].vertex_1
    return shapes.triangles[triangle].vertex_2


@wp.func
def nearest_triangle(shapes: Shapes, part: int, p: wp.vec3, facing: wp.vec3, ahead: float, within: float):
    """The nearest triangle within a radius.

    With `facing` not zero, of those that oppose it and have p behind them, or no more than `ahead` in front of them.
    """
    best = NearestTriangle()
    best.triangle = -1
    best.squared = within * within
    faced = wp.length_sq(facing) > 0.0
    node = shapes.parts[part].tree_start
    while node < shapes.parts[part].tree_end:
        leaf, node = next_leaf(node, shapes.parts[part].tree_end, p, best.squared, shapes)
        first, end = triangles_of(leaf)
        for t in range(first, end):
            triangle = read_triangle(t, shapes.triangles)
            foot = foot_on_triangle(p, triangle.corner_0, triangle.corner_1, triangle.corner_2)
            gap = wp.length_sq(foot.offset)
            if gap < best.squared:
                n = face_normal(triangle)
                if not faced or (wp.dot(n, facing) < OPPOSING and wp.dot(n, foot.offset) <= ahead):
                    best.squared = gap
                    best.triangle = t
                    best.feature = foot.feature
                    best.offset = foot.offset
    return best


@wp.func
def border_width(shapes: Shapes, part: int):
    """How far beyond the border of a face of a mesh a sample still counts as above the face [m]."""
    root = shapes.parts[part].tree_start
    return 0.5 * BORDER * wp.min(shapes.tree[root].upper - shapes.tree[root].lower)


@wp.func
def is_opposed(normal: wp.vec3, facing: wp.vec3, feature: int):
    """Whether the normal of a feature opposes a sample, or there is no sample normal."""
    cosine = wp.dot(normal, facing)
    # Where the edges of two equal bodies coincide, the normal of a side or corner is a mixture of the face in contact
    # and of faces beside it.
    return wp.length_sq(facing) == 0.0 or cosine < wp.where(feature == Feature.FACE, OPPOSING, -0.5)


@wp.func
def farthest_by_grid(distance: float, cell: float):
    """Largest distance to a mesh, up to the error between nodes, from its grid's distance and cell.

    The padding of a grid is three cells wide. Outside, the distance is at most sqrt(2) times the bound that it gives.
    """
    return wp.where(distance > 2.9 * cell, 1.4143 * distance, wp.abs(distance))


@wp.func
def direction_from(offset: wp.vec3, distance: float, sign: float, normal: wp.vec3, cell: float):
    """Direction from the nearest point of a mesh: the normal very near it, where rounding errors turn the offset."""
    if distance > 2.0e-3 * cell:
        return sign * offset / distance
    return normal


@wp.func
def triangle_distance(
    shapes: Shapes, part: int, p: wp.vec3, facing: wp.vec3, far: float, within: float, fallback: wp.vec4
):
    """Distance to the nearest triangle within a radius, and its direction; `fallback` if there is none.

    It is hardly farther than `far`. For a point inside the mesh and a sample normal `facing` other than zero, it is
    the distance to the nearest triangle that opposes the sample, if there is one within the radius: a sample that has
    passed the middle of a thin wall touches the face through which it entered. For a point outside, within the border
    of such a triangle, it is the distance to its plane.
    """
    best = NearestTriangle()
    best.triangle = -1
    normal = wp.vec3(0.0, 0.0, 0.0)
    asked = wp.vec3(0.0, 0.0, 0.0)
    # Grids are seldom off by more than a fifth of a cell: the first radius of the search is small.
    radius = wp.min(far + 0.2 * shapes.parts[part].grid_spacing, within)
    ahead = float(0.0)
    sign = float(1.0)
    stage = int(Look.LIKELY)
    while stage < Look.DONE:
        found = nearest_triangle(shapes, part, p, asked, ahead, radius)
        if found.triangle >= 0:
            best = found
            feature = wp.where(sign < 0.0 or ahead > 0.0, Feature.FACE, best.feature)
            normal = feature_normal(shapes, best.triangle, feature)
            if ahead > 0.0:
                return wp.vec4(normal[0], normal[1], normal[2], wp.dot(normal, best.offset))
            inside = sign < 0.0 or wp.dot(best.offset, normal) < 0.0
            sign = wp.where(inside, -1.0, 1.0)
        is_missed = stage == Look.LIKELY and found.triangle < 0 and radius < within
        stage = wp.where(is_missed, Look.ALL, wp.where(stage == Look.OPPOSING, Look.DONE, Look.OPPOSING))
        radius = within
        if stage == Look.OPPOSING:
            asked = facing
            radius += shapes.parts[part].grid_spacing
            if best.triangle < 0 or is_opposed(normal, facing, wp.where(sign < 0.0, Feature.FACE, best.feature)):
                stage = Look.DONE
            elif sign > 0.0:
                ahead = border_width(shapes, part)
                radius = ahead
                stage = wp.where(best.squared < ahead * ahead, Look.OPPOSING, Look.DONE)
    if best.triangle < 0:
        return fallback
    distance = wp.sqrt(best.squared)
    normal = direction_from(best.offset, distance, sign, normal, shapes.parts[part].grid_spacing)
    return wp.vec4(normal[0], normal[1], normal[2], sign * distance)


@wp.func
def is_upright(foot: Foot, normal: wp.vec3):
    """Whether a point lies above its foot on a triangle; the foot may lie on the border to a face in the same plane."""
    height = wp.dot(foot.offset, normal)
    aligned = foot.feature == Feature.FACE or height * height > 0.9999 * wp.length_sq(foot.offset)
    return height > 0.0 and aligned


@wp.func
def keep_place(triangle: int, squared: float, direction: wp.vec3, places: Places):
    """Add a place, unless there is a nearer one in a similar direction, or four nearer ones."""
    slot = places.count
    farthest = float(squared)
    for k in range(places.count):
        known = wp.vec3(places.direction[k, 0], places.direction[k, 1], places.direction[k, 2])
        if wp.dot(known, direction) > SAME_PATCH:
            if places.squared[k] <= squared:
                return places
            slot = k
            farthest = wp.inf
        elif places.count == BALL_PLACES and places.squared[k] > farthest:
            slot = k
            farthest = places.squared[k]
    if slot == BALL_PLACES:
        return places
    if slot == places.count:
        places.count += 1
    places.triangle[slot] = triangle
    places.squared[slot] = squared
    for i in range(3):
        places.direction[slot, i] = direction[i]
    return places


@wp.func
def places_near(shapes: Shapes, part: int, p: wp.vec3, within: float):
    """The faces on which the foot of a point outside lies, and the nearest place, within a radius.

    If the nearest place shows that the point is inside, it is the only one, and its distance is negative.
    """
    places = Places()
    best = nearest_triangle(shapes, part, p, wp.vec3(0.0, 0.0, 0.0), 0.0, within)
    if best.triangle < 0:
        return places
    normal = feature_normal(shapes, best.triangle, best.feature)
    sign = wp.where(wp.dot(best.offset, normal) < 0.0, -1.0, 1.0)
    normal = direction_from(best.offset, wp.sqrt(best.squared), sign, normal, shapes.parts[part].grid_spacing)
    places = keep_place(best.triangle, best.squared, normal, places)
    if sign < 0.0:
        places.squared[0] = -best.squared
        return places
    node = shapes.parts[part].tree_start
    while node < shapes.parts[part].tree_end:
        leaf, node = next_leaf(node, shapes.parts[part].tree_end, p, within * within, shapes)
        first, end = triangles_of(leaf)
        for t in range(first, end):
            triangle = read_triangle(t, shapes.triangles)
            foot = foot_on_triangle(p, triangle.corner_0, triangle.corner_1, triangle.corner_2)
            n = face_normal(triangle)
            gap = wp.length_sq(foot.offset)
            if gap < within * within and is_upright(foot, n):
                places = keep_place(t, gap, n, places)
    return places


@wp.func
def place_of_rank(places: Places, choice: int, fallback: wp.vec4):
    """Direction to a ball from its place of the given rank, from 1, in the order of the triangles, and the distance."""
    result = fallback
    if choice > 1:
        result[3] = FAR
    for k in range(places.count):
        rank = int(1)
        for other in range(places.count):
            if places.triangle[other] < places.triangle[k]:
                rank += 1
        if rank == choice:
            distance = wp.sqrt(wp.abs(places.squared[k]))
            result = wp.vec4(
                places.direction[k, 0],
                places.direction[k, 1],
                places.direction[k, 2],
                wp.where(places.squared[k] < 0.0, -distance, distance),
            )
    return result


@wp.func
def chosen_place(shapes: Shapes, part: int, p: wp.vec3, within: float, choice: int, fallback: wp.vec4):
    """Distance to the place of a ball that has the given rank, from 1, in the order of the triangles.

    This order does not change as long as the ball touches the same faces, whichever is nearest.
    """
    return place_of_rank(places_near(shapes, part, p, within), choice, fallback)
