"""Watches: contact impulses, contacts, overlaps and motion of chosen bodies, recorded in every step.

A watch is of all bodies of an environment, of one body, or of a pair. The impulse of a pair in a step is the magnitude
of the vector sum of the impulses of its contacts, in impacts and at rest. The sum of a step is one of integers, so that
it does not depend on the order of threads.
"""

import warp as wp

from warp_rigid.kernels.constraints.contact import IMPULSE, impulse_of, read_contact, world_vector
from warp_rigid.kernels.enums import Role
from warp_rigid.kernels.schema import Bodies, Contacts, Environments, History, Motions, Pairs, State, Watches
from warp_rigid.kernels.update.sleep import history_row_if_asleep

wp.set_module_options({"enable_backward": False})

UNITS = wp.constant(wp.float64(2.0**40))
"""Units of the sum of a step in its largest impulse."""

ANY = wp.constant(-1)
"""In place of a body: every body."""


@wp.func
def watches_pair(first: int, second: int, a: int, b: int):
    """Whether a watch of two bodies, of which either may be ANY, is of a pair; indices within the environment."""
    one = (first == ANY or first == a) and (second == ANY or second == b)
    return one or ((first == ANY or first == b) and (second == ANY or second == a))


@wp.func
def impulse_of_pair(pair: int, pairs: Pairs, contacts: Contacts, history: History, motions: Motions):
    """Magnitude of the impulse of a pair in this step; sleeping bodies press on each other as in their last step."""
    sum = wp.vec3(0.0, 0.0, 0.0)
    row = history_row_if_asleep(pair, motions, pairs)
    if row >= 0:
        for c in range(history.contact_start[row], history.contact_start[row + 1]):
            sum += history.impulse[c]
        return wp.length(sum)
    begin = pairs.contact_start[pair]
    end = pairs.contact_start[pair + 1]
    if begin < end:
        sum += contacts.impact[pair]
        for c in range(begin, end):
            own = read_contact(c, contacts.rows)
            sum += world_vector(own.normal, own.tangent, impulse_of(c, IMPULSE, contacts))
    return wp.length(sum)


@wp.func
def overlap_of_pair(pair: int, pairs: Pairs, contacts: Contacts):
    """Largest overlap at a contact of a pair at the start of this step, at least 0."""
    overlap = float(0.0)
    for c in range(pairs.contact_start[pair], pairs.contact_start[pair + 1]):
        overlap = wp.max(overlap, -read_contact(c, contacts.rows).gap)
    return overlap


@wp.func
def watch_pair(env: int, w: int, summing: int, impulse: float, overlap: float, watches: Watches):
    """Record the impulse and overlap of a pair for a watch of it; `summing`: as in `watch_pairs`."""
    if summing == 1:
        share = wp.float64(impulse) / wp.float64(watches.largest[env, w])
        wp.atomic_add(watches.sum, env, w, wp.int64(share * UNITS))
    else:
        wp.atomic_max(watches.overlap, env, w, overlap)
        wp.atomic_max(watches.largest, env, w, impulse)


@wp.kernel
def watch_pairs(
    summing: int,
    threads: int,
    envs: Environments,
    bodies: Bodies,
    pairs: Pairs,
    contacts: Contacts,
    history: History,
    motions: Motions,
    watches: Watches,
):
    """The threads share the pairs: largest impulse, contact and overlap for the watches of their environment.

    In a second launch, which is `summing`: the sums of the impulses, in units of the largest one, for any masses.
    """
    for pair in range(wp.tid(), pairs.start[pairs.start.shape[0] - 1], threads):
        impulse = impulse_of_pair(pair, pairs, contacts, history, motions)
        overlap = float(0.0)
        if summing == 0:
            overlap = overlap_of_pair(pair, pairs, contacts)
        if impulse > 0.0 or overlap > 0.0:
            env = bodies.env[pairs.body_a[pair]]
            a = pairs.body_a[pair] - envs.first_body[env]
            b = pairs.body_b[pair] - envs.first_body[env]
            for w in range(watches.first.shape[1]):
                if watches_pair(watches.first[env, w], watches.second[env, w], a, b):
                    watch_pair(env, w, summing, impulse, overlap, watches)


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
    """One thread per environment: add up the impulses, note the first contact, and count contacts that begin."""
    env = wp.tid()
    step = envs.step[env]
    for w in range(watches.first.shape[1]):
        largest = watches.largest[env, w]
        sum = wp.float64(watches.sum[env, w]) / UNITS * wp.float64(largest)
        watches.largest[env, w] = 0.0
        watches.sum[env, w] = wp.int64(0)
        if envs.failed[env] == 1:
            continue
        watches.peak[env, w] = wp.max(watches.peak[env, w], largest)
        watches.total[env, w] = watches.total[env, w] + sum
        touching = wp.where(largest > 0.0, 1, 0)
        if touching == 1 and watches.first_contact[env, w] == 0:
            watches.first_contact[env, w] = step
        if touching == 1 and watches.touching[env, w] == 0:
            watches.impacts[env, w] = watches.impacts[env, w] + 1
        watches.touching[env, w] = touching
