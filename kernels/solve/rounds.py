"""Rounds: all contacts are solved at once, on split masses with Nesterov's momentum.

In a *round*, every contact is solved once, at the same time as all others. A body with n contacts is split into n
copies with mass m/n (Tonge, Benevolenski and Voroshilov 2012); its new velocity is the mean of theirs. No two threads
wait for each other within a round, and rounds need neither colours nor levels.

Let l be the impulses and v(l) the velocities after them. A round takes (l, v(l)) to better impulses l1. The next round
starts at y = l1 + b (l1 - l), extrapolated from the results of the last two rounds (Nesterov 1983), with the momentum b
= (k - 1) / (k + 2) of round k, at most 0.98. Without this limit, momentum diverges slowly, because sliding friction is
not the gradient of an energy. With it, restarts (O'Donoghue and Candes 2015) were not needed in any scene that was
measured. The fixed point solves the Coulomb problem of the sweeps.

Since v is affine in l, the mean over the copies equals v(y): the velocity before the solve, plus the changes by the
impulses of all contacts. Each pair stores the changes of its two bodies in slots; the velocity of a
body in the next round is the sum over its slots. Slots are in the order of the constraints, so the sum does not
depend on the order of the threads. A round reads the slots that the last one wrote, and writes those of another buffer
(slots.py). A pair is left out of a round, and its slots keep their values, if no pair has noticeably changed one of its
bodies in the last one.
"""

import warp as wp

from warp_rigid.kernels.common.sharing import Sharing
from warp_rigid.kernels.common.solver_body import (
    VELOCITY,
    BodyPair,
    first_three,
    inertia_at,
    inverse_mass_of,
    read_solver_body,
    with_impulse,
)
from warp_rigid.kernels.common.tangents import world_vector
from warp_rigid.kernels.common.team import broadcast_vector, exchanged_vector, max_of_lanes, next_place, raise_to
from warp_rigid.kernels.constraints.contact import (
    ANGULAR_IMPULSE,
    IMPULSE,
    START_ANGULAR_IMPULSE,
    START_IMPULSE,
    impulse_of,
    next_impulse,
    read_contact,
    set_impulse,
    solve_rolling,
    store_start,
    velocity_change,
)
from warp_rigid.kernels.constraints.records import is_active
from warp_rigid.kernels.declare import record_reader
from warp_rigid.kernels.enums import Motion
from warp_rigid.kernels.graph.heap_arrays import RoundRecord, Rounds, Slots
from warp_rigid.kernels.graph.islands import most_rounds, tolerance_of
from warp_rigid.kernels.graph.support import is_swept
from warp_rigid.kernels.schema import (
    Bodies,
    Constraints,
    ContactRecord,
    Contacts,
    Environments,
    Graph,
    Motions,
    SolverBodyRecord,
)
from warp_rigid.kernels.solve.round_sharing import first_share, next_share
from warp_rigid.kernels.solve.slots import buffer_start, change_of, keep_changes, store_change, sum_of_changes
from warp_rigid.kernels.tuning import MOST_MOMENTUM, NOTICEABLE, PLAIN_ROUNDS

wp.set_module_options({"enable_backward": False})

read_round_pair = record_reader(RoundRecord)
"""Reads a pair that is solved in rounds: (k, pairs)."""


LANES = 4
"""Lanes that visit a pair on a GPU."""


@wp.func
def momentum(round: int, limit: int):
    """Momentum after a round or sweep. The first one and the last PLAIN_ROUNDS of at most `limit` have none."""
    if round + PLAIN_ROUNDS > limit:
        return 0.0
    return wp.min(float(round - 1) / float(round + 2), MOST_MOMENTUM)


@wp.func
def part_of_velocity(
    part: int, entry: RoundRecord, base: float, buffer: int, slots: Slots, bodies: wp.array[SolverBodyRecord]
):
    """Linear (part 0) and angular (1) velocity of the first body of a pair, or of the second (2 and 3).

    It is `base` times that before the rounds, plus the changes by the impulses of a buffer. The last component is the
    number of pairs that changed it noticeably.
    """
    b = wp.where(part < 2, entry.body_a, entry.body_b)
    start = buffer_start(buffer, slots)
    first = start + wp.where(part < 2, entry.first_a, entry.first_b)
    end = start + wp.where(part < 2, entry.end_a, entry.end_b)
    before = first_three(read_solver_body(bodies, b, VELOCITY + part % 2))
    change = sum_of_changes(first, end, part % 2, slots.changes)
    now = base * before + first_three(change)
    return wp.vec4(now[0], now[1], now[2], change[3])


