"""Push-out in large environments: overlaps that remain are removed in rounds, as velocities are solved (rounds.py).

The problem is that of push_out.py without a frozen body: each contact that would end the step deeper than the slop
requires a separation speed, and pseudo-impulses along the normals produce it. A body takes part with its mass divided
by the number of such contacts.
"""

import warp as wp

from warp_rigid.kernels.common.arithmetic import quotient
from warp_rigid.kernels.common.sharing import Sharing
from warp_rigid.kernels.common.solver_body import PUSH, BodyPair, store_velocity
from warp_rigid.kernels.common.team import raise_to
from warp_rigid.kernels.constraints.contact import (
    IMPACT_IMPULSE,
    read_contact,
    read_impulse,
    separation_speed,
    write_impulse,
)
from warp_rigid.kernels.graph.heap_arrays import RoundRecord, Rounds, Slots
from warp_rigid.kernels.schema import Bodies, Contacts, Motions, Pairs, Shapes, SolverBodyRecord, State
from warp_rigid.kernels.solve.push_out import wanted_speed
from warp_rigid.kernels.solve.round_sharing import first_share, next_share
from warp_rigid.kernels.solve.rounds import (
    Wrench,
    count_rounds,
    is_stirred,
    lanes_of_pair,
    list_round_pair,
    momentum,
    needs_round,
    read_round_pair,
    record_change,
    store_changes,
    velocities_of,
    with_impulse_of,
)
from warp_rigid.kernels.solve.slots import change_of, clear_slots, keep_changes
from warp_rigid.kernels.tuning import PUSH_OUT_CONVERGED, SHARE_OF_TARGET

wp.set_module_options({"enable_backward": False})


@wp.func
def tolerance(entry: RoundRecord, rounds: Rounds):
    """Change of a pseudo-velocity with which rounds end [m/s]."""
    return wp.max(entry.tolerance, SHARE_OF_TARGET * rounds.largest_target[entry.env])


@wp.kernel
def find_overlaps_of_rounds(
    dt: float,
    threads: int,
    shapes: Shapes,
    bodies: Bodies,
    state: State,
    pairs: Pairs,
    motions: Motions,
    contacts: Contacts,
    solved: Rounds,
    rounds: Rounds,
    slots: Slots,
):
    """The threads share the pairs: the separation speed of each contact; list the pairs that need one.

    The pseudo-impulses of the last two rounds are stored in the first two components of the impact impulse.
    """
    for k in range(wp.tid(), solved.count[0], threads):
        entry = read_round_pair(k, solved.pairs)
        clear_slots(entry, slots)
        deep = int(0)
        largest = float(0.0)
        for c in range(entry.begin, entry.end):
            target = wanted_speed(c, dt, shapes, bodies, state, pairs, motions, contacts)
            write_impulse(contacts.impulses, c, IMPACT_IMPULSE, wp.vec3(0.0, 0.0, 0.0), target)
            deep += wp.where(target > 0.0, 1, 0)
            largest = wp.max(largest, target)
        if deep > 0:
            raise_to(entry.env, largest, rounds.largest_target)
            entry.tolerance = PUSH_OUT_CONVERGED * motions.velocity_unit[entry.body_a]
            list_round_pair(entry, deep, rounds, motions)


@wp.kernel
def share_masses(threads: int, rounds: Rounds):
    """The threads share the pairs: the number of contacts that share each body's mass."""
    for k in range(wp.tid(), rounds.count[0], threads):
        entry = rounds.pairs[k]
        rounds.pairs[k].sharing_a = rounds.sharing[entry.body_a]
        rounds.pairs[k].sharing_b = rounds.sharing[entry.body_b]


