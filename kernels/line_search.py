"""The line search that keeps two-pass shock propagation from ever gaining energy.

The two passes give a search direction. With v0, l0 the velocities and impulses before and dv, dl their
change, the contact problem's energy f(l) = v.Mv / 2 + b.l along the segment is a parabola. Its minimum

    t = clamp(-(v0.M dv + b.dl) / (dv.M dv), 0, 1)

is taken, one t an island: the cones are convex, so the impulses stay admissible, and f never rises. Since
dv = M^-1 J^T dl, both sums run over contacts: v0.M dv = sum dl.(J v0) and dv.M dv = sum dl.(J dv).
"""

import warp as wp

from warp_rigid.kernels.data import (
    MOTION_DYNAMIC,
    SHOCK_TWO_PASS,
    Bodies,
    Contacts,
    Environments,
    Graph,
    Motions,
    Pairs,
    State,
)
from warp_rigid.kernels.impulses import slip_velocity
from warp_rigid.kernels.tangents import in_world

wp.set_module_options({"enable_backward": False})

DYNAMIC = wp.constant(MOTION_DYNAMIC)
TWO_PASS = wp.constant(SHOCK_TWO_PASS)


@wp.kernel
def remember_start(bodies_per_env: int, graph: Graph, pairs: Pairs, contacts: Contacts, motions: Motions, state: State):
    """One block an environment: keep velocities and impulses as they are before the passes."""
    env, lane = wp.tid()
    first = env * bodies_per_env
    for b in range(first + lane, first + bodies_per_env, wp.block_dim()):
        motions.start_linear[b] = state.linear_velocity[b]
        motions.start_angular[b] = state.angular_velocity[b]
        graph.numerator[b] = 0.0
        graph.denominator[b] = 0.0
    begin = pairs.contact_start[pairs.start[first]]
    end = pairs.contact_start[pairs.start[first + bodies_per_env]]
    for c in range(begin + lane, end, wp.block_dim()):
        contacts.start_impulse[c] = contacts.impulse[c]
        contacts.start_twist[c] = contacts.twist[c]
        contacts.reaction[c] = wp.vec3(0.0, 0.0, 0.0)
        contacts.twist_reaction[c] = wp.vec3(0.0, 0.0, 0.0)


@wp.func
def island_of(c: int, bodies: Bodies, graph: Graph, contacts: Contacts):
    """The island of a contact: that of a dynamic body in it."""
    a = contacts.body_a[c]
    return wp.where(bodies.motion[a] == DYNAMIC, graph.island[a], graph.island[contacts.body_b[c]])


@wp.func
def start_slip(c: int, contacts: Contacts, motions: Motions):
    """Relative velocity at the contact before the passes."""
    a = contacts.body_a[c]
    b = contacts.body_b[c]
    va = motions.start_linear[a] + wp.cross(motions.start_angular[a], contacts.arm_a[c])
    vb = motions.start_linear[b] + wp.cross(motions.start_angular[b], contacts.arm_b[c])
    return va - vb


@wp.kernel
def sum_energy(
    bodies_per_env: int,
    bodies: Bodies,
    motions: Motions,
    envs: Environments,
    graph: Graph,
    pairs: Pairs,
    contacts: Contacts,
    state: State,
):
    """One thread an environment: both sums of the line search, island by island, in the order of the contacts."""
    env = wp.tid()
    if envs.shock_propagation[env] != TWO_PASS:
        return
    first = env * bodies_per_env
    begin = pairs.contact_start[pairs.start[first]]
    end = pairs.contact_start[pairs.start[first + bodies_per_env]]
    for c in range(begin, end):
        n = contacts.normal[c]
        change = contacts.impulse[c] - contacts.start_impulse[c]
        impulse = in_world(n, change)
        twist = in_world(n, contacts.twist[c] - contacts.start_twist[c])
        before = start_slip(c, contacts, motions)
        spin_before = motions.start_angular[contacts.body_a[c]] - motions.start_angular[contacts.body_b[c]]
        spin = state.angular_velocity[contacts.body_a[c]] - state.angular_velocity[contacts.body_b[c]]
        island = island_of(c, bodies, graph, contacts)
        slope = wp.dot(impulse, before) + wp.dot(twist, spin_before) + change[0] * contacts.closing[c]
        gained = wp.dot(impulse, slip_velocity(c, contacts, state) - before) + wp.dot(twist, spin - spin_before)
        graph.numerator[island] = graph.numerator[island] - slope
        graph.denominator[island] = graph.denominator[island] + gained


@wp.func
def accepted_share(island: int, graph: Graph):
    """The line search's t of an island."""
    if graph.denominator[island] <= 0.0:
        return 1.0
    return wp.clamp(graph.numerator[island] / graph.denominator[island], 0.0, 1.0)


@wp.kernel
def accept_bodies(bodies_per_env: int, envs: Environments, graph: Graph, motions: Motions, state: State):
    """One thread a body: go the accepted share of the way."""
    b = wp.tid()
    if envs.shock_propagation[b / bodies_per_env] != TWO_PASS:
        return
    t = accepted_share(graph.island[b], graph)
    state.linear_velocity[b] = motions.start_linear[b] + t * (state.linear_velocity[b] - motions.start_linear[b])
    state.angular_velocity[b] = motions.start_angular[b] + t * (state.angular_velocity[b] - motions.start_angular[b])


@wp.kernel
def accept_impulses(
    bodies_per_env: int, bodies: Bodies, envs: Environments, graph: Graph, pairs: Pairs, contacts: Contacts
):
    """One thread a contact: go the accepted share of the way."""
    c = wp.tid()
    if c >= pairs.contact_start[pairs.contact_start.shape[0] - 1]:
        return
    a = contacts.body_a[c]
    if envs.shock_propagation[a / bodies_per_env] != TWO_PASS:
        return
    t = accepted_share(island_of(c, bodies, graph, contacts), graph)
    contacts.impulse[c] = contacts.start_impulse[c] + t * (contacts.impulse[c] - contacts.start_impulse[c])
    contacts.twist[c] = contacts.start_twist[c] + t * (contacts.twist[c] - contacts.start_twist[c])
