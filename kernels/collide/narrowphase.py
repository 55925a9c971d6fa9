"""Narrow phase: finds the surface samples of each body that touch the other, and reduces them to a few contacts.

Both directions are tested: samples of A against the distance of B, and samples of B against the distance of A. A
cluster of samples is skipped if the distance at its centre exceeds its radius plus the reach. A sample touches if its
gap at the end of the step, predicted from the relative velocity, is below the contact distance, and if its outward
normal opposes the gradient of the distance. If one sample touches, nearby samples that move away are contacts too: a
body that lands on a corner may rotate back onto them within the step.

Contacts are reduced while they are found (contact_reduction.py).

Bodies may overlap so deeply that no sample of one opposes the surface of the other, or that contact normals oppose
each other. Two convex bodies then touch along the axis of their least overlap (convex.py). Otherwise the contact is
made with a large ball inside one body, which overlaps the other body only if the bodies overlap. It also replaces
contacts that show less than a third of its overlap.

A team of lanes processes a pair. The lanes test clusters in parallel, then the samples of a cluster. Touching samples
are broadcast to all lanes in sample order, and each lane updates its own slots.
"""

import warp as wp

from warp_rigid.kernels.collide.approach import (
    Approach,
    Touch,
    approach_of,
    closing_gap,
    contact_reach,
    smaller_approach,
    touch_of,
    travel,
)
from warp_rigid.kernels.collide.broadphase import may_meet
from warp_rigid.kernels.collide.contact_reduction import (
    contradictory,
    deepest_gap,
    gap_weight,
    keep_slots,
    offer_sample,
)
from warp_rigid.kernels.collide.convex import is_solid
from warp_rigid.kernels.collide.convex_pairs import border_of, check_by_axis, cut_by_axis, is_apart
from warp_rigid.kernels.collide.distance import FAR, has_triangles, is_nearer, signed_distance
from warp_rigid.kernels.collide.samples import MUCH_DEEPER, OVERLAP, Search, gradient, place_sample
from warp_rigid.kernels.common.team import ballot, broadcast, lowest_bit, sync_warp
from warp_rigid.kernels.enums import PartKind, SampleKind
from warp_rigid.kernels.schema import PAIR_SLOTS, Bodies, Environments, History, Motions, Pairs, Shapes, State
from warp_rigid.kernels.update.predict import CONTACT_DISTANCE, smaller_size

wp.set_module_options({"enable_backward": False, "max_unroll": 4})

REUSE_TRAVEL = wp.constant(2.5e-4)
"""Pairs that have moved less than this fraction of the smaller size, half the contact distance, keep their contacts."""

TURNED_BACK = wp.constant(0.25)
"""Separating samples closer than this fraction of the pair's reach are kept: they may come back within the step."""

BY_CENTER = wp.constant(-2)
"""Identity of the contact of the first body's inscribed sphere; that of the second body is one less."""

BY_AXIS = wp.constant(-4)
"""Identity of the contact of two convex bodies along the axis of their least overlap."""

MOST_KEPT = wp.constant(PAIR_SLOTS)
"""Maximum number of contacts of a pair."""


@wp.func
def last_pair(a: int, b: int, history: History):
    """Row of the same pair in the last step, or -1."""
    for pair in range(history.pair_start[a], history.pair_start[a + 1]):
        if history.body_b[pair] == b:
            return pair
    return -1


