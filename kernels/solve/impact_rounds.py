"""Restitution in large environments: impacts are solved in rounds, all pairs at once (rounds.py).

A pair with an impact is solved as in restitution.py, with the mass of each body divided by the number of its pairs with
an impact, and the new velocity of a body is the mean over these copies. No pair increases the energy of its copies, and
the energy of a mean is at most the mean of the energies, so a round never increases the energy. Impacts without
rebound are left to the contact solver, which solves all contacts of an island together.
"""

import warp as wp

from warp_rigid.kernels.common.solver_body import load_bodies
from warp_rigid.kernels.graph.heap_arrays import RoundRecord, Rounds, Slots
from warp_rigid.kernels.schema import Contacts, Environments, Motions
from warp_rigid.kernels.solve.pair_impact import after_impact, has_restitution, set_targets
from warp_rigid.kernels.solve.rounds import list_round_pair, read_round_pair, with_split_masses
from warp_rigid.kernels.solve.slots import clear_slots, store_change

wp.set_module_options({"enable_backward": False})


@wp.func
def relative_acceleration(entry: RoundRecord, envs: Environments, motions: Motions):
    """Acceleration of the first body relative to the second that follows the impacts, 0 if it precedes them [m/s^2]."""
    first = float(envs.collision_first[entry.env])
    return first * (motions.acceleration[entry.body_a] - motions.acceleration[entry.body_b])


@wp.kernel
def find_impacts(
    dt: float,
    threads: int,
    envs: Environments,
    solved: Rounds,
    rounds: Rounds,
    motions: Motions,
    contacts: Contacts,
    slots: Slots,
):
    """The threads share the pairs: list those with an impact, and set the target velocities."""
    for k in range(wp.tid(), solved.count[0], threads):
        entry = read_round_pair(k, solved.pairs)
        clear_slots(entry, slots)
        if rounds.done[0] < envs.collision_iterations[entry.env] and has_restitution(entry.begin, entry.end, contacts):
            pair = load_bodies(entry.body_a, entry.body_b, 1.0, 1.0, motions)
            pull = relative_acceleration(entry, envs, motions)
            unit = motions.velocity_unit[entry.body_a]
            if set_targets(entry.begin, entry.end, unit, pair, pull, dt, contacts) == 1:
                list_round_pair(entry, 1, rounds, motions)


@wp.kernel
def impact_round(
    dt: float,
    threads: int,
    envs: Environments,
    rounds: Rounds,
    motions: Motions,
    contacts: Contacts,
    slots: Slots,
    counts: wp.array[int],
):
    """The threads share the pairs: solve the impacts of each for its copies of the bodies, and count the rounds."""
    for k in range(wp.tid(), rounds.count[0], threads):
        entry = read_round_pair(k, rounds.pairs)
        if counts[entry.env] <= rounds.done[0]:
            wp.atomic_max(counts, entry.env, rounds.done[0] + 1)
        entry.sharing_a = rounds.sharing[entry.body_a]
        entry.sharing_b = rounds.sharing[entry.body_b]
        mobility_a = float(entry.sharing_a)
        mobility_b = float(entry.sharing_b)
        before = load_bodies(entry.body_a, entry.body_b, 1.0, 1.0, motions)
        before = with_split_masses(entry, before, motions.solver_bodies)
        lag = 0.5 * dt * relative_acceleration(entry, envs, motions)
        unit = motions.velocity_unit[entry.body_a]
        after = after_impact(entry.begin, entry.end, mobility_a, mobility_b, unit, lag, before, contacts)
        if before.inverse_mass_a > 0.0:
            store_change(entry.slot_a, 0, 0, (after.linear_a - before.linear_a) / mobility_a, 0.0, slots)
            store_change(entry.slot_a, 1, 0, (after.angular_a - before.angular_a) / mobility_a, 0.0, slots)
        if before.inverse_mass_b > 0.0:
            store_change(entry.slot_b, 0, 0, (after.linear_b - before.linear_b) / mobility_b, 0.0, slots)
            store_change(entry.slot_b, 1, 0, (after.angular_b - before.angular_b) / mobility_b, 0.0, slots)
