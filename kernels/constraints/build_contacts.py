"""Contact rows: constraint data built from the touching samples, and the initial impulses for warm starting."""

import warp as wp

from warp_rigid.kernels.collide.approach import Touch
from warp_rigid.kernels.collide.convex_pairs import touch_along
from warp_rigid.kernels.collide.distance import FAR
from warp_rigid.kernels.collide.near_samples import NARROWPHASE, NearSamples
from warp_rigid.kernels.collide.pair_contacts import ContactKey, center_inside
from warp_rigid.kernels.collide.parting import is_parting
from warp_rigid.kernels.common.sharing import Sharing, claim, finish, rows_of
from warp_rigid.kernels.common.solver_body import inverse_effective_mass, inverse_inertia_of, inverse_mass_of
from warp_rigid.kernels.common.tangents import tangent_of, world_vector
from warp_rigid.kernels.common.team import MOST_REGISTERS
from warp_rigid.kernels.constraints.contact import (
    ANGULAR_IMPULSE,
    IMPULSE,
    impulse_of,
    read_contact,
    set_impulse,
    velocity_of_turning,
    write_contact,
)
from warp_rigid.kernels.constraints.records import store_constraint
from warp_rigid.kernels.enums import CombineRule
from warp_rigid.kernels.schema import (
    Bodies,
    Constraints,
    ContactRecord,
    Contacts,
    Environments,
    Graph,
    History,
    Motions,
    Pairs,
    Shapes,
    State,
)
from warp_rigid.kernels.tuning import TOUCHING, WIDER
from warp_rigid.kernels.update.predict import smaller_size

wp.set_module_options({"enable_backward": False})


@wp.func
def combine(x: float, y: float, rule: int):
    """Combine the coefficients of two bodies."""
    if rule == CombineRule.AVERAGE:
        return 0.5 * (x + y)
    if rule == CombineRule.MULTIPLY:
        return x * y
    if rule == CombineRule.MAX:
        return wp.max(x, y)
    return wp.min(x, y)


@wp.func
def tangential_inverse_mass(arm: wp.vec3, u: wp.vec3, v: wp.vec3, inverse_mass: float, inverse_inertia: wp.mat33):
    """The tangential block of K: entries 11, 12, 22."""
    return wp.vec3(
        inverse_effective_mass(arm, u, u, inverse_mass, inverse_inertia),
        inverse_effective_mass(arm, u, v, inverse_mass, inverse_inertia),
        inverse_effective_mass(arm, v, v, inverse_mass, inverse_inertia),
    )


@wp.func
def last_contact(pair: int, key: int, history: History):
    """Row of the same contact in the last step, or -1; `pair` is the pair's row in the history."""
    if pair >= 0:
        for c in range(history.contact_start[pair], history.contact_start[pair + 1]):
            if history.key[c] == key:
                return c
    return -1


@wp.func
def with_masses(row: ContactRecord, a: int, b: int, motions: Motions):
    """The row with the inverse effective masses of its bodies, along the normal and in the tangent plane."""
    n = row.normal
    u = row.tangent
    v = wp.cross(n, u)
    mass = inverse_mass_of(a, motions)
    inertia = inverse_inertia_of(a, motions)
    r = row.arm_a
    row.normal_a = inverse_effective_mass(r, n, n, mass, inertia)
    row.coupling_a = wp.vec2(
        inverse_effective_mass(r, u, n, mass, inertia), inverse_effective_mass(r, v, n, mass, inertia)
    )
    row.tangent_a = tangential_inverse_mass(r, u, v, mass, inertia)
    mass = inverse_mass_of(b, motions)
    inertia = inverse_inertia_of(b, motions)
    r = row.arm_b
    row.normal_b = inverse_effective_mass(r, n, n, mass, inertia)
    row.coupling_b = wp.vec2(
        inverse_effective_mass(r, u, n, mass, inertia), inverse_effective_mass(r, v, n, mass, inertia)
    )
    row.tangent_b = tangential_inverse_mass(r, u, v, mass, inertia)
    return row


