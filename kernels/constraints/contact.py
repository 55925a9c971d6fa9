"""Contact rows: a non-penetrating contact point with Coulomb, rolling and spinning friction (projected Gauss-Seidel).

A row stores its accumulated impulse (normal, two tangents). The solver first updates the normal impulse: it removes the
approach velocity that exceeds the bias velocity, and the accumulated impulse is never negative. It then updates the
tangential impulse: it removes the slip, within the disk of radius friction times normal impulse. First, the impulse for
sticking is computed with the full tangential matrix, as in Guendelman et al. 2003, section 7. If it lies outside the
disk, a projected gradient step is taken, with the largest eigenvalue as inverse step length; at its fixed point the
friction opposes the slip.
"""

import warp as wp

from warp_rigid.kernels.common.arithmetic import inverse_root, quotient, root
from warp_rigid.kernels.common.solver_body import (
    BodyPair,
    first_three,
    relative_velocity,
    with_angular_impulse,
    with_impulse,
)
from warp_rigid.kernels.common.surfaces import along_own_way, carried_share
from warp_rigid.kernels.common.symmetry import arm_after, chord_velocity, rotation_after, spin_of_surface
from warp_rigid.kernels.common.tangents import world_vector
from warp_rigid.kernels.declare import group_of, group_reader, group_writer, record_reader, record_writer
from warp_rigid.kernels.enums import PartKind, Role
from warp_rigid.kernels.schema import Bodies, ContactRecord, Contacts, ImpulseRecord, Motions, Shapes, State
from warp_rigid.kernels.tuning import CONVERGED

wp.set_module_options({"enable_backward": False})

read_contact = record_reader(ContactRecord, flag="more", optional_from="surface")
"""Read a contact row: (c, contacts.rows)."""

write_contact = record_writer(ContactRecord, flag="more", optional_from="surface")
"""Store a contact row: (c, row, contacts.rows)."""

read_impulse = group_reader(ImpulseRecord)
write_impulse = group_writer(ImpulseRecord)

IMPULSE = group_of(ImpulseRecord, "impulse")
ANGULAR_IMPULSE = group_of(ImpulseRecord, "angular_impulse")
IMPACT_IMPULSE = group_of(ImpulseRecord, "impact_impulse")
START_IMPULSE = group_of(ImpulseRecord, "start_impulse")
START_ANGULAR_IMPULSE = group_of(ImpulseRecord, "start_angular_impulse")
"""Impulses of a row; components are along the normal and the two tangents."""


LEAST_INVERSE, MOST_INVERSE = wp.constant(1.0e-12), wp.constant(1.0e12)
"""Range of the inverse moments of inertia of ordinary bodies, whose squares fit into single precision [1/(kg m^2)]."""


@wp.func
def impulse_of(c: int, which: int, contacts: Contacts):
    """One of the impulses of a contact row, such as IMPULSE."""
    return first_three(read_impulse(contacts.impulses, c, which))


@wp.func
def set_impulse(c: int, which: int, value: wp.vec3, contacts: Contacts):
    """Store one of the impulses of a contact row."""
    write_impulse(contacts.impulses, c, which, value, 0.0)


@wp.func
def set_target_impulse(c: int, impulse: wp.vec3, target: float, contacts: Contacts):
    """Store the impulse of an impact or of the push-out, and its target velocity [m/s]."""
    write_impulse(contacts.impulses, c, IMPACT_IMPULSE, impulse, target)


@wp.func
def contact_velocity(row: ContactRecord, pair: BodyPair):
    """Velocity of the first body's surface relative to the second's at a contact [m/s]."""
    return relative_velocity(row.arm_a, row.arm_b, pair) + row.surface


@wp.func
def separation_speed(row: ContactRecord, pair: BodyPair):
    """Speed along the normal with which the bodies move apart at a contact [m/s]."""
    return wp.dot(relative_velocity(row.arm_a, row.arm_b, pair), row.normal)


@wp.func
def chord_of_carried(
    carrier: int,
    b: int,
    normal: wp.vec3,
    dt: float,
    shapes: Shapes,
    bodies: Bodies,
    state: State,
    motions: Motions,
):
    """Velocity of the centre of a body along the chord on which a carrier turns it, less that of the tangent [m/s].

    A round carrier that spins about its axis moves its material, but not its surface, so that the chord counts in the
    plane of the contact only, and only for a body that turns with the carrier: a box on a turntable, not a plank on
    rollers. Other bodies, such as a ball on a turntable, move on their own way over what turns about the normal.
    """
    away = motions.center[b] - motions.center[carrier]
    spin = motions.solver_bodies[carrier].angular
    spin_of_its_surface = spin_of_surface(carrier, spin, shapes, bodies, state)
    of_surface = chord_velocity(spin_of_its_surface, away, dt)
    of_material = chord_velocity(spin, away, dt) - of_surface
    about_normal = chord_velocity(wp.dot(spin_of_its_surface, normal) * normal, away, dt)
    free = along_own_way(carrier, b, spin, normal, dt, motions) - about_normal
    share = carried_share(b, spin, motions)
    return of_surface + share * (of_material - wp.dot(of_material, normal) * normal) + (1.0 - share) * free


