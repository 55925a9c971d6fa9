"""Culling: which samples of a body are close enough to another body to be tested for contact.

Clusters of samples are tested first, then the samples of the near ones. Bounding boxes, the axis of a pair of convex
bodies and the grids of meshes give cheap bounds of the distance.
"""

import warp as wp

from warp_rigid.kernels.collide.approach import Approach
from warp_rigid.kernels.collide.contact_search import is_segment
from warp_rigid.kernels.collide.convex_pairs import border_of
from warp_rigid.kernels.collide.distance import has_places, has_triangles, is_near_grid, is_nearer
from warp_rigid.kernels.collide.edge_search import OVERLAP
from warp_rigid.kernels.enums import PartKind, SampleKind
from warp_rigid.kernels.schema import Shapes
from warp_rigid.kernels.shape_arrays import read_cluster, read_sample
from warp_rigid.kernels.tuning import TURNED_BACK

wp.set_module_options({"enable_backward": False, "max_unroll": 4})


@wp.func
def matters(kind: int, own_shape: int, shape: int, edges: int, shapes: Shapes):
    """Whether samples of a kind can contribute to a contact.

    Between convex shapes, points inside a face never touch first, and only points touch a plane first. A contact with a
    sphere is found exactly by the sample at the sphere's centre, so other samples are not needed, except those of
    shapes with a grid: their edges and corners are rounded, and their faces are needed if they are smaller than the
    sphere. Against a mesh with unsampled edges, a box needs none of its own: points slide along those of the mesh, to
    which the box is convex. The last segments of a cylinder's side are needed against shapes without such edges and
    axes. The faces of nonconvex shapes are needed against convex ones too: points on their unsampled edges slide, and
    axes of capsules find one contact a segment.
    """
    if kind == SampleKind.CORNER:
        return has_places(shapes, shape)
    if kind == SampleKind.ARC:
        return shapes.shapes[shape].convex == 0
    other = shapes.parts[shapes.shapes[shape].part_start].kind
    own = shapes.parts[shapes.shapes[own_shape].part_start].kind
    if kind == SampleKind.SIDE:
        return wp.where(shapes.shapes[shape].convex == 1, other == PartKind.CYLINDER, not has_triangles(shapes, shape))
    if shapes.shapes[shape].convex == 0:
        by_mesh = is_box(own_shape, shapes) and has_triangles(shapes, shape) and shapes.shapes[shape].dip > 0.0
        return kind != SampleKind.EDGE or (edges == 1 and not by_mesh)
    if own == PartKind.HEIGHTFIELD:
        return True
    by_center = other == PartKind.SPHERE and shapes.shapes[own_shape].convex == 1
    if kind == SampleKind.POINT:
        return own == PartKind.SPHERE or not by_center
    if kind == SampleKind.EDGE:
        return edges == 1 and other != PartKind.PLANE and not by_center
    if other == PartKind.SPHERE:
        return not by_center and shapes.shapes[own_shape].size < shapes.shapes[shape].size
    return shapes.shapes[own_shape].convex == 0 and other != PartKind.PLANE


@wp.func
def is_box(shape: int, shapes: Shapes):
    """Whether a shape is one box."""
    kind = shapes.parts[shapes.shapes[shape].part_start].kind
    return shapes.shapes[shape].convex == 1 and kind == PartKind.BOX


@wp.func
def out_of_box(p: wp.vec3, margin: float, shape: int, shapes: Shapes):
    """Whether a point is further than a margin from a shape's bounding box, a cheap bound of the distance."""
    below = shapes.shapes[shape].lower - p
    above = p - shapes.shapes[shape].upper
    return wp.max(wp.max(below), wp.max(above)) > margin


@wp.func
def is_over_face(p: wp.vec3, margin: float, shape: int, shapes: Shapes):
    """Whether a point is over a face of a shape's bounding box, further than a margin from the edges of this face."""
    below = shapes.shapes[shape].lower - p
    above = p - shapes.shapes[shape].upper
    within = int(0)
    for axis in range(3):
        within += wp.where(wp.max(below[axis], above[axis]) < -margin, 1, 0)
    return within >= 2