@wp.func_native(f"""
#if defined(__CUDA_ARCH__)
    return {LANES};
#else
    return 1;
#endif
""")
def lanes_of_pair() -> int:
    """Number of lanes that visit a pair. It is known when a kernel is compiled, so that loops over lanes unroll."""
    ...


@wp.func
def velocities_of(
    entry: RoundRecord,
    base: float,
    buffer: int,
    lane: int,
    lanes: int,
    slots: Slots,
    bodies: wp.array[SolverBodyRecord],
):
    """The velocities of a pair (`part_of_velocity`), without masses. Of four lanes, each adds up one part.

    `change` is the number of pairs that changed the velocity of one of the bodies noticeably in the last round.
    """
    pair = BodyPair()
    if lanes == LANES:
        part = part_of_velocity(lane, entry, base, buffer, slots, bodies)
        own = first_three(part)
        pair.linear_a = broadcast_vector(own, 0, lanes)
        pair.angular_a = broadcast_vector(own, 1, lanes)
        pair.linear_b = broadcast_vector(own, 2, lanes)
        pair.angular_b = broadcast_vector(own, 3, lanes)
        pair.change = max_of_lanes(part[3], lanes)
    else:
        linear_a = part_of_velocity(0, entry, base, buffer, slots, bodies)
        linear_b = part_of_velocity(2, entry, base, buffer, slots, bodies)
        pair.linear_a = first_three(linear_a)
        pair.angular_a = first_three(part_of_velocity(1, entry, base, buffer, slots, bodies))
        pair.linear_b = first_three(linear_b)
        pair.angular_b = first_three(part_of_velocity(3, entry, base, buffer, slots, bodies))
        pair.change = linear_a[3] + linear_b[3]
    return pair


@wp.func
def with_split_masses(entry: RoundRecord, pair: BodyPair, bodies: wp.array[SolverBodyRecord]):
    """The pair with the masses and inertias of the copies of its bodies."""
    mobility_a = float(entry.sharing_a)
    mobility_b = float(entry.sharing_b)
    pair.inverse_mass_a = mobility_a * read_solver_body(bodies, entry.body_a, VELOCITY)[3]
    pair.inverse_mass_b = mobility_b * read_solver_body(bodies, entry.body_b, VELOCITY)[3]
    if mobility_a > 0.0:
        pair.inverse_inertia_a = mobility_a * inertia_at(entry.body_a, bodies)
    if mobility_b > 0.0:
        pair.inverse_inertia_b = mobility_b * inertia_at(entry.body_b, bodies)
    return pair


@wp.func
def body_change(change: float, entry: RoundRecord):
    """Bound on the velocity change of a body from the change of the relative velocity of its copies [m/s]."""
    sharing = wp.min(entry.sharing_a, entry.sharing_b)
    return change / float(wp.where(sharing > 0, sharing, wp.max(entry.sharing_a, entry.sharing_b)))


@wp.struct
class Wrench:
    """Impulse of a pair on its first body [N s], and its moments about both centres of mass [N m s].

    On the second body, all act in the opposite direction. `change` is the largest change of a relative velocity by a
    row, and `stirring` the largest one with the extrapolation of its impulse [m/s].
    """

    impulse: wp.vec3
    moment_a: wp.vec3
    moment_b: wp.vec3
    change: float
    stirring: float


@wp.func
def with_impulse_of(row: ContactRecord, impulse: wp.vec3, wrench: Wrench):
    """The wrench with an impulse in the contact frame added."""
    force = world_vector(row.normal, row.tangent, impulse)
    wrench.impulse += force
    wrench.moment_a += wp.cross(row.arm_a, force)
    wrench.moment_b += wp.cross(row.arm_b, force)
    return wrench


