"""Impact of a pair: target velocities, impulses with friction, and their energy (Guendelman et al. 2003, section 6).

All contacts of a pair are solved together: the target normal velocity of each is -e times its approach velocity, normal
impulses are not negative, and friction stays within its cone.

The velocity of symplectic Euler lags behind by half a step of acceleration, and the impact is solved up to one step
before the surfaces meet. Reflecting the velocity as it is would change the bounce height by |v| dt. Instead, the
velocity is centred in time, extrapolated over the gap, reflected, and extrapolated back: with the centred approach
speed v and the acceleration p that closes the gap g, the rebound speed is sqrt(e^2 (v^2 + 2 p g) - 2 p g). The centring
is reduced for the slowest impacts, so that resting bodies stay at rest. An impact too weak to rebound over the gap is
left to the contact solver, and bounces once it has landed.
"""

import warp as wp

from warp_rigid.kernels.common.arithmetic import quotient
from warp_rigid.kernels.common.solver_body import BodyPair, at_rest, first_three, relative_velocity, with_impulse
from warp_rigid.kernels.common.tangents import world_vector
from warp_rigid.kernels.constraints.contact import (
    IMPACT_IMPULSE,
    contact_velocity,
    friction_impulse,
    read_contact,
    read_impulse,
    set_target_impulse,
    velocity_change,
)
from warp_rigid.kernels.schema import ContactRecord, Contacts, Motions, OrderRecord
from warp_rigid.kernels.tuning import CONVERGED, IMPACT_ITERATIONS, SLOWEST

wp.set_module_options({"enable_backward": False})

NO_IMPACT = wp.constant(-1.0e10)
"""Target velocity of a contact without an impact in this step [m/s]."""


@wp.func
def relative_pull(entry: OrderRecord, first: int, motions: Motions):
    """Acceleration of the first body relative to the second that follows the impacts, 0 if it precedes them [m/s^2]."""
    return float(first) * (motions.acceleration[entry.body_a] - motions.acceleration[entry.body_b])


@wp.func
def rebound(row: ContactRecord, speed: float, pull: float, dt: float):
    """Target normal velocity of a contact approaching at `speed`, or NO_IMPACT. `pull`: approach acceleration."""
    if row.bias_velocity > speed + dt * pull:
        return NO_IMPACT
    e = row.restitution
    if e == 0.0:
        return -row.bias_velocity
    lag = 0.5 * dt * pull * wp.min(speed / wp.max(dt * pull, 1.0e-9), 1.0)
    fall = 2.0 * pull * wp.max(row.gap, 0.0)
    squared = e * e * ((speed + lag) * (speed + lag) + fall) - fall
    if squared <= 0.0:
        return NO_IMPACT
    return wp.sqrt(squared) + lag


@wp.func
def set_targets(
    begin: int, end: int, unit: float, pair: BodyPair, relative_pull: wp.vec3, dt: float, contacts: Contacts
):
    """Set the target velocities of the pair's contacts. Returns 1 if there is an impact."""
    colliding = int(0)
    for c in range(begin, end):
        row = read_contact(c, contacts.rows)
        speed = -wp.dot(contact_velocity(row, pair), row.normal)
        target = float(NO_IMPACT)
        if speed >= SLOWEST * unit:
            target = rebound(row, speed, wp.max(-wp.dot(relative_pull, row.normal), 0.0), dt)
        set_target_impulse(c, wp.vec3(0.0, 0.0, 0.0), target, contacts)
        if target > NO_IMPACT:
            colliding = 1
    return colliding


@wp.func
def next_impact(stored: wp.vec4, mobility_a: float, mobility_b: float, row: ContactRecord, pair: BodyPair):
    """The impulse that brings the normal velocity to its target, and the slip to zero within the friction cone.

    `stored`: the impulse so far, and the target. The mobilities are factors on the inverse masses.
    """
    n = row.normal
    u = row.tangent
    v = wp.cross(n, u)
    old = first_three(stored)
    slip = contact_velocity(row, pair)
    k_normal = mobility_a * row.normal_a + mobility_b * row.normal_b
    normal = wp.max(old[0] + quotient(stored[3] - wp.dot(slip, n), k_normal), 0.0)
    gained = normal - old[0]
    sliding = wp.vec2(wp.dot(slip, u), wp.dot(slip, v)) + gained * (
        mobility_a * row.coupling_a + mobility_b * row.coupling_b
    )
    k = mobility_a * row.tangent_a + mobility_b * row.tangent_b
    before = wp.vec2(old[1], old[2])
    after = friction_impulse(before, sliding, k, row.friction * normal)
    return wp.vec3(normal, after[0], after[1])


