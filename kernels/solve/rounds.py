"""Heaps: all contacts are solved at once, in rounds on split masses with Nesterov's momentum.

In a heap, bodies lean on each other in all directions, so there is no order in which load could be transmitted. In a
*round*, every contact is solved once, at the same time as all others. A body with n contacts is split into n copies
with mass m/n (Tonge, Benevolenski and Voroshilov 2012); its new velocity is the mean of theirs. No two threads wait for
each other within a round, and rounds need neither colours nor levels.

Let l be the impulses and v(l) the velocities after them. A round takes (l, v(l)) to better impulses l1. The next round
starts at y = l1 + b (l1 - l), extrapolated from the results of the last two rounds (Nesterov 1983), with the momentum
b = (k - 1) / (k + 2) of round k, at most 0.9. Without this limit, momentum diverges slowly, because friction that
slides is not the gradient of an energy. With it, restarts (O'Donoghue and Candes 2015) were never needed in any heap
that was measured. The fixed point is the Coulomb problem that sweeps solve, too.

Since v is affine in l, the mean over the copies equals v(y): the velocity before the solve, plus the changes by the
impulses of all contacts. These are summed up as whole multiples of 2^-40 m/s, so the sum does not depend on the order
of the threads. Each round writes another of three buffers while it reads the second and clears the third.
"""

import warp as wp

from warp_rigid.kernels.common.solver_body import (
    VELOCITY,
    BodyPair,
    inverse_inertia_of,
    inverse_mass_of,
    load_velocity,
    with_impulse,
)
from warp_rigid.kernels.common.tangents import world_vector
from warp_rigid.kernels.common.team import max_of_lanes, next_place, raise_to, sum_of_vectors
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
    velocity_change,
)
from warp_rigid.kernels.constraints.records import is_active
from warp_rigid.kernels.declare import record_reader
from warp_rigid.kernels.enums import Motion
from warp_rigid.kernels.graph.islands import most_rounds
from warp_rigid.kernels.graph.support import is_swept
from warp_rigid.kernels.schema import (
    Bodies,
    Constraints,
    ContactRecord,
    Contacts,
    Environments,
    Graph,
    Motions,
    RoundRecord,
    Rounds,
)

wp.set_module_options({"enable_backward": False})

read_round_pair = record_reader(RoundRecord)
"""Reads a pair that is solved in rounds: (k, pairs)."""

MOST_MOMENTUM = wp.constant(0.9)
"""Maximum momentum. Values from 0.85 to 0.95 converge equally fast; without a limit, rounds diverge after about 80."""

PLAIN_ROUNDS = wp.constant(3)
"""Rounds without momentum at the end, if the limit is reached. They do not increase the energy."""

SETTLED = wp.constant(1.0e-5)
"""Rounds end when no contact changes the velocity of a body by more than this [m/s]."""

UNIT = wp.constant(2.0**-40)
"""Unit of the sums [m/s, rad/s]."""

LARGEST_GAIN = wp.constant(4.0e6)
"""Largest velocity change by one pair [m/s, rad/s]: sums stay within 63 bits."""


@wp.func
def momentum(turn: int, limit: int, most: float):
    """Momentum after a round or sweep. The first one and the last PLAIN_ROUNDS of at most `limit` have none."""
    if turn + PLAIN_ROUNDS > limit:
        return 0.0
    return wp.min(float(turn - 1) / float(turn + 2), most)


@wp.func
def gained_of(b: int, first: int, rounds: Rounds):
    """Three components of the summed velocity changes of a body, from column `first`."""
    units = wp.vec3(
        float(rounds.gained[b, first]), float(rounds.gained[b, first + 1]), float(rounds.gained[b, first + 2])
    )
    return UNIT * units


@wp.func
def add_gain(b: int, first: int, gain: wp.vec3, rounds: Rounds):
    """Add a velocity change of a body."""
    for i in range(3):
        units = wp.int64(wp.clamp(gain[i], -LARGEST_GAIN, LARGEST_GAIN) / UNIT)
        wp.atomic_add(rounds.gained, b, first + i, units)


@wp.func
def add_to_velocity(b: int, buffer: int, rounds: Rounds, motions: Motions):
    """Add the summed velocity changes of a buffer to the velocity of a body."""
    if inverse_mass_of(b, motions) > 0.0:
        motions.solver_bodies[b].linear += gained_of(b, 6 * buffer, rounds)
        motions.solver_bodies[b].angular += gained_of(b, 6 * buffer + 3, rounds)