@wp.func
def with_moment_of(row: ContactRecord, angular_impulse: wp.vec3, wrench: Wrench):
    """The wrench with an angular impulse in the contact frame added."""
    moment = world_vector(row.normal, row.tangent, angular_impulse)
    wrench.moment_a += moment
    wrench.moment_b += moment
    return wrench


@wp.func
def part_of_wrench(part: int, wrench: Wrench):
    """What acts on a velocity (`part_of_velocity`): the impulse, or the moment about a body's centre of mass."""
    if part % 2 == 0:
        return wrench.impulse
    return wp.where(part < 2, wrench.moment_a, wrench.moment_b)


@wp.func
def sum_of_parts(lane: int, wrench: Wrench):
    """The sum of `part_of_wrench` over a team of four lanes: each gets the part with its own number.

    In two exchanges, a lane passes on what another one needs, so half as many values are exchanged as for whole sums.
    """
    impulse = wrench.impulse + exchanged_vector(wrench.impulse, 2, LANES)
    moment = part_of_wrench(lane | 1, wrench) + exchanged_vector(part_of_wrench(3 - (lane & 2), wrench), 2, LANES)
    even = lane % 2 == 0
    passed_on = wp.where(even, moment, impulse)
    return wp.where(even, impulse, moment) + exchanged_vector(passed_on, 1, LANES)


@wp.func
def store_part(
    part: int,
    cause: wp.vec3,
    stirring: float,
    entry: RoundRecord,
    buffer: int,
    slots: Slots,
    bodies: wp.array[SolverBodyRecord],
):
    """Store the change of a velocity by its part of a wrench, with the whole mass of the body."""
    b = wp.where(part < 2, entry.body_a, entry.body_b)
    change = wp.where(part < 2, 1.0, -1.0) * cause
    if part % 2 == 0:
        change = read_solver_body(bodies, b, VELOCITY)[3] * change
    else:
        change = inertia_at(b, bodies) * change
    store_change(wp.where(part < 2, entry.slot_a, entry.slot_b), part % 2, buffer, change, stirring, slots)


@wp.func
def store_changes(
    entry: RoundRecord,
    buffer: int,
    lane: int,
    lanes: int,
    wrench: Wrench,
    tolerance: float,
    slots: Slots,
    bodies: wp.array[SolverBodyRecord],
):
    """Store the velocity changes of both bodies by the wrenches of a team. Returns the bound on their change [m/s].

    Whether they have changed noticeably, including the extrapolation, follows from the tolerance of the rounds [m/s].
    """
    change = body_change(max_of_lanes(wrench.change, lanes), entry)
    most = wp.max(change, body_change(max_of_lanes(wrench.stirring, lanes), entry))
    stirring = wp.where(most > NOTICEABLE * tolerance, 1.0, 0.0)
    if lanes == LANES:
        store_part(lane, sum_of_parts(lane, wrench), stirring, entry, buffer, slots, bodies)
    else:
        for part in range(4):
            store_part(part, part_of_wrench(part, wrench), stirring, entry, buffer, slots, bodies)
    return change


@wp.func
def needs_round(entry: RoundRecord, round: int, rounds: Rounds):
    """Whether a pair takes part in a round: the last one changed a velocity, and the limit is not reached."""
    return round <= entry.limit and rounds.last_change[entry.env] >= round - 1


@wp.func
def is_stirred(pair: BodyPair, round: int):
    """Whether a pair must be solved in a round: the last one changed the velocity of one of its bodies noticeably."""
    return round == 1 or pair.change > 0.0


@wp.func
def record_change(k: int, entry: RoundRecord, round: int, change: float, tolerance: float, rounds: Rounds):
    """Record that a pair was solved, whether it changed a velocity, and whether another round is needed."""
    rounds.visited[k] = round
    if change > tolerance:
        if rounds.last_change[entry.env] != round:
            rounds.last_change[entry.env] = round
        if round < entry.limit and rounds.latest[0] != round:
            rounds.latest[0] = round


