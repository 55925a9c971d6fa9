"""Shock propagation: weight travels through a stack in two passes instead of many sweeps.

*Up*, from the lowest level: a level's contacts are iterated with the lower bodies frozen (infinitely heavy) until
nothing changes; what the frozen bodies did not take is kept as `reaction`. With `one_pass`, the method of 2003
(section 8.2), that is all: loads are never felt below. *Down*, from the highest level (after Xiong, Leach, Thomas and
Sueda 2025): each level is iterated once more in the same way, then its lower bodies receive the reactions, so that
the level below sees the load.

The two passes are then only a search direction. With v0, l0 the velocities and impulses before and dv, dl their
change, the contact problem's energy f(l) = v.Mv / 2 + b.l along the segment is a parabola. Its minimum

    t = clamp(-(v0.M dv + b.dl) / (dv.M dv), 0, 1)

is taken, one t an island: the cones are convex, so the impulses stay admissible, and f never rises. Since dv = M^-1 J^T dl,
both sums run over contacts: v0.M dv = sum dl.(J v0) and dv.M dv = sum dl.(J dv).
"""

import warp as wp

from warp_rigid.kernels.data import (
    MOTION_DYNAMIC,
    SHOCK_OFF,
    SHOCK_TWO_PASS,
    Bodies,
    Contacts,
    Environments,
    Graph,
    Motions,
    Pairs,
    State,
)
from warp_rigid.kernels.impulses import meet, push, slip_velocity, visit_contact
from warp_rigid.kernels.narrowphase import tangent_of

wp.set_module_options({"enable_backward": False})

DYNAMIC = wp.constant(MOTION_DYNAMIC)
OFF = wp.constant(SHOCK_OFF)
TWO_PASS = wp.constant(SHOCK_TWO_PASS)

LAYER_ITERATIONS = wp.constant(20)
"""Most iterations of one level in one pass."""

SETTLED = wp.constant(1.0e-6)
"""A level is solved when no visit changes a velocity by more than this [m/s]."""


@wp.func
def solve_level(
    env: int,
    lane: int,
    level: int,
    bodies_per_env: int,
    dt: float,
    bodies: Bodies,
    motions: Motions,
    graph: Graph,
    pairs: Pairs,
    contacts: Contacts,
    state: State,
):
    """Iterate one level with its lower bodies frozen until no visit changes anything."""
    row = env * (bodies_per_env + 2) + level
    for iteration in range(LAYER_ITERATIONS):
        if lane == 0:
            graph.residual[env, (iteration + 1) % 3] = 0.0
            if iteration == 0:
                graph.residual[env, 0] = 0.0
        meet()
        largest = float(0.0)
        for group in range(graph.level_start[row], graph.level_start[row + 1]):
            for k in range(graph.group_start[group] + lane, graph.group_start[group + 1], wp.block_dim()):
                pair = graph.order[k]
                share_a = wp.where(graph.level[pairs.body_a[pair]] == level, 1.0, 0.0)
                share_b = wp.where(graph.level[pairs.body_b[pair]] == level, 1.0, 0.0)
                for c in range(pairs.contact_start[pair], pairs.contact_start[pair + 1]):
                    change = visit_contact(c, share_a, share_b, dt, bodies, motions, contacts, state)
                    largest = wp.max(largest, change)
            meet()
        wp.atomic_max(graph.residual, env, iteration % 3, largest)
        meet()
        if graph.residual[env, iteration % 3] < SETTLED:
            return


@wp.func
def hand_down(
    env: int, lane: int, level: int, bodies_per_env: int, bodies: Bodies, motions: Motions, graph: Graph, pairs: Pairs,
    contacts: Contacts, state: State,
):
    """Give the frozen bodies of a level the reactions that they did not take."""
    row = env * (bodies_per_env + 2) + level
    for group in range(graph.level_start[row], graph.level_start[row + 1]):
        for k in range(graph.group_start[group] + lane, graph.group_start[group + 1], wp.block_dim()):
            pair = graph.order[k]
            for c in range(pairs.contact_start[pair], pairs.contact_start[pair + 1]):
                if graph.level[pairs.body_a[pair]] < level:
                    push(pairs.body_a[pair], contacts.arm_a[c], contacts.reaction[c], bodies, motions, state)
                elif graph.level[pairs.body_b[pair]] < level:
                    push(pairs.body_b[pair], contacts.arm_b[c], -contacts.reaction[c], bodies, motions, state)
                contacts.reaction[c] = wp.vec3(0.0, 0.0, 0.0)
        meet()


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
        contacts.reaction[c] = wp.vec3(0.0, 0.0, 0.0)


@wp.kernel
def propagate(
    repetition: int,
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
    """One block an environment: the pass up, and with two_pass the pass down."""
    env, lane = wp.tid()
    mode = envs.shock_propagation[env]
    if mode == OFF or repetition >= envs.shock_iterations[env]:
        return
    levels = graph.level_count[env]
    for level in range(1, levels + 1):
        solve_level(env, lane, level, bodies_per_env, dt, bodies, motions, graph, pairs, contacts, state)
    if mode == TWO_PASS:
        for up in range(levels):
            level = levels - up
            solve_level(env, lane, level, bodies_per_env, dt, bodies, motions, graph, pairs, contacts, state)
            hand_down(env, lane, level, bodies_per_env, bodies, motions, graph, pairs, contacts, state)


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
    """One thread an environment: both sums of the line search, island by island, in the order of the contacts."""
    env = wp.tid()
    if envs.shock_propagation[env] != TWO_PASS:
        return
    first = env * bodies_per_env
    begin = pairs.contact_start[pairs.start[first]]
    end = pairs.contact_start[pairs.start[first + bodies_per_env]]
    for c in range(begin, end):
        n = contacts.normal[c]
        u = tangent_of(n)
        change = contacts.impulse[c] - contacts.start_impulse[c]
        impulse = change[0] * n + change[1] * u + change[2] * wp.cross(n, u)
        before = start_slip(c, contacts, motions)
        island = graph.island[contacts.body_a[c]]
        if bodies.motion[contacts.body_a[c]] != DYNAMIC:
            island = graph.island[contacts.body_b[c]]
        bias = change[0] * wp.max(contacts.gap[c], 0.0) / dt
        graph.numerator[island] = graph.numerator[island] - wp.dot(impulse, before) - bias
        gained = wp.dot(impulse, slip_velocity(c, contacts, state) - before)
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
    body = wp.where(bodies.motion[a] == DYNAMIC, a, contacts.body_b[c])
    t = accepted_share(graph.island[body], graph)
    contacts.impulse[c] = contacts.start_impulse[c] + t * (contacts.impulse[c] - contacts.start_impulse[c])