@wp.func
def clear_buffer(thread: int, threads: int, buffer: int, rounds: Rounds):
    """Clear a buffer of the sums; the threads share the bodies."""
    for b in range(thread, rounds.sharing.shape[0], threads):
        if rounds.sharing[b] > 0:
            for i in range(6):
                rounds.gained[b, 6 * buffer + i] = wp.int64(0)


@wp.func
def split_pair(entry: RoundRecord, base: float, buffer: int, rounds: Rounds, motions: Motions):
    """The two bodies of a pair with split masses; velocities are `base` times the current ones plus a buffer's sums."""
    a = entry.body_a
    b = entry.body_b
    share_a = float(entry.sharing_a)
    share_b = float(entry.sharing_b)
    pair = BodyPair()
    pair.inverse_mass_a = share_a * inverse_mass_of(a, motions)
    pair.inverse_mass_b = share_b * inverse_mass_of(b, motions)
    pair.linear_a = base * load_velocity(a, VELOCITY, motions)
    pair.angular_a = base * load_velocity(a, VELOCITY + 1, motions)
    pair.linear_b = base * load_velocity(b, VELOCITY, motions)
    pair.angular_b = base * load_velocity(b, VELOCITY + 1, motions)
    if pair.inverse_mass_a > 0.0:
        pair.inverse_inertia_a = share_a * inverse_inertia_of(a, motions)
        pair.linear_a += gained_of(a, 6 * buffer, rounds)
        pair.angular_a += gained_of(a, 6 * buffer + 3, rounds)
    if pair.inverse_mass_b > 0.0:
        pair.inverse_inertia_b = share_b * inverse_inertia_of(b, motions)
        pair.linear_b += gained_of(b, 6 * buffer, rounds)
        pair.angular_b += gained_of(b, 6 * buffer + 3, rounds)
    return pair


@wp.struct
class Wrench:
    """Impulse of a pair on its first body [N s], and its moments about both centres of mass [N m s].

    On the second body, all act in the opposite direction. `change` is the largest change of a relative velocity by a
    row [m/s].
    """

    impulse: wp.vec3
    moment_a: wp.vec3
    moment_b: wp.vec3
    change: float


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
def sum_of_wrenches(lanes: int, wrench: Wrench):
    """The sum of the wrenches of a team."""
    wrench.impulse = sum_of_vectors(wrench.impulse, lanes)
    wrench.moment_a = sum_of_vectors(wrench.moment_a, lanes)
    wrench.moment_b = sum_of_vectors(wrench.moment_b, lanes)
    wrench.change = max_of_lanes(wrench.change, lanes)
    return wrench


@wp.func
def add_gains(entry: RoundRecord, buffer: int, lane: int, lanes: int, wrench: Wrench, pair: BodyPair, rounds: Rounds):
    """Add the velocity changes by a wrench to both bodies, with their whole masses; the lanes share the sums."""
    whole_a = 1.0 / float(wp.max(entry.sharing_a, 1))
    whole_b = -1.0 / float(wp.max(entry.sharing_b, 1))
    for part in range(lane, 4, lanes):
        gain = whole_a * pair.inverse_mass_a * wrench.impulse
        if part == 1:
            gain = whole_a * (pair.inverse_inertia_a * wrench.moment_a)
        if part == 2:
            gain = whole_b * pair.inverse_mass_b * wrench.impulse
        if part == 3:
            gain = whole_b * (pair.inverse_inertia_b * wrench.moment_b)
        b = wp.where(part < 2, entry.body_a, entry.body_b)
        if wp.where(part < 2, pair.inverse_mass_a, pair.inverse_mass_b) > 0.0:
            add_gain(b, 6 * buffer + 3 * (part % 2), gain, rounds)


@wp.func
def needs_round(entry: RoundRecord, turn: int, rounds: Rounds):
    """Whether a pair takes part in a round: the last one changed a velocity, and the limit is not reached."""
    return turn <= entry.limit and rounds.last_change[entry.env] >= turn - 1


@wp.func
def record_change(entry: RoundRecord, turn: int, change: float, tolerance: float, rounds: Rounds):
    """Record that a round changed a velocity by more than the tolerance, and whether another round is needed."""
    if change > tolerance:
        if rounds.last_change[entry.env] != turn:
            rounds.last_change[entry.env] = turn
        if turn < entry.limit and rounds.latest[0] != turn:
            rounds.latest[0] = turn


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


