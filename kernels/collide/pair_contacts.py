"""Contact choice: the touching samples of each pair are reduced to a few contacts (contact_reduction.py).

Contacts that carry a body at rest are kept as long as they touch. The reduction might replace them by samples that are
further out and do not touch, onto which the body would sink. Convex solids have few samples, of which it finds all that
carry them.

Bodies may overlap so deeply that no sample of one opposes the surface of the other, or that contact normals oppose
each other. Two convex bodies then touch along the axis of their least overlap (convex.py). Others come apart along one
direction, as long as samples that are no contacts are inside (parting.py). If there are none, the contact is made with
the largest ball inside one body, which overlaps the other body only if the bodies overlap. It also replaces contacts
that show less than a third of its overlap.

A team of lanes processes a pair.
"""

from enum import IntEnum

import warp as wp

from warp_rigid.kernels.collide.approach import Touch, load_between, smaller_approach, touch_of, travel
from warp_rigid.kernels.collide.contact_reduction import (
    Ranking,
    contradictory,
    deepest_gap,
    keep_slots,
    offer_samples,
    ranking_of,
)
from warp_rigid.kernels.collide.contact_search import Search, gradient
from warp_rigid.kernels.collide.convex import are_solid, is_solid, may_have_many_corners
from warp_rigid.kernels.collide.convex_pairs import check_by_axis
from warp_rigid.kernels.collide.culling import out_of_box
from warp_rigid.kernels.collide.distance import FAR, signed_distance
from warp_rigid.kernels.collide.near_samples import NARROWPHASE, NearSamples
from warp_rigid.kernels.collide.parting import Closing, deepest_hidden, way_out
from warp_rigid.kernels.collide.samples import MUCH_DEEPER
from warp_rigid.kernels.common.sharing import Sharing, claim, finish, rows_of
from warp_rigid.kernels.common.team import MOST_REGISTERS, ballot, broadcast_integer, lowest_bit, sync_warp
from warp_rigid.kernels.enums import PartKind
from warp_rigid.kernels.schema import PAIR_SLOTS, Bodies, Environments, History, Motions, Pairs, Shapes, State
from warp_rigid.kernels.tuning import CONTACT_DISTANCE, REUSE_TRAVEL
from warp_rigid.kernels.update.predict import smaller_size

wp.set_module_options({"enable_backward": False, "max_unroll": 4})


class ContactKey(IntEnum):
    """Identities of contacts that belong to no sample."""

    GONE = -1
    """Of one reused from the last step that no longer exists; it has no impulse."""
    BY_CENTER = -2
    """Of the first body's inscribed sphere; that of the second body is one less."""
    BY_AXIS = -4
    """Of two convex bodies along the axis of their least overlap."""


@wp.func
def touch_at(k: int, end: int, b: int, state: State, near: NearSamples):
    """The contact point of a near sample in the frame of body b.

    Its gap is FAR if there is none, and beyond the end of the batch.
    """
    touch = Touch()
    touch.gap = FAR
    if k < end:
        touch.position = wp.quat_rotate_inv(state.orientation[b], near.position[k] - state.position[b])
        touch.normal = wp.quat_rotate_inv(state.orientation[b], near.normal[k])
        touch.left = near.left[k]
        touch.closing = near.closing[k]
        if touch.closing != Closing.CROSSED:
            touch.gap = near.gap[k]
    return touch


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
        ball = shapes.balls[shapes.shapes[shape].ball_start]
        query = wp.vec3(ball[0], ball[1], ball[2])
        inner = ball[3]
        x = wp.quat_rotate(state.orientation[own], query) + state.position[own]
    placed = Search()
    placed.query = wp.quat_rotate_inv(state.orientation[other], x - state.position[other])
    placed.distance = FAR
    while evaluated < 2:
        # First the radius of the ball, then its distance from the other body.
        # The grid of a mesh may be wrong by almost a cell: its triangles decide whether the centre is inside.
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
def keep_ball(
    pair: int,
    kept: int,
    size: float,
    lane: int,
    shapes: Shapes,
    bodies: Bodies,
    state: State,
    motions: Motions,
    pairs: Pairs,
):
    """Replace the contacts of a deep overlap by that of an inner ball, if there is one.

    The largest ball of a body replaces contacts that show much less than its overlap. Contacts that oppose each other
    are kept if they show as much: a body that fits closely into a hollow one touches it on opposite sides. Contacts
    show an overlap of the contact distance at least: a ball that touches the ground as the corners do is deeper by a
    rounding error.
    """
    a = pairs.body_a[pair]
    b = pairs.body_b[pair]
    shown = wp.where(kept == 0, 0.0, wp.min(deepest_gap(pair, pairs), -CONTACT_DISTANCE * size))
    deepest = MUCH_DEEPER * shown
    key = int(0)
    side = int(0)
    while side < 2:
        touch = center_inside(side, a, b, shapes, bodies, state, motions)
        if touch.gap < deepest:
            deepest = touch.gap
            key = ContactKey.BY_CENTER - side
        side += 1
    if key == 0:
        return kept
    if lane == 0:
        pairs.kept[pair, 0] = key
    return 1


