"""Load distribution: how the contacts of a sliding pair share its load.

More than three contacts in a plane can carry a load in many ways. The sweeps find one that depends on their order, and
warm starting keeps it. Friction is limited at each contact, so it depends on the distribution where a sliding body is
braked (Farkas, Bartels, Unger and Wolf 2003). Before the sweeps, the normal impulses of a sliding pair are therefore
replaced by those with the same sum and the same torque that have the smallest sum of squares. They are linear in the
position of the contact, as on an elastic ground. Friction changes with them, so that it stays at its limit; velocities
do not change unless the body spins.
"""

import warp as wp

from warp_rigid.kernels.common.arithmetic import quotient
from warp_rigid.kernels.constraints.contact import IMPULSE, impulse_of, read_contact, set_impulse
from warp_rigid.kernels.schema import ContactRecord, Contacts
from warp_rigid.kernels.tuning import ON_A_LINE, PARALLEL_NORMALS, SLIDING_SHARE

wp.set_module_options({"enable_backward": False})

DETERMINATE = wp.constant(3)
"""Number of contacts in a plane whose loads are determined by statics."""


@wp.struct
class LoadPlane:
    """Normal impulses as a linear function of the position in the plane of a pair's contacts.

    `origin` [m] is relative to the centre of mass of a body, `u` and `v` are the axes of the plane. `value` [N s] is
    the impulse at the origin, `slope` [N s/m] its change along the axes. `redundant` is 0 if statics determines the
    loads, or if the contacts are not in a plane.
    """

    origin: wp.vec3
    u: wp.vec3
    v: wp.vec3
    value: float
    slope: wp.vec2
    redundant: int


@wp.func
def place_of(row: ContactRecord, plane: LoadPlane):
    """Coordinates of a contact in the plane [m]."""
    d = wp.where(row.normal_a > 0.0, row.arm_a, row.arm_b) - plane.origin
    return wp.vec2(wp.dot(d, plane.u), wp.dot(d, plane.v))


@wp.func
def linear_load(n: float, load: wp.vec3, place: wp.vec2, moment: wp.vec3, plane: LoadPlane):
    """The plane with the linear function that has the sum and torque of n impulses.

    Args:
        n: number of contacts.
        load: sums of the impulses [N s], and of the impulses times the coordinates [N s m].
        place: sum of the coordinates [m].
        moment: sums of the products xx, xy and yy of the coordinates [m^2].
        plane: the plane.
    """
    plane.redundant = 1
    mean = place / n
    central = moment - n * wp.vec3(mean[0] * mean[0], mean[0] * mean[1], mean[1] * mean[1])
    spread = ON_A_LINE * (central[0] + central[2])
    central += wp.vec3(spread, 0.0, spread)
    x = load[1] - load[0] * mean[0]
    y = load[2] - load[0] * mean[1]
    inverse = quotient(1.0, wp.max(central[0] * central[2] - central[1] * central[1], 1.0e-30))
    plane.slope = inverse * wp.vec2(central[2] * x - central[1] * y, central[0] * y - central[1] * x)
    plane.value = load[0] / n - wp.dot(plane.slope, mean)
    return plane


@wp.func
def slides(begin: int, end: int, contacts: Contacts):
    """Whether the friction of a pair is at its limit."""
    friction = float(0.0)
    normal = float(0.0)
    for c in range(begin, end):
        impulse = impulse_of(c, IMPULSE, contacts)
        normal += impulse[0]
        friction += wp.length(wp.vec2(impulse[1], impulse[2]))
    limit = read_contact(begin, contacts.rows).friction * normal
    return limit > 0.0 and friction > SLIDING_SHARE * limit


@wp.func
def find_load_plane(begin: int, end: int, contacts: Contacts):
    """The plane of a pair's contacts, and the linear function of their impulses; contacts with a gap are left out."""
    first = read_contact(begin, contacts.rows)
    plane = LoadPlane()
    plane.origin = wp.where(first.normal_a > 0.0, first.arm_a, first.arm_b)
    plane.u = first.tangent
    plane.v = wp.cross(first.normal, first.tangent)
    n = float(0.0)
    flattest = float(1.0)
    load = wp.vec3(0.0, 0.0, 0.0)
    place = wp.vec2(0.0, 0.0)
    moment = wp.vec3(0.0, 0.0, 0.0)
    for c in range(begin, end):
        row = read_contact(c, contacts.rows)
        flattest = wp.min(flattest, wp.dot(row.normal, first.normal))
        if row.bias_velocity <= 0.0:
            p = place_of(row, plane)
            n += 1.0
            load += impulse_of(c, IMPULSE, contacts)[0] * wp.vec3(1.0, p[0], p[1])
            place += p
            moment += wp.vec3(p[0] * p[0], p[0] * p[1], p[1] * p[1])
    if n > float(DETERMINATE) and flattest > PARALLEL_NORMALS:
        plane = linear_load(n, load, place, moment, plane)
    return plane


@wp.func
def planned_impulse(row: ContactRecord, plane: LoadPlane):
    """The normal impulse of a contact by the linear function [N s]."""
    return plane.value + wp.dot(plane.slope, place_of(row, plane))


@wp.func
def distribute_contact_load(begin: int, end: int, contacts: Contacts):
    """Distribute the normal impulses of a pair that slides on a plane, as far as no contact would have to pull."""
    if end - begin <= DETERMINATE:
        return
    if not slides(begin, end, contacts):
        return
    plane = find_load_plane(begin, end, contacts)
    if plane.redundant == 0:
        return
    share = float(1.0)
    for c in range(begin, end):
        row = read_contact(c, contacts.rows)
        planned = planned_impulse(row, plane)
        if row.bias_velocity <= 0.0 and planned < 0.0:
            present = impulse_of(c, IMPULSE, contacts)[0]
            share = wp.min(share, quotient(present, present - planned))
    for c in range(begin, end):
        row = read_contact(c, contacts.rows)
        if row.bias_velocity <= 0.0:
            impulse = impulse_of(c, IMPULSE, contacts)
            normal = wp.max(impulse[0] + share * (planned_impulse(row, plane) - impulse[0]), 0.0)
            factor = wp.where(impulse[0] > 0.0, quotient(normal, impulse[0]), 1.0)
            set_impulse(c, IMPULSE, wp.vec3(normal, factor * impulse[1], factor * impulse[2]), contacts)
