"""Crossed bodies: pairs that overlap where no contact shows it come apart along one direction, which they keep.

If thin walls cross, or the rim of a cylinder is in the inner corner of an L, the samples inside the other body do not
oppose the faces next to them, so they are no contacts. The faces around the crossing do not give its extent: two
walls that cross have the same overlap however far they move. The direction is therefore chosen from the boxes that
bound the bodies: that of the least motion after which these do not overlap. All samples inside are pushed along it,
step by step, until none is left.
"""

from enum import IntFlag

import warp as wp

from warp_rigid.kernels.collide.approach import approach_of
from warp_rigid.kernels.collide.convex import are_solid
from warp_rigid.kernels.collide.distance import FAR
from warp_rigid.kernels.collide.near_samples import NearSamples
from warp_rigid.kernels.common.team import ballot, broadcast_integer, lowest_bit, min_of_lanes
from warp_rigid.kernels.schema import Bodies, Pairs, Shapes, State
from warp_rigid.kernels.tuning import HIDDEN_DEPTH

wp.set_module_options({"enable_backward": False, "max_unroll": 4})


class Closing(IntFlag):
    """Values of `NearSamples.closing`."""

    CLOSES = 1
    """The gap may close in the step."""
    CROSSED = 2
    """The sample is no contact, but inside the other body."""


@wp.func
def is_parting(pair: int, shapes: Shapes, bodies: Bodies, pairs: Pairs):
    """Whether a pair has a direction in which it comes apart; the axis of two convex solids is none."""
    if wp.length_sq(pairs.axis[pair]) == 0.0:
        return False
    return not are_solid(bodies.shape[pairs.body_a[pair]], bodies.shape[pairs.body_b[pair]], shapes)


@wp.func
def hidden_depth(a: int, b: int, shapes: Shapes):
    """Depth from which a sample that is no contact shows that two bodies of given shapes are crossed [m].

    FAR if one has no inside, or both are convex.
    """
    if are_solid(a, b, shapes):
        return FAR
    first = shapes.balls[shapes.shapes[a].ball_start]
    second = shapes.balls[shapes.shapes[b].ball_start]
    radius = wp.min(first[3], second[3])
    return wp.where(radius > 0.0, HIDDEN_DEPTH * radius, FAR)


@wp.func
def deepest_hidden(pair: int, lane: int, lanes: int, near: NearSamples):
    """Place in the list of the deepest sample of a pair that is inside the other body but no contact; -1 if none."""
    deepest = float(0.0)
    place = int(-1)
    batch = near.first[pair]
    while batch >= 0:
        for k in range(batch + lane, near.end[batch], lanes):
            if near.closing[k] == Closing.CROSSED and near.gap[k] < deepest:
                deepest = near.gap[k]
                place = k
        batch = near.next[batch]
    lowest = min_of_lanes(deepest, lanes)
    return broadcast_integer(place, lowest_bit(ballot(wp.where(deepest == lowest, 1, 0), lanes)), lanes)


@wp.func
def half_extent(n: wp.vec3, shape: int, shapes: Shapes):
    """Half the extent of a shape's bounding box along a direction in its frame [m]."""
    half = 0.5 * (shapes.shapes[shape].upper - shapes.shapes[shape].lower)
    return wp.abs(n[0]) * half[0] + wp.abs(n[1]) * half[1] + wp.abs(n[2]) * half[2]


@wp.func
def way_out(a: int, b: int, shapes: Shapes, bodies: Bodies, state: State):
    """Direction in the second body's frame in which the first one must move least, until their boxes are apart.

    Of the six normals of the boxes' faces. Zero if it would have to move further than the diagonal of the smaller box
    along each of them: a small body in a wall of a large one is not carried through all of it.
    """
    approach = approach_of(a, b, 0.0, bodies, state)
    own = approach.own_shape
    other = approach.shape
    center = wp.quat_rotate(approach.turn, 0.5 * (shapes.shapes[own].lower + shapes.shapes[own].upper))
    center += approach.shift - 0.5 * (shapes.shapes[other].lower + shapes.shapes[other].upper)
    best = wp.vec3(0.0, 0.0, 0.0)
    own_size = wp.length(shapes.shapes[own].upper - shapes.shapes[own].lower)
    least = wp.min(own_size, wp.length(shapes.shapes[other].upper - shapes.shapes[other].lower))
    for k in range(6):
        n = wp.vec3(0.0, 0.0, 0.0)
        n[k % 3] = 1.0
        if k < 3:
            n = wp.quat_rotate(approach.turn, n)
        first = half_extent(wp.quat_rotate_inv(approach.turn, n), own, shapes)
        second = half_extent(n, other, shapes)
        along = wp.dot(n, center)
        way = first + second - wp.abs(along)
        if way < least:
            least = way
            best = wp.where(along < 0.0, -n, n)
    return best
