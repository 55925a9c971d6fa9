"""Third stage: which surface samples of one body touch the other, and which few of them represent the contact.

Both directions are tried: samples of A in the distance of B and samples of B in that of A. A cluster of samples is
passed over when the distance at its centre exceeds its reach. A sample touches if its gap, less what its velocity
closes within the step, is below the contact distance, and if its own outward normal opposes the distance's gradient.

Contacts are thinned while they are found. Touching samples are sorted into patches of like normal; a patch keeps the
furthest sample in each of eight fixed directions of its tangent plane, and the deepest. What carries a load at all
carries it with its convex hull, so nothing is lost; ties go to the first sample, so identities persist.
"""

import warp as wp

from warp_rigid.kernels.data import (
    EXTREME_DIRECTIONS,
    PAIR_SLOTS,
    PATCH_SLOTS,
    PATCHES,
    Bodies,
    Environments,
    Motions,
    Pairs,
    Shapes,
    State,
)
from warp_rigid.kernels.distance import BORDER, FAR, PLANE, SPHERE, contact_distance, direction_or_up, signed_distance
from warp_rigid.kernels.predict import CONTACT_DISTANCE
from warp_rigid.kernels.tangents import tangent_of

wp.set_module_options({"enable_backward": False})

POINT = wp.constant(0)
EDGE = wp.constant(1)
RIM = wp.constant(2)
FACE = wp.constant(3)

DIRECTIONS = wp.constant(EXTREME_DIRECTIONS)
SLOTS = wp.constant(PATCH_SLOTS)
MOST_PATCHES = wp.constant(PATCHES)
MOST_SLOTS = wp.constant(PAIR_SLOTS)

CAP = wp.constant(4)

OPPOSED = wp.constant(0.1)
"""A vertex or edge counts only if its normal's cosine with the contact normal is below this: their cones are wide."""

SAME_PATCH = wp.constant(0.94)
"""Cosine (20 degrees) above which two contact normals belong to one patch."""

GAP_WEIGHT = wp.constant(20.0)
"""How much nearer in the tangent plane a sample counts for each metre of gap: those that touch come first."""

TIE = wp.constant(1.0e-5)
"""A later sample must be better by this part of the size to replace an earlier one."""

EIGHTH_TURN = wp.constant(0.70710678)
"""Sine and cosine of the angle between neighbouring directions of a patch."""

OVERLAP = wp.constant(1.05)
"""Edge segments are searched this much longer than they are."""

BEYOND = wp.constant(1.01)
"""What is found further out than this many half-lengths belongs to the next segment, or lies past the edge's end."""

STEEP = wp.constant(0.05)
"""Slope beyond which an edge crosses another and does not lie along it."""

FLAT = wp.constant(0.01)
"""Slope of the distance along an edge below which the edge lies flat."""


@wp.struct
class Sample:
    """A sample brought to its touching place, in the frame of the other body's shape."""

    point: wp.vec3
    direction: wp.vec3
    gap: float


@wp.struct
class Touch:
    """A touching place in the world. The normal points from the pair's second body to the first."""

    position: wp.vec3
    normal: wp.vec3
    gap: float


@wp.struct
class EdgeTouch:
    """Where an edge touches a shape: point, unit direction and distance, FAR if nowhere near."""

    point: wp.vec3
    direction: wp.vec3
    distance: float
    crossing: int


