"""Contact impulses: projected Gauss-Seidel with the exact Coulomb cone.

A contact keeps its accumulated impulse (normal, two tangents). A visit first lets the normal part take away what
approach remains beyond the gap, never pulling; then the tangential part takes away the slip, inside the disk of radius
friction times normal part. Sticking is tried with the full tangential matrix, as in Guendelman et al. 2003, section 7;
if it leaves the disk, a projected step of the smallest safe length is taken, whose fixed point opposes the slip.

A solver kernel runs with one block an environment. A block's lanes share the pairs of a group, which no body has in
common, and meet before the next group. On the CPU a block has one lane and the same code is a plain loop.
"""

import warp as wp

from warp_rigid.kernels.data import Bodies, Contacts, Environments, Graph, Motions, Pairs, State
from warp_rigid.kernels.tangents import in_world, tangent_of

wp.set_module_options({"enable_backward": False})


@wp.func_native("WP_TILE_SYNC();")
def meet():
    """Let all lanes of a block arrive before any goes on."""
    ...


@wp.func
def slip_velocity(c: int, contacts: Contacts, state: State):
    """Velocity of the first body relative to the second at the contact."""
    a = contacts.body_a[c]
    b = contacts.body_b[c]
    va = state.linear_velocity[a] + wp.cross(state.angular_velocity[a], contacts.arm_a[c])
    vb = state.linear_velocity[b] + wp.cross(state.angular_velocity[b], contacts.arm_b[c])
    return va - vb


@wp.func
def push(body: int, arm: wp.vec3, impulse: wp.vec3, bodies: Bodies, motions: Motions, state: State):
    """Apply a world impulse at an arm from the centre of mass. Static and kinematic bodies do not answer."""
    if bodies.inverse_mass[body] > 0.0:
        state.linear_velocity[body] = state.linear_velocity[body] + bodies.inverse_mass[body] * impulse
        spin = motions.inverse_inertia[body] * wp.cross(arm, impulse)
        state.angular_velocity[body] = state.angular_velocity[body] + spin


@wp.func
def push_both(
    c: int,
    impulse: wp.vec3,
    share_a: float,
    share_b: float,
    bodies: Bodies,
    motions: Motions,
    contacts: Contacts,
    state: State,
):
    """Apply an impulse to the first body and its opposite to the second; a frozen body (share 0) takes nothing."""
    if share_a > 0.0:
        push(contacts.body_a[c], contacts.arm_a[c], impulse, bodies, motions, state)
    if share_b > 0.0:
        push(contacts.body_b[c], contacts.arm_b[c], -impulse, bodies, motions, state)


@wp.func
def friction_impulse(old: wp.vec2, slip: wp.vec2, k: wp.vec3, limit: float):
    """New tangential impulse from the old one, the slip, the tangential matrix (11, 12, 22) and the disk's radius."""
    determinant = wp.max(k[0] * k[2] - k[1] * k[1], 1.0e-30)
    stick = old - wp.vec2(k[2] * slip[0] - k[1] * slip[1], k[0] * slip[1] - k[1] * slip[0]) / determinant
    if wp.length_sq(stick) <= limit * limit:
        return stick
    mean = 0.5 * (k[0] + k[2])
    deviation = 0.5 * (k[0] - k[2])
    largest = mean + wp.sqrt(deviation * deviation + k[1] * k[1])
    slide = old - slip / largest
    length = wp.length(slide)
    if length > limit:
        slide = slide * (limit / length)
    return slide


@wp.func
def twist_both(
    c: int,
    twist: wp.vec3,
    share_a: float,
    share_b: float,
    motions: Motions,
    contacts: Contacts,
    state: State,
):
    """Apply an angular impulse to the first body and its opposite to the second; frozen bodies take nothing."""
    a = contacts.body_a[c]
    b = contacts.body_b[c]
    state.angular_velocity[a] = state.angular_velocity[a] + share_a * (motions.inverse_inertia[a] * twist)
    state.angular_velocity[b] = state.angular_velocity[b] - share_b * (motions.inverse_inertia[b] * twist)


