"""Pairs of convex solids in the narrow phase: rejection of pairs that do not touch, and checks of deep overlaps."""

import warp as wp

from warp_rigid.kernels.collide.approach import Approach, approach_of, contact_reach, touch_of
from warp_rigid.kernels.collide.contact_reduction import contradictory, deepest_gap
from warp_rigid.kernels.collide.contact_search import Search
from warp_rigid.kernels.collide.convex import (
    are_solid,
    deepest_point,
    find_axis,
    furthest_point,
    gap_along,
    solid_of,
    solids_of_shapes,
)
from warp_rigid.kernels.collide.distance import BORDER, FAR
from warp_rigid.kernels.common.team import sync_warp
from warp_rigid.kernels.schema import PATCH_SLOTS, Bodies, History, Motions, Pairs, Shapes, State
from warp_rigid.kernels.tuning import ALONG_AXIS, CONTACT_DISTANCE, DEEP_OVERLAP, DOUBTFUL, TRUSTED
from warp_rigid.kernels.update.predict import smaller_size

wp.set_module_options({"enable_backward": False, "max_unroll": 4})


@wp.func
def solids_of(a: int, b: int, size: float, shapes: Shapes, bodies: Bodies, state: State):
    """A pair as convex solids, in the frame of the second body."""
    approach = approach_of(a, b, 0.0, bodies, state)
    pose = wp.transformation(approach.shift, approach.turn)
    return solids_of_shapes(approach.own_shape, approach.shape, pose, size, shapes)


@wp.func
def touch_along(axis: wp.vec3, a: int, b: int, shapes: Shapes, bodies: Bodies, state: State):
    """The contact point of two overlapping convex solids along an axis, in the world frame."""
    size = smaller_size(a, b, shapes, bodies)
    solids = solids_of(a, b, size, shapes, bodies, state)
    placed = Search()
    placed.direction = axis
    placed.distance = gap_along(solids, shapes, axis)
    placed.query = deepest_point(solids, shapes, axis)
    return touch_of(placed, 0, b, state)


@wp.func
def drop_untrusted(pair: int, axis: wp.vec3, depth: float, lane: int, lanes: int, pairs: Pairs):
    """Empty the slots of samples that do not point along the axis, or are deeper than the solids."""
    for slot in range(lane, pairs.patch_count[pair] * PATCH_SLOTS, lanes):
        along = wp.dot(pairs.patch_normal[pair, slot / PATCH_SLOTS], axis)
        if along < ALONG_AXIS or pairs.slots[pair, slot].gap < -TRUSTED * depth:
            pairs.slots[pair, slot].place = -1


@wp.func
def check_by_axis(
    pair: int,
    closing: int,
    lane: int,
    lanes: int,
    size: float,
    shapes: Shapes,
    bodies: Bodies,
    state: State,
    pairs: Pairs,
):
    """Compare the samples of two convex solids with their overlap, and drop those that contradict it.

    Returns 1 if a contact along the axis of least overlap is needed. It is not where a sample touches and the overlap
    is shallow: its point would be any point of the face on which they lie.
    """
    solids = solids_of(pairs.body_a[pair], pairs.body_b[pair], size, shapes, bodies, state)
    axis = pairs.axis[pair]
    gap = float(-FAR)
    for p in range(pairs.patch_count[pair]):
        along = gap_along(solids, shapes, pairs.patch_normal[pair, p])
        if along > gap:
            gap = along
            axis = pairs.patch_normal[pair, p]
    doubtful = gap < -DOUBTFUL * size and gap < TRUSTED * deepest_gap(pair, pairs)
    doubtful = doubtful or gap < -DEEP_OVERLAP * size or closing == 0 or contradictory(pair, pairs)
    if doubtful:
        axis = find_axis(solids, shapes, axis, 0.0)
        gap = gap_along(solids, shapes, axis)
    sync_warp(lanes)
    if lane == 0:
        pairs.axis[pair] = axis
    if gap >= 0.0 or not doubtful:
        return 0
    drop_untrusted(pair, axis, -gap, lane, lanes, pairs)
    sync_warp(lanes)
    deepest = deepest_gap(pair, pairs)
    near = CONTACT_DISTANCE * size
    return wp.where((deepest < near and gap > -near) or deepest * TRUSTED < gap, 0, 1)


@wp.func
def border_of(a: int, b: int, shapes: Shapes):
    """Distance from a shape at which a point may still count as above one of its faces (distance.py) [m]."""
    return BORDER * wp.max(shapes.shapes[a].size, shapes.shapes[b].size)


@wp.func
def cut_by_axis(approach: Approach, axis: wp.vec3, side: int, shapes: Shapes):
    """Limit the samples of a convex body to those that are near the other convex body along the axis of the pair.

    On side 0 the approach is that of the first body in the frame of the second one, and of this the axis is. On side 1
    it is the inverse.
    """
    if wp.length_sq(axis) == 0.0 or not are_solid(approach.own_shape, approach.shape, shapes):
        return approach
    n = axis
    if side == 1:
        n = -wp.quat_rotate(approach.turn, axis)
    approach.cut = wp.quat_rotate_inv(approach.turn, n)
    furthest = wp.dot(n, furthest_point(solid_of(shapes, approach.shape, wp.transform_identity()), shapes, n))
    border = border_of(approach.own_shape, approach.shape, shapes)
    approach.level = furthest + approach.reach + border - wp.dot(n, approach.shift)
    return approach


@wp.func
def is_apart(
    pair: int,
    last: int,
    dt: float,
    size: float,
    shapes: Shapes,
    bodies: Bodies,
    state: State,
    motions: Motions,
    history: History,
    pairs: Pairs,
):
    """Whether an axis shows that two convex solids cannot touch in this step, first of all that of the last step.

    Another one is searched for only if the solids had no contact. Samples slightly beyond the border of a face may be
    in contact with it (distance.py), so the gap must exceed the reach by as much. Other pairs keep their axis.
    """
    axis = wp.vec3(0.0, 0.0, 0.0)
    touched = int(0)
    if last >= 0:
        axis = history.axis[last]
        touched = history.contact_start[last + 1] - history.contact_start[last]
    pairs.axis[pair] = axis
    a = pairs.body_a[pair]
    b = pairs.body_b[pair]
    shape_a = bodies.shape[a]
    shape_b = bodies.shape[b]
    if not are_solid(shape_a, shape_b, shapes):
        return False
    reach = contact_reach(a, b, size, dt, state, motions)
    reach += border_of(shape_a, shape_b, shapes)
    solids = solids_of(a, b, size, shapes, bodies, state)
    if touched == 0:
        axis = find_axis(solids, shapes, axis, reach)
    pairs.axis[pair] = axis
    return gap_along(solids, shapes, axis) > reach