@wp.func
def matters(kind: int, own_shape: int, shape: int, edges: int, shapes: Shapes):
    """Whether samples of a kind can contribute to a contact.

    Between convex shapes, points inside a face never touch first, and only points touch a plane first. A contact with a
    sphere is found exactly by the sample at the sphere's centre, so other samples are not needed, except those of
    shapes with a grid: their edges and corners are rounded, and their faces are needed if they are smaller than the
    sphere. The faces of nonconvex shapes are needed against capsules and cylinders too: the side of these is sampled by
    segments of the axis, which find one contact each, and a nonconvex shape may touch such a segment twice.
    """
    if kind == SampleKind.CORNER:
        return has_triangles(shapes, shape)
    if shapes.shapes[shape].convex == 0:
        return kind != SampleKind.EDGE or edges == 1
    other = shapes.parts[shapes.shapes[shape].part_start].kind
    own = shapes.parts[shapes.shapes[own_shape].part_start].kind
    if own == PartKind.HEIGHTFIELD:
        return True
    by_center = other == PartKind.SPHERE and shapes.shapes[own_shape].convex == 1
    if kind == SampleKind.POINT:
        return own == PartKind.SPHERE or not by_center
    if kind == SampleKind.EDGE:
        return edges == 1 and other != PartKind.PLANE and not by_center
    if other == PartKind.SPHERE:
        return not by_center and shapes.shapes[own_shape].size < shapes.shapes[shape].size
    return shapes.shapes[own_shape].convex == 0 and (other == PartKind.CAPSULE or other == PartKind.CYLINDER)


@wp.func
def out_of_box(p: wp.vec3, margin: float, shape: int, shapes: Shapes):
    """Whether a point is further than a margin from a shape's bounding box, a cheap bound of the distance."""
    below = shapes.shapes[shape].lower - p
    above = p - shapes.shapes[shape].upper
    return wp.max(wp.max(below), wp.max(above)) > margin


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
def cluster_is_near(cluster: int, approach: Approach, edges: int, shapes: Shapes):
    """Whether a cluster may contain a touching sample."""
    if not matters(shapes.clusters[cluster].kind, approach.own_shape, approach.shape, edges, shapes):
        return 0
    if wp.dot(approach.cut, shapes.clusters[cluster].center) - shapes.clusters[cluster].radius > approach.level:
        return 0
    center = wp.quat_rotate(approach.turn, shapes.clusters[cluster].center) + approach.shift
    margin = shapes.clusters[cluster].radius + approach.reach
    if out_of_box(center, margin, approach.shape, shapes):
        return 0
    return wp.where(is_nearer(shapes, approach.shape, center, margin), 1, 0)


@wp.func
def sample_is_near(s: int, approach: Approach, shapes: Shapes):
    """Whether a sample is close enough to the other shape's bounding box, and along the pair's axis, to touch."""
    lowest = wp.dot(approach.cut, shapes.samples[s].point) - wp.abs(wp.dot(approach.cut, shapes.samples[s].slide))
    if lowest - shapes.samples[s].radius > approach.level:
        return False
    p = wp.quat_rotate(approach.turn, shapes.samples[s].point) + approach.shift
    margin = approach.reach + shapes.samples[s].radius
    if shapes.samples[s].kind == SampleKind.EDGE:
        slide = OVERLAP * wp.quat_rotate(approach.turn, shapes.samples[s].slide)
        margin += border_of(approach.own_shape, approach.shape, shapes)
        return segment_meets_box(p, slide, margin, approach.shape, shapes)
    return not out_of_box(p, margin, approach.shape, shapes)


@wp.func
def touching(
    s: int, side: int, approach: Approach, dt: float, size: float, shapes: Shapes, state: State, motions: Motions
):
    """The contact point of a sample in the second body's frame; its gap is FAR if there is none."""
    result = Touch()
    result.gap = FAR
    if not sample_is_near(s, approach, shapes):
        return result
    placed = place_sample(shapes, s, approach.own_shape, approach.shape, approach.turn, approach.shift, approach.reach)
    if placed.distance >= approach.reach:
        return result
    touch = touch_of(placed, side, approach.other, state)
    a = wp.where(side == 0, approach.own, approach.other)
    b = wp.where(side == 0, approach.other, approach.own)
    left = closing_gap(touch, a, b, dt, state, motions) - approach.rise
    result.closing = wp.where(left < CONTACT_DISTANCE * size, 1, 0)
    if result.closing == 0 and touch.gap > TURNED_BACK * approach.reach:
        return result
    result.position = wp.quat_rotate_inv(state.orientation[b], touch.position - state.position[b])
    result.normal = wp.quat_rotate_inv(state.orientation[b], touch.normal)
    result.gap = touch.gap
    return result