@wp.func
def add_contact(pair: int, key: int, kept: int, lane: int, pairs: Pairs):
    """Append a contact to those of a pair, in place of the last one if there are too many. Returns their number."""
    place = wp.min(kept, PAIR_SLOTS - 1)
    if lane == 0:
        pairs.kept[pair, place] = key
    return place + 1


@wp.func
def touching_place(pair: int, key: int, size: float, lane: int, lanes: int, near: NearSamples):
    """Place of the sample with a key among the near samples of a pair, -1 if it does not touch."""
    found = int(-1)
    batch = near.first[pair]
    while batch >= 0:
        end = near.end[batch]
        for k in range(batch + lane, end, lanes):
            touches = near.gap[k] < CONTACT_DISTANCE * size and near.closing[k] != Closing.CROSSED
            if touches and near.key[k] == key:
                found = k
        batch = near.next[batch]
    hits = ballot(wp.where(found >= 0, 1, 0), lanes)
    if hits == wp.uint32(0):
        return -1
    return broadcast_integer(found, lowest_bit(hits), lanes)


@wp.func
def keep_loaded(
    pair: int, chosen: int, size: float, lane: int, lanes: int, near: NearSamples, history: History, pairs: Pairs
):
    """Add the contacts that carried load in the last step and still touch, if the pair was at rest.

    Returns the number of contacts.
    """
    kept = int(chosen)
    last = pairs.last[pair]
    if last < 0 or history.searched[last] == 0:
        return kept
    for c in range(history.contact_start[last], history.contact_start[last + 1]):
        if kept < PAIR_SLOTS and history.key[c] >= 0 and wp.length_sq(history.impulse[c]) > 0.0:
            place = touching_place(pair, history.key[c], size, lane, lanes, near)
            for k in range(kept):
                if pairs.kept[pair, k] == place:
                    place = -1
            sync_warp(lanes)
            if place >= 0:
                kept = add_contact(pair, place, kept, lane, pairs)
            sync_warp(lanes)
    return kept


@wp.func
def offer_near_samples(
    pair: int, ranking: Ranking, size: float, lane: int, lanes: int, state: State, near: NearSamples, pairs: Pairs
):
    """Offer all touching samples of a pair to the slots of their patches.

    Returns 1 if one of them closes, plus CROSSED if a sample is inside the other body that is no contact.
    """
    closing = int(0)
    batch = near.first[pair]
    while batch >= 0:
        end = near.end[batch]
        for start in range(batch, end, lanes):
            touch = touch_at(start + lane, end, pairs.body_b[pair], state, near)
            closing |= touch.closing
            offer_samples(pair, start + lane, touch, ranking, size, lane, lanes, pairs)
        batch = near.next[batch]
    crossed = wp.where(ballot(closing & Closing.CROSSED, lanes) == wp.uint32(0), 0, Closing.CROSSED)
    return crossed + wp.where(ballot(closing & 1, lanes) == wp.uint32(0), 0, 1)


@wp.func
def part(
    pair: int,
    kept: int,
    crossed: int,
    lane: int,
    lanes: int,
    shapes: Shapes,
    bodies: Bodies,
    state: State,
    near: NearSamples,
    pairs: Pairs,
):
    """Begin to part a pair that overlaps where no contact shows it, or end it. Returns the number of contacts.

    It begins with the deepest sample alone, and ends when no sample is inside. The next step searches again.
    """
    axis = pairs.axis[pair]
    deepest = int(-1)
    if wp.length_sq(axis) > 0.0:
        if kept > 0:
            return kept
        axis = wp.vec3(0.0, 0.0, 0.0)
    elif crossed > 0:
        shown = wp.where(kept == 0, 0.0, deepest_gap(pair, pairs))
        shown *= wp.where(contradictory(pair, pairs), 1.0 / MUCH_DEEPER, MUCH_DEEPER)
        deepest = deepest_hidden(pair, lane, lanes, near)
        if near.gap[deepest] < shown:
            axis = way_out(pairs.body_a[pair], pairs.body_b[pair], shapes, bodies, state)
        if wp.length_sq(axis) == 0.0:
            return kept
    else:
        return kept
    sync_warp(lanes)
    if lane == 0:
        pairs.axis[pair] = axis
        pairs.searched[pair] = 0
        if deepest >= 0:
            pairs.kept[pair, 0] = deepest
    sync_warp(lanes)
    return wp.where(deepest >= 0, 1, 0)