@wp.func
def rolls_on_ground(b: int, ground: int, reach: float, dt: float, shapes: Shapes, bodies: Bodies, motions: Motions):
    """Whether the rotation of a dynamic body counts where it touches ground, of which no surface turns.

    It does not if it is negligible. If it is more than a fifth of a radian in a step, an impact within the step would
    leave a deep overlap: bodies left closed rooms. The parts of a compound roll in different ways, which are not told
    apart, and corners of a mesh may stand for a curved surface. `reach`: distance of the contact from the centre of
    mass [m].
    """
    shape = shapes.shapes[bodies.shape[b]]
    if motions.role[b] != Role.FREE or motions.role[ground] == Role.FREE or shape.part_end - shape.part_start > 1:
        return False
    if shapes.parts[shape.part_start].kind == PartKind.GRID:
        return False
    turning = wp.length_sq(motions.solver_bodies[ground].angular)
    if turning + wp.length_sq(bodies.surface_angular_velocity[ground]) > 0.0:
        return False
    spin = wp.length(motions.solver_bodies[b].angular)
    return spin * dt < 0.2 and 0.5 * dt * spin * spin * reach > CONVERGED * motions.velocity_unit[b]


@wp.func
def velocity_on_ground(
    b: int,
    arm: wp.vec3,
    normal: wp.vec3,
    t: float,
    shapes: Shapes,
    bodies: Bodies,
    state: State,
    motions: Motions,
):
    """Velocity of a body's material where it touches ground after a time t, less that where it does now [m/s].

    The velocity of a step is that in its middle. With the contact of its start, a body that rolls or tips over an edge
    would gain or lose energy in proportion to the step. Without contact, the body turns with constant momentum.
    """
    spin = motions.solver_bodies[b].angular
    turn = state.orientation[b]
    local = wp.quat_rotate_inv(turn, spin)
    gained = bodies.inverse_inertia[b] * wp.cross(bodies.inertia[b] * local, local)
    after = arm_after(b, arm, normal, rotation_after(spin, t), shapes, bodies, state)
    return wp.cross(spin, after - arm) + wp.cross(t * wp.quat_rotate(turn, gained), after)


@wp.func
def velocity_of_turning(
    row: ContactRecord,
    count: int,
    a: int,
    b: int,
    dt: float,
    shapes: Shapes,
    bodies: Bodies,
    state: State,
    motions: Motions,
):
    """Mean velocity of the first body's surface relative to the second's in a step, beyond that at its start [m/s].

    `count`: number of contacts of the pair. With three or more, a body does not roll.

    A point of a kinematic body that turns moves along a chord. A body that it carries turns with it, so that the chord
    of its centre counts.
    """
    n = row.normal
    result = wp.vec3(0.0, 0.0, 0.0)
    if count < 3 and rolls_on_ground(a, b, wp.length(row.arm_a), dt, shapes, bodies, motions):
        result += velocity_on_ground(a, row.arm_a, n, 0.5 * dt, shapes, bodies, state, motions)
    if count < 3 and rolls_on_ground(b, a, wp.length(row.arm_b), dt, shapes, bodies, motions):
        result -= velocity_on_ground(b, row.arm_b, -n, 0.5 * dt, shapes, bodies, state, motions)
    if motions.role[a] == Role.KINEMATIC:
        result += chord_of_carried(a, b, n, dt, shapes, bodies, state, motions)
    if motions.role[b] == Role.KINEMATIC:
        result -= chord_of_carried(b, a, n, dt, shapes, bodies, state, motions)
    return result


@wp.func
def friction_impulse(old: wp.vec2, slip: wp.vec2, k: wp.vec3, limit: float):
    """New tangential impulse from the old one, the slip, the tangential matrix (11, 12, 22) and the friction limit."""
    inverse = quotient(1.0, wp.max(k[0] * k[2] - k[1] * k[1], 1.0e-30))
    stick = old - inverse * wp.vec2(k[2] * slip[0] - k[1] * slip[1], k[0] * slip[1] - k[1] * slip[0])
    if wp.length_sq(stick) <= limit * limit:
        return stick
    mean = 0.5 * (k[0] + k[2])
    deviation = 0.5 * (k[0] - k[2])
    largest = mean + root(deviation * deviation + k[1] * k[1])
    slide = old - quotient(1.0, largest) * slip
    squared = wp.length_sq(slide)
    if squared > limit * limit:
        slide = slide * (limit * inverse_root(squared))
    return slide


