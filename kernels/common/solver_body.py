"""Solver bodies: velocities, inverse masses, and the two bodies of a constraint in registers.

On a GPU, the solver is limited by memory latency. The records that it reads often are therefore packed in groups of
four words, and read group by group (declare.py).
"""

import warp as wp

from warp_rigid.kernels.declare import group_of, group_reader, group_writer, record_reader
from warp_rigid.kernels.schema import Bodies, Motions, OrderRecord, SolverBodyRecord

wp.set_module_options({"enable_backward": False})

read_solver_body = group_reader(SolverBodyRecord)
write_solver_body = group_writer(SolverBodyRecord)

read_entry = record_reader(OrderRecord)
"""Reads an entry of the solving order: (k, entries)."""

VELOCITY = group_of(SolverBodyRecord, "linear")
INERTIA = group_of(SolverBodyRecord, "inverse_inertia_xx")
PUSH = group_of(SolverBodyRecord, "push_linear")
START = group_of(SolverBodyRecord, "start_linear")
UNDER_LOAD = group_of(SolverBodyRecord, "loaded_linear")
BEFORE_CONTACTS = group_of(SolverBodyRecord, "before_contacts_linear")
"""First group of each velocity: the linear velocity, followed by the angular velocity."""


@wp.struct
class BodyPair:
    """The two bodies of a constraint in registers. Bodies that are not dynamic, or are frozen, have inverse mass 0.

    `frozen_impulse` and `frozen_angular_impulse` are the impulses on a frozen body, which do not change its velocity
    [N s, N m s]. `change` is the largest velocity change by a row so far [m/s].
    """

    linear_a: wp.vec3
    angular_a: wp.vec3
    linear_b: wp.vec3
    angular_b: wp.vec3
    inverse_mass_a: float
    inverse_mass_b: float
    inverse_inertia_a: wp.mat33
    inverse_inertia_b: wp.mat33
    frozen_impulse: wp.vec3
    frozen_angular_impulse: wp.vec3
    change: float


@wp.func
def first_three(q: wp.vec4):
    """The first three components of a group of four words."""
    return wp.vec3(q[0], q[1], q[2])


@wp.func
def inverse_mass_of(b: int, motions: Motions):
    """A body's inverse mass [1/kg], 0 unless it is dynamic."""
    return read_solver_body(motions.solver_bodies, b, VELOCITY)[3]


@wp.func
def inertia_at(b: int, bodies: wp.array[SolverBodyRecord]):
    """A body's inverse inertia tensor in the world frame [1/(kg m^2)]."""
    q = read_solver_body(bodies, b, INERTIA)
    r = read_solver_body(bodies, b, INERTIA + 1)
    return wp.mat33(q[0], q[1], q[2], q[1], q[3], r[0], q[2], r[0], r[1])


@wp.func
def inverse_inertia_of(b: int, motions: Motions):
    """A body's inverse inertia tensor in the world frame [1/(kg m^2)]."""
    return inertia_at(b, motions.solver_bodies)


@wp.func
def inverse_inertia_at(b: int, turn: wp.quat, bodies: Bodies):
    """A body's inverse inertia tensor in the world frame, for an orientation [1/(kg m^2)]."""
    r = wp.quat_to_matrix(turn)
    return r * bodies.inverse_inertia[b] * wp.transpose(r)


@wp.func
def store_inverse_inertia(b: int, inverse: wp.mat33, motions: Motions):
    """Store a body's inverse inertia tensor in the world frame [1/(kg m^2)]."""
    motions.solver_bodies[b].inverse_inertia_xx = wp.vec4(inverse[0, 0], inverse[0, 1], inverse[0, 2], inverse[1, 1])
    motions.solver_bodies[b].inverse_inertia_yz = wp.vec3(inverse[1, 2], inverse[2, 2], 0.0)


@wp.func
def load_velocity(b: int, which: int, motions: Motions):
    """A linear velocity of a body, by its first group; the angular velocity is at `which` + 1."""
    return first_three(read_solver_body(motions.solver_bodies, b, which))


@wp.func
def store_velocity(b: int, which: int, linear: wp.vec3, angular: wp.vec3, motions: Motions):
    """Store one of a body's additional velocities: PUSH, START, UNDER_LOAD or BEFORE_CONTACTS."""
    write_solver_body(motions.solver_bodies, b, which, linear, 0.0)
    write_solver_body(motions.solver_bodies, b, which + 1, angular, 0.0)


