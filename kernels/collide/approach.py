"""Approach of two bodies: their relative pose and motion, and the point in which they touch."""

import warp as wp

from warp_rigid.kernels.collide.contact_search import Search
from warp_rigid.kernels.enums import PartKind, Role
from warp_rigid.kernels.schema import Bodies, Motions, Pairs, Shapes, State
from warp_rigid.kernels.tuning import CONTACT_DISTANCE, NEAR_REACH, PUSHED

wp.set_module_options({"enable_backward": False, "max_unroll": 4})


@wp.struct
class Touch:
    """A contact point in the world frame. The normal points from the pair's second body to the first.

    `left`: the gap at the end of the step if the bodies move on as before. `closing`: 1 if the gap may close.
    """

    position: wp.vec3
    normal: wp.vec3
    gap: float
    left: float
    closing: int


@wp.struct
class Approach:
    """Relative pose of the body with the samples (`own`) in the frame of the body with the distance (`other`).

    `cut`, `level`: points p of `own`, in its frame, with `cut . p > level` cannot touch; a zero vector if that is not
    known of any. `motion`, `rotation`: a point p of `own`, in the frame of `other`, moves by `motion + rotation x p` in
    the step. `touching`: gap below which surfaces touch [m]. `speculative`: see `speculative_distance`. `searched`:
    gap up to which samples are searched [m]: the reach, or more where unsampled edges may be nearer. `load`: see
    `load_between`.
    """

    own: int
    other: int
    own_shape: int
    shape: int
    turn: wp.quat
    shift: wp.vec3
    reach: float
    speculative: float
    rise: float
    cut: wp.vec3
    level: float
    motion: wp.vec3
    rotation: wp.vec3
    touching: float
    searched: float
    load: wp.vec3


@wp.func
def touch_of(placed: Search, side: int, other: int, state: State):
    """The contact point in the world frame; the sample belongs to the first body on side 0, to the second on side 1."""
    result = Touch()
    turn = state.orientation[other]
    n = wp.quat_rotate(turn, placed.direction)
    middle = placed.query - 0.5 * placed.distance * placed.direction
    result.position = wp.quat_rotate(turn, middle) + state.position[other]
    result.normal = wp.where(side == 0, n, -n)
    result.gap = placed.distance
    return result


@wp.func
def velocity_at(body: int, x: wp.vec3, dt: float, state: State, motions: Motions):
    """Velocity of a body's material at world point x, after accelerating for a time dt."""
    v = state.linear_velocity[body] + dt * motions.acceleration[body]
    w = state.angular_velocity[body] + dt * motions.spin_acceleration[body]
    return v + wp.cross(w, x - motions.center[body])


@wp.func
def closing_gap(touch: Touch, a: int, b: int, dt: float, state: State, motions: Motions):
    """The gap at the end of the step if the approach continues; at most the current gap."""
    v = velocity_at(a, touch.position, dt, state, motions) - velocity_at(b, touch.position, dt, state, motions)
    return touch.gap + dt * wp.min(wp.dot(v, touch.normal), 0.0)


@wp.func
def travel(a: int, b: int, dt: float, ahead: float, state: State, motions: Motions):
    """Upper bound of the relative motion of two surfaces in a time dt, after accelerating for a time `ahead` [m]."""
    small = wp.where(motions.radius[a] < motions.radius[b], a, b)
    x = motions.center[small]
    speed = velocity_at(a, x, ahead, state, motions) - velocity_at(b, x, ahead, state, motions)
    spin = wp.length(state.angular_velocity[a] - state.angular_velocity[b]) * motions.radius[small]
    return dt * (wp.length(speed) + spin)


@wp.func
def surface_speed(b: int, state: State, motions: Motions):
    """Upper bound of the speed of a body's surface [m/s]."""
    return wp.length(state.linear_velocity[b]) + wp.length(state.angular_velocity[b]) * motions.radius[b]


@wp.func
def speculative_distance(a: int, b: int, size: float, dt: float, state: State, motions: Motions):
    """Distance by which two surfaces may approach if another body stops or deflects one of them in the step [m].

    Contacts within it let the solver stop a chain of impacts in one step. A sleeping body has none of them: only bodies
    that would touch it wake it.
    """
    if motions.role[a] == Role.ASLEEP or motions.role[b] == Role.ASLEEP:
        return 0.0
    speed = wp.max(surface_speed(a, state, motions), surface_speed(b, state, motions))
    return wp.min(PUSHED * dt * speed, NEAR_REACH * size)