@wp.func
def collide_contact(c: int, mobility_a: float, mobility_b: float, pair: BodyPair, contacts: Contacts):
    """Update one contact, as `next_impact`."""
    stored = read_impulse(contacts.impulses, c, IMPACT_IMPULSE)
    if stored[3] <= NO_IMPACT:
        return pair
    row = read_contact(c, contacts.rows)
    new = next_impact(stored, mobility_a, mobility_b, row, pair)
    change = new - first_three(stored)
    set_target_impulse(c, new, stored[3], contacts)
    pair = with_impulse(row.arm_a, row.arm_b, world_vector(row.normal, row.tangent, change), pair)
    pair.change = wp.max(pair.change, velocity_change(change, mobility_a, mobility_b, row))
    return pair


@wp.func
def energy_of_impact(begin: int, end: int, before: BodyPair, after: BodyPair, lag: wp.vec3, contacts: Contacts):
    """Change of the kinetic energy by the impacts of a pair [J]: with a factor s on all impulses, s x + s^2 y.

    x = J.u and y = J.du / 2, where u are the time-centred relative velocities before the impact (which differ from the
    stored ones by `lag`), and du is their change.
    """
    linear = float(0.0)
    quadratic = float(0.0)
    for c in range(begin, end):
        stored = read_impulse(contacts.impulses, c, IMPACT_IMPULSE)
        if stored[3] > NO_IMPACT:
            row = read_contact(c, contacts.rows)
            impulse = world_vector(row.normal, row.tangent, first_three(stored))
            slip = contact_velocity(row, before)
            linear += wp.dot(impulse, slip + lag)
            quadratic += 0.5 * wp.dot(impulse, contact_velocity(row, after) - slip)
    return wp.vec2(linear, quadratic)


@wp.func
def energy_neutral_share(begin: int, end: int, before: BodyPair, after: BodyPair, lag: wp.vec3, contacts: Contacts):
    """Largest factor in [0, 1] on the pair's impulse that does not increase the kinetic energy."""
    change = energy_of_impact(begin, end, before, after, lag, contacts)
    if change[0] + change[1] <= 0.0 or change[1] <= 0.0:
        return 1.0
    return wp.clamp(-change[0] / change[1], 0.0, 1.0)


@wp.func
def note_impact(begin: int, end: int, keep: float, contacts: Contacts):
    """Add the impulse of an impact, of which the fraction `keep` was applied, to those of its pair in this step."""
    total = wp.vec3(0.0, 0.0, 0.0)
    for c in range(begin, end):
        stored = read_impulse(contacts.impulses, c, IMPACT_IMPULSE)
        if stored[3] > NO_IMPACT:
            row = read_contact(c, contacts.rows)
            total += world_vector(row.normal, row.tangent, first_three(stored))
    pair = contacts.pair[begin]
    contacts.impact[pair] = contacts.impact[pair] + keep * total


@wp.func
def is_impact(c: int, contacts: Contacts):
    """Whether a contact belongs to the impacts of its pair."""
    return read_impulse(contacts.impulses, c, IMPACT_IMPULSE)[3] > NO_IMPACT