@wp.func(inline=True)
def choose(
    pair: int,
    lane: int,
    lanes: int,
    dt: float,
    edges: int,
    shapes: Shapes,
    bodies: Bodies,
    state: State,
    motions: Motions,
    near: NearSamples,
    history: History,
    pairs: Pairs,
):
    """Choose the samples that become contacts of a pair. Returns the number of contacts, 0 if no sample closes."""
    a = pairs.body_a[pair]
    b = pairs.body_b[pair]
    size = smaller_size(a, b, shapes, bodies)
    if lane == 0:
        pairs.patch_count[pair] = 0
    sync_warp(lanes)
    turn = dt * wp.length(state.angular_velocity[a] - state.angular_velocity[b])
    corners = is_solid(shapes, bodies.shape[a]) or is_solid(shapes, bodies.shape[b])
    ranking = ranking_of(travel(a, b, dt, 0.0, state, motions), turn, size, corners)
    if may_have_many_corners(shapes, bodies.shape[a]) or may_have_many_corners(shapes, bodies.shape[b]):
        ranking.load = load_between(a, b, b, state, motions)
    offered = offer_near_samples(pair, ranking, size, lane, lanes, state, near, pairs)
    closing = offered & 1
    sync_warp(lanes)
    solid = edges == 1 and is_solid(shapes, bodies.shape[a]) and is_solid(shapes, bodies.shape[b])
    along = int(0)
    if solid:
        along = check_by_axis(pair, closing, lane, lanes, size, shapes, bodies, state, pairs)
        sync_warp(lanes)
    kept = int(keep_slots(pair, size, lane, lanes, pairs))
    sync_warp(lanes)
    if not solid:
        kept = keep_loaded(pair, kept, size, lane, lanes, near, history, pairs)
    kept *= closing
    if along == 1:
        return add_contact(pair, ContactKey.BY_AXIS, kept, lane, pairs)
    if not are_solid(bodies.shape[a], bodies.shape[b], shapes):
        kept = part(pair, kept, offered & Closing.CROSSED, lane, lanes, shapes, bodies, state, near, pairs)
    if not solid and wp.length_sq(pairs.axis[pair]) == 0.0:
        kept = keep_ball(pair, kept, size, lane, shapes, bodies, state, motions, pairs)
    return kept


@wp.kernel(module=NARROWPHASE, cuda_max_registers=MOST_REGISTERS)
def choose_contacts(
    sharing: Sharing,
    lanes: int,
    dt: float,
    shapes: Shapes,
    bodies: Bodies,
    state: State,
    motions: Motions,
    envs: Environments,
    near: NearSamples,
    history: History,
    pairs: Pairs,
):
    """The teams share the listed pairs: choose the samples that represent a pair's contact.

    Which samples those are depends on the motion, so the contacts of a moving pair are not reused when it stops.
    """
    lane = wp.tid() % lanes
    own = claim(wp.tid() / lanes, sharing)
    rows = rows_of(own, pairs.candidate_count[0], sharing)
    for k in range(rows.first, rows.end, rows.stride):
        pair = pairs.candidates[k]
        a = pairs.body_a[pair]
        b = pairs.body_b[pair]
        edges = envs.edge_samples[bodies.env[a]]
        if lane == 0:
            moves = travel(a, b, dt, 0.0, state, motions) >= REUSE_TRAVEL * smaller_size(a, b, shapes, bodies)
            pairs.searched[pair] = wp.where(moves, 0, edges + 1)
        sync_warp(lanes)
        kept = choose(pair, lane, lanes, dt, edges, shapes, bodies, state, motions, near, history, pairs)
        if lane == 0:
            approach = smaller_approach(pair, bodies, state, motions, pairs)
            pairs.contact_count[pair] = kept
            pairs.searched_orientation[pair] = approach.turn
            pairs.searched_position[pair] = approach.shift
    finish(own, sharing)
