"""Narrow phase: lists the surface samples of each body that are near enough to the other to touch it in this step.

Both directions are tested: samples of A against the distance of B, and samples of B against the distance of A. A
cluster of samples is skipped if the distance at its centre exceeds its radius plus the reach. Then the contact points
of the near samples are found (touches.py): a sample touches if its gap at the end of the step, predicted from the
relative velocity, is below the contact distance or its gap is below the speculative distance (approach.py), and if its
outward normal opposes the gradient of the distance, unless it then passes by an immovable body. If one sample touches,
nearby samples that move away are contacts too: a body that lands on a corner may rotate back onto them within the step.
At last, contacts are chosen among the touching samples (pair_contacts.py).

A team of lanes processes a pair. The lanes test clusters in parallel, then the samples of each near cluster. Teams do
not search contact points, as pairs would wait for the one that needs most distances.
"""

import warp as wp

from warp_rigid.kernels.collide.approach import (
    Approach,
    approach_from,
    smaller_approach,
    speculative_distance,
    travel,
    with_motion,
)
from warp_rigid.kernels.collide.broadphase import may_meet
from warp_rigid.kernels.collide.convex_pairs import cut_by_axis, is_apart
from warp_rigid.kernels.collide.culling import cluster_is_near, sample_is_near
from warp_rigid.kernels.collide.near_samples import Group, NearSamples
from warp_rigid.kernels.common.sharing import Sharing, claim, finish, rows_of
from warp_rigid.kernels.common.team import (
    MOST_REGISTERS,
    ballot,
    bits_below,
    broadcast_integer,
    lowest_bit,
    next_place,
    sync_warp,
    take_places,
    take_together,
)
from warp_rigid.kernels.schema import PAIR_SLOTS, Bodies, Environments, History, Motions, Pairs, Shapes, State
from warp_rigid.kernels.shape_arrays import read_cluster
from warp_rigid.kernels.tuning import REUSE_TRAVEL
from warp_rigid.kernels.update.predict import smaller_size

wp.set_module_options({"enable_backward": False, "max_unroll": 4})


@wp.func
def last_pair(a: int, b: int, history: History):
    """Row of the same pair in the last step, or -1."""
    for pair in range(history.pair_start[a], history.pair_start[a + 1]):
        if history.body_b[pair] == b:
            return pair
    return -1


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
def may_be_pushed_together(
    last: int, a: int, b: int, dt: float, size: float, state: State, motions: Motions, history: History
):
    """Whether two bodies had no contact, but move, if together: another body may stop one of them."""
    if history.contact_start[last + 1] > history.contact_start[last]:
        return False
    return speculative_distance(a, b, size, dt, state, motions) > REUSE_TRAVEL * size


@wp.func
def reuse_contacts(pair: int, last: int, edges: int, history: History, pairs: Pairs, near: NearSamples):
    """List the samples of the last step's contacts, and keep the data of the search that found them.

    There is room for them, as for the contacts of the last step.
    """
    start = history.contact_start[last]
    count = history.contact_start[last + 1] - start
    begin = near.next.shape[0] + take_together(near.count, Group.KEPT, count)
    for k in range(count):
        key = history.key[start + k]
        near.pair[begin + k] = pair
        near.key[begin + k] = key
        pairs.kept[pair, k] = wp.where(key < 0, key, begin + k)
    pairs.contact_count[pair] = count
    pairs.searched[pair] = edges + 1
    pairs.searched_orientation[pair] = history.searched_orientation[last]
    pairs.searched_position[pair] = history.searched_position[last]
    pairs.axis[pair] = history.axis[last]


@wp.func
def note_no_search(pair: int, pairs: Pairs):
    """Note that a pair was not searched in this step; its contacts of an earlier one are not to be reused."""
    pairs.searched[pair] = 0
    pairs.searched_orientation[pair] = wp.quat()
    pairs.searched_position[pair] = wp.vec3()


@wp.kernel
def keep_contacts(
    woken: int,
    sharing: Sharing,
    dt: float,
    shapes: Shapes,
    bodies: Bodies,
    state: State,
    motions: Motions,
    envs: Environments,
    history: History,
    pairs: Pairs,
    near: NearSamples,
):
    """The threads share the pairs: keep the samples of pairs that have hardly moved, list the others for the search.

    The first launch skips dormant pairs, the second one processes those that have been woken since. The order of the
    list is arbitrary, as the pairs are searched independently.
    """
    own = claim(wp.tid(), sharing)
    rows = rows_of(own, pairs.start[pairs.start.shape[0] - 1], sharing)
    for pair in range(rows.first, rows.end, rows.stride):
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
            and not may_be_pushed_together(last, a, b, dt, size, state, motions, history)
        ):
            reuse_contacts(pair, last, edges, history, pairs, near)
        elif is_apart(pair, last, dt, size, shapes, bodies, state, motions, history, pairs):
            note_no_search(pair, pairs)
        else:
            pairs.candidates[next_place(pairs.candidate_count, 0)] = pair
    finish(own, sharing)