@wp.func
def body_change(change: float, entry: RoundRecord):
    """Bound on the velocity change of a body from the change of the relative velocity of its copies [m/s]."""
    sharing = wp.min(entry.sharing_a, entry.sharing_b)
    return change / float(wp.where(sharing > 0, sharing, wp.max(entry.sharing_a, entry.sharing_b)))


@wp.kernel
def open_rounds(done: int, threads: int, rounds: Rounds):
    """The threads share the bodies and environments: no pairs, nothing gained, and `done` more rounds; 0: from 0."""
    tid = wp.tid()
    for b in range(tid, rounds.sharing.shape[0], threads):
        if rounds.sharing[b] > 0:
            for i in range(rounds.gained.shape[1]):
                rounds.gained[b, i] = wp.int64(0)
        rounds.sharing[b] = 0
    for env in range(tid, rounds.last_change.shape[0], threads):
        rounds.last_change[env] = 0
    if tid == 0:
        rounds.count[0] = 0
        rounds.done[0] = wp.where(done > 0, rounds.done[0] + done, 0)
        rounds.latest[0] = 0
        rounds.again[0] = 0


@wp.kernel
def list_heaps(
    threads: int,
    bodies: Bodies,
    envs: Environments,
    motions: Motions,
    constraints: Constraints,
    graph: Graph,
    rounds: Rounds,
):
    """The threads share the constraints: list the pairs of heaps."""
    for k in range(wp.tid(), constraints.start[constraints.start.shape[0] - 1], threads):
        if is_active(k, constraints) and not is_swept(k, constraints, graph):
            entry = RoundRecord()
            entry.body_a = constraints.body_a[k]
            entry.body_b = constraints.body_b[k]
            entry.begin = constraints.first_row[k]
            entry.end = entry.begin + constraints.row_count[k]
            entry.env = bodies.env[entry.body_a]
            dynamic = wp.where(bodies.motion[entry.body_a] == Motion.DYNAMIC, entry.body_a, entry.body_b)
            entry.limit = most_rounds(graph.island[dynamic], envs.contact_iterations[entry.env], graph)
            list_round_pair(entry, entry.end - entry.begin, rounds, motions)


@wp.func
def apply_impulses(entry: RoundRecord, buffer: int, rounds: Rounds, motions: Motions, contacts: Contacts):
    """Add the velocity changes by the current impulses of a pair. Returns 1 if they are finite."""
    wrench = Wrench()
    for c in range(entry.begin, entry.end):
        row = read_contact(c, contacts.rows)
        wrench = with_impulse_of(row, impulse_of(c, IMPULSE, contacts), wrench)
        wrench = with_moment_of(row, impulse_of(c, ANGULAR_IMPULSE, contacts), wrench)
    add_gains(entry, buffer, 0, 1, wrench, split_pair(entry, 0.0, buffer, rounds, motions), rounds)
    sum = wrench.impulse + wrench.moment_a + wrench.moment_b
    return wp.where(wp.isfinite(sum[0] + sum[1] + sum[2]), 1, 0)


@wp.kernel
def start_rounds(threads: int, rounds: Rounds, motions: Motions, contacts: Contacts):
    """The threads share the pairs: split the masses, and apply the initial impulses."""
    for k in range(wp.tid(), rounds.count[0], threads):
        entry = read_round_pair(k, rounds.pairs)
        entry.sharing_a = rounds.sharing[entry.body_a]
        entry.sharing_b = rounds.sharing[entry.body_b]
        rounds.pairs[k] = entry
        for c in range(entry.begin, entry.end):
            set_impulse(c, START_IMPULSE, impulse_of(c, IMPULSE, contacts), contacts)
            set_impulse(c, START_ANGULAR_IMPULSE, impulse_of(c, ANGULAR_IMPULSE, contacts), contacts)
        apply_impulses(entry, 0, rounds, motions, contacts)


@wp.func
def extrapolated(c: int, which: int, before: wp.vec3, new: wp.vec3, beta: float, contacts: Contacts):
    """Store a new impulse, and the extrapolation from the one before. Returns the extrapolated impulse."""
    ahead = new + beta * (new - before)
    set_impulse(c, which, ahead, contacts)
    set_impulse(c, wp.where(which == IMPULSE, START_IMPULSE, START_ANGULAR_IMPULSE), new, contacts)
    return ahead