@wp.func
def segment_meets_box(middle: wp.vec3, half: wp.vec3, margin: float, shape: int, shapes: Shapes):
    """Whether a segment comes within a margin of a shape's bounding box, by separating axes of the enlarged box."""
    center = 0.5 * (shapes.shapes[shape].lower + shapes.shapes[shape].upper)
    e = 0.5 * (shapes.shapes[shape].upper - shapes.shapes[shape].lower) + wp.vec3(margin, margin, margin)
    m = middle - center
    h = wp.vec3(wp.abs(half[0]), wp.abs(half[1]), wp.abs(half[2]))
    if wp.abs(m[0]) > e[0] + h[0] or wp.abs(m[1]) > e[1] + h[1] or wp.abs(m[2]) > e[2] + h[2]:
        return False
    across = wp.cross(m, half)
    x = wp.abs(across[0]) <= e[1] * h[2] + e[2] * h[1]
    y = wp.abs(across[1]) <= e[0] * h[2] + e[2] * h[0]
    return x and y and wp.abs(across[2]) <= e[0] * h[1] + e[1] * h[0]


@wp.func
def may_touch_mesh(p: wp.vec3, radius: float, approach: Approach, shapes: Shapes):
    """Whether samples within a radius of a point may be contacts with a mesh, by its grid; never wrongly false.

    They are near enough to turn back or to be pushed onto it, or may reach the surface along their path. A distance is
    Lipschitz with constant 1, so on such a path it is at most half of the length at the midpoint.
    """
    near = wp.max(TURNED_BACK * approach.reach, approach.touching + approach.speculative)
    if approach.searched > approach.reach:
        # An unsampled edge may touch although the sample at its end does not come near.
        near = wp.max(near, approach.searched)
    if is_near_grid(shapes, approach.shape, p, near + radius):
        return True
    way = approach.motion + wp.cross(approach.rotation, p)
    spread = wp.length(approach.rotation) * radius
    margin = approach.touching + 0.5 * wp.length(way) + spread + radius
    return is_near_grid(shapes, approach.shape, p + 0.5 * way, margin)


@wp.func
def cluster_is_near(cluster: int, approach: Approach, edges: int, shapes: Shapes):
    """Whether a cluster may contain a touching sample."""
    known = read_cluster(cluster, shapes.clusters)
    if not matters(known.kind, approach.own_shape, approach.shape, edges, shapes):
        return 0
    radius = known.radius
    if wp.dot(approach.cut, known.center) - radius > approach.level:
        return 0
    center = wp.quat_rotate(approach.turn, known.center) + approach.shift
    if out_of_box(center, radius + approach.searched, approach.shape, shapes):
        return 0
    if has_triangles(shapes, approach.shape):
        return wp.where(may_touch_mesh(center, radius, approach, shapes), 1, 0)
    return wp.where(is_nearer(shapes, approach.shape, center, radius + approach.searched), 1, 0)


@wp.func
def sample_is_near(s: int, approach: Approach, shapes: Shapes):
    """Whether a sample is close enough to the other shape's bounding box, and along the pair's axis, to touch.

    The distance to a mesh is slow, so bounds from its grid are tested, too.
    """
    sample = read_sample(s, shapes.samples)
    if sample.kind == SampleKind.RIM and shapes.shapes[approach.shape].convex == 0:
        return False
    lowest = wp.dot(approach.cut, sample.point) - wp.abs(wp.dot(approach.cut, sample.slide))
    if lowest - sample.radius > approach.level:
        return False
    p = wp.quat_rotate(approach.turn, sample.point) + approach.shift
    margin = approach.searched + sample.radius
    if is_segment(sample.kind):
        slide = OVERLAP * wp.quat_rotate(approach.turn, sample.slide)
        margin += border_of(approach.own_shape, approach.shape, shapes)
        if not segment_meets_box(p, slide, margin, approach.shape, shapes):
            return False
        margin += wp.length(slide)
    elif out_of_box(p, margin, approach.shape, shapes):
        return False
    elif is_box(approach.shape, shapes) and out_of_box(p, approach.reach + sample.radius, approach.shape, shapes):
        # Only across its edges is a box nearer to an unsampled edge than to the ends of it.
        length = shapes.shapes[approach.own_shape].unsampled_length
        return not is_over_face(p, length, approach.shape, shapes)
    return not has_triangles(shapes, approach.shape) or may_touch_mesh(p, margin - approach.searched, approach, shapes)