@wp.func
def push_contact_apart(c: int, entry: RoundRecord, beta: float, pair: BodyPair, wrench: Wrench, contacts: Contacts):
    """Bring a contact's separation to its target for its copies of the bodies, and add its pseudo-impulse."""
    stored = read_impulse(contacts.impulses, c, IMPACT_IMPULSE)
    target = stored[3]
    if target > 0.0:
        row = read_contact(c, contacts.rows)
        k = float(entry.sharing_a) * row.normal_a + float(entry.sharing_b) * row.normal_b
        missing = target - separation_speed(row, pair)
        new = wp.max(stored[0] + quotient(missing, k), 0.0)
        ahead = new + beta * (new - stored[1])
        write_impulse(contacts.impulses, c, IMPACT_IMPULSE, wp.vec3(ahead, new, 0.0), target)
        wrench = with_impulse_of(row, wp.vec3(ahead, 0.0, 0.0), wrench)
        wrench.change = wp.max(wrench.change, k * wp.abs(new - stored[0]))
        wrench.stirring = wp.max(wrench.stirring, k * wp.abs(ahead - stored[0]))
    return wrench


@wp.func
def push_pair_apart(
    entry: RoundRecord,
    round: int,
    lane: int,
    lanes: int,
    pair: BodyPair,
    enough: float,
    slots: Slots,
    bodies: wp.array[SolverBodyRecord],
    contacts: Contacts,
):
    """Push a pair apart in a round. Returns the bound on the change of a body's pseudo-velocity [m/s]."""
    beta = momentum(round, entry.limit)
    wrench = Wrench()
    for c in range(entry.begin + lane, entry.end, lanes):
        wrench = push_contact_apart(c, entry, beta, pair, wrench, contacts)
    return store_changes(entry, round % 2, lane, lanes, wrench, enough, slots, bodies)


@wp.kernel
def push_round(
    place: int, sharing: Sharing, rounds: Rounds, slots: Slots, bodies: wp.array[SolverBodyRecord], contacts: Contacts
):
    """Teams of lanes share the pairs of a round, the one at `place` of its group; workers on a CPU those of all."""
    lanes = lanes_of_pair()
    lane = wp.tid() % lanes
    share = first_share(wp.tid() / lanes, place, sharing, rounds)
    while share.round > 0:
        for k in range(share.first, share.end, share.stride):
            entry = read_round_pair(k, rounds.pairs)
            if needs_round(entry, share.round, rounds):
                pair = velocities_of(entry, 0.0, (share.round - 1) % 2, lane, lanes, slots, bodies)
                if is_stirred(pair, share.round):
                    enough = tolerance(entry, rounds)
                    change = push_pair_apart(entry, share.round, lane, lanes, pair, enough, slots, bodies, contacts)
                    record_change(k, entry, share.round, change, enough, rounds)
                else:
                    keep_changes(k, entry, share.round, lane, lanes, rounds, slots)
        share = next_share(sharing, rounds)


@wp.kernel
def finish_push(
    threads: int, rounds: Rounds, slots: Slots, motions: Motions, contacts: Contacts, counts: wp.array[int]
):
    """The threads share the pairs: add up the pseudo-impulses of the last round, which are not extrapolated."""
    for k in range(wp.tid(), rounds.count[0], threads):
        entry = read_round_pair(k, rounds.pairs)
        count_rounds(entry, rounds, counts)
        wrench = Wrench()
        for c in range(entry.begin, entry.end):
            stored = read_impulse(contacts.impulses, c, IMPACT_IMPULSE)
            if stored[3] > 0.0:
                wrench = with_impulse_of(read_contact(c, contacts.rows), wp.vec3(stored[1], 0.0, 0.0), wrench)
        store_changes(entry, 0, 0, 1, wrench, 0.0, slots, motions.solver_bodies)


@wp.kernel
def store_push(threads: int, rounds: Rounds, slots: Slots, motions: Motions):
    """The threads share the bodies: the pseudo-velocities after the last round."""
    for b in range(wp.tid(), rounds.sharing.shape[0], threads):
        if rounds.sharing[b] > 0:
            first = slots.first[b]
            end = first + slots.count[b]
            store_velocity(b, PUSH, change_of(first, end, 0, 0, slots), change_of(first, end, 1, 0, slots), motions)