@wp.func
def solve_contact(c: int, entry: RoundRecord, beta: float, pair: BodyPair, wrench: Wrench, contacts: Contacts):
    """Solve a contact for its copies of the bodies, and add its extrapolated impulses to the wrench."""
    share_a = float(entry.sharing_a)
    share_b = float(entry.sharing_b)
    row = read_contact(c, contacts.rows)
    old = impulse_of(c, IMPULSE, contacts)
    before = impulse_of(c, START_IMPULSE, contacts)
    new = next_impulse(old, share_a, share_b, row, pair)
    wrench = with_impulse_of(row, extrapolated(c, IMPULSE, before, new, beta, contacts), wrench)
    wrench.change = wp.max(wrench.change, velocity_change(new - old, share_a, share_b, row))
    if row.rolling_friction + row.spinning_friction > 0.0:
        gained = world_vector(row.normal, row.tangent, new - old)
        solve_rolling(c, new[0], row, with_impulse(row.arm_a, row.arm_b, gained, pair), contacts)
        moment = impulse_of(c, ANGULAR_IMPULSE, contacts)
        start = impulse_of(c, START_ANGULAR_IMPULSE, contacts)
        wrench = with_moment_of(row, extrapolated(c, ANGULAR_IMPULSE, start, moment, beta, contacts), wrench)
    return wrench


@wp.kernel
def solve_round(
    place: int, threads: int, lanes: int, rounds: Rounds, motions: Motions, contacts: Contacts, graph: Graph
):
    """One round, the one at `place` of its group: teams of lanes share the pairs, and clear a buffer."""
    turn = rounds.done[0] + place
    lane = wp.tid() % lanes
    clear_buffer(wp.tid(), threads, (turn + 1) % 3, rounds)
    for k in range(wp.tid() / lanes, rounds.count[0], threads / lanes):
        entry = read_round_pair(k, rounds.pairs)
        if needs_round(entry, turn, rounds):
            pair = split_pair(entry, 1.0, (turn - 1) % 3, rounds, motions)
            beta = momentum(turn, entry.limit, MOST_MOMENTUM)
            wrench = Wrench()
            for c in range(entry.begin + lane, entry.end, lanes):
                wrench = solve_contact(c, entry, beta, pair, wrench, contacts)
            wrench = sum_of_wrenches(lanes, wrench)
            add_gains(entry, turn % 3, lane, lanes, wrench, pair, rounds)
            change = body_change(wrench.change, entry)
            record_change(entry, turn, change, SETTLED, rounds)
            if change <= SETTLED or turn == entry.limit:
                raise_to(entry.env, change, graph.residual)


@wp.kernel
def close_rounds(count: int, rounds: Rounds):
    """One thread: after a group of `count` rounds, whether more follow."""
    rounds.done[0] += count
    rounds.again[0] = wp.where(rounds.latest[0] == rounds.done[0], 1, 0)


@wp.kernel
def finish_pairs(threads: int, rounds: Rounds, motions: Motions, contacts: Contacts, graph: Graph):
    """The threads share the pairs: take the impulses of the last round, which are not extrapolated.

    A non-finite velocity change cannot be summed as whole numbers; it makes the velocities of its bodies non-finite.
    """
    for k in range(wp.tid(), rounds.count[0], threads):
        entry = read_round_pair(k, rounds.pairs)
        count_rounds(entry, rounds, graph.rounds)
        for c in range(entry.begin, entry.end):
            set_impulse(c, IMPULSE, impulse_of(c, START_IMPULSE, contacts), contacts)
            set_impulse(c, ANGULAR_IMPULSE, impulse_of(c, START_ANGULAR_IMPULSE, contacts), contacts)
        if apply_impulses(entry, (rounds.done[0] + 1) % 3, rounds, motions, contacts) == 0:
            motions.solver_bodies[entry.body_a].angular = wp.vec3(wp.nan, wp.nan, wp.nan)
            motions.solver_bodies[entry.body_b].angular = wp.vec3(wp.nan, wp.nan, wp.nan)


@wp.kernel
def finish_bodies(threads: int, rounds: Rounds, motions: Motions):
    """The threads share the bodies: the velocities after the last round."""
    for b in range(wp.tid(), rounds.sharing.shape[0], threads):
        if rounds.sharing[b] > 0:
            add_to_velocity(b, (rounds.done[0] + 1) % 3, rounds, motions)