@wp.func
def with_coefficients(row: ContactRecord, a: int, b: int, rules: wp.vec2i, bodies: Bodies):
    """The row with the combined coefficients of its bodies."""
    row.friction = combine(bodies.friction[a], bodies.friction[b], rules[0])
    row.rolling_friction = combine(bodies.rolling_friction[a], bodies.rolling_friction[b], rules[0])
    row.spinning_friction = combine(bodies.spinning_friction[a], bodies.spinning_friction[b], rules[0])
    row.restitution = combine(bodies.restitution[a], bodies.restitution[b], rules[1])
    return row


@wp.func
def in_contact_frame(row: ContactRecord, world: wp.vec3):
    """Components of a world vector along a contact's normal and tangents."""
    v = wp.cross(row.normal, row.tangent)
    return wp.vec3(wp.dot(world, row.normal), wp.dot(world, row.tangent), wp.dot(world, v))


@wp.func
def bias_velocity_of(gap: float, size: float, dt: float):
    """Approach speed that is allowed in the step because of the gap [m/s]."""
    return wp.where(gap > WIDER * TOUCHING * size, (gap - TOUCHING * size) / dt, 0.0)


@wp.func
def start_from_history(c: int, pair: int, row: ContactRecord, warm: int, contacts: Contacts, history: History):
    """Initialize the impulses from the last step, transformed to the current contact frame, or with zero."""
    impulse = wp.vec3(0.0, 0.0, 0.0)
    angular_impulse = wp.vec3(0.0, 0.0, 0.0)
    if warm == 1 and contacts.key[c] != ContactKey.GONE:
        last = last_contact(pair, contacts.key[c], history)
        if last >= 0:
            impulse = in_contact_frame(row, history.impulse[last])
            angular_impulse = in_contact_frame(row, history.angular_impulse[last])
    set_impulse(c, IMPULSE, wp.vec3(wp.max(impulse[0], 0.0), impulse[1], impulse[2]), contacts)
    set_impulse(c, ANGULAR_IMPULSE, angular_impulse, contacts)


@wp.func
def kept_touch(
    place: int,
    pair: int,
    shapes: Shapes,
    bodies: Bodies,
    state: State,
    motions: Motions,
    pairs: Pairs,
    near: NearSamples,
):
    """The contact point of a near sample, or of a contact that belongs to no sample."""
    a = pairs.body_a[pair]
    b = pairs.body_b[pair]
    if place == ContactKey.BY_AXIS:
        return touch_along(pairs.axis[pair], a, b, shapes, bodies, state)
    if place < 0:
        return center_inside(ContactKey.BY_CENTER - place, a, b, shapes, bodies, state, motions)
    touch = Touch()
    touch.position = near.position[place]
    touch.normal = near.normal[place]
    touch.gap = near.gap[place]
    if is_parting(pair, shapes, bodies, pairs):
        touch.normal = wp.quat_rotate(state.orientation[b], pairs.axis[pair])
    return touch


@wp.func
def point_apart(touch: Touch, a: int, b: int, size: float, bodies: Bodies):
    """From the contact point to that point of the first body's surface which will touch an immovable body [m].

    The contact point is halfway between the surfaces. With it, a ball that approaches the ground would bounce with too
    much spin, as the friction would act on a longer arm. Two free bodies are left with a common point, so that their
    angular momentum is conserved. A contact that is gone has no point.
    """
    near = touch.gap <= WIDER * TOUCHING * size or touch.gap >= FAR
    if near or bodies.inverse_mass[a] * bodies.inverse_mass[b] > 0.0:
        return wp.vec3(0.0, 0.0, 0.0)
    return 0.5 * touch.gap * touch.normal


@wp.func
def build_row(
    count: int,
    a: int,
    b: int,
    touch: Touch,
    dt: float,
    size: float,
    shapes: Shapes,
    bodies: Bodies,
    state: State,
    motions: Motions,
):
    """A contact row with its geometry and effective masses."""
    row = ContactRecord()
    row.normal = touch.normal
    row.tangent = tangent_of(touch.normal)
    apart = point_apart(touch, a, b, size, bodies)
    row.arm_a = touch.position + apart - motions.center[a]
    row.arm_b = touch.position - apart - motions.center[b]
    row.gap = touch.gap
    row.bias_velocity = bias_velocity_of(touch.gap, size, dt)
    row.surface = velocity_of_turning(row, count, a, b, dt, shapes, bodies, state, motions)
    return with_masses(row, a, b, motions)