@wp.func
def count_rounds(entry: RoundRecord, rounds: Rounds, counts: wp.array[int]):
    """Record how many rounds a pair took part in."""
    done = wp.min(entry.limit, rounds.last_change[entry.env] + 1)
    if counts[entry.env] < done:
        wp.atomic_max(counts, entry.env, done)


@wp.func
def list_round_pair(entry: RoundRecord, contacts: int, rounds: Rounds, motions: Motions):
    """Append a pair; the masses of its dynamic bodies are shared by its contacts."""
    rounds.pairs[next_place(rounds.count, 0)] = entry
    rounds.again[0] = 1
    if inverse_mass_of(entry.body_a, motions) > 0.0:
        wp.atomic_add(rounds.sharing, entry.body_a, contacts)
    if inverse_mass_of(entry.body_b, motions) > 0.0:
        wp.atomic_add(rounds.sharing, entry.body_b, contacts)


@wp.kernel
def open_rounds(done: int, threads: int, rounds: Rounds):
    """The threads share the bodies and environments: no pairs, and `done` more rounds; 0: from 0."""
    tid = wp.tid()
    for b in range(tid, rounds.sharing.shape[0], threads):
        rounds.sharing[b] = 0
    for env in range(tid, rounds.last_change.shape[0], threads):
        rounds.last_change[env] = 0
        rounds.largest_target[env] = 0.0
    if tid == 0:
        rounds.count[0] = 0
        rounds.done[0] = wp.where(done > 0, rounds.done[0] + done, 0)
        rounds.latest[0] = 0
        rounds.again[0] = 0


@wp.kernel
def open_slots(threads: int, slots: Slots):
    """The threads share the bodies: no slots."""
    tid = wp.tid()
    for b in range(tid, slots.count.shape[0], threads):
        slots.count[b] = 0
    if tid == 0:
        slots.used[0] = 0


@wp.func
def add_member(b: int, constraint: int, motions: Motions, slots: Slots):
    """Add a pair to those of a dynamic body."""
    if inverse_mass_of(b, motions) > 0.0:
        slots.members[b, wp.atomic_add(slots.count, b, 1)] = constraint


@wp.kernel
def list_pairs(
    dt: float,
    threads: int,
    bodies: Bodies,
    envs: Environments,
    motions: Motions,
    constraints: Constraints,
    graph: Graph,
    rounds: Rounds,
    slots: Slots,
):
    """The threads share the constraints: list the pairs that are solved in rounds."""
    for k in range(wp.tid(), constraints.start[constraints.start.shape[0] - 1], threads):
        if is_active(k, constraints) and not is_swept(k, constraints, graph):
            entry = RoundRecord()
            entry.body_a = constraints.body_a[k]
            entry.body_b = constraints.body_b[k]
            entry.begin = constraints.first_row[k]
            entry.end = entry.begin + constraints.row_count[k]
            entry.env = bodies.env[entry.body_a]
            entry.constraint = k
            dynamic = wp.where(bodies.motion[entry.body_a] == Motion.DYNAMIC, entry.body_a, entry.body_b)
            island = graph.island[dynamic]
            entry.limit = most_rounds(island, envs.contact_iterations[entry.env], graph)
            unit = motions.velocity_unit[entry.body_a]
            entry.tolerance = tolerance_of(island, dt * wp.length(envs.gravity[entry.env]), unit, graph)
            add_member(entry.body_a, k, motions, slots)
            add_member(entry.body_b, k, motions, slots)
            list_round_pair(entry, entry.end - entry.begin, rounds, motions)


@wp.kernel
def assign_slots(threads: int, slots: Slots):
    """The threads share the bodies: a slot for each pair. Where they lie does not matter."""
    for b in range(wp.tid(), slots.count.shape[0], threads):
        if slots.count[b] > 0:
            slots.first[b] = wp.atomic_add(slots.used, 0, slots.count[b])


@wp.func
def slot_of(b: int, constraint: int, slots: Slots):
    """The slot of a pair among those of a body, which are in the order of the constraints; -1 if it has none."""
    if slots.count[b] == 0:
        return -1
    slot = slots.first[b]
    for i in range(slots.count[b]):
        slot += wp.where(slots.members[b, i] < constraint, 1, 0)
    return slot


