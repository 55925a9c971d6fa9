"""Push-out: separate what still overlaps after the velocities are solved, without touching the velocities.

Contacts that would end the step deeper than the slop get a pseudo-velocity that moves the bodies in this step only.
Levels go from the ground up with the lower bodies frozen (Guendelman et al. 2003, section 8.3), so a deep stack
is set right in one pass.
"""

import warp as wp

from warp_rigid.kernels.data import Bodies, Contacts, Environments, Graph, Motions, Pairs, Shapes, State
from warp_rigid.kernels.impulses import meet, slip_velocity

wp.set_module_options({"enable_backward": False})

LEVEL_ITERATIONS = wp.constant(6)

SLOP = wp.constant(1.0e-4)
"""Overlap left alone, as a part of the smaller body's size."""

RECOVERY = wp.constant(0.25)
"""Part of the overlap taken out in one step."""

FASTEST = wp.constant(2.0)
"""Largest speed at which bodies are pushed apart [m/s]."""


@wp.func
def wanted_speed(c: int, dt: float, shapes: Shapes, bodies: Bodies, contacts: Contacts, state: State):
    """Separation speed that the contact needs [m/s], 0 if none."""
    size = wp.min(
        shapes.shapes[bodies.shape[contacts.body_a[c]]].size, shapes.shapes[bodies.shape[contacts.body_b[c]]].size
    )
    approach = wp.dot(slip_velocity(c, contacts, state), contacts.normal[c])
    left = contacts.gap[c] + dt * approach + SLOP * size
    return wp.min(RECOVERY * wp.max(-left, 0.0) / dt, FASTEST)


@wp.func
def push_contact(c: int, share_a: float, share_b: float, bodies: Bodies, motions: Motions, contacts: Contacts):
    """One visit: bring the pseudo-velocity of separation to its target; reaction[0] is the pseudo-impulse."""
    a = contacts.body_a[c]
    b = contacts.body_b[c]
    n = contacts.normal[c]
    k = share_a * contacts.normal_a[c] + share_b * contacts.normal_b[c]
    if k < 1.0e-12 or contacts.target[c] <= 0.0:
        return
    va = motions.push_linear[a] + wp.cross(motions.push_angular[a], contacts.arm_a[c])
    vb = motions.push_linear[b] + wp.cross(motions.push_angular[b], contacts.arm_b[c])
    old = contacts.reaction[c][0]
    new = wp.max(old + (contacts.target[c] - wp.dot(va - vb, n)) / k, 0.0)
    contacts.reaction[c] = wp.vec3(new, 0.0, 0.0)
    impulse = (new - old) * n
    if share_a > 0.0 and bodies.inverse_mass[a] > 0.0:
        motions.push_linear[a] = motions.push_linear[a] + bodies.inverse_mass[a] * impulse
        motions.push_angular[a] = motions.push_angular[a] + motions.inverse_inertia[a] * wp.cross(
            contacts.arm_a[c], impulse
        )
    if share_b > 0.0 and bodies.inverse_mass[b] > 0.0:
        motions.push_linear[b] = motions.push_linear[b] - bodies.inverse_mass[b] * impulse
        motions.push_angular[b] = motions.push_angular[b] - motions.inverse_inertia[b] * wp.cross(
            contacts.arm_b[c], impulse
        )


@wp.kernel
def find_overlaps(
    dt: float,
    bodies_per_env: int,
    shapes: Shapes,
    bodies: Bodies,
    graph: Graph,
    pairs: Pairs,
    contacts: Contacts,
    state: State,
):
    """One block an environment: the separation speed that each contact needs, and whether any needs one."""
    env, lane = wp.tid()
    if lane == 0:
        graph.residual[env, 0] = 0.0
    meet()
    first = env * bodies_per_env
    begin = pairs.contact_start[pairs.start[first]]
    end = pairs.contact_start[pairs.start[first + bodies_per_env]]
    largest = float(0.0)
    for c in range(begin + lane, end, wp.block_dim()):
        contacts.target[c] = wanted_speed(c, dt, shapes, bodies, contacts, state)
        contacts.reaction[c] = wp.vec3(0.0, 0.0, 0.0)
        largest = wp.max(largest, contacts.target[c])
    wp.atomic_max(graph.residual, env, 0, largest)


@wp.kernel
def push_apart(
    bodies_per_env: int,
    bodies: Bodies,
    motions: Motions,
    envs: Environments,
    graph: Graph,
    pairs: Pairs,
    contacts: Contacts,
):
    """One block an environment: separate level by level, each against the frozen level below."""
    env, lane = wp.tid()
    if graph.residual[env, 0] == 0.0 or envs.contact_iterations[env] == 0:
        return
    rows = env * (bodies_per_env + 2)
    for level in range(1, graph.level_count[env] + 1):
        for _iteration in range(LEVEL_ITERATIONS):
            for group in range(graph.level_start[rows + level], graph.level_start[rows + level + 1]):
                for k in range(graph.group_start[group] + lane, graph.group_start[group + 1], wp.block_dim()):
                    pair = graph.order[k]
                    share_a = wp.where(graph.level[pairs.body_a[pair]] == level, 1.0, 0.0)
                    share_b = wp.where(graph.level[pairs.body_b[pair]] == level, 1.0, 0.0)
                    for c in range(pairs.contact_start[pair], pairs.contact_start[pair + 1]):
                        push_contact(c, share_a, share_b, bodies, motions, contacts)
                meet()
