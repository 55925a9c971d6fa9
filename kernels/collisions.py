"""Collisions: impacts with restitution, before the velocity update (Guendelman et al. 2003, sections 4 and 6).

A body at rest has no velocity here, gravity comes later: nothing that rests can bounce, without any threshold speed.
Only contacts that approach and would close within the step take part, so what merely touches is left to the contact
stage. A visit treats all contacts of a pair at once: each aims at -e times its approach, none pulls, friction stays in
its cone, and the pair's impulse is scaled down if it would gain energy. Pairs follow one another, so a blow
travels along a row of balls.

Symplectic Euler's velocity lags half a step of acceleration behind, and the impact is dealt with up to a step before
the surfaces meet. Reflecting the velocity as it is changes the height of a bounce by |v| dt. So the velocity is centred
in time, carried down the gap, reflected there and carried back: with v the centred approach, p the pull that closes
the gap g, the rebound is sqrt(e^2 (v^2 + 2 p g) - 2 p g). The centring fades out for the slowest impacts so that rest
stays rest; an impact too weak to come back up the gap is left to the contact stage, and bounces when it has landed.
"""

import warp as wp

from warp_rigid.kernels.data import Bodies, Contacts, Environments, Graph, Motions, Pairs, State
from warp_rigid.kernels.impulses import friction_impulse, meet, push_both, slip_velocity
from warp_rigid.kernels.tangents import tangent_of

wp.set_module_options({"enable_backward": False})

INNER_ITERATIONS = wp.constant(8)
"""Rounds over the contacts of one pair."""

SLOWEST = wp.constant(1.0e-4)
"""Approach below which a contact is no collision [m/s]."""


@wp.func
def rebound(c: int, dt: float, first: int, contacts: Contacts, motions: Motions, state: State):
    """Normal velocity that the contact aims at, or -1e10 if it does not collide in this step."""
    n = contacts.normal[c]
    speed = -wp.dot(slip_velocity(c, contacts, state), n)
    a = contacts.body_a[c]
    b = contacts.body_b[c]
    pull = float(first) * wp.max(wp.dot(motions.acceleration[b] - motions.acceleration[a], n), 0.0)
    if speed < SLOWEST or contacts.closing[c] > speed + dt * pull:
        return -1.0e10
    e = contacts.restitution[c]
    if e == 0.0:
        return 0.0
    lag = 0.5 * dt * pull * wp.min(speed / wp.max(dt * pull, 1.0e-9), 1.0)
    fall = 2.0 * pull * wp.max(contacts.gap[c], 0.0)
    squared = e * e * ((speed + lag) * (speed + lag) + fall) - fall
    if squared <= 0.0:
        return -1.0e10
    return wp.sqrt(squared) + lag


@wp.func
def collide_contact(c: int, bodies: Bodies, motions: Motions, contacts: Contacts, state: State):
    """One visit inside a pair: bring the normal velocity to its target, the slip to zero within the cone."""
    n = contacts.normal[c]
    u = tangent_of(n)
    v = wp.cross(n, u)
    old = contacts.reaction[c]
    missing = contacts.target[c] - wp.dot(slip_velocity(c, contacts, state), n)
    normal = wp.max(old[0] + missing / (contacts.normal_a[c] + contacts.normal_b[c]), 0.0)
    push_both(c, (normal - old[0]) * n, 1.0, 1.0, bodies, motions, contacts, state)
    slip = slip_velocity(c, contacts, state)
    k = contacts.tangent_a[c] + contacts.tangent_b[c]
    before = wp.vec2(old[1], old[2])
    after = friction_impulse(before, wp.vec2(wp.dot(slip, u), wp.dot(slip, v)), k, contacts.friction[c] * normal)
    push_both(c, (after[0] - old[1]) * u + (after[1] - old[2]) * v, 1.0, 1.0, bodies, motions, contacts, state)
    contacts.reaction[c] = wp.vec3(normal, after[0], after[1])


