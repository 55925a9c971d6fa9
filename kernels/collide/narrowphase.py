"""Narrow phase: finds the surface samples of each body that touch the other, and reduces them to a few contacts.

Both directions are tested: samples of A against the distance of B, and samples of B against the distance of A. A
cluster of samples is skipped if the distance at its centre exceeds its radius plus the reach. A sample touches if its
gap at the end of the step, predicted from the relative velocity, is below the contact distance, and if its outward
normal opposes the gradient of the distance. If one sample touches, nearby samples that move away are contacts too: a
body that lands on a corner may rotate back onto them within the step.

Contacts are reduced while they are found (contact_reduction.py).

Bodies may overlap so deeply that no sample of one opposes the surface of the other, or that contact normals oppose
each other. Two convex bodies then touch along the axis of their least overlap (convex.py). Otherwise the contact is
made with the largest ball inside one body, which overlaps the other body only if the bodies overlap, or between a ball
inside one body and a ball inside the other (ball_pairs.py). It also replaces contacts that show less than a third of
its overlap.

A team of lanes processes a pair. The lanes test clusters in parallel, then the samples of each near cluster. Samples
that are near are queued, and tested together when there is one for each lane: this takes most of the time. Touching
samples are broadcast to all lanes in sample order, and each lane updates its own slots.
"""

import warp as wp

from warp_rigid.kernels.collide.approach import (
    TURNED_BACK,
    Approach,
    Touch,
    approach_of,
    closing_gap,
    contact_reach,
    smaller_approach,
    touch_of,
    travel,
    with_motion,
)
from warp_rigid.kernels.collide.ball_pairs import ball_of, deepest_balls
from warp_rigid.kernels.collide.broadphase import may_meet
from warp_rigid.kernels.collide.contact_reduction import (
    contradictory,
    deepest_gap,
    gap_weight,
    keep_slots,
    offer_sample,
)
from warp_rigid.kernels.collide.convex import is_solid
from warp_rigid.kernels.collide.convex_pairs import check_by_axis, cut_by_axis, is_apart
from warp_rigid.kernels.collide.culling import SampleQueue, has_samples, out_of_box, queue_samples, test_clusters
from warp_rigid.kernels.collide.distance import FAR, signed_distance
from warp_rigid.kernels.collide.samples import MUCH_DEEPER, Search, gradient, place_sample
from warp_rigid.kernels.common.team import ballot, broadcast, broadcast_integer, lowest_bit, sync_warp
from warp_rigid.kernels.enums import PartKind
from warp_rigid.kernels.schema import PAIR_SLOTS, Bodies, Environments, History, Motions, Pairs, Shapes, State
from warp_rigid.kernels.update.predict import CONTACT_DISTANCE, smaller_size

wp.set_module_options({"enable_backward": False, "max_unroll": 4})

REUSE_TRAVEL = wp.constant(2.5e-4)
"""Pairs that have moved less than this fraction of the smaller size, half the contact distance, keep their contacts."""

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
def touching(
    s: int, side: int, approach: Approach, dt: float, size: float, shapes: Shapes, state: State, motions: Motions
):
    """The contact point of a near sample in the second body's frame; its gap is FAR if there is none."""
    result = Touch()
    result.gap = FAR
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
def approach_from(side: int, pair: int, reach: float, rise: float, bodies: Bodies, state: State, pairs: Pairs):
    """Relative pose for the samples of a pair's first (side 0) or second (side 1) body."""
    a = pairs.body_a[pair]
    b = pairs.body_b[pair]
    approach = approach_of(wp.where(side == 0, a, b), wp.where(side == 0, b, a), reach, bodies, state)
    approach.rise = rise
    return approach


@wp.func
def touch_queued(
    queue: SampleQueue,
    pair: int,
    lane: int,
    reach: float,
    rise: float,
    dt: float,
    size: float,
    shapes: Shapes,
    bodies: Bodies,
    state: State,
    motions: Motions,
    pairs: Pairs,
):
    """The contact point of the lane's queued sample; its gap is FAR if there is none."""
    touch = Touch()
    touch.gap = FAR
    if lane < queue.queued:
        side = queue.key % 2
        approach = approach_from(side, pair, reach, rise, bodies, state, pairs)
        touch = touching(queue.key / 2, side, approach, dt, size, shapes, state, motions)
    return touch