@wp.kernel
def place_pairs(threads: int, rounds: Rounds, slots: Slots, contacts: Contacts):
    """The threads share the pairs: split the masses, and find the slots."""
    for k in range(wp.tid(), rounds.count[0], threads):
        entry = read_round_pair(k, rounds.pairs)
        entry.sharing_a = rounds.sharing[entry.body_a]
        entry.sharing_b = rounds.sharing[entry.body_b]
        entry.slot_a = slot_of(entry.body_a, entry.constraint, slots)
        entry.slot_b = slot_of(entry.body_b, entry.constraint, slots)
        entry.first_a = slots.first[entry.body_a]
        entry.first_b = slots.first[entry.body_b]
        entry.end_a = entry.first_a + slots.count[entry.body_a]
        entry.end_b = entry.first_b + slots.count[entry.body_b]
        row = read_contact(entry.begin, contacts.rows)
        entry.rolls = wp.where(row.rolling_friction + row.spinning_friction > 0.0, 1, 0)
        rounds.pairs[k] = entry


@wp.func
def apply_impulses(entry: RoundRecord, slots: Slots, motions: Motions, contacts: Contacts):
    """Store the velocity changes by the current impulses of a pair, in the buffer that the first round reads."""
    wrench = Wrench()
    for c in range(entry.begin, entry.end):
        row = read_contact(c, contacts.rows)
        wrench = with_impulse_of(row, impulse_of(c, IMPULSE, contacts), wrench)
        wrench = with_moment_of(row, impulse_of(c, ANGULAR_IMPULSE, contacts), wrench)
    store_changes(entry, 0, 0, 1, wrench, 0.0, slots, motions.solver_bodies)


@wp.kernel
def start_rounds(threads: int, rounds: Rounds, slots: Slots, motions: Motions, contacts: Contacts):
    """The threads share the pairs: apply the initial impulses."""
    for k in range(wp.tid(), rounds.count[0], threads):
        entry = read_round_pair(k, rounds.pairs)
        for c in range(entry.begin, entry.end):
            store_start(c, contacts)
        apply_impulses(entry, slots, motions, contacts)


@wp.func
def extrapolated(c: int, which: int, before: wp.vec3, new: wp.vec3, beta: float, contacts: Contacts):
    """Store a new impulse, and the extrapolation from the one before. Returns the extrapolated impulse."""
    ahead = new + beta * (new - before)
    set_impulse(c, which, ahead, contacts)
    set_impulse(c, wp.where(which == IMPULSE, START_IMPULSE, START_ANGULAR_IMPULSE), new, contacts)
    return ahead


@wp.func
def surface_change(gained: wp.vec3, row: ContactRecord, pair: BodyPair):
    """Bound on the change of the velocity of a body's surface by an angular impulse in the contact frame [m/s]."""
    moment = world_vector(row.normal, row.tangent, gained)
    of_a = wp.length(row.arm_a) * wp.length(pair.inverse_inertia_a * moment)
    return wp.max(of_a, wp.length(row.arm_b) * wp.length(pair.inverse_inertia_b * moment))


@wp.func
def solve_contact(
    c: int,
    entry: RoundRecord,
    beta: float,
    pair: BodyPair,
    wrench: Wrench,
    bodies: wp.array[SolverBodyRecord],
    contacts: Contacts,
):
    """Solve a contact for its copies of the bodies, and add its extrapolated impulses to the wrench."""
    mobility_a = float(entry.sharing_a)
    mobility_b = float(entry.sharing_b)
    row = read_contact(c, contacts.rows)
    old = impulse_of(c, IMPULSE, contacts)
    before = impulse_of(c, START_IMPULSE, contacts)
    new = next_impulse(old, mobility_a, mobility_b, row, pair)
    ahead = extrapolated(c, IMPULSE, before, new, beta, contacts)
    wrench = with_impulse_of(row, ahead, wrench)
    wrench.change = wp.max(wrench.change, velocity_change(new - old, mobility_a, mobility_b, row))
    wrench.stirring = wp.max(wrench.stirring, velocity_change(ahead - old, mobility_a, mobility_b, row))
    if entry.rolls == 1:
        gained = world_vector(row.normal, row.tangent, new - old)
        copies = with_impulse(row.arm_a, row.arm_b, gained, with_split_masses(entry, pair, bodies))
        last = impulse_of(c, ANGULAR_IMPULSE, contacts)
        solve_rolling(c, new[0], row, copies, contacts)
        moment = impulse_of(c, ANGULAR_IMPULSE, contacts)
        start = impulse_of(c, START_ANGULAR_IMPULSE, contacts)
        further = extrapolated(c, ANGULAR_IMPULSE, start, moment, beta, contacts)
        wrench = with_moment_of(row, further, wrench)
        wrench.stirring = wp.max(wrench.stirring, surface_change(further - last, row, copies))
    return wrench


