"""Contact points of the near samples, which narrowphase.py has listed: one thread for each, whatever its pair.

Samples of different pairs need different numbers of distances. As they are in one list, no pair waits for another one,
and neighbouring threads do similar work.
"""

import warp as wp

from warp_rigid.kernels.collide.approach import (
    TURNED_BACK,
    Approach,
    Touch,
    approach_from,
    closing_gap,
    touch_of,
)
from warp_rigid.kernels.collide.distance import FAR
from warp_rigid.kernels.collide.near_samples import NARROWPHASE, NearSamples
from warp_rigid.kernels.collide.parting import CROSSED, hidden_depth, is_parting
from warp_rigid.kernels.collide.samples import Search, place_sample
from warp_rigid.kernels.common.capacity import usable_count
from warp_rigid.kernels.schema import Bodies, Motions, Pairs, Shapes, State
from warp_rigid.kernels.update.predict import CONTACT_DISTANCE, smaller_size

wp.set_module_options({"enable_backward": False, "max_unroll": 4})


@wp.func
def place_near_sample(s: int, approach: Approach, parting: bool, shapes: Shapes):
    """The contact point of a near sample; `crossing` if it is none, but inside the other body.

    Of a pair that comes apart, every sample inside is a contact.
    """
    weight = wp.where(parting, 0.0, 1.0)
    placed = Search()
    crossing = int(0)
    again = int(1)
    while again == 1:
        again = 0
        placed = place_sample(
            shapes, s, approach.own_shape, approach.shape, approach.turn, approach.shift, approach.reach, weight
        )
        if weight > 0.0 and placed.distance >= FAR and placed.least < 0.0:
            if placed.least < -hidden_depth(approach.own_shape, approach.shape, shapes):
                weight = 0.0
                crossing = 1
                again = 1
    placed.crossing = crossing
    return placed


@wp.func
def touching(
    s: int,
    side: int,
    approach: Approach,
    parting: bool,
    dt: float,
    size: float,
    shapes: Shapes,
    state: State,
    motions: Motions,
):
    """The contact point of a near sample in the second body's frame; its gap is FAR if there is none."""
    result = Touch()
    result.gap = FAR
    placed = place_near_sample(s, approach, parting, shapes)
    if placed.crossing == 1:
        if placed.distance < -hidden_depth(approach.own_shape, approach.shape, shapes):
            result.gap = placed.distance
            result.closing = CROSSED
        return result
    if placed.distance >= wp.where(parting, 0.0, approach.reach):
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


@wp.kernel(module=NARROWPHASE)
def touch_near_samples(
    which: int,
    threads: int,
    dt: float,
    shapes: Shapes,
    bodies: Bodies,
    state: State,
    motions: Motions,
    pairs: Pairs,
    turn: wp.array[int],
    near: NearSamples,
    wanted: wp.array2d[int],
):
    """The threads share the near samples: find their contact points. Record the number of samples.

    If there are more than fit, the step is void, and no sample touches.
    """
    count = usable_count(wp.tid(), which, near.count[0], near.key.shape[0], turn, wanted)
    for k in range(wp.tid(), count, threads):
        pair = near.pair[k]
        side = near.key[k] % 2
        size = smaller_size(pairs.body_a[pair], pairs.body_b[pair], shapes, bodies)
        approach = approach_from(side, pair, dt, size, shapes, bodies, state, motions, pairs)
        parting = is_parting(pair, shapes, bodies, pairs)
        touch = touching(near.key[k] / 2, side, approach, parting, dt, size, shapes, state, motions)
        if parting:
            touch.normal = pairs.axis[pair]
            touch.closing = 1
        near.position[k] = touch.position
        near.normal[k] = touch.normal
        near.gap[k] = touch.gap
        near.closing[k] = touch.closing
