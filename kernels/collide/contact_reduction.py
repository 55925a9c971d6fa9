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

A team of lanes processes a pair. Each lane finds the patch of its own sample. The samples that take a slot are then
broadcast to all lanes in sample order, and each lane updates its own slots.
"""

import warp as wp

from warp_rigid.kernels.collide.approach import Touch
from warp_rigid.kernels.collide.distance import FAR
from warp_rigid.kernels.common.tangents import tangent_of
from warp_rigid.kernels.common.team import ballot, bits_below, broadcast, broadcast_integer, lowest_bit, sync_warp
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


@wp.struct
class Offer:
    """A touching sample that is offered to the slots of its patch.

    `place`: its place among the near samples. `patch`: -1 for a sample that does not touch. `x`, `y`: coordinates in
    the tangent plane of the patch [m]. `loaded`: 1 if a load points along x. `gap`, `left`: as in `Touch`.
    """

    place: int
    patch: int
    x: float
    y: float
    loaded: int
    gap: float
    left: float


@wp.func
def nearest_patch(pair: int, normal: wp.vec3, pairs: Pairs):
    """The patch with the most similar normal; -1 if none is similar enough and another patch can be added."""
    count = pairs.patch_count[pair]
    best = int(0)
    likeness = float(-2.0)
    for p in range(count):
        c = wp.dot(pairs.patch_normal[pair, p], normal)
        if c > likeness:
            likeness = c
            best = p
    if likeness < SAME_PATCH and count < PATCHES:
        return -1
    return best


@wp.func
def add_patch(pair: int, normal: wp.vec3, pairs: Pairs):
    """Add a patch with a normal and empty slots. Returns it."""
    count = pairs.patch_count[pair]
    pairs.patch_count[pair] = count + 1
    pairs.patch_normal[pair, count] = normal
    for k in range(PATCH_SLOTS):
        pairs.slots[pair, count * PATCH_SLOTS + k].place = -1
    return count


@wp.func
def patch_for(pair: int, touch: Touch, lane: int, lanes: int, pairs: Pairs):
    """The patch of each lane's sample, as if the lanes chose theirs one after another; -1 if it does not touch.

    A sample that is like no patch adds one. The lanes before it have chosen among the patches without this one.
    """
    result = int(-1)
    waiting = ballot(wp.where(touch.gap < FAR, 1, 0), lanes)
    while waiting != wp.uint32(0):
        waits = (waiting >> wp.uint32(lane)) & wp.uint32(1)
        patch = int(0)
        if waits == wp.uint32(1):
            patch = nearest_patch(pair, touch.normal, pairs)
        adding = ballot(wp.where(patch < 0, 1, 0), lanes)
        adder = lanes
        if adding != wp.uint32(0):
            adder = lowest_bit(adding)
        if lane == adder:
            patch = add_patch(pair, touch.normal, pairs)
        if waits == wp.uint32(1) and lane <= adder:
            result = patch
            waits = wp.uint32(0)
        sync_warp(lanes)
        waiting = ballot(int(waits), lanes)
    return result


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
def offer_of(pair: int, place: int, touch: Touch, ranking: Ranking, lane: int, lanes: int, pairs: Pairs):
    """The offer of each lane's sample, which is in the second body's frame."""
    offer = Offer()
    offer.place = place
    offer.gap = touch.gap
    offer.left = touch.left
    offer.patch = patch_for(pair, touch, lane, lanes, pairs)
    if offer.patch >= 0:
        n = pairs.patch_normal[pair, offer.patch]
        u = tangent_along(ranking.load, n)
        offer.loaded = wp.where(wp.length_sq(u) > 0.0, 1, 0)
        if offer.loaded == 0:
            u = tangent_of(n)
        offer.x = wp.dot(touch.position, u)
        offer.y = wp.dot(touch.position, wp.cross(n, u))
    return offer


@wp.func
def weight_in(k: int, ranking: Ranking):
    """Weight of a gap in a slot; 1 for the slot of the deepest sample, whose score is a gap."""
    if k == EXTREME_DIRECTIONS:
        return 1.0
    return wp.where(k % 2 == 0, ranking.upright, ranking.tipped)


@wp.func
def score_in(k: int, offer: Offer, ranking: Ranking):
    """Score of a sample in a slot [m]."""
    if k == EXTREME_DIRECTIONS:
        return -offer.left
    gap = wp.max(offer.gap, -ranking.deepest)
    if offer.left < COMES_NEAR * offer.gap:
        gap = wp.min(gap, ranking.furthest)
    reach = extent(k, offer.x, offer.y)
    if offer.loaded == 1:
        reach = extent_under_load(k, offer.x, offer.y)
    return reach - weight_in(k, ranking) * gap


@wp.func
def takes_slot(pair: int, k: int, offer: Offer, score: float, ranking: Ranking, size: float, pairs: Pairs):
    """Whether a sample with a score replaces the one in a slot of its patch."""
    best = pairs.slots[pair, offer.patch * PATCH_SLOTS + k]
    return best.place < 0 or score > best.score + TIE * size * weight_in(k, ranking)


@wp.func
def takes_any_slot(pair: int, offer: Offer, ranking: Ranking, size: float, pairs: Pairs):
    """Whether a sample replaces one in any slot of its patch."""
    for k in range(PATCH_SLOTS):
        if takes_slot(pair, k, offer, score_in(k, offer, ranking), ranking, size, pairs):
            return True
    return False


@wp.func
def broadcast_offer(offer: Offer, lane: int, lanes: int):
    """The offer of one lane, broadcast to the whole team."""
    result = Offer()
    result.place = broadcast_integer(offer.place, lane, lanes)
    result.patch = broadcast_integer(offer.patch, lane, lanes)
    result.x = broadcast(offer.x, lane, lanes)
    result.y = broadcast(offer.y, lane, lanes)
    result.loaded = broadcast_integer(offer.loaded, lane, lanes)
    result.gap = broadcast(offer.gap, lane, lanes)
    result.left = broadcast(offer.left, lane, lanes)
    return result


@wp.func
def offer_samples(
    pair: int, place: int, touch: Touch, ranking: Ranking, size: float, lane: int, lanes: int, pairs: Pairs
):
    """Offer the samples of all lanes to the slots of their patches, in the order of the lanes.

    Scores in the slots only grow, so a sample that takes no slot now need not be offered. A single lane does not test
    this first.
    """
    offer = offer_of(pair, place, touch, ranking, lane, lanes, pairs)
    offers = offer.patch >= 0
    if offers and lanes > 1:
        offers = takes_any_slot(pair, offer, ranking, size, pairs)
    hits = ballot(wp.where(offers, 1, 0), lanes)
    while hits != wp.uint32(0):
        offered = broadcast_offer(offer, lowest_bit(hits), lanes)
        hits = hits & (hits - wp.uint32(1))
        for k in range(lane, PATCH_SLOTS, lanes):
            score = score_in(k, offered, ranking)
            if takes_slot(pair, k, offered, score, ranking, size, pairs):
                slot = SlotRecord(offered.place, score, offered.gap, offered.left)
                pairs.slots[pair, offered.patch * PATCH_SLOTS + k] = slot
    sync_warp(lanes)


@wp.func
def keep_slots(pair: int, size: float, lane: int, lanes: int, pairs: Pairs):
    """List the kept samples, each once, and a deepest one only if it will be deeper. Returns their number."""
    kept = int(0)
    slots = pairs.patch_count[pair] * PATCH_SLOTS
    for base in range(0, slots, lanes):
        slot = base + lane
        place = int(-1)
        if slot < slots:
            own = pairs.slots[pair, slot]
            place = own.place
            lowest = float(FAR)
            for k in range(slot - slot % PATCH_SLOTS, slot):
                earlier = pairs.slots[pair, k]
                if earlier.place >= 0:
                    lowest = wp.min(lowest, earlier.left)
                    if earlier.place == own.place:
                        place = -1
            if slot % PATCH_SLOTS == EXTREME_DIRECTIONS and own.left > lowest - 0.1 * CONTACT_DISTANCE * size:
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
    """Gap of the deepest kept sample of a pair [m]; FAR if it has none."""
    deepest = float(FAR)
    for slot in range(pairs.patch_count[pair] * PATCH_SLOTS):
        if pairs.slots[pair, slot].place >= 0:
            deepest = wp.min(deepest, pairs.slots[pair, slot].gap)
    return deepest