@wp.func
def lowest_on_edge(shapes: Shapes, shape: int, p: wp.vec3, slide: wp.vec3, reach: float):
    """Where on the segment p +- slide an edge touches between its ends.

    That is the distance's inner minimum, or, for an edge that lies flat, the place where it leaves the face. In both
    cases the slope along the edge jumps there, from s1 with the gradient g1 to s2 with g2. The tangents at both ends
    meet below the curve; their meeting point replaces the end on its side: exact at once where two straight edges cross
    and the distance is a V. Neighbouring segments overlap a little, so that nothing falls between them.

    On a convex shape the direction is the mixture s2 g1 - s1 g2 without slope along the edge: perpendicular to both
    crossing edges. Along it the edge is d / (g1 . n) away where both faces are d away.
    """
    result = EdgeTouch()
    result.distance = FAR
    half = wp.length(slide)
    along = slide / half
    middle = signed_distance(shapes, shape, p)
    if middle[3] > OVERLAP * half + reach:
        return result
    left = -OVERLAP * half
    right = OVERLAP * half
    low = signed_distance(shapes, shape, p + left * along)
    high = signed_distance(shapes, shape, p + right * along)
    slope_low = slope(low, along)
    slope_high = slope(high, along)
    if slope_low > FLAT or slope_high < -FLAT or slope_high - slope_low < 2.0 * FLAT:
        return result
    turning = 0.5 * (wp.min(slope_low + FLAT, 0.0) + wp.max(slope_high - FLAT, 0.0))
    if slope_low < -STEEP and slope_high > STEEP:
        turning = 0.0
    g = wp.vec3(low[0], low[1], low[2])
    mixture = wp.max(slope_high, 0.0) * g + wp.max(-slope_low, 0.0) * wp.vec3(high[0], high[1], high[2])
    t = float(0.0)
    for _ in range(5):
        t = (low[3] - high[3] + slope_high * right - slope_low * left) / wp.max(slope_high - slope_low, 1.0e-6)
        t = wp.clamp(t, left, right)
        here = signed_distance(shapes, shape, p + t * along)
        result.distance = here[3]
        result.direction = wp.vec3(here[0], here[1], here[2])
        if slope(here, along) < turning:
            left = t
            low = here
            slope_low = slope(here, along)
        else:
            right = t
            high = here
            slope_high = slope(here, along)
    if wp.abs(t) > half:
        if wp.abs(t) > BEYOND * half:
            result.distance = FAR
            return result
        t = wp.clamp(t, -half, half)
        here = signed_distance(shapes, shape, p + t * along)
        result.distance = here[3]
    result.point = p + t * along
    result.crossing = wp.where(turning == 0.0, 1, 0)
    if shapes.shapes[shape].convex == 1 and result.crossing == 1:
        result.direction = direction_or_up(mixture)
        if result.distance < 0.0:
            result.distance = result.distance / wp.max(wp.dot(g, result.direction), 0.3)
    return result


@wp.func
def slope(d: wp.vec4, along: wp.vec3):
    """Slope of a distance along a direction."""
    return d[0] * along[0] + d[1] * along[1] + d[2] * along[2]


@wp.func
def lowest_on_rim(shapes: Shapes, shape: int, center: wp.vec3, axis: wp.vec3, radius: float):
    """The deepest point of a circle: vec4(point, distance); FAR where the circle lies flat on the surface."""
    p = center
    d = wp.vec4(0.0, 0.0, 1.0, 0.0)
    for _ in range(3):
        d = signed_distance(shapes, shape, p)
        n = wp.vec3(d[0], d[1], d[2])
        down = wp.dot(n, axis) * axis - n
        if wp.length(down) < 0.05:
            return wp.vec4(0.0, 0.0, 0.0, FAR)
        p = center + radius * wp.normalize(down)
    d = signed_distance(shapes, shape, p)
    return wp.vec4(p[0], p[1], p[2], d[3])


@wp.func
def ball_touch(shapes: Shapes, shape: int, center: wp.vec3, radius: float):
    """Distance from a ball's surface to a shape, at the ball's deepest point.

    Beyond a grid the distance is only a bound, and a ball's centre may lie there; its deepest point does not.
    """
    d = signed_distance(shapes, shape, center)
    if shapes.shapes[shape].convex == 1:
        return wp.vec4(d[0], d[1], d[2], d[3] - radius)
    for _ in range(4):
        d = signed_distance(shapes, shape, center - radius * wp.vec3(d[0], d[1], d[2]))
    return d