@wp.func
def unit_moment(k: wp.vec3):
    """Unit of moments of inertia in which the squares of the inverses k fit into single precision [kg m^2]."""
    mean = 0.5 * (k[0] + k[2])
    if mean > LEAST_INVERSE and mean < MOST_INVERSE:
        return 1.0
    return quotient(1.0, wp.max(mean, 1.0e-30))


@wp.func
def solve_rolling(c: int, normal_impulse: float, row: ContactRecord, pair: BodyPair, contacts: Contacts):
    """Rolling and spinning friction: torques up to a coefficient [m] times the normal impulse."""
    n = row.normal
    u = row.tangent
    v = wp.cross(n, u)
    k = pair.inverse_inertia_a + pair.inverse_inertia_b
    old = impulse_of(c, ANGULAR_IMPULSE, contacts)
    limit = row.spinning_friction * normal_impulse
    spin = wp.dot(pair.angular_a - pair.angular_b, n) + row.surface_spin
    about_normal = wp.clamp(old[0] - quotient(spin, wp.max(wp.dot(n, k * n), 1.0e-30)), -limit, limit)
    pair = with_angular_impulse((about_normal - old[0]) * n, pair)
    spins = pair.angular_a - pair.angular_b
    matrix = wp.vec3(wp.dot(u, k * u), wp.dot(u, k * v), wp.dot(v, k * v))
    slip = wp.vec2(wp.dot(spins, u), wp.dot(spins, v))
    limit = row.rolling_friction * normal_impulse
    unit = unit_moment(matrix)
    rolling = unit * friction_impulse(wp.vec2(old[1], old[2]) / unit, slip, unit * matrix, limit / unit)
    pair = with_angular_impulse((rolling[0] - old[1]) * u + (rolling[1] - old[2]) * v, pair)
    new = wp.vec3(about_normal, rolling[0], rolling[1])
    set_impulse(c, ANGULAR_IMPULSE, new, contacts)
    if pair.inverse_mass_a * pair.inverse_mass_b == 0.0:
        sign = wp.where(pair.inverse_mass_a > 0.0, -1.0, 1.0)
        pair.frozen_angular_impulse += sign * world_vector(n, u, new - old)
    return pair


@wp.func
def next_impulse(old: wp.vec3, mobility_a: float, mobility_b: float, row: ContactRecord, pair: BodyPair):
    """New impulse of a row from the old one. A mobility is a factor on an inverse mass; 0: the body is frozen."""
    n = row.normal
    u = row.tangent
    v = wp.cross(n, u)
    slip = contact_velocity(row, pair)
    k_normal = mobility_a * row.normal_a + mobility_b * row.normal_b
    normal = wp.max(old[0] - quotient(wp.dot(slip, n) + row.bias_velocity, k_normal), 0.0)
    coupling = (normal - old[0]) * (mobility_a * row.coupling_a + mobility_b * row.coupling_b)
    k = mobility_a * row.tangent_a + mobility_b * row.tangent_b
    sliding = wp.vec2(wp.dot(slip, u), wp.dot(slip, v)) + coupling
    after = friction_impulse(wp.vec2(old[1], old[2]), sliding, k, row.friction * normal)
    return wp.vec3(normal, after[0], after[1])


@wp.func
def velocity_change(gained: wp.vec3, mobility_a: float, mobility_b: float, row: ContactRecord):
    """Bound on the change of the relative velocity at a row by an impulse [m/s]."""
    k_normal = mobility_a * row.normal_a + mobility_b * row.normal_b
    k = mobility_a * row.tangent_a + mobility_b * row.tangent_b
    return k_normal * wp.abs(gained[0]) + (k[0] + k[2]) * (wp.abs(gained[1]) + wp.abs(gained[2]))


@wp.func
def solve_row(c: int, mobility_a: float, mobility_b: float, pair: BodyPair, contacts: Contacts):
    """Solve one contact for the velocities of a pair, and record the largest velocity change [m/s].

    A body of mobility 0 is frozen: its mass counts as infinite, and the impulse on it is added to `frozen_impulse`.
    """
    row = read_contact(c, contacts.rows)
    if mobility_a * row.normal_a + mobility_b * row.normal_b <= 0.0:
        return pair
    old = impulse_of(c, IMPULSE, contacts)
    new = next_impulse(old, mobility_a, mobility_b, row, pair)
    impulse = world_vector(row.normal, row.tangent, new - old)
    pair = with_impulse(row.arm_a, row.arm_b, impulse, pair)
    set_impulse(c, IMPULSE, new, contacts)
    if mobility_a == 0.0:
        pair.frozen_impulse += impulse
        pair.frozen_angular_impulse += wp.cross(row.arm_a, impulse)
    if mobility_b == 0.0:
        pair.frozen_impulse -= impulse
        pair.frozen_angular_impulse -= wp.cross(row.arm_b, impulse)
    if row.rolling_friction + row.spinning_friction > 0.0:
        pair = solve_rolling(c, new[0], row, pair, contacts)
    pair.change = wp.max(pair.change, velocity_change(new - old, mobility_a, mobility_b, row))
    return pair


