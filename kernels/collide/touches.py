"""Contact points of the near samples, which narrowphase.py has listed: one thread for each, of all pairs together.

Samples of different pairs need different numbers of distances. As they are in one list, no pair waits for another one,
and neighbouring threads do similar work.
"""

import warp as wp

from warp_rigid.kernels.collide.approach import Approach, Touch, approach_from, closing_gap, touch_of, velocity_at
from warp_rigid.kernels.collide.contact_search import Search, gradient, sticks_out
from warp_rigid.kernels.collide.course import Course, closing_speed, curvature_of, place_at, placed_course
from warp_rigid.kernels.collide.distance import FAR, signed_distance
from warp_rigid.kernels.collide.edge_search import OPPOSED
from warp_rigid.kernels.collide.near_samples import NARROWPHASE, Group, NearSamples
from warp_rigid.kernels.collide.parting import Closing, hidden_depth, is_parting
from warp_rigid.kernels.collide.samples import place_sample
from warp_rigid.kernels.common.capacity import usable_count
from warp_rigid.kernels.common.sharing import Sharing, claim, finish, rows_of
from warp_rigid.kernels.common.symmetry import spin_of_surface
from warp_rigid.kernels.common.team import MOST_REGISTERS
from warp_rigid.kernels.enums import SampleKind
from warp_rigid.kernels.schema import Bodies, Motions, Pairs, Shapes, State
from warp_rigid.kernels.tuning import CLEARLY, CONTACT_DISTANCE, FURTHEST_PATH, SLOW_APPROACH, TURNED_BACK
from warp_rigid.kernels.update.predict import smaller_size

wp.set_module_options({"enable_backward": False, "max_unroll": 4})


@wp.struct
class Way:
    """The path of a sample in the frame of the other body.

    `start`: a point, the centre of a ball of the given radius, or a point of the surface. `arm`: that point from the
    centre of its body, in the world frame. `facing`: the sample's outward normal. `first`: the distance at the start.
    `step`: its motion in the step. `bend`: largest distance of that motion from the tangent at its start [m].
    """

    start: wp.vec3
    radius: float
    arm: wp.vec3
    facing: wp.vec3
    first: wp.vec4
    step: wp.vec3
    bend: float


@wp.func
def place_near_sample(s: int, approach: wp.ref[Approach], parting: bool, shapes: wp.ref[Shapes]):
    """The contact point of a near sample; `crossing` if it is none, but inside the other body.

    Of a pair that comes apart, every sample inside is a contact.
    """
    weight = wp.where(parting, 0.0, 1.0)
    placed = Search()
    crossing = int(0)
    again = int(1)
    while again == 1:
        again = 0
        placed = place_sample(s, approach, weight, shapes)
        if weight > 0.0 and placed.distance >= FAR and placed.least < 0.0:
            if placed.least < -hidden_depth(approach.own_shape, approach.shape, shapes):
                weight = 0.0
                crossing = 1
                again = 1
    placed.crossing = crossing
    return placed


@wp.func
def course_before(b: int, shapes: Shapes, bodies: Bodies, state: State, motions: Motions):
    """The motion of a body's surface in the step at its velocities before it."""
    course = placed_course(b, bodies, state, motions)
    course.linear = state.linear_velocity[b]
    course.angular = spin_of_surface(b, state.angular_velocity[b], shapes, bodies, state)
    return course


@wp.func
def way_of(
    s: int, placed: Search, approach: Approach, own: Course, other: Course, dt: float, shapes: Shapes, state: State
):
    """The path of a near sample: that of its ball if it has one, else that of the point that is nearest."""
    way = Way()
    way.facing = placed.normal
    way.start = placed.query
    if shapes.samples[s].radius > 0.0 and not sticks_out(shapes.samples[s].kind):
        way.radius = shapes.samples[s].radius
        way.facing = wp.vec3(0.0, 0.0, 0.0)
        way.start += way.radius * placed.direction
    n = placed.direction
    way.first = wp.vec4(n[0], n[1], n[2], placed.distance)
    way.arm = wp.quat_rotate(other.turn, way.start) + state.position[approach.other] - own.center
    way.step = place_at(own, other, way.arm, dt) - way.start
    way.bend = 0.5 * dt * dt * curvature_of(own, other, way.arm)
    return way


@wp.func
def is_inside_edge(s: int, placed: Search, shapes: Shapes):
    """Whether the nearest point of a sample is a point of an edge between its ends."""
    # At an end the cosine is larger. That point is a corner; points beside it would stop it at the next tile.
    across = wp.abs(wp.dot(placed.along, placed.direction)) < 0.1
    return shapes.samples[s].kind == SampleKind.EDGE and across