@wp.func
def place_sample(shapes: Shapes, s: int, shape: int, turn: wp.quat, shift: wp.vec3, reach: float):
    """Bring sample s to its touching place; turn and shift map its shape's frame to that of the other `shape`.

    What is further than `reach` from the shape may be told as infinitely far. An edge that ends at a face without
    leaving it is no contact: its distance to the faces that it opposes is not its distance.
    """
    result = Sample()
    result.gap = FAR
    p = wp.quat_rotate(turn, shapes.samples[s].point) + shift
    normal = wp.quat_rotate(turn, shapes.samples[s].normal)
    radius = shapes.samples[s].radius
    kind = shapes.samples[s].kind
    d = wp.vec4(0.0, 0.0, 1.0, FAR)
    if kind == EDGE:
        edge = lowest_on_edge(shapes, shape, p, wp.quat_rotate(turn, shapes.samples[s].slide), radius + reach)
        p = edge.point - radius * edge.direction
        d = wp.vec4(edge.direction[0], edge.direction[1], edge.direction[2], edge.distance - radius)
        if edge.crossing == 0 and edge.distance < FAR:
            d = contact_distance(shapes, shape, p, normal)
            if d[3] < edge.distance - radius - BORDER * shapes.shapes[shape].size:
                d[3] = FAR
    elif kind == RIM:
        found = lowest_on_rim(shapes, shape, p, normal, radius)
        if found[3] < FAR:
            normal = direction_or_up(wp.vec3(found[0], found[1], found[2]) - p)
            p = wp.vec3(found[0], found[1], found[2])
            d = contact_distance(shapes, shape, p, normal)
    elif radius > 0.0:
        d = ball_touch(shapes, shape, p, radius)
        p = p - radius * wp.vec3(d[0], d[1], d[2])
    else:
        d = contact_distance(shapes, shape, p, normal)
    n = wp.vec3(d[0], d[1], d[2])
    if d[3] >= FAR or not opposed(wp.dot(n, normal), kind, shapes.parts[shapes.shapes[shape].part_start].kind):
        return result
    result.point = p
    result.direction = n
    result.gap = d[3]
    return result


@wp.func
def opposed(cosine: float, kind: int, other: int):
    """Whether a sample's normal, by its cosine with the contact normal, allows it to touch there.

    The points of a cap stand for it only while it lies nearly flat; else its rim does, without corners. What is below
    a plane touches it in any case: a plane has no far side.
    """
    if kind == CAP:
        return cosine < -0.95
    if kind == FACE:
        return cosine < -0.5
    return cosine < OPPOSED or other == PLANE


@wp.func
def touch_of(placed: Sample, side: int, other: int, state: State):
    """The touching place in the world; on side 0 the sample is the first body's, on side 1 the second's."""
    result = Touch()
    turn = state.orientation[other]
    n = wp.quat_rotate(turn, placed.direction)
    middle = placed.point - 0.5 * placed.gap * placed.direction
    result.position = wp.quat_rotate(turn, middle) + state.position[other]
    result.normal = wp.where(side == 0, n, -n)
    result.gap = placed.gap
    return result


@wp.func
def velocity_at(body: int, x: wp.vec3, dt: float, state: State, motions: Motions):
    """Velocity of a body's material at world point x, with a step's acceleration."""
    v = state.linear_velocity[body] + dt * motions.acceleration[body]
    w = state.angular_velocity[body] + dt * motions.spin_acceleration[body]
    return v + wp.cross(w, x - motions.center[body])


@wp.func
def closing_gap(touch: Touch, a: int, b: int, dt: float, state: State, motions: Motions):
    """The gap that is left after the step if nothing stops the approach; never more than the gap now."""
    v = velocity_at(a, touch.position, dt, state, motions) - velocity_at(b, touch.position, dt, state, motions)
    return touch.gap + dt * wp.min(wp.dot(v, touch.normal), 0.0)


