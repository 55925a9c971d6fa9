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
from warp_rigid.kernels.collide.course import place_at, placed_course
from warp_rigid.kernels.collide.distance import FAR, signed_distance
from warp_rigid.kernels.collide.near_samples import NARROWPHASE, NearSamples
from warp_rigid.kernels.collide.parting import CROSSED, hidden_depth, is_parting
from warp_rigid.kernels.collide.samples import Search, gradient, place_sample
from warp_rigid.kernels.common.capacity import usable_count
from warp_rigid.kernels.common.sharing import Sharing, claim, finish, rows_of
from warp_rigid.kernels.schema import Bodies, Motions, Pairs, Shapes, State
from warp_rigid.kernels.update.predict import CONTACT_DISTANCE, smaller_size

wp.set_module_options({"enable_backward": False, "max_unroll": 4})

CLEARLY = wp.constant(3.0)
"""A sample clearly enters a face if it is deeper than this many contact distances."""

FURTHEST = wp.constant(16.0)
"""The way of a step is continued at most by this factor."""

SLOW = wp.constant(0.01)
"""Samples that approach by less than this many contact distances in a step touch without further tests."""

ROUNDS = wp.constant(6)
"""Maximum number of distances along a way. They are enough for curved surfaces."""


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
def course_before(b: int, bodies: Bodies, state: State, motions: Motions):
    """The motion of a body in the step at its velocities before it."""
    course = placed_course(b, bodies, state, motions)
    course.linear = state.linear_velocity[b]
    course.angular = state.angular_velocity[b]
    return course


@wp.func
def stays_outside(p: wp.vec3, way: wp.vec3, start: wp.vec4, allowed: float, shape: int, shapes: Shapes):
    """Whether a point that moves from p along `way` stays out of a shape, or enters it by at most `allowed`.

    The distance along the way lies above its tangents where the shape is convex: it is evaluated where the tangents at
    both ends of an interval meet. `start`: the distance at p.
    """
    left = float(0.0)
    right = float(1.0)
    low = start
    high = start
    t = wp.where(start[3] < -allowed, 0.0, 1.0)
    for _round in range(ROUNDS):
        d = signed_distance(shapes, shape, p + t * way, wp.length(way))
        if d[3] < -allowed:
            return False
        slope = wp.dot(gradient(d), way)
        if t == 0.0 or (t < 1.0 and slope < 0.0):
            left = t
            low = d
        else:
            right = t
            high = d
        if t > 0.0:
            fall = -wp.dot(gradient(low), way)
            rise = wp.dot(gradient(high), way)
            if fall <= 0.0 or rise <= 0.0:
                return True
            t = (low[3] - high[3] + fall * left + rise * right) / (fall + rise)
            if low[3] - fall * (t - left) >= -allowed:
                return True
        else:
            t = float(1.0)
    return True


@wp.func
def passes_by(
    placed: Search,
    approach: Approach,
    dt: float,
    size: float,
    shapes: Shapes,
    bodies: Bodies,
    state: State,
    motions: Motions,
):
    """Whether a sample that approaches the nearest point of an immovable body nevertheless misses that body.

    An example is a corner that slides towards the next tile of a floor: the nearest point is on the edge of the tile,
    the corner moves along the normal there, and arrives above the tile. A contact would stop it. The way is that at the
    velocities before the step, continued until it clearly passes the plane of the contact. A body that can move may be
    pushed into the way within the step, so its contacts are kept.
    """
    if bodies.inverse_mass[approach.own] * bodies.inverse_mass[approach.other] > 0.0:
        return False
    allowed = CONTACT_DISTANCE * size
    own = course_before(approach.own, bodies, state, motions)
    other = course_before(approach.other, bodies, state, motions)
    arm = wp.quat_rotate(other.turn, placed.query) + state.position[approach.other] - own.center
    way = place_at(own, other, arm, dt) - placed.query
    fall = -wp.dot(way, placed.direction)
    if fall < SLOW * allowed:
        return False
    further = wp.clamp((placed.distance + CLEARLY * allowed) / fall, 1.0, FURTHEST)
    if placed.distance - further * fall > -allowed:
        return False
    n = placed.direction
    start = wp.vec4(n[0], n[1], n[2], placed.distance)
    return stays_outside(placed.query, further * way, start, allowed, approach.shape, shapes)


@wp.func
def touching(
    s: int,
    side: int,
    approach: Approach,
    parting: bool,
    dt: float,
    size: float,
    shapes: Shapes,
    bodies: Bodies,
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
    result.left = closing_gap(touch, a, b, dt, state, motions) - approach.rise
    least = wp.min(result.left, touch.gap - approach.speculative)
    result.closing = wp.where(least < CONTACT_DISTANCE * size, 1, 0)
    if result.closing == 0 and touch.gap > TURNED_BACK * approach.reach:
        return result
    if not parting and approach.rise == 0.0 and passes_by(placed, approach, dt, size, shapes, bodies, state, motions):
        result.closing = 0
        return result
    result.position = wp.quat_rotate_inv(state.orientation[b], touch.position - state.position[b])
    result.normal = wp.quat_rotate_inv(state.orientation[b], touch.normal)
    result.gap = touch.gap
    return result


@wp.kernel(module=NARROWPHASE)
def touch_near_samples(
    which: int,
    sharing: Sharing,
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
    own = claim(wp.tid(), sharing)
    count = usable_count(own, which, near.count[0], near.key.shape[0], turn, wanted)
    rows = rows_of(own, count, sharing)
    for k in range(rows.first, rows.end, rows.stride):
        pair = near.pair[k]
        side = near.key[k] % 2
        size = smaller_size(pairs.body_a[pair], pairs.body_b[pair], shapes, bodies)
        approach = approach_from(side, pair, dt, size, shapes, bodies, state, motions, pairs)
        parting = is_parting(pair, shapes, bodies, pairs)
        touch = touching(near.key[k] / 2, side, approach, parting, dt, size, shapes, bodies, state, motions)
        if parting:
            touch.normal = pairs.axis[pair]
            touch.closing = 1
        near.position[k] = touch.position
        near.normal[k] = touch.normal
        near.gap[k] = touch.gap
        near.left[k] = touch.left
        near.closing[k] = touch.closing
    finish(own, sharing)