@wp.func
def apply_row(c: int, pair: BodyPair, contacts: Contacts):
    """The bodies after applying the initial impulses of a contact (warm start)."""
    row = read_contact(c, contacts.rows)
    impulse = world_vector(row.normal, row.tangent, impulse_of(c, IMPULSE, contacts))
    pair = with_impulse(row.arm_a, row.arm_b, impulse, pair)
    return with_angular_impulse(world_vector(row.normal, row.tangent, impulse_of(c, ANGULAR_IMPULSE, contacts)), pair)


@wp.func
def direction_and_approach(c: int, pair: BodyPair, contacts: Contacts):
    """Direction in which a contact pushes the first body (x, y, z), and the approach speed along it (w) [m/s]."""
    row = read_contact(c, contacts.rows)
    n = row.normal
    return wp.vec4(n[0], n[1], n[2], -wp.dot(contact_velocity(row, pair), n))


@wp.func
def store_start(c: int, contacts: Contacts):
    """Store the impulses at the start of the line search."""
    set_impulse(c, START_IMPULSE, impulse_of(c, IMPULSE, contacts), contacts)
    set_impulse(c, START_ANGULAR_IMPULSE, impulse_of(c, ANGULAR_IMPULSE, contacts), contacts)


@wp.func
def energy_terms(c: int, has_start: bool, then: BodyPair, now: BodyPair, contacts: Contacts):
    """Contribution of a row to the two sums of a line search [J]: -(v0.M dv + b.dl) and dv.M dv.

    `has_start`: whether the search starts at the stored start impulses, or without impulses.
    """
    row = read_contact(c, contacts.rows)
    change = impulse_of(c, IMPULSE, contacts)
    moment = impulse_of(c, ANGULAR_IMPULSE, contacts)
    if has_start:
        change -= impulse_of(c, START_IMPULSE, contacts)
        moment -= impulse_of(c, START_ANGULAR_IMPULSE, contacts)
    impulse = world_vector(row.normal, row.tangent, change)
    angular_impulse = world_vector(row.normal, row.tangent, moment)
    before = contact_velocity(row, then)
    spin_before = then.angular_a - then.angular_b
    spin = now.angular_a - now.angular_b
    slope = wp.dot(impulse, before) + wp.dot(angular_impulse, spin_before) + change[0] * row.bias_velocity
    gained = wp.dot(impulse, contact_velocity(row, now) - before) + wp.dot(angular_impulse, spin - spin_before)
    return wp.vec2(-slope, gained)


@wp.func
def scale_row(c: int, t: float, contacts: Contacts):
    """Multiply the impulses of a row by a factor."""
    set_impulse(c, IMPULSE, t * impulse_of(c, IMPULSE, contacts), contacts)
    set_impulse(c, ANGULAR_IMPULSE, t * impulse_of(c, ANGULAR_IMPULSE, contacts), contacts)


@wp.func
def blend_row(c: int, t: float, contacts: Contacts):
    """Interpolate linearly from the stored start impulses (t = 0) to the current impulses (t = 1)."""
    start = impulse_of(c, START_IMPULSE, contacts)
    set_impulse(c, IMPULSE, start + t * (impulse_of(c, IMPULSE, contacts) - start), contacts)
    moment = impulse_of(c, START_ANGULAR_IMPULSE, contacts)
    set_impulse(c, ANGULAR_IMPULSE, moment + t * (impulse_of(c, ANGULAR_IMPULSE, contacts) - moment), contacts)


@wp.func
def extrapolate_row(c: int, beta: float, contacts: Contacts):
    """Extrapolate the impulses by `beta` times their change since the start impulses, and store them as these."""
    new = impulse_of(c, IMPULSE, contacts)
    set_impulse(c, IMPULSE, new + beta * (new - impulse_of(c, START_IMPULSE, contacts)), contacts)
    set_impulse(c, START_IMPULSE, new, contacts)
    moment = impulse_of(c, ANGULAR_IMPULSE, contacts)
    set_impulse(c, ANGULAR_IMPULSE, moment + beta * (moment - impulse_of(c, START_ANGULAR_IMPULSE, contacts)), contacts)
    set_impulse(c, START_ANGULAR_IMPULSE, moment, contacts)
