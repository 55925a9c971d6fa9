"""Contact reduction: selects a few of the touching samples to represent the contact of a pair.

Touching samples are grouped into patches with similar normals. A patch keeps the furthest sample in each of eight
directions of its tangent plane, and the one that will be deepest at the end of the step. The convex hull of the samples
can support the same loads as all of them. The directions are fixed in the frame of the second body. On cylinders and
convex meshes they are closer together towards the load, over which these bodies tip, so that they topple neither early
nor late. Ties are resolved in favour of the first sample, so that contact identities persist.

The score of a sample is its extent in the direction, reduced by its gap times a weight; this corresponds to tilting the
bodies by a small angle. In every other direction the weight is small (TIPPED_WEIGHT, TURNING_WEIGHT), so that the
closest samples do not replace the corners onto which a fast body rotates. In the directions between, the weight is
large for slow bodies (UPRIGHT_WEIGHT): a bumpy shape then keeps the samples that support it, and not those around its
bumps, on which it would rock indefinitely.

A team of lanes processes a pair. All lanes find the patch, and each lane updates its own slots.
"""

import warp as wp

from warp_rigid.kernels.collide.approach import Touch
from warp_rigid.kernels.collide.distance import FAR
from warp_rigid.kernels.common.tangents import tangent_of
from warp_rigid.kernels.common.team import ballot, bits_below, sync_warp
from warp_rigid.kernels.schema import EXTREME_DIRECTIONS, PATCH_SLOTS, PATCHES, Pairs, SlotRecord
from warp_rigid.kernels.tuning import (
    COMES_NEAR,
    CONTACT_DISTANCE,
    OPPOSING_NORMALS,
    RANKED_GAP,
    SAME_PATCH,
    SLOPING,
    TIE,
    TIPPED_WEIGHT,
    TRAVEL_WEIGHT,
    TURNING_WEIGHT,
    UPRIGHT_WEIGHT,
)

wp.set_module_options({"enable_backward": False})

DIRECTIONS = wp.constant(EXTREME_DIRECTIONS)
SLOTS = wp.constant(PATCH_SLOTS)
MOST_PATCHES = wp.constant(PATCHES)


@wp.struct
class Ranking:
    """How the gaps of a pair's samples count.

    `upright`, `tipped`: weights of a gap in every other direction, and in those between. `deepest`, `furthest`: overlap
    and gap beyond which all count as equal [m]. `load`: acceleration of the bodies in the frame of the second one; a
    zero vector if the directions do not depend on it.
    """

    upright: float
    tipped: float
    deepest: float
    furthest: float
    load: wp.vec3


@wp.func
def ranking_of(way: float, turn: float, size: float, solid: bool):
    """How the gaps of a pair's samples count, from its relative travel [m] and rotation [rad] in the step.

    `solid`: whether one of the bodies is a convex solid.
    """
    result = Ranking()
    result.upright = wp.clamp(TRAVEL_WEIGHT * size / wp.max(way, 1.0e-6 * size), TIPPED_WEIGHT, UPRIGHT_WEIGHT)
    result.tipped = wp.clamp(1.0 / wp.max(turn, 1.0e-6), TURNING_WEIGHT, TIPPED_WEIGHT)
    result.deepest = RANKED_GAP * size
    result.furthest = wp.where(solid, RANKED_GAP * size, FAR)
    return result


@wp.func
def patch_for(pair: int, normal: wp.vec3, lane: int, lanes: int, pairs: Pairs):
    """The patch with a similar normal, or a new one, or the most similar one if all are in use. Runs in all lanes."""
    count = pairs.patch_count[pair]
    best = int(0)
    likeness = float(-2.0)
    for p in range(count):
        c = wp.dot(pairs.patch_normal[pair, p], normal)
        if c > likeness:
            likeness = c
            best = p
    if likeness < SAME_PATCH and count < MOST_PATCHES:
        best = count
        sync_warp(lanes)
        if lane == 0:
            pairs.patch_count[pair] = count + 1
            pairs.patch_normal[pair, count] = normal
        for k in range(lane, SLOTS, lanes):
            pairs.slots[pair, count * SLOTS + k].place = -1
        sync_warp(lanes)
    return best


@wp.func
def tangent_along(load: wp.vec3, n: wp.vec3):
    """The tangent in which a load points, 0 if it has no direction along the contact."""
    along = load - wp.dot(load, n) * n
    if wp.length(along) <= SLOPING * wp.length(load):
        return wp.vec3(0.0, 0.0, 0.0)
    return wp.normalize(along)