@wp.func
def store_batch(pair: int, listed: int, before: int, lane: int, lanes: int, pairs: Pairs, near: NearSamples):
    """Append the samples that a pair has listed, as the batch that follows the one at `before`. Returns its place.

    Samples that do not fit are only counted.
    """
    sync_warp(lanes)
    begin = int(0)
    if lane == 0:
        begin = take_places(near.count, Group.SEARCHED, listed)
    begin = broadcast_integer(begin, 0, lanes)
    if begin < 0 or begin + listed > near.next.shape[0]:
        return before
    if lane == 0:
        near.end[begin] = begin + listed
        near.next[begin] = -1
        if before < 0:
            near.first[pair] = begin
        else:
            near.next[before] = begin
    for k in range(lane, listed, lanes):
        near.pair[begin + k] = pair
        near.key[begin + k] = pairs.kept[pair, k]
    sync_warp(lanes)
    return begin


@wp.struct
class Listing:
    """Samples that a pair has listed in `Pairs.kept`, and the place of its last batch; -1 if it has none."""

    listed: int
    batch: int


@wp.func
def list_cluster(
    pair: int,
    side: int,
    cluster: int,
    lane: int,
    lanes: int,
    approach: Approach,
    listing: Listing,
    shapes: Shapes,
    pairs: Pairs,
    near: NearSamples,
):
    """List the near samples of a cluster."""
    listed = read_cluster(cluster, shapes.clusters)
    end = listed.sample_end
    for start in range(listed.sample_start, end, lanes):
        s = start + lane
        hit = int(0)
        if s < end and sample_is_near(s, approach, shapes):
            hit = 1
        hits = ballot(hit, lanes)
        count = bits_below(hits, 32)
        if listing.listed + count > PAIR_SLOTS:
            listing.batch = store_batch(pair, listing.listed, listing.batch, lane, lanes, pairs, near)
            listing.listed = 0
        if hit == 1:
            pairs.kept[pair, listing.listed + bits_below(hits, lane)] = 2 * s + side
        listing.listed += count
    return listing


@wp.kernel(cuda_max_registers=MOST_REGISTERS)
def list_near_samples(
    sharing: Sharing,
    lanes: int,
    dt: float,
    shapes: Shapes,
    bodies: Bodies,
    state: State,
    motions: Motions,
    envs: Environments,
    pairs: Pairs,
    near: NearSamples,
):
    """The teams share the listed pairs: list the samples of both bodies that may touch, in their order."""
    lane = wp.tid() % lanes
    own = claim(wp.tid() / lanes, sharing)
    rows = rows_of(own, pairs.candidate_count[0], sharing)
    for k in range(rows.first, rows.end, rows.stride):
        pair = pairs.candidates[k]
        size = smaller_size(pairs.body_a[pair], pairs.body_b[pair], shapes, bodies)
        edges = envs.edge_samples[bodies.env[pairs.body_a[pair]]]
        listing = Listing()
        listing.batch = -1
        if lane == 0:
            near.first[pair] = -1
        side = int(0)
        while side < 2:
            approach = approach_from(side, pair, dt, size, shapes, bodies, state, motions, pairs)
            approach = with_motion(approach, size, dt, state, motions)
            approach = cut_by_axis(approach, pairs.axis[pair], side, shapes)
            end = shapes.shapes[approach.own_shape].cluster_end
            for start in range(shapes.shapes[approach.own_shape].cluster_start, end, lanes):
                close = int(0)
                if start + lane < end:
                    close = cluster_is_near(start + lane, approach, edges, shapes)
                clusters = ballot(close, lanes)
                while clusters != wp.uint32(0):
                    cluster = start + lowest_bit(clusters)
                    clusters = clusters & (clusters - wp.uint32(1))
                    listing = list_cluster(pair, side, cluster, lane, lanes, approach, listing, shapes, pairs, near)
            side += 1
        if listing.listed > 0:
            store_batch(pair, listing.listed, listing.batch, lane, lanes, pairs, near)
    finish(own, sharing)