@wp.func
def patch_for(pair: int, normal: wp.vec3, pairs: Pairs):
    """The patch of like normal, a new one, or, when all are in use, the nearest."""
    count = pairs.patch_count[pair]
    best = int(0)
    likeness = float(-2.0)
    for p in range(count):
        c = wp.dot(pairs.patch_normal[pair, p], normal)
        if c > likeness:
            likeness = c
            best = p
    if likeness < SAME_PATCH and count < MOST_PATCHES:
        pairs.patch_count[pair] = count + 1
        pairs.patch_normal[pair, count] = normal
        for k in range(SLOTS):
            pairs.slot_key[pair, count * SLOTS + k] = -1
        return count
    return best


@wp.func
def offer(pair: int, slot: int, score: float, gap: float, key: int, tie: float, pairs: Pairs):
    """Keep the sample in the slot if it is better than the one there."""
    if pairs.slot_key[pair, slot] < 0 or score > pairs.slot_score[pair, slot] + tie:
        pairs.slot_key[pair, slot] = key
        pairs.slot_score[pair, slot] = score
        pairs.slot_gap[pair, slot] = gap


@wp.func
def remember(pair: int, point: wp.vec3, normal: wp.vec3, gap: float, key: int, size: float, pairs: Pairs):
    """Offer a touching sample, given in the second body's frame, to the slots of its patch."""
    patch = patch_for(pair, normal, pairs)
    n = pairs.patch_normal[pair, patch]
    u = tangent_of(n)
    v = wp.cross(n, u)
    x = wp.dot(point, u)
    y = wp.dot(point, v)
    base = patch * SLOTS
    c = float(0.9)
    s = float(0.43588989)
    for k in range(DIRECTIONS):
        offer(pair, base + k, c * x + s * y - GAP_WEIGHT * gap, gap, key, TIE * size, pairs)
        turned = EIGHTH_TURN * (c - s)
        s = EIGHTH_TURN * (c + s)
        c = turned
    offer(pair, base + DIRECTIONS, -gap, gap, key, TIE * size, pairs)


@wp.func
def keep_if_touching(
    pair: int, key: int, placed: Sample, dt: float, size: float, state: State, motions: Motions, pairs: Pairs
):
    """Remember a placed sample if its gap closes within the step."""
    a = pairs.body_a[pair]
    b = pairs.body_b[pair]
    side = key % 2
    touch = touch_of(placed, side, wp.where(side == 0, b, a), state)
    gap = closing_gap(touch, a, b, dt, state, motions)
    if gap < CONTACT_DISTANCE * size:
        to_b = wp.quat_inverse(state.orientation[b])
        point = wp.quat_rotate(to_b, touch.position - state.position[b])
        remember(pair, point, wp.quat_rotate(to_b, touch.normal), gap, key, size, pairs)


@wp.func
def approach_reach(a: int, b: int, size: float, dt: float, state: State, motions: Motions):
    """How far apart two surfaces can be now and still touch within the step [m]."""
    small = wp.where(motions.radius[a] < motions.radius[b], a, b)
    x = motions.center[small]
    travel = velocity_at(a, x, dt, state, motions) - velocity_at(b, x, dt, state, motions)
    spin = wp.length(state.angular_velocity[a] - state.angular_velocity[b]) * motions.radius[small]
    return CONTACT_DISTANCE * size + dt * (wp.length(travel) + spin)


@wp.func
def matters(kind: int, own_shape: int, shape: int, edges: int, shapes: Shapes):
    """Whether samples of a kind can tell something of a contact that the others do not.

    Between convex shapes a point inside a face never touches first, nothing but a point touches a plane first, and a
    ball is found exactly by its own centre.
    """
    if shapes.shapes[shape].convex == 0:
        return kind != EDGE or edges == 1
    other = shapes.parts[shapes.shapes[shape].part_start].kind
    if kind == POINT:
        own = shapes.parts[shapes.shapes[own_shape].part_start].kind
        return other != SPHERE or own == SPHERE or shapes.shapes[own_shape].convex == 0
    return kind == EDGE and edges == 1 and other != PLANE and other != SPHERE