@wp.kernel(module=NARROWPHASE, cuda_max_registers=MOST_REGISTERS)
def build_contacts(
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
    history: History,
    contacts: Contacts,
):
    """The teams share the pairs: build contact rows from the contact points of the kept samples."""
    own = claim(wp.tid() / lanes, sharing)
    rows = rows_of(own, pairs.start[pairs.start.shape[0] - 1], sharing)
    for pair in range(rows.first, rows.end, rows.stride):
        start = pairs.contact_start[pair]
        count = pairs.contact_start[pair + 1] - start
        a = pairs.body_a[pair]
        b = pairs.body_b[pair]
        size = smaller_size(a, b, shapes, bodies)
        env = bodies.env[a]
        contacts.impact[pair] = wp.vec3(0.0, 0.0, 0.0)
        rules = wp.vec2i(envs.friction_rule[env], envs.restitution_rule[env])
        for k in range(wp.tid() % lanes, count, lanes):
            c = start + k
            place = pairs.kept[pair, k]
            touch = kept_touch(place, pair, shapes, bodies, state, motions, pairs, near)
            contacts.key[c] = place
            if place >= 0:
                contacts.key[c] = near.key[place]
            if touch.gap >= FAR:
                touch.position = motions.center[a]
                pairs.searched[pair] = 0
                contacts.key[c] = ContactKey.GONE
            contacts.pair[c] = pair
            contacts.position[c] = touch.position
            row = build_row(count, a, b, touch, dt, size, shapes, bodies, state, motions)
            write_contact(c, with_coefficients(row, a, b, rules, bodies), contacts.rows)
            start_from_history(c, pairs.last[pair], row, envs.warm_starting[env], contacts, history)
    finish(own, sharing)


@wp.func
def store_contact(target: int, c: int, contacts: Contacts, history: History):
    """Write a solved contact to a row of the history, with its impulses in the world frame."""
    row = read_contact(c, contacts.rows)
    history.key[target] = contacts.key[c]
    history.impulse[target] = world_vector(row.normal, row.tangent, impulse_of(c, IMPULSE, contacts))
    history.angular_impulse[target] = world_vector(row.normal, row.tangent, impulse_of(c, ANGULAR_IMPULSE, contacts))
    history.position[target] = contacts.position[c]
    history.normal[target] = row.normal
    history.gap[target] = row.gap


@wp.func
def store_pair(i: int, pairs: Pairs, history: History):
    """Store a row of the list of pairs, with the data of its last contact search."""
    if i < history.pair_start.shape[0]:
        history.pair_start[i] = pairs.start[i]
    if i < pairs.start[pairs.start.shape[0] - 1]:
        history.body_b[i] = pairs.body_b[i]
        history.searched[i] = pairs.searched[i]
        history.searched_orientation[i] = pairs.searched_orientation[i]
        history.searched_position[i] = pairs.searched_position[i]
        history.axis[i] = pairs.axis[i]
    if i < history.contact_start.shape[0]:
        history.contact_start[i] = pairs.contact_start[i]


@wp.kernel
def store_lists(
    with_contacts: int,
    threads: int,
    contacts: Contacts,
    pairs: Pairs,
    constraints: Constraints,
    history: History,
    graph: Graph,
):
    """The threads share the pairs, constraints and, if `with_contacts`, contacts, and store them for the next step."""
    count = wp.max(history.pair_start.shape[0], history.contact_start.shape[0])
    for i in range(wp.tid(), count, threads):
        store_pair(i, pairs, history)
        store_constraint(i, constraints, graph)
    for c in range(wp.tid(), with_contacts * pairs.contact_start[pairs.contact_start.shape[0] - 1], threads):
        store_contact(c, c, contacts, history)