@wp.func
def solve_pair(
    entry: RoundRecord,
    round: int,
    lane: int,
    lanes: int,
    pair: BodyPair,
    slots: Slots,
    bodies: wp.array[SolverBodyRecord],
    contacts: Contacts,
):
    """Solve the contacts of a pair in a round. Returns the bound on the change of a body's velocity [m/s]."""
    beta = momentum(round, entry.limit)
    wrench = Wrench()
    for c in range(entry.begin + lane, entry.end, lanes):
        wrench = solve_contact(c, entry, beta, pair, wrench, bodies, contacts)
    return store_changes(entry, round % 2, lane, lanes, wrench, entry.tolerance, slots, bodies)


@wp.kernel
def solve_round(
    place: int,
    sharing: Sharing,
    rounds: Rounds,
    slots: Slots,
    bodies: wp.array[SolverBodyRecord],
    contacts: Contacts,
    residual: wp.array[float],
):
    """Teams of lanes share the pairs of a round, the one at `place` of its group; workers on a CPU those of all."""
    lanes = lanes_of_pair()
    lane = wp.tid() % lanes
    share = first_share(wp.tid() / lanes, place, sharing, rounds)
    while share.round > 0:
        for k in range(share.first, share.end, share.stride):
            entry = read_round_pair(k, rounds.pairs)
            if needs_round(entry, share.round, rounds):
                pair = velocities_of(entry, 1.0, (share.round - 1) % 2, lane, lanes, slots, bodies)
                if is_stirred(pair, share.round):
                    change = solve_pair(entry, share.round, lane, lanes, pair, slots, bodies, contacts)
                    record_change(k, entry, share.round, change, entry.tolerance, rounds)
                    if change <= entry.tolerance or share.round == entry.limit:
                        raise_to(entry.env, change, residual)
                else:
                    keep_changes(k, entry, share.round, lane, lanes, rounds, slots)
        share = next_share(sharing, rounds)


@wp.kernel
def close_rounds(count: int, rounds: Rounds):
    """One thread: after a group of `count` rounds, whether more follow."""
    rounds.done[0] += count
    rounds.again[0] = wp.where(rounds.latest[0] == rounds.done[0], 1, 0)


@wp.kernel
def finish_pairs(
    threads: int, rounds: Rounds, slots: Slots, motions: Motions, contacts: Contacts, counts: wp.array[int]
):
    """The threads share the pairs: take the impulses of the last round, which are not extrapolated."""
    for k in range(wp.tid(), rounds.count[0], threads):
        entry = read_round_pair(k, rounds.pairs)
        count_rounds(entry, rounds, counts)
        for c in range(entry.begin, entry.end):
            set_impulse(c, IMPULSE, impulse_of(c, START_IMPULSE, contacts), contacts)
            set_impulse(c, ANGULAR_IMPULSE, impulse_of(c, START_ANGULAR_IMPULSE, contacts), contacts)
        apply_impulses(entry, slots, motions, contacts)


@wp.kernel
def finish_bodies(threads: int, slots: Slots, motions: Motions):
    """The threads share the bodies: add the velocity changes in the first buffer to the velocities."""
    for b in range(wp.tid(), slots.count.shape[0], threads):
        if slots.count[b] > 0:
            first = slots.first[b]
            motions.solver_bodies[b].linear += change_of(first, first + slots.count[b], 0, 0, slots)
            motions.solver_bodies[b].angular += change_of(first, first + slots.count[b], 1, 0, slots)