@wp.func
def collide_pair(
    first_contact: int,
    last_contact: int,
    dt: float,
    first: int,
    bodies: Bodies,
    motions: Motions,
    contacts: Contacts,
    state: State,
):
    """Let the contacts of a pair collide together. Returns 1 if any did."""
    colliding = int(0)
    for c in range(first_contact, last_contact):
        target = rebound(c, dt, first, contacts, motions, state)
        contacts.target[c] = target
        contacts.reaction[c] = wp.vec3(0.0, 0.0, 0.0)
        if target > -1.0e9:
            colliding = 1
    if colliding == 0:
        return 0
    a = contacts.body_a[first_contact]
    b = contacts.body_b[first_contact]
    va = state.linear_velocity[a]
    wa = state.angular_velocity[a]
    vb = state.linear_velocity[b]
    wb = state.angular_velocity[b]
    for _ in range(INNER_ITERATIONS):
        for c in range(first_contact, last_contact):
            if contacts.target[c] > -1.0e9:
                collide_contact(c, bodies, motions, contacts, state)
    lag = 0.5 * dt * float(first) * (motions.acceleration[a] - motions.acceleration[b])
    keep = energy_neutral_share(first_contact, last_contact, va, wa, vb, wb, lag, contacts, state)
    state.linear_velocity[a] = va + keep * (state.linear_velocity[a] - va)
    state.angular_velocity[a] = wa + keep * (state.angular_velocity[a] - wa)
    state.linear_velocity[b] = vb + keep * (state.linear_velocity[b] - vb)
    state.angular_velocity[b] = wb + keep * (state.angular_velocity[b] - wb)
    return 1


@wp.func
def energy_neutral_share(
    first_contact: int,
    last_contact: int,
    va: wp.vec3,
    wa: wp.vec3,
    vb: wp.vec3,
    wb: wp.vec3,
    lag: wp.vec3,
    contacts: Contacts,
    state: State,
):
    """Largest share in [0, 1] of the pair's impulse that gains no kinetic energy.

    With the share s the energy changes by s J.u + s^2 J.du / 2, u the time-centred relative velocities before (which
    differ from the stored ones by `lag`), du their change.
    """
    linear = float(0.0)
    quadratic = float(0.0)
    for c in range(first_contact, last_contact):
        n = contacts.normal[c]
        t = tangent_of(n)
        j = contacts.reaction[c]
        impulse = j[0] * n + j[1] * t + j[2] * wp.cross(n, t)
        before = va + wp.cross(wa, contacts.arm_a[c]) - vb - wp.cross(wb, contacts.arm_b[c])
        linear += wp.dot(impulse, before + lag)
        quadratic += 0.5 * wp.dot(impulse, slip_velocity(c, contacts, state) - before)
    if linear + quadratic <= 0.0 or quadratic <= 0.0:
        return 1.0
    return wp.clamp(-linear / quadratic, 0.0, 1.0)


@wp.kernel
def collide(
    dt: float,
    bodies_per_env: int,
    bodies: Bodies,
    motions: Motions,
    envs: Environments,
    graph: Graph,
    pairs: Pairs,
    contacts: Contacts,
    state: State,
):
    """One block an environment: sweeps of pairwise impacts until none is left or the iterations are spent."""
    env, lane = wp.tid()
    rows = env * (bodies_per_env + 2)
    for iteration in range(envs.collision_iterations[env]):
        if lane == 0:
            graph.residual[env, (iteration + 1) % 3] = 0.0
            if iteration == 0:
                graph.residual[env, 0] = 0.0
        meet()
        for group in range(graph.level_start[rows], graph.level_start[rows + graph.level_count[env] + 1]):
            for k in range(graph.group_start[group] + lane, graph.group_start[group + 1], wp.block_dim()):
                begin = pairs.contact_start[graph.order[k]]
                end = pairs.contact_start[graph.order[k] + 1]
                if collide_pair(begin, end, dt, envs.collision_first[env], bodies, motions, contacts, state) == 1:
                    wp.atomic_max(graph.residual, env, iteration % 3, 1.0)
            meet()
        if graph.residual[env, iteration % 3] == 0.0:
            return