@wp.func
def across_edge(placed: Search, own: Course, other: Course, at: wp.vec3):
    """The motion of a body without that of the nearest point of its edge along this edge.

    `placed`: that point. `at`: position of the other body's shape.
    """
    arm = wp.quat_rotate(other.turn, placed.query) + at - own.center
    back = closing_speed(own, other, arm, placed.query, placed.along, 0.0)
    own.linear += back * wp.quat_rotate(other.turn, placed.along)
    return own


@wp.func
def beside(way: Way, placed: Search, shift: float, other: Course):
    """The path of another point of an edge, at most at its end; the distance at the start of the path is not known.

    `shift`: from the nearest point along the edge [m].
    """
    t = wp.dot(placed.query - placed.start, placed.along)
    aside = (wp.clamp(t + shift, -placed.half, placed.half) - t) * placed.along
    way.start += aside
    way.arm += wp.quat_rotate(other.turn, aside)
    way.first[3] = -FAR
    return way


@wp.func
def stays_outside(
    way: Way, own: Course, other: Course, dt: float, steps: float, allowed: float, near: float, shapes: Shapes
):
    """Whether a sample stays out of a shape for some steps, or enters it by at most `allowed`.

    The distance along a straight path lies above its tangents where the shape is convex, and along a curved way above
    parabolas. It is evaluated where the tangents at both ends of an interval meet. A sample that moves along a face has
    entered if its body lies behind that face: the corners of a box that lands flush on an equal one move along its
    sides.
    """
    left = float(0.0)
    right = float(steps)
    low = way.first[3]
    fall = dt * closing_speed(own, other, way.arm, way.start, gradient(way.first), 0.0)
    high = float(0.0)
    rise = float(0.0)
    t = wp.where(low < -allowed, 0.0, right)
    # Enough for curved surfaces.
    for _ in range(6):
        x = place_at(own, other, way.arm, wp.min(t, 1.0) * dt) + wp.max(t - 1.0, 0.0) * way.step
        d = signed_distance(shapes, other.shape, x, near)
        gap = d[3] - way.radius
        if gap < -allowed or (t > 0.0 and gap < allowed and wp.dot(gradient(d), way.facing) > OPPOSED):
            return False
        slope = wp.dot(gradient(d), way.step)
        if t < 1.0:
            slope = -dt * closing_speed(own, other, way.arm, x, gradient(d), t * dt)
        if t == 0.0 or (t < steps and slope < 0.0):
            left = t
            low = gap
            fall = -slope
        else:
            right = t
            high = gap
            rise = slope
        if t > 0.0:
            if fall <= 0.0 or rise <= 0.0:
                return True
            t = wp.clamp((low - high + fall * left + rise * right) / (fall + rise), left, right)
            bend = way.bend * wp.max((t - left) * (t - left), (right - t) * (right - t))
            if low - fall * (t - left) - bend >= -allowed:
                return True
        else:
            t = float(steps)
    return True


@wp.func
def all_stay_outside(
    sides: int,
    way: Way,
    placed: Search,
    own: Course,
    other: Course,
    dt: float,
    steps: float,
    allowed: float,
    near: float,
    shapes: Shapes,
):
    """Whether a sample stays out of a shape, and with `sides` = 1 also points to both sides of it on its edge.

    They are as far from it as it moves. The nearest point of the edge is then between them if the edge crosses one of
    the other body at 45 degrees or more.
    """
    shift = float(sides) * steps * wp.length(way.step)
    for side in range(-sides, sides + 1):
        path = way
        if side != 0:
            path = beside(way, placed, float(side) * shift, other)
        if not stays_outside(path, own, other, dt, steps, allowed, near + shift, shapes):
            return False
    return True


