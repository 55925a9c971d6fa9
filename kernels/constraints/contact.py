"""Fourth stage: the contact records that the solver works on, and the impulses that they start from."""

import warp as wp

from warp_rigid.kernels.collide.distance import FAR
from warp_rigid.kernels.collide.narrowphase import BY_CENTER, approach_of, center_inside, touch_of
from warp_rigid.kernels.collide.samples import place_sample
from warp_rigid.kernels.common.packed import (
    ANGULAR_IMPULSE,
    IMPULSE,
    impulse_of,
    inverse_inertia_of,
    put_contact_row,
    set_impulse,
)
from warp_rigid.kernels.common.tangents import tangent_of, world_vector
from warp_rigid.kernels.enums import CombineRule
from warp_rigid.kernels.schema import (
    Bodies,
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
from warp_rigid.kernels.update.predict import smaller_size

wp.set_module_options({"enable_backward": False})

NARROWPHASE = wp.get_module("warp_rigid.kernels.collide.narrowphase")
"""Kernels that evaluate distances share one compilation unit."""

GONE = wp.constant(-1)
"""Identity of a contact taken over from the last step that is none any more: it carries nothing."""


TOUCHING = wp.constant(1.0e-4)
"""Gaps up to this part of the smaller body's size carry load as they are.

If every gap of a rounding error had to close first, the load would jump from contact to contact at each step: a pyramid
of 20 rows that keeps to 0.02 mm so creeps by millimetres with a fifth of it."""

WIDER = wp.constant(1.05)
"""A gap wider than that by no more than this factor carries load, too. Those that have just closed are, by rounding
errors, and would otherwise keep closing for ever: a stack at rest is then seldom solved at once."""


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
def inverse_effective_mass(arm: wp.vec3, d: wp.vec3, e: wp.vec3, inverse_mass: float, inverse_inertia: wp.mat33):
    """Entry d . K e of the collision matrix K = 1/m + [r]^T I^-1 [r] of one body (Guendelman 2003, section 7)."""
    return inverse_mass * wp.dot(d, e) + wp.dot(wp.cross(arm, d), inverse_inertia * wp.cross(arm, e))


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
    """Row of the same contact of a pair, given by its row in the history, in the last step, or -1."""
    if pair >= 0:
        for c in range(history.contact_start[pair], history.contact_start[pair + 1]):
            if history.key[c] == key:
                return c
    return -1


@wp.func
def with_masses(row: ContactRecord, bodies: Bodies, motions: Motions):
    """Inverse masses that the contact sees along its normal and in its tangent plane."""
    n = row.normal
    u = row.tangent
    v = wp.cross(n, u)
    mass = bodies.inverse_mass[row.body_a]
    inertia = inverse_inertia_of(row.body_a, motions)
    r = row.arm_a
    row.normal_a = inverse_effective_mass(r, n, n, mass, inertia)
    row.coupling_a = wp.vec2(
        inverse_effective_mass(r, u, n, mass, inertia), inverse_effective_mass(r, v, n, mass, inertia)
    )
    row.tangent_a = tangential_inverse_mass(r, u, v, mass, inertia)
    mass = bodies.inverse_mass[row.body_b]
    inertia = inverse_inertia_of(row.body_b, motions)
    r = row.arm_b
    row.normal_b = inverse_effective_mass(r, n, n, mass, inertia)
    row.coupling_b = wp.vec2(
        inverse_effective_mass(r, u, n, mass, inertia), inverse_effective_mass(r, v, n, mass, inertia)
    )
    row.tangent_b = tangential_inverse_mass(r, u, v, mass, inertia)
    return row


@wp.func
def with_coefficients(row: ContactRecord, rules: wp.vec2i, bodies: Bodies):
    """Coefficients of the pair."""
    a = row.body_a
    b = row.body_b
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
    """Speed at which the bodies may still approach in the step."""
    return wp.where(gap > WIDER * TOUCHING * size, (gap - TOUCHING * size) / dt, 0.0)


@wp.func
def start_from_history(c: int, pair: int, row: ContactRecord, warm: int, contacts: Contacts, history: History):
    """Start from the last step's impulses, turned into today's tangent plane, or from zero."""
    impulse = wp.vec3(0.0, 0.0, 0.0)
    angular_impulse = wp.vec3(0.0, 0.0, 0.0)
    if warm == 1 and contacts.key[c] != GONE:
        last = last_contact(pair, contacts.key[c], history)
        if last >= 0:
            impulse = in_contact_frame(row, history.impulse[last])
            angular_impulse = in_contact_frame(row, history.angular_impulse[last])
    set_impulse(c, IMPULSE, wp.vec3(wp.max(impulse[0], 0.0), impulse[1], impulse[2]), contacts)
    set_impulse(c, ANGULAR_IMPULSE, angular_impulse, contacts)


@wp.func
def touch_again(key: int, a: int, b: int, shapes: Shapes, bodies: Bodies, state: State, motions: Motions):
    """Evaluate the place of a contact's identity once more."""
    if key <= BY_CENTER:
        return center_inside(BY_CENTER - key, a, b, shapes, bodies, state, motions)
    side = key % 2
    approach = approach_of(wp.where(side == 0, a, b), wp.where(side == 0, b, a), FAR, bodies, state)
    placed = place_sample(shapes, key / 2, approach.own_shape, approach.shape, approach.turn, approach.shift, FAR)
    return touch_of(placed, side, approach.other, state)


@wp.kernel(module=NARROWPHASE)
def build_contacts(
    teams: int,
    lanes: int,
    dt: float,
    rules: wp.vec2i,
    shapes: Shapes,
    bodies: Bodies,
    state: State,
    motions: Motions,
    envs: Environments,
    pairs: Pairs,
    history: History,
    contacts: Contacts,
):
    """The teams share the pairs: turn the samples kept into contact records. `rules`: how coefficients combine."""
    bodies_per_env = bodies.shape.shape[0] / envs.failed.shape[0]
    for pair in range(wp.tid() / lanes, pairs.start[pairs.start.shape[0] - 1], teams):
        start = pairs.contact_start[pair]
        row = ContactRecord()
        row.body_a = pairs.body_a[pair]
        row.body_b = pairs.body_b[pair]
        size = smaller_size(row.body_a, row.body_b, shapes, bodies)
        for k in range(wp.tid() % lanes, pairs.contact_start[pair + 1] - start, lanes):
            c = start + k
            key = pairs.kept[pair, k]
            touch = touch_again(key, row.body_a, row.body_b, shapes, bodies, state, motions)
            if touch.gap >= FAR:
                touch.position = motions.center[row.body_a]
                pairs.searched[pair] = 0
                key = GONE
            contacts.key[c] = key
            contacts.position[c] = touch.position
            row.normal = touch.normal
            row.tangent = tangent_of(touch.normal)
            row.arm_a = touch.position - motions.center[row.body_a]
            row.arm_b = touch.position - motions.center[row.body_b]
            row.gap = touch.gap
            row.bias_velocity = bias_velocity_of(touch.gap, size, dt)
            put_contact_row(c, with_coefficients(with_masses(row, bodies, motions), rules, bodies), contacts)
            warm = envs.warm_starting[row.body_a / bodies_per_env]
            start_from_history(c, pairs.last[pair], row, warm, contacts, history)


@wp.func
def store_contact(target: int, c: int, contacts: Contacts, history: History):
    """Write a solved contact to a row of the history, its impulses in the world frame."""
    row = contacts.rows[c]
    history.key[target] = contacts.key[c]
    history.impulse[target] = world_vector(row.normal, row.tangent, impulse_of(c, IMPULSE, contacts))
    history.angular_impulse[target] = world_vector(row.normal, row.tangent, impulse_of(c, ANGULAR_IMPULSE, contacts))
    history.position[target] = contacts.position[c]
    history.normal[target] = row.normal
    history.gap[target] = row.gap


@wp.kernel
def store_pairs(threads: int, pairs: Pairs, history: History, graph: Graph):
    """Last stage, first half: the threads share the rows of the history and remember which pairs touched, and how."""
    for i in range(wp.tid(), wp.max(history.pair_start.shape[0], history.contact_start.shape[0]), threads):
        if i < history.pair_start.shape[0]:
            history.pair_start[i] = pairs.start[i]
        if i < pairs.start[pairs.start.shape[0] - 1]:
            history.body_b[i] = pairs.body_b[i]
            history.searched[i] = pairs.searched[i]
            history.searched_orientation[i] = pairs.searched_orientation[i]
            history.searched_position[i] = pairs.searched_position[i]
            graph.supports_before[i] = wp.where(
                pairs.contact_start[i + 1] > pairs.contact_start[i], graph.supports[i], -1
            )
            graph.colored[i] = graph.pair_color[i]
        if i < history.contact_start.shape[0]:
            history.contact_start[i] = pairs.contact_start[i]


@wp.kernel
def store_impulses(threads: int, contacts: Contacts, pairs: Pairs, history: History):
    """Last stage, second half: the threads share the contacts and remember them."""
    for c in range(wp.tid(), pairs.contact_start[pairs.contact_start.shape[0] - 1], threads):
        store_contact(c, c, contacts, history)