@wp.func
def broadcast_touch(touch: Touch, lane: int, lanes: int):
    """The contact point of one lane, broadcast to the whole team."""
    result = Touch()
    for i in range(3):
        result.position[i] = broadcast(touch.position[i], lane, lanes)
        result.normal[i] = broadcast(touch.normal[i], lane, lanes)
    result.gap = broadcast(touch.gap, lane, lanes)
    return result


@wp.func
def try_cluster(
    cluster: int,
    pair: int,
    side: int,
    lane: int,
    lanes: int,
    approach: Approach,
    dt: float,
    size: float,
    shapes: Shapes,
    state: State,
    motions: Motions,
    pairs: Pairs,
):
    """Test the samples of a cluster, one per lane at a time. Returns 1 if one of the lane's own samples closes."""
    closing = int(0)
    end = shapes.clusters[cluster].sample_end
    for base in range(shapes.clusters[cluster].sample_start, end, lanes):
        touch = Touch()
        touch.gap = FAR
        if base + lane < end:
            touch = touching(base + lane, side, approach, dt, size, shapes, state, motions)
        closing |= touch.closing
        hits = ballot(wp.where(touch.gap < FAR, 1, 0), lanes)
        while hits != wp.uint32(0):
            k = lowest_bit(hits)
            hits = hits & (hits - wp.uint32(1))
            hit = broadcast_touch(touch, k, lanes)
            key = 2 * (base + k) + side
            offer_sample(pair, key, hit.position, hit.normal, hit.gap, approach.weight, size, lane, lanes, pairs)
    return closing


@wp.func
def has_exact_distance(shapes: Shapes, shape: int):
    """Whether the distance outside a shape is exact everywhere: it consists of analytic parts."""
    kind = shapes.parts[shapes.shapes[shape].part_start].kind
    return shapes.shapes[shape].cell == 0.0 and kind != PartKind.HEIGHTFIELD


@wp.func
def center_inside(side: int, a: int, b: int, shapes: Shapes, bodies: Bodies, state: State, motions: Motions):
    """The contact of the inner ball of a pair's first (side 0) or second (side 1) body.

    If it penetrates the other body, the two bodies overlap. That of a convex body is about its centre of mass, and any
    overlap with analytic parts counts; else its centre must be inside the other body. The gap is FAR if it is not
    known: outside a grid the distance is only a bound.
    """
    own = wp.where(side == 0, a, b)
    other = wp.where(side == 0, b, a)
    shape = bodies.shape[own]
    convex = shapes.shapes[shape].convex
    query = bodies.center_of_mass[own]
    x = motions.center[own]
    radius = float(0.0)
    evaluated = int(0)
    if convex == 0:
        query = shapes.shapes[shape].inner_center
        x = wp.quat_rotate(state.orientation[own], query) + state.position[own]
    placed = Search()
    placed.query = wp.quat_rotate_inv(state.orientation[other], x - state.position[other])
    placed.distance = FAR
    while evaluated < 2:
        # First the radius of the ball, then its distance from the other body.
        d = signed_distance(shapes, shape, query, -FAR)
        if evaluated == 1 and (
            d[3] < 0.0 or (is_solid(shapes, bodies.shape[own]) and has_exact_distance(shapes, shape))
        ):
            placed.direction = gradient(d)
            placed.distance = d[3] - radius
            placed.query -= radius * placed.direction
        elif evaluated == 0:
            radius = wp.where(convex == 1, -d[3], shapes.shapes[shape].inner_radius)
        shape = bodies.shape[other]
        query = placed.query
        evaluated = wp.where(radius > 0.0 and not out_of_box(query, radius, shape, shapes), evaluated + 1, 2)
    return touch_of(placed, side, other, state)