@wp.func
def passes_by(
    s: int,
    placed: Search,
    material_fall: float,
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
    the corner moves along the normal there, and arrives above the tile. A contact would stop it. The way is that of the
    surface at the velocities before the step, continued straight on until it clearly passes the plane of the contact.
    The side of a rolling disc does not come nearer, although its material does. The motion of an edge along itself does
    not count. When it moves across itself, another point of it may become the nearest one, so points to both sides of
    that one must miss the body, too. Bodies that can move may be pushed into the way, so their contacts are kept.

    `material_fall`: the approach in the step at the velocity of the contact point [m].
    """
    allowed = CONTACT_DISTANCE * size
    if (
        material_fall < SLOW_APPROACH * allowed
        or bodies.inverse_mass[approach.own] * bodies.inverse_mass[approach.other] > 0.0
    ):
        return False
    own = course_before(approach.own, shapes, bodies, state, motions)
    other = course_before(approach.other, shapes, bodies, state, motions)
    is_edge = is_inside_edge(s, placed, shapes)
    if is_edge:
        own = across_edge(placed, own, other, state.position[approach.other])
    way = way_of(s, placed, approach, own, other, dt, shapes, state)
    gap = placed.distance
    fall = -wp.dot(way.step, placed.direction)
    steps = wp.clamp((gap + CLEARLY * allowed) / wp.max(fall, SLOW_APPROACH * allowed), 1.0, FURTHEST_PATH)
    if gap - steps * fall > -allowed:
        # The surface does not arrive. The material does, where it runs along the surface.
        closing = dt * closing_speed(own, other, way.arm, way.start, placed.direction, 0.0)
        if material_fall < SLOW_APPROACH * allowed + closing:
            return False
        steps = 1.0
    near = way.radius + steps * wp.length(way.step)
    return all_stay_outside(wp.where(is_edge, 1, 0), way, placed, own, other, dt, steps, allowed, near, shapes)


@wp.func(inline=True)
def touching(
    s: int,
    side: int,
    approach: Approach,
    parting: bool,
    kept: bool,
    dt: float,
    size: float,
    shapes: Shapes,
    bodies: Bodies,
    state: State,
    motions: Motions,
):
    """The contact point of a near sample; its gap is FAR if there is none.

    `kept`: the sample belongs to a contact that the pair keeps, without a search.
    """
    result = Touch()
    result.gap = FAR
    placed = place_near_sample(s, approach, parting, shapes)
    touch = touch_of(placed, side, approach.other, state)
    if placed.crossing == 1:
        if not kept and placed.distance < -hidden_depth(approach.own_shape, approach.shape, shapes):
            result = touch
            result.closing = Closing.CROSSED
        return result
    if kept:
        return touch
    if placed.distance >= wp.where(parting, 0.0, approach.reach):
        return result
    a = wp.where(side == 0, approach.own, approach.other)
    b = wp.where(side == 0, approach.other, approach.own)
    result.left = closing_gap(touch, a, b, dt, state, motions) - approach.rise
    least = wp.min(result.left, touch.gap - approach.speculative)
    result.closing = wp.where(least < CONTACT_DISTANCE * size, 1, 0)
    if result.closing == 0 and touch.gap > TURNED_BACK * approach.reach:
        return result
    if not parting and approach.rise == 0.0:
        fall = (
            -wp.dot(
                velocity_at(a, touch.position, 0.0, state, motions)
                - velocity_at(b, touch.position, 0.0, state, motions),
                touch.normal,
            )
            * dt
        )
        if passes_by(s, placed, fall, approach, dt, size, shapes, bodies, state, motions):
            result.closing = 0
            return result
    result.position = touch.position
    result.normal = touch.normal
    result.gap = touch.gap
    return result


@wp.kernel(module=NARROWPHASE, cuda_max_registers=MOST_REGISTERS)
def touch_near_samples(
    woken: int,
    which: int,
    sharing: Sharing,
    dt: float,
    shapes: Shapes,
    bodies: Bodies,
    state: State,
    motions: Motions,
    pairs: Pairs,
    wanted_row: wp.array[int],
    near: NearSamples,
    wanted: wp.array2d[int],
):
    """The threads share the near samples of a launch: find their contact points. Record the number of samples.

    If there are more of searched pairs than fit, the step is void, and none of them touches. Only the second launch,
    of pairs that were `woken`, has samples before its own.
    """
    own = claim(wp.tid(), sharing)
    count = usable_count(own, which, near.count[Group.SEARCHED], near.next.shape[0], wanted_row, wanted)
    first = int(0)
    first_kept = int(0)
    if woken == 1:
        first = near.begin[Group.SEARCHED]
        first_kept = near.begin[Group.KEPT]
    searched = wp.max(count - first, 0)
    rows = rows_of(own, searched + near.count[Group.KEPT] - first_kept, sharing)
    for row in range(rows.first, rows.end, rows.stride):
        k = first + row
        if row >= searched:
            k = near.next.shape[0] + first_kept + row - searched
        if near.key[k] < 0:
            continue
        pair = near.pair[k]
        side = near.key[k] % 2
        size = smaller_size(pairs.body_a[pair], pairs.body_b[pair], shapes, bodies)
        approach = approach_from(side, pair, dt, size, shapes, bodies, state, motions, pairs)
        parting = is_parting(pair, shapes, bodies, pairs)
        kept = row >= searched
        if kept:
            approach.reach = FAR
            approach.searched = FAR
        touch = touching(near.key[k] / 2, side, approach, parting, kept, dt, size, shapes, bodies, state, motions)
        if parting:
            touch.normal = wp.quat_rotate(state.orientation[pairs.body_b[pair]], pairs.axis[pair])
            touch.closing = 1
        near.position[k] = touch.position
        near.normal[k] = touch.normal
        near.gap[k] = touch.gap
        if not kept:
            near.left[k] = touch.left
            near.closing[k] = touch.closing
    finish(own, sharing)