@wp.func
def extent(k: int, x: float, y: float):
    """Extent of a point (x, y) of the tangent plane in one of eight directions that are 45 degrees apart.

    The first is at 26 degrees to x: boxes have corners, and no edges, in the eight directions.
    """
    c = float(0.9)
    s = float(0.43588989)
    if k % 2 == 1:
        c = 0.32817533
        s = 0.94461734
    along = c * x + s * y
    across = c * y - s * x
    quarter = k / 2
    return wp.where(quarter % 2 == 0, along, across) * wp.where(quarter < 2, 1.0, -1.0)


@wp.func
def extent_under_load(k: int, x: float, y: float):
    """Extent of a point (x, y) of the tangent plane in one of eight directions; the load points along x.

    They are at 2.4, 11.6, 36 and 125 degrees to the load, on both sides of it. The corners that they find on the base
    of a prism of 3 to 128 sides reach at least 0.9966 of the way to its edge, in the direction of the load.
    """
    c = float(0.999123)
    s = float(0.041876)
    if k % 4 == 1:
        c = 0.979575
        s = 0.201078
    elif k % 4 == 2:
        c = 0.809017
        s = 0.587785
    elif k % 4 == 3:
        c = -0.573576
        s = 0.819152
    return c * x + s * wp.where(k < 4, y, -y)


@wp.func
def offer_sample(
    pair: int,
    place: int,
    touch: Touch,
    ranking: Ranking,
    size: float,
    lane: int,
    lanes: int,
    pairs: Pairs,
):
    """Offer a touching sample, in the second body's frame, to the slots of its patch; a lane updates its own slots."""
    patch = patch_for(pair, touch.normal, lane, lanes, pairs)
    n = pairs.patch_normal[pair, patch]
    u = tangent_along(ranking.load, n)
    loaded = wp.length_sq(u) > 0.0
    if not loaded:
        u = tangent_of(n)
    x = wp.dot(touch.position, u)
    y = wp.dot(touch.position, wp.cross(n, u))
    for k in range(lane, SLOTS, lanes):
        counts = float(1.0)
        score = -touch.left
        if k < DIRECTIONS:
            counts = wp.where(k % 2 == 0, ranking.upright, ranking.tipped)
            gap = wp.max(touch.gap, -ranking.deepest)
            if touch.left < COMES_NEAR * touch.gap:
                gap = wp.min(gap, ranking.furthest)
            if loaded:
                score = extent_under_load(k, x, y) - counts * gap
            else:
                score = extent(k, x, y) - counts * gap
        best = pairs.slots[pair, patch * SLOTS + k]
        if best.place < 0 or score > best.score + TIE * size * counts:
            pairs.slots[pair, patch * SLOTS + k] = SlotRecord(place, score, touch.gap, touch.left)


@wp.func
def keep_slots(pair: int, size: float, lane: int, lanes: int, pairs: Pairs):
    """List the kept samples, each once, and a deepest one only if it will be deeper. Returns their number."""
    kept = int(0)
    slots = pairs.patch_count[pair] * SLOTS
    for base in range(0, slots, lanes):
        slot = base + lane
        place = int(-1)
        if slot < slots:
            own = pairs.slots[pair, slot]
            place = own.place
            lowest = float(FAR)
            for k in range(slot - slot % SLOTS, slot):
                earlier = pairs.slots[pair, k]
                if earlier.place >= 0:
                    lowest = wp.min(lowest, earlier.left)
                    if earlier.place == own.place:
                        place = -1
            if slot % SLOTS == DIRECTIONS and own.left > lowest - 0.1 * CONTACT_DISTANCE * size:
                place = -1
        hits = ballot(wp.where(place >= 0, 1, 0), lanes)
        if place >= 0:
            pairs.kept[pair, kept + bits_below(hits, lane)] = place
        kept += bits_below(hits, 32)
    return kept


@wp.func
def contradictory(pair: int, pairs: Pairs):
    """Whether two patches of a pair have opposing normals."""
    for p in range(pairs.patch_count[pair]):
        for q in range(p):
            if wp.dot(pairs.patch_normal[pair, p], pairs.patch_normal[pair, q]) < OPPOSING_NORMALS:
                return True
    return False


@wp.func
def deepest_gap(pair: int, pairs: Pairs):
    """Gap of the deepest kept sample of a pair [m], at most 0."""
    deepest = float(0.0)
    for slot in range(pairs.patch_count[pair] * SLOTS):
        if pairs.slots[pair, slot].place >= 0:
            deepest = wp.min(deepest, pairs.slots[pair, slot].gap)
    return deepest