@wp.func
def keep_center(
    pair: int, kept: int, lane: int, shapes: Shapes, bodies: Bodies, state: State, motions: Motions, pairs: Pairs
):
    """Replace the contacts of a deep overlap by the deeper contact of the two inscribed spheres, if there is one.

    Contacts that do not oppose each other are replaced only if they show much less than the overlap.
    """
    a = pairs.body_a[pair]
    b = pairs.body_b[pair]
    replaced = kept == 0 or contradictory(pair, pairs)
    deepest = wp.where(replaced, 0.0, MUCH_DEEPER * deepest_gap(pair, pairs))
    shallowest = deepest
    side = int(0)
    while side < 2:
        touch = center_inside(side, a, b, shapes, bodies, state, motions)
        if touch.gap < deepest:
            deepest = touch.gap
            if lane == 0:
                pairs.kept[pair, 0] = BY_CENTER - side
        side += 1
    if deepest == shallowest:
        return kept
    return 1


@wp.func
def add_contact(pair: int, key: int, kept: int, lane: int, pairs: Pairs):
    """Append a contact to those of a pair, in place of the last one if there are too many. Returns their number."""
    place = wp.min(kept, MOST_KEPT - 1)
    if lane == 0:
        pairs.kept[pair, place] = key
    return place + 1


@wp.func
def look_for_contacts(
    pair: int,
    lane: int,
    lanes: int,
    dt: float,
    size: float,
    edges: int,
    shapes: Shapes,
    bodies: Bodies,
    state: State,
    motions: Motions,
    pairs: Pairs,
):
    """Test the samples of both bodies of a pair. Returns the number of contacts, 0 if no sample closes."""
    a = pairs.body_a[pair]
    b = pairs.body_b[pair]
    rise = dt * (shapes.shapes[bodies.shape[a]].rise + shapes.shapes[bodies.shape[b]].rise)
    reach = contact_reach(a, b, size, dt, state, motions) + rise
    if lane == 0:
        pairs.patch_count[pair] = 0
    sync_warp(lanes)
    closing = int(0)
    side = int(0)
    while side < 2:
        approach = approach_of(wp.where(side == 0, a, b), wp.where(side == 0, b, a), reach, bodies, state)
        approach.rise = rise
        approach.weight = gap_weight(travel(a, b, dt, 0.0, state, motions), size)
        approach = cut_by_axis(approach, pairs.axis[pair], side, shapes)
        end = shapes.shapes[approach.own_shape].cluster_end
        for base in range(shapes.shapes[approach.own_shape].cluster_start, end, lanes):
            near = int(0)
            if base + lane < end:
                near = cluster_is_near(base + lane, approach, edges, shapes)
            bits = ballot(near, lanes)
            while bits != wp.uint32(0):
                cluster = base + lowest_bit(bits)
                bits = bits & (bits - wp.uint32(1))
                closing |= try_cluster(
                    cluster, pair, side, lane, lanes, approach, dt, size, shapes, state, motions, pairs
                )
        side += 1
    sync_warp(lanes)
    closing = wp.where(ballot(closing, lanes) == wp.uint32(0), 0, 1)
    solid = edges == 1 and is_solid(shapes, bodies.shape[a]) and is_solid(shapes, bodies.shape[b])
    along = int(0)
    if solid:
        along = check_by_axis(pair, closing, lane, lanes, size, shapes, bodies, state, pairs)
        sync_warp(lanes)
    kept = int(keep_slots(pair, size, lane, lanes, pairs))
    sync_warp(lanes)
    kept *= closing
    if along == 1:
        return add_contact(pair, BY_AXIS, kept, lane, pairs)
    if not solid:
        kept = keep_center(pair, kept, lane, shapes, bodies, state, motions, pairs)
    return kept