@wp.func
def contact_reach(a: int, b: int, size: float, dt: float, state: State, motions: Motions):
    """Largest gap at which two surfaces can have a contact in this step [m].

    It includes their relative motion in the step. Bodies that move further than their size are first moved to their
    time of impact by continuous collision detection (ccd.py), as contact point and normal are not known from afar.
    This does not apply to pairs with a kinematic body, whose motion is never limited. It includes the speculative
    distance, too.
    """
    way = travel(a, b, dt, dt, state, motions)
    if way > size and motions.role[a] != Role.KINEMATIC and motions.role[b] != Role.KINEMATIC:
        way = NEAR_REACH * size
    return CONTACT_DISTANCE * size + wp.max(way, speculative_distance(a, b, size, dt, state, motions))


@wp.func
def load_between(a: int, b: int, frame: int, state: State, motions: Motions):
    """Sum of the accelerations of two bodies, in the frame of one of them [m/s^2].

    Bodies that stand on each other tip over that part of their contact to which it points.
    """
    return wp.quat_rotate_inv(state.orientation[frame], motions.acceleration[a] + motions.acceleration[b])


@wp.func
def approach_of(own: int, other: int, reach: float, bodies: Bodies, state: State):
    """Relative pose of `own` in the frame of `other`."""
    approach = Approach()
    approach.own = own
    approach.other = other
    approach.own_shape = bodies.shape[own]
    approach.shape = bodies.shape[other]
    back = wp.quat_inverse(state.orientation[other])
    approach.turn = back * state.orientation[own]
    approach.shift = wp.quat_rotate(back, state.position[own] - state.position[other])
    approach.reach = reach
    approach.searched = reach
    return approach


@wp.func
def dip_of(own: int, other: int, shapes: Shapes):
    """How much nearer the crossing of unsampled edges may be than the nearest of their four ends [m].

    Edges of lengths l and k, whose faces form the angles a and b, cross at most min(l tan(b / 2), k tan(a / 2)) / 2
    nearer, which is less than the geometric mean of l tan(a / 2) / 2 and k tan(b / 2) / 2. An edge of length l crosses
    the edge of a box or the rim of a cylinder at most l sin(45 degrees) / 2 nearer than its ends.
    """
    kind = shapes.parts[shapes.shapes[other].part_start].kind
    if shapes.shapes[other].convex == 1 and (kind == PartKind.BOX or kind == PartKind.CYLINDER):
        return 0.36 * shapes.shapes[own].unsampled_length
    return wp.sqrt(shapes.shapes[own].dip * shapes.shapes[other].dip)


@wp.func
def approach_from(
    side: int,
    pair: int,
    dt: float,
    size: float,
    shapes: Shapes,
    bodies: Bodies,
    state: State,
    motions: Motions,
    pairs: Pairs,
):
    """Relative pose for the samples of a pair's first (side 0) or second (side 1) body."""
    a = pairs.body_a[pair]
    b = pairs.body_b[pair]
    rise = dt * (shapes.shapes[bodies.shape[a]].rise + shapes.shapes[bodies.shape[b]].rise)
    reach = contact_reach(a, b, size, dt, state, motions) + rise
    approach = approach_of(wp.where(side == 0, a, b), wp.where(side == 0, b, a), reach, bodies, state)
    approach.rise = rise
    dip = dip_of(approach.own_shape, approach.shape, shapes)
    approach.searched = wp.max(reach, CONTACT_DISTANCE * size + dip)
    approach.speculative = speculative_distance(a, b, size, dt, state, motions)
    approach.load = load_between(a, b, approach.other, state, motions)
    return approach


@wp.func
def with_motion(approach: Approach, size: float, dt: float, state: State, motions: Motions):
    """The approach with the relative motion of its bodies in the step."""
    own = approach.own
    other = approach.other
    back = wp.quat_inverse(state.orientation[other])
    x = state.position[other]
    v = velocity_at(own, x, dt, state, motions) - velocity_at(other, x, dt, state, motions)
    w = state.angular_velocity[own] + dt * motions.spin_acceleration[own]
    w -= state.angular_velocity[other] + dt * motions.spin_acceleration[other]
    approach.motion = dt * wp.quat_rotate(back, v)
    approach.rotation = dt * wp.quat_rotate(back, w)
    approach.touching = CONTACT_DISTANCE * size + approach.rise
    return approach


@wp.func
def smaller_approach(pair: int, bodies: Bodies, state: State, motions: Motions, pairs: Pairs):
    """Relative pose of the smaller body of a pair in the frame of the larger one."""
    a = pairs.body_a[pair]
    b = pairs.body_b[pair]
    small = wp.where(motions.radius[a] < motions.radius[b], a, b)
    return approach_of(small, a + b - small, 0.0, bodies, state)