@wp.func
def try_samples(
    pair: int,
    side: int,
    reach: float,
    dt: float,
    size: float,
    edges: int,
    shapes: Shapes,
    bodies: Bodies,
    state: State,
    motions: Motions,
    pairs: Pairs,
):
    """Find the touching samples of one body of the pair in the distance of the other."""
    a = pairs.body_a[pair]
    b = pairs.body_b[pair]
    own = wp.where(side == 0, a, b)
    other = wp.where(side == 0, b, a)
    shape = bodies.shape[other]
    back = wp.quat_inverse(state.orientation[other])
    turn = back * state.orientation[own]
    shift = wp.quat_rotate(back, state.position[own] - state.position[other])
    own_shape = bodies.shape[own]
    middle = wp.quat_rotate(back, motions.center[own] - state.position[other])
    far = signed_distance(shapes, shape, middle)
    if far[3] > motions.radius[own] + reach:
        return
    for cluster in range(shapes.shapes[own_shape].cluster_start, shapes.shapes[own_shape].cluster_end):
        if matters(shapes.clusters[cluster].kind, own_shape, shape, edges, shapes):
            c = wp.quat_rotate(turn, shapes.clusters[cluster].center) + shift
            d = signed_distance(shapes, shape, c)
            if d[3] < shapes.clusters[cluster].radius + reach:
                for s in range(shapes.clusters[cluster].sample_start, shapes.clusters[cluster].sample_end):
                    placed = place_sample(shapes, s, shape, turn, shift, reach)
                    if placed.gap < reach:
                        keep_if_touching(pair, 2 * s + side, placed, dt, size, state, motions, pairs)


@wp.func
def take_out_doubles(pair: int, size: float, pairs: Pairs):
    """Empty the slots whose sample another slot holds too, and deepest ones no deeper than the rest."""
    kept = int(0)
    for slot in range(pairs.patch_count[pair] * SLOTS):
        key = pairs.slot_key[pair, slot]
        lowest = float(FAR)
        is_deepest = slot % SLOTS == DIRECTIONS
        for k in range(slot % SLOTS):
            earlier = slot - slot % SLOTS + k
            if pairs.slot_key[pair, earlier] == key and key >= 0:
                pairs.slot_key[pair, slot] = -1
            if pairs.slot_key[pair, earlier] >= 0:
                lowest = wp.min(lowest, pairs.slot_gap[pair, earlier])
        if is_deepest and pairs.slot_gap[pair, slot] > lowest - 0.1 * CONTACT_DISTANCE * size:
            pairs.slot_key[pair, slot] = -1
        if pairs.slot_key[pair, slot] >= 0:
            kept += 1
    return kept


@wp.kernel
def find_contacts(
    dt: float,
    bodies_per_env: int,
    shapes: Shapes,
    bodies: Bodies,
    state: State,
    motions: Motions,
    envs: Environments,
    pairs: Pairs,
):
    """One thread a pair: fill its slots with the samples that represent its contact."""
    pair = wp.tid()
    pairs.contact_count[pair] = 0
    if pair >= pairs.start[pairs.start.shape[0] - 1]:
        return
    pairs.patch_count[pair] = 0
    a = pairs.body_a[pair]
    b = pairs.body_b[pair]
    size = wp.min(shapes.shapes[bodies.shape[a]].size, shapes.shapes[bodies.shape[b]].size)
    reach = approach_reach(a, b, size, dt, state, motions)
    edges = envs.edge_samples[a / bodies_per_env]
    try_samples(pair, 0, reach, dt, size, edges, shapes, bodies, state, motions, pairs)
    try_samples(pair, 1, reach, dt, size, edges, shapes, bodies, state, motions, pairs)
    pairs.contact_count[pair] = take_out_doubles(pair, size, pairs)