@wp.func
def equal_impulse(begin: int, end: int, pair: BodyPair, response: BodyPair, contacts: Contacts):
    """The equal normal impulse of all impacts of a pair that brings their mean normal velocity to its target.

    `response`: the velocities that a unit impulse at every contact gives. Returns the impulse [N s], and by how much it
    changes the mean velocity [m/s].
    """
    lacking = float(0.0)
    gained = float(0.0)
    count = float(0.0)
    for c in range(begin, end):
        if is_impact(c, contacts):
            target = read_impulse(contacts.impulses, c, IMPACT_IMPULSE)[3]
            row = read_contact(c, contacts.rows)
            lacking += target - wp.dot(contact_velocity(row, pair), row.normal)
            gained += wp.dot(relative_velocity(row.arm_a, row.arm_b, response), row.normal)
            count += 1.0
    impulse = wp.max(quotient(lacking, gained), 0.0)
    return wp.vec2(impulse, wp.where(impulse > 0.0, lacking / count, 0.0))


@wp.func
def set_normal_impulses(begin: int, end: int, impulse: float, contacts: Contacts):
    """Set the impulses of all impacts of a pair to the same normal one [N s]."""
    for c in range(begin, end):
        if is_impact(c, contacts):
            target = read_impulse(contacts.impulses, c, IMPACT_IMPULSE)[3]
            set_target_impulse(c, wp.vec3(impulse, 0.0, 0.0), target, contacts)


@wp.func
def with_equal_impulses(begin: int, end: int, impulse: float, pair: BodyPair, contacts: Contacts):
    """The bodies after the same normal impulse at all impacts of a pair [N s]."""
    for c in range(begin, end):
        if is_impact(c, contacts):
            row = read_contact(c, contacts.rows)
            pair = with_impulse(row.arm_a, row.arm_b, impulse * row.normal, pair)
    return pair


@wp.func
def with_equal_start(begin: int, end: int, pair: BodyPair, contacts: Contacts):
    """The bodies after `equal_impulse`, from which iterations over the contacts of a pair with restitution start.

    From zero, the first contact would stop the bodies alone, and the spin that this gives them decays by as little as
    6 % an iteration where the contacts are within a tenth of the body's width. Without restitution, the contact
    solver follows.
    """
    response = with_equal_impulses(begin, end, 1.0, at_rest(pair), contacts)
    start = equal_impulse(begin, end, pair, response, contacts)
    set_normal_impulses(begin, end, start[0], contacts)
    pair = with_equal_impulses(begin, end, start[0], pair, contacts)
    pair.change = start[1]
    return pair


@wp.func
def with_impacts(
    begin: int, end: int, mobility_a: float, mobility_b: float, unit: float, pair: BodyPair, contacts: Contacts
):
    """The bodies after iterations over the contacts of a pair, whose targets are set.

    `change` of the result is the largest one of the iterations, and of the start if that is larger.
    """
    largest = pair.change
    left = int(IMPACT_ITERATIONS)
    while left > 0:
        pair.change = 0.0
        for c in range(begin, end):
            pair = collide_contact(c, mobility_a, mobility_b, pair, contacts)
        largest = wp.max(largest, pair.change)
        left = wp.where(pair.change > CONVERGED * unit, left - 1, 0)
    pair.change = largest
    return pair


@wp.func
def has_restitution(begin: int, end: int, contacts: Contacts):
    """Whether a pair has restitution, which is the same in all its contacts."""
    if begin == end:
        return False
    row = read_contact(begin, contacts.rows)
    return row.restitution > 0.0


@wp.func
def after_impact(
    begin: int,
    end: int,
    mobility_a: float,
    mobility_b: float,
    unit: float,
    lag: wp.vec3,
    before: BodyPair,
    contacts: Contacts,
):
    """The bodies after the impacts of all contacts of a pair, whose targets are set; see `energy_neutral_share`."""
    after = before
    if has_restitution(begin, end, contacts):
        after = with_equal_start(begin, end, after, contacts)
    after = with_impacts(begin, end, mobility_a, mobility_b, unit, after, contacts)
    keep = energy_neutral_share(begin, end, before, after, lag, contacts)
    note_impact(begin, end, keep, contacts)
    after.linear_a = before.linear_a + keep * (after.linear_a - before.linear_a)
    after.angular_a = before.angular_a + keep * (after.angular_a - before.angular_a)
    after.linear_b = before.linear_b + keep * (after.linear_b - before.linear_b)
    after.angular_b = before.angular_b + keep * (after.angular_b - before.angular_b)
    return after