@wp.func
def resist_turning(
    c: int,
    share_a: float,
    share_b: float,
    motions: Motions,
    contacts: Contacts,
    state: State,
):
    """Rolling and spinning friction: torques up to a coefficient [m] times the normal impulse."""
    a = contacts.body_a[c]
    b = contacts.body_b[c]
    n = contacts.normal[c]
    u = tangent_of(n)
    v = wp.cross(n, u)
    k = share_a * motions.inverse_inertia[a] + share_b * motions.inverse_inertia[b]
    old = contacts.twist[c]
    spin = state.angular_velocity[a] - state.angular_velocity[b]
    limit = contacts.spinning_friction[c] * contacts.impulse[c][0]
    about_normal = wp.clamp(old[0] - wp.dot(spin, n) / wp.max(wp.dot(n, k * n), 1.0e-30), -limit, limit)
    twist_both(c, (about_normal - old[0]) * n, share_a, share_b, motions, contacts, state)
    spin = state.angular_velocity[a] - state.angular_velocity[b]
    matrix = wp.vec3(wp.dot(u, k * u), wp.dot(u, k * v), wp.dot(v, k * v))
    limit = contacts.rolling_friction[c] * contacts.impulse[c][0]
    rolling = friction_impulse(wp.vec2(old[1], old[2]), wp.vec2(wp.dot(spin, u), wp.dot(spin, v)), matrix, limit)
    twist_both(c, (rolling[0] - old[1]) * u + (rolling[1] - old[2]) * v, share_a, share_b, motions, contacts, state)
    new = wp.vec3(about_normal, rolling[0], rolling[1])
    contacts.twist[c] = new
    if share_a * share_b == 0.0:
        contacts.twist_reaction[c] = contacts.twist_reaction[c] + in_world(n, new - old)


@wp.func
def visit_contact(
    c: int,
    share_a: float,
    share_b: float,
    bodies: Bodies,
    motions: Motions,
    contacts: Contacts,
    state: State,
):
    """Solve one contact against the velocities at hand. Returns by how much it changed them [m/s].

    A share of 0 freezes that body: it weighs nothing in the contact, and what it did not take goes to `reaction`.
    """
    k_normal = share_a * contacts.normal_a[c] + share_b * contacts.normal_b[c]
    if k_normal < 1.0e-12:
        return 0.0
    n = contacts.normal[c]
    u = tangent_of(n)
    v = wp.cross(n, u)
    old = contacts.impulse[c]
    approach = wp.dot(slip_velocity(c, contacts, state), n) + contacts.closing[c]
    normal = wp.max(old[0] - approach / k_normal, 0.0)
    push_both(c, (normal - old[0]) * n, share_a, share_b, bodies, motions, contacts, state)
    slip = slip_velocity(c, contacts, state)
    k = share_a * contacts.tangent_a[c] + share_b * contacts.tangent_b[c]
    before = wp.vec2(old[1], old[2])
    after = friction_impulse(before, wp.vec2(wp.dot(slip, u), wp.dot(slip, v)), k, contacts.friction[c] * normal)
    tangential = (after[0] - old[1]) * u + (after[1] - old[2]) * v
    push_both(c, tangential, share_a, share_b, bodies, motions, contacts, state)
    contacts.impulse[c] = wp.vec3(normal, after[0], after[1])
    if share_a * share_b == 0.0:
        contacts.reaction[c] = contacts.reaction[c] + (normal - old[0]) * n + tangential
    if contacts.rolling_friction[c] + contacts.spinning_friction[c] > 0.0:
        resist_turning(c, share_a, share_b, motions, contacts, state)
    return k_normal * wp.abs(normal - old[0]) + wp.sqrt((k[0] + k[2]) * k_normal) * wp.length(after - before)


@wp.kernel
def warm_start(
    bodies_per_env: int,
    bodies: Bodies,
    motions: Motions,
    envs: Environments,
    graph: Graph,
    pairs: Pairs,
    contacts: Contacts,
    state: State,
):
    """One block an environment: apply the impulses that the contacts start from."""
    env, lane = wp.tid()
    if envs.warm_starting[env] == 0:
        return
    rows = env * (bodies_per_env + 2)
    for group in range(graph.level_start[rows], graph.level_start[rows + graph.level_count[env] + 1]):
        for k in range(graph.group_start[group] + lane, graph.group_start[group + 1], wp.block_dim()):
            pair = graph.order[k]
            for c in range(pairs.contact_start[pair], pairs.contact_start[pair + 1]):
                world = in_world(contacts.normal[c], contacts.impulse[c])
                push_both(c, world, 1.0, 1.0, bodies, motions, contacts, state)
                twist_both(c, in_world(contacts.normal[c], contacts.twist[c]), 1.0, 1.0, motions, contacts, state)
        meet()


@wp.kernel
def sweep_contacts(
    after_shock: int,
    bodies_per_env: int,
    bodies: Bodies,
    motions: Motions,
    envs: Environments,
    graph: Graph,
    pairs: Pairs,
    contacts: Contacts,
    state: State,
):
    """One block an environment: half the contact iterations, before or after shock propagation, from the ground up."""
    env, lane = wp.tid()
    rows = env * (bodies_per_env + 2)
    sweeps = (envs.contact_iterations[env] + 1 - after_shock) / 2
    for _sweep in range(sweeps):
        for group in range(graph.level_start[rows], graph.level_start[rows + graph.level_count[env] + 1]):
            for k in range(graph.group_start[group] + lane, graph.group_start[group + 1], wp.block_dim()):
                pair = graph.order[k]
                for c in range(pairs.contact_start[pair], pairs.contact_start[pair + 1]):
                    visit_contact(c, 1.0, 1.0, bodies, motions, contacts, state)
            meet()
