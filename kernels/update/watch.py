"""Watches: contact impulses, contacts, overlaps and motion of chosen bodies, recorded in every step.

A watch is of all bodies of an environment, of one body, or of a pair. The impulse of a pair in a step is the magnitude
of the vector sum of the impulses of its contacts, in impacts and at rest. Sums are kept as integers, so that they do
not depend on the order of threads.
"""

import warp as wp

from warp_rigid.kernels.constraints.contact import IMPULSE, impulse_of, read_contact, world_vector
from warp_rigid.kernels.enums import Role
from warp_rigid.kernels.schema import Bodies, Contacts, Environments, Motions, Pairs, State, Watches

wp.set_module_options({"enable_backward": False})

UNITS = wp.constant(wp.float64(2.0**36))
"""Units of the summed impulse in 1 N s."""

ANY = wp.constant(-1)
"""In place of a body: every body."""


@wp.func
def watches_pair(first: int, second: int, a: int, b: int):
    """Whether a watch of two bodies, of which either may be ANY, is of a pair; indices within the environment."""
    one = (first == ANY or first == a) and (second == ANY or second == b)
    return one or ((first == ANY or first == b) and (second == ANY or second == a))


@wp.kernel
def watch_pairs(threads: int, envs: Environments, bodies: Bodies, pairs: Pairs, contacts: Contacts, watches: Watches):
    """The threads share the pairs: impulse, contact and overlap of each for the watches of its environment."""
    for pair in range(wp.tid(), pairs.start[pairs.start.shape[0] - 1], threads):
        begin = pairs.contact_start[pair]
        end = pairs.contact_start[pair + 1]
        if begin < end or pairs.dormant[pair] > 0:
            env = bodies.env[pairs.body_a[pair]]
            sum = contacts.impact[pair]
            overlap = float(0.0)
            for c in range(begin, end):
                row = read_contact(c, contacts.rows)
                sum += world_vector(row.normal, row.tangent, impulse_of(c, IMPULSE, contacts))
                overlap = wp.max(overlap, -row.gap)
            impulse = wp.length(sum)
            a = pairs.body_a[pair] - envs.first_body[env]
            b = pairs.body_b[pair] - envs.first_body[env]
            for w in range(watches.first.shape[1]):
                if watches_pair(watches.first[env, w], watches.second[env, w], a, b):
                    wp.atomic_max(watches.overlap, env, w, overlap)
                    if impulse > 0.0:
                        wp.atomic_max(watches.peak, env, w, impulse)
                        wp.atomic_add(watches.total, env, w, wp.int64(wp.float64(impulse) * UNITS))
                    if impulse > 0.0 or pairs.dormant[pair] > 0:
                        watches.contact_step[env, w] = envs.step[env]


@wp.kernel
def watch_bodies(speed: float, bodies: Bodies, motions: Motions, state: State, envs: Environments, watches: Watches):
    """One thread per body: note the step if the body is at least as fast as `speed`."""
    body = wp.tid()
    if motions.role[body] != Role.FREE or wp.length(state.linear_velocity[body]) < speed:
        return
    env = bodies.env[body]
    own = body - envs.first_body[env]
    for w in range(watches.first.shape[1]):
        every = watches.first[env, w] == ANY
        if every or watches.first[env, w] == own or watches.second[env, w] == own:
            watches.moving_step[env, w] = envs.step[env]


@wp.kernel
def close_watches(envs: Environments, watches: Watches):
    """One thread per environment: note the first contact, and count contacts that begin."""
    env = wp.tid()
    if envs.failed[env] == 1:
        return
    step = envs.step[env]
    for w in range(watches.first.shape[1]):
        touching = wp.where(watches.contact_step[env, w] == step, 1, 0)
        if touching == 1 and watches.first_contact[env, w] == 0:
            watches.first_contact[env, w] = step
        if touching == 1 and watches.touching[env, w] == 0:
            watches.impacts[env, w] = watches.impacts[env, w] + 1
        watches.touching[env, w] = touching