@wp.func
def has_barely_moved(
    last: int,
    approach: Approach,
    dt: float,
    size: float,
    bodies: Bodies,
    state: State,
    motions: Motions,
    history: History,
):
    """Whether the relative pose of two bodies, now and after the step, is close to that of their last contact search.

    Samples that did not touch then had a gap above the contact distance, which is still above half of it.
    """
    moved = wp.length(approach.shift - history.searched_position[last]) + travel(
        approach.own, approach.other, dt, 0.0, state, motions
    )
    q = approach.turn
    q0 = history.searched_orientation[last]
    turned = 2.0 * wp.min(wp.length(q - q0), wp.length(q + q0))
    radius = motions.radius[approach.own] + wp.length(bodies.center_of_mass[approach.own])
    return moved + turned * radius < REUSE_TRAVEL * size


@wp.func
def reuse_contacts(pair: int, last: int, edges: int, history: History, pairs: Pairs):
    """Keep the samples of the last step's contacts, and the data of the search that found them."""
    start = history.contact_start[last]
    count = history.contact_start[last + 1] - start
    for k in range(count):
        pairs.kept[pair, k] = history.key[start + k]
    pairs.contact_count[pair] = count
    pairs.searched[pair] = edges + 1
    pairs.searched_orientation[pair] = history.searched_orientation[last]
    pairs.searched_position[pair] = history.searched_position[last]
    pairs.axis[pair] = history.axis[last]


@wp.kernel
def keep_contacts(
    woken: int,
    threads: int,
    dt: float,
    shapes: Shapes,
    bodies: Bodies,
    state: State,
    motions: Motions,
    envs: Environments,
    history: History,
    pairs: Pairs,
):
    """The threads share the pairs: keep the samples of pairs that have hardly moved, list the others for the search.

    The first round skips dormant pairs, the second one processes those that have been woken since. The order of the
    list is arbitrary, as the pairs are searched independently.
    """
    for pair in range(wp.tid(), pairs.start[pairs.start.shape[0] - 1], threads):
        a = pairs.body_a[pair]
        b = pairs.body_b[pair]
        dormant = wp.where(pairs.dormant[pair] > 0, 1, 0)
        if dormant != woken or (woken == 1 and not may_meet(motions.role[a], motions.role[b])):
            continue
        size = smaller_size(a, b, shapes, bodies)
        edges = envs.edge_samples[bodies.env[a]]
        approach = smaller_approach(pair, bodies, state, motions, pairs)
        last = last_pair(a, b, history)
        pairs.last[pair] = last
        if (
            last >= 0
            and shapes.shapes[bodies.shape[a]].rise + shapes.shapes[bodies.shape[b]].rise == 0.0
            and history.searched[last] == edges + 1
            and has_barely_moved(last, approach, dt, size, bodies, state, motions, history)
        ):
            reuse_contacts(pair, last, edges, history, pairs)
        elif not is_apart(pair, last, dt, size, shapes, bodies, state, motions, history, pairs):
            pairs.candidates[wp.atomic_add(pairs.candidate_count, 0, 1)] = pair


@wp.kernel
def search_contacts(
    teams: int,
    lanes: int,
    dt: float,
    shapes: Shapes,
    bodies: Bodies,
    state: State,
    motions: Motions,
    envs: Environments,
    pairs: Pairs,
):
    """The teams share the listed pairs: find the samples that represent a pair's contact."""
    lane = wp.tid() % lanes
    for k in range(wp.tid() / lanes, pairs.candidate_count[0], teams):
        pair = pairs.candidates[k]
        a = pairs.body_a[pair]
        size = smaller_size(a, pairs.body_b[pair], shapes, bodies)
        edges = envs.edge_samples[bodies.env[a]]
        kept = look_for_contacts(pair, lane, lanes, dt, size, edges, shapes, bodies, state, motions, pairs)
        if lane == 0:
            approach = smaller_approach(pair, bodies, state, motions, pairs)
            pairs.contact_count[pair] = kept
            pairs.searched[pair] = edges + 1
            pairs.searched_orientation[pair] = approach.turn
            pairs.searched_position[pair] = approach.shift