@wp.func
def offer_touches(pair: int, key: int, touch: Touch, weight: float, size: float, lane: int, lanes: int, pairs: Pairs):
    """Offer the contact points of all lanes to the slots of their patches, in the order of the lanes."""
    hits = ballot(wp.where(touch.gap < FAR, 1, 0), lanes)
    while hits != wp.uint32(0):
        k = lowest_bit(hits)
        hits = hits & (hits - wp.uint32(1))
        hit = broadcast_touch(touch, k, lanes)
        own_key = broadcast_integer(key, k, lanes)
        offer_sample(pair, own_key, hit.position, hit.normal, hit.gap, weight, size, lane, lanes, pairs)


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
    inner = float(0.0)
    radius = float(0.0)
    evaluated = int(0)
    if convex == 0:
        ball = ball_of(0, shape, shapes)
        query = wp.vec3(ball[0], ball[1], ball[2])
        inner = ball[3]
        x = wp.quat_rotate(state.orientation[own], query) + state.position[own]
    placed = Search()
    placed.query = wp.quat_rotate_inv(state.orientation[other], x - state.position[other])
    placed.distance = FAR
    while evaluated < 2:
        # First the radius of the ball, then its distance from the other body.
        # The grid of a mesh may be wrong by almost a cell: its triangles tell whether the centre is inside.
        d = signed_distance(shapes, shape, query, wp.where(evaluated == 1, 0.0, -FAR))
        if evaluated == 1 and (
            d[3] < 0.0 or (is_solid(shapes, bodies.shape[own]) and has_exact_distance(shapes, shape))
        ):
            placed.direction = gradient(d)
            placed.distance = d[3] - radius
            placed.query -= radius * placed.direction
        elif evaluated == 0:
            radius = wp.where(convex == 1, -d[3], inner)
        shape = bodies.shape[other]
        query = placed.query
        evaluated = wp.where(radius > 0.0 and not out_of_box(query, radius, shape, shapes), evaluated + 1, 2)
    return touch_of(placed, side, other, state)


@wp.func
def keep_balls(
    pair: int,
    kept: int,
    size: float,
    lane: int,
    lanes: int,
    shapes: Shapes,
    bodies: Bodies,
    state: State,
    motions: Motions,
    pairs: Pairs,
):
    """Replace the contacts of a deep overlap by that of an inner ball, if there is one.

    The largest ball of a body replaces contacts that show much less than its overlap or, if they oppose each other, not
    much more. Two balls replace whatever shows much less than their overlap. Contacts show an overlap of the contact
    distance at least: a ball that touches the ground as the corners do is deeper by a rounding error.
    """
    a = pairs.body_a[pair]
    b = pairs.body_b[pair]
    shown = wp.where(kept == 0, 0.0, wp.min(deepest_gap(pair, pairs), -CONTACT_DISTANCE * size))
    deepest = wp.where(contradictory(pair, pairs), 1.0 / MUCH_DEEPER, MUCH_DEEPER) * shown
    key = int(0)
    side = int(0)
    while side < 2:
        touch = center_inside(side, a, b, shapes, bodies, state, motions)
        if touch.gap < deepest:
            deepest = touch.gap
            key = BY_CENTER - side
        side += 1
    shown = wp.where(key == 0, shown, deepest)
    found = deepest_balls(a, b, MUCH_DEEPER * shown, lane, lanes, shapes, bodies, state)
    key = wp.where(found == 0, key, found)
    if key == 0:
        return kept
    if lane == 0:
        pairs.kept[pair, 0] = key
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
    weight = gap_weight(travel(a, b, dt, 0.0, state, motions), size)
    closing = int(0)
    axis = pairs.axis[pair]
    approach = with_motion(approach_from(0, pair, reach, rise, bodies, state, pairs), size, dt, state, motions)
    approach = cut_by_axis(approach, axis, 0, shapes)
    queue = SampleQueue()
    queue.group = shapes.shapes[approach.own_shape].cluster_start
    while queue.side < 2:
        queue.queued = 0
        while queue.side < 2 and queue.queued < lanes:
            if has_samples(queue):
                queue = queue_samples(queue, lane, lanes, approach, shapes)
            elif queue.group < shapes.shapes[approach.own_shape].cluster_end:
                queue = test_clusters(queue, lane, lanes, approach, edges, shapes)
            else:
                queue.side += 1
                approach = approach_from(1, pair, reach, rise, bodies, state, pairs)
                approach = cut_by_axis(with_motion(approach, size, dt, state, motions), axis, 1, shapes)
                queue.group = shapes.shapes[approach.own_shape].cluster_start
        touch = touch_queued(queue, pair, lane, reach, rise, dt, size, shapes, bodies, state, motions, pairs)
        closing |= touch.closing
        offer_touches(pair, queue.key, touch, weight, size, lane, lanes, pairs)
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
        kept = keep_balls(pair, kept, size, lane, lanes, shapes, bodies, state, motions, pairs)
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