@wp.func
def load_bodies(a: int, b: int, mobility_a: float, mobility_b: float, motions: Motions):
    """Load two bodies; a body whose mobility is 0 is frozen."""
    pair = BodyPair()
    q = read_solver_body(motions.solver_bodies, a, VELOCITY)
    pair.linear_a = first_three(q)
    pair.inverse_mass_a = wp.where(mobility_a > 0.0, q[3], 0.0)
    pair.angular_a = load_velocity(a, VELOCITY + 1, motions)
    q = read_solver_body(motions.solver_bodies, b, VELOCITY)
    pair.linear_b = first_three(q)
    pair.inverse_mass_b = wp.where(mobility_b > 0.0, q[3], 0.0)
    pair.angular_b = load_velocity(b, VELOCITY + 1, motions)
    if mobility_a > 0.0:
        pair.inverse_inertia_a = inverse_inertia_of(a, motions)
    if mobility_b > 0.0:
        pair.inverse_inertia_b = inverse_inertia_of(b, motions)
    return pair


@wp.func
def with_velocities(a: int, b: int, which: int, pair: BodyPair, motions: Motions):
    """The pair with its velocities replaced by PUSH, START, UNDER_LOAD or BEFORE_CONTACTS."""
    pair.linear_a = load_velocity(a, which, motions)
    pair.angular_a = load_velocity(a, which + 1, motions)
    pair.linear_b = load_velocity(b, which, motions)
    pair.angular_b = load_velocity(b, which + 1, motions)
    return pair


@wp.func
def store_bodies(a: int, b: int, pair: BodyPair, motions: Motions):
    """Store the velocities of the bodies that have an inverse mass."""
    if pair.inverse_mass_a > 0.0:
        write_solver_body(motions.solver_bodies, a, VELOCITY, pair.linear_a, pair.inverse_mass_a)
        write_solver_body(motions.solver_bodies, a, VELOCITY + 1, pair.angular_a, 0.0)
    if pair.inverse_mass_b > 0.0:
        write_solver_body(motions.solver_bodies, b, VELOCITY, pair.linear_b, pair.inverse_mass_b)
        write_solver_body(motions.solver_bodies, b, VELOCITY + 1, pair.angular_b, 0.0)


@wp.func
def store_velocities(a: int, b: int, which: int, pair: BodyPair, motions: Motions):
    """Store the velocities of the bodies that have an inverse mass as PUSH or UNDER_LOAD."""
    if pair.inverse_mass_a > 0.0:
        store_velocity(a, which, pair.linear_a, pair.angular_a, motions)
    if pair.inverse_mass_b > 0.0:
        store_velocity(b, which, pair.linear_b, pair.angular_b, motions)


@wp.func
def relative_velocity(arm_a: wp.vec3, arm_b: wp.vec3, pair: BodyPair):
    """Velocity of the first body relative to the second, at points relative to their centres of mass [m/s]."""
    va = pair.linear_a + wp.cross(pair.angular_a, arm_a)
    return va - pair.linear_b - wp.cross(pair.angular_b, arm_b)


@wp.func
def with_impulse(arm_a: wp.vec3, arm_b: wp.vec3, impulse: wp.vec3, pair: BodyPair):
    """The bodies after applying an impulse [N s] to the first at `arm_a`, and its opposite to the second at `arm_b`."""
    pair.linear_a += pair.inverse_mass_a * impulse
    pair.angular_a += pair.inverse_inertia_a * wp.cross(arm_a, impulse)
    pair.linear_b -= pair.inverse_mass_b * impulse
    pair.angular_b -= pair.inverse_inertia_b * wp.cross(arm_b, impulse)
    return pair


@wp.func
def at_rest(pair: BodyPair):
    """The pair with velocities of 0."""
    pair.linear_a = wp.vec3(0.0, 0.0, 0.0)
    pair.angular_a = wp.vec3(0.0, 0.0, 0.0)
    pair.linear_b = wp.vec3(0.0, 0.0, 0.0)
    pair.angular_b = wp.vec3(0.0, 0.0, 0.0)
    return pair


@wp.func
def with_angular_impulse(angular_impulse: wp.vec3, pair: BodyPair):
    """The bodies after applying an angular impulse [N m s] to the first, and its opposite to the second."""
    pair.angular_a += pair.inverse_inertia_a * angular_impulse
    pair.angular_b -= pair.inverse_inertia_b * angular_impulse
    return pair


@wp.func
def inverse_effective_mass(arm: wp.vec3, d: wp.vec3, e: wp.vec3, inverse_mass: float, inverse_inertia: wp.mat33):
    """Entry d . K e of the collision matrix K = 1/m + [r]^T I^-1 [r] of one body (Guendelman 2003, section 7)."""
    return inverse_mass * wp.dot(d, e) + wp.dot(wp.cross(arm, d), inverse_inertia * wp.cross(arm, e))
