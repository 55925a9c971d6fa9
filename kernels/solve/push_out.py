"""Push-out: separates bodies that would still overlap after the velocity solve, without changing the velocities.

Contacts that would end the step deeper than the slop get a pseudo-velocity that moves the bodies in this step only. An
existing overlap is removed over several steps; an additional overlap is prevented completely. Of two bodies in
different levels the lower one is frozen (Guendelman et al. 2003, section 8.3): a stack is corrected from the ground up.
This holds for contacts through which the upper body rests on the lower one, with a normal along its acceleration. In a
row of bodies that lean on each other, each would be turned further than the one below it: the correction grows by a
quarter from body to body, and throws the last of 30 dominoes by 0.3 m.
"""

import warp as wp

from warp_rigid.kernels.common.arithmetic import quotient
from warp_rigid.kernels.common.solver_body import (
    PUSH,
    BodyPair,
    load_bodies,
    store_velocities,
    with_impulse,
    with_velocities,
)
from warp_rigid.kernels.common.surfaces import tangential_running
from warp_rigid.kernels.common.symmetry import turn_of_surface
from warp_rigid.kernels.common.team import Team, any_of_team, sync_team, team_of
from warp_rigid.kernels.constraints.contact import (
    IMPACT_IMPULSE,
    read_contact,
    read_impulse,
    separation_speed,
    set_target_impulse,
    velocity_of_turning,
)
from warp_rigid.kernels.enums import ShockMode
from warp_rigid.kernels.schema import (
    Bodies,
    ContactRecord,
    Contacts,
    Environments,
    Graph,
    Motions,
    Order,
    OrderRecord,
    Pairs,
    Shapes,
    State,
)
from warp_rigid.kernels.solve.schedule import entry_at, first_of_color, stride_of_color
from warp_rigid.kernels.tuning import (
    FURTHEST_PUSH,
    LIGHTER,
    PUSH_OUT_CONVERGED,
    PUSH_OUT_SWEEPS,
    RECOVERY,
    SLOP,
    UPRIGHT_NORMAL,
    WEIGHTLESS,
)
from warp_rigid.kernels.update.predict import smaller_size

wp.set_module_options({"enable_backward": False})


@wp.func
def gap_after(row: ContactRecord, key: int, dt: float, pair: BodyPair, turn_a: wp.quat, turn_b: wp.quat):
    """Gap of a contact after the step, including the rotation of arms and normal, which velocities do not account for.

    The normal turns with the surface to which it belongs: that of the second body if the key is even, else the first.
    """
    way_a = dt * pair.linear_a + wp.quat_rotate(turn_a, row.arm_a) - row.arm_a
    way_b = dt * pair.linear_b + wp.quat_rotate(turn_b, row.arm_b) - row.arm_b
    turn = turn_b
    if key % 2 == 1:
        turn = turn_a
    return row.gap + wp.dot(way_a - way_b + dt * row.surface, wp.quat_rotate(turn, row.normal))


@wp.func
def fastest_recovery(pull: float, size: float, dt: float):
    """Largest speed at which bodies that overlap are pushed apart [m/s]: that of a fall from their own size.

    Without an acceleration it is a fraction of the size in a step.
    """
    return wp.where(pull > 0.0, wp.sqrt(2.0 * pull * size), WEIGHTLESS * size / dt)


@wp.func
def wanted_speed(
    c: int, dt: float, shapes: Shapes, bodies: Bodies, state: State, pairs: Pairs, motions: Motions, contacts: Contacts
):
    """Separation speed that the contact requires [m/s], 0 if none."""
    row = read_contact(c, contacts.rows)
    a = pairs.body_a[contacts.pair[c]]
    b = pairs.body_b[contacts.pair[c]]
    # The rotation of the arms accounts for what turns, and a surface that runs along itself closes no gap.
    if shapes.shapes[bodies.shape[a]].rise + shapes.shapes[bodies.shape[b]].rise > 0.0:
        count = pairs.contact_start[contacts.pair[c] + 1] - pairs.contact_start[contacts.pair[c]]
        row.surface -= velocity_of_turning(row, count, a, b, dt, shapes, bodies, state, motions)
        row.surface -= tangential_running(a, b, contacts.position[c], row.normal, dt, bodies, state, motions)
    else:
        row.surface = wp.vec3(0.0, 0.0, 0.0)
    size = smaller_size(a, b, shapes, bodies)
    pair = load_bodies(a, b, 0.0, 0.0, motions)
    turn_a = turn_of_surface(a, pair.angular_a, dt, shapes, bodies, state)
    turn_b = turn_of_surface(b, pair.angular_b, dt, shapes, bodies, state)
    overlap = wp.max(-gap_after(row, contacts.key[c], dt, pair, turn_a, turn_b) - SLOP * size, 0.0)
    old = wp.min(overlap, wp.max(-row.gap - SLOP * size, 0.0))
    falls = wp.max(wp.length(motions.acceleration[a]), wp.length(motions.acceleration[b]))
    recovery = wp.min(RECOVERY * old / dt, fastest_recovery(falls, size, dt))
    return wp.min((overlap - old) / dt + recovery, FURTHEST_PUSH * size / dt)


@wp.func
def with_impulse_on(row: ContactRecord, impulse: wp.vec3, mobility_a: float, mobility_b: float, pair: BodyPair):
    """The pseudo-velocities after a pseudo-impulse; a body whose mobility is 0 is frozen."""
    moved = with_impulse(row.arm_a, row.arm_b, impulse, pair)
    if mobility_a > 0.0:
        pair.linear_a = moved.linear_a
        pair.angular_a = moved.angular_a
    if mobility_b > 0.0:
        pair.linear_b = moved.linear_b
        pair.angular_b = moved.angular_b
    return pair


@wp.func
def push_contact(c: int, mobility_a: float, mobility_b: float, pull: wp.vec3, pair: BodyPair, contacts: Contacts):
    """Update one contact: bring the pseudo-velocity of separation to its target by a pseudo-impulse.

    The mobility is 0 for the lower body, which is frozen if the upper one, with acceleration `pull`, rests on it.
    """
    stored = read_impulse(contacts.impulses, c, IMPACT_IMPULSE)
    target = stored[3]
    if target <= 0.0:
        return pair
    row = read_contact(c, contacts.rows)
    lower = (1.0 - mobility_a) * row.normal_a + (1.0 - mobility_b) * row.normal_b
    upper = mobility_a * row.normal_a + mobility_b * row.normal_b
    if lower < LIGHTER * upper and wp.abs(wp.dot(row.normal, pull)) < UPRIGHT_NORMAL * wp.length(pull):
        mobility_a = 1.0
        mobility_b = 1.0
    k = mobility_a * row.normal_a + mobility_b * row.normal_b
    if k <= 0.0:
        return pair
    old = stored[0]
    missing = target - separation_speed(row, pair)
    new = wp.max(old + quotient(missing, k), 0.0)
    set_target_impulse(c, wp.vec3(new, 0.0, 0.0), target, contacts)
    pair = with_impulse_on(row, (new - old) * row.normal, mobility_a, mobility_b, pair)
    pair.change = wp.max(pair.change, k * wp.abs(new - old))
    return pair


@wp.func
def push_pair(entry: OrderRecord, freeze: int, motions: Motions, contacts: Contacts):
    """Update the contacts of a pair, with pseudo-velocities in place of velocities. Returns 1 if one changed."""
    a = entry.body_a
    b = entry.body_b
    mobility_a = wp.where(freeze == 1, float(entry.upper_a), 1.0)
    mobility_b = wp.where(freeze == 1, float(entry.upper_b), 1.0)
    pull = motions.acceleration[wp.where(entry.upper_a == 1, a, b)]
    pair = load_bodies(a, b, 1.0, 1.0, motions)
    pair = with_velocities(a, b, PUSH, pair, motions)
    for c in range(entry.begin, entry.end):
        pair = push_contact(c, mobility_a, mobility_b, pull, pair, contacts)
    store_velocities(a, b, PUSH, pair, motions)
    return wp.where(pair.change > PUSH_OUT_CONVERGED * motions.velocity_unit[a], 1, 0)


@wp.kernel
def find_overlaps(
    dt: float,
    threads: int,
    shapes: Shapes,
    bodies: Bodies,
    state: State,
    envs: Environments,
    pairs: Pairs,
    motions: Motions,
    graph: Graph,
    contacts: Contacts,
):
    """The threads share the contacts: the separation speed that each requires, and the environments that need push-out.

    Environments that are solved in rounds only are left out (push_rounds.py).
    """
    for c in range(wp.tid(), pairs.contact_start[pairs.start[pairs.start.shape[0] - 1]], threads):
        env = bodies.env[pairs.body_a[contacts.pair[c]]]
        if graph.swept[env] == 1:
            target = wanted_speed(c, dt, shapes, bodies, state, pairs, motions, contacts)
            set_target_impulse(c, wp.vec3(0.0, 0.0, 0.0), target, contacts)
            if target > 0.0 and envs.contact_iterations[env] > 0 and graph.overlapping[env] == 0:
                graph.overlapping[env] = 1


@wp.func
def separate(freeze: int, most: int, team: Team, order: Order, graph: Graph, motions: Motions, contacts: Contacts):
    """Sweep over all pairs, at most `most` times. Returns 1 if the pseudo-velocities have not converged by then."""
    left = most
    changed = int(0)
    while left > 0:
        changed = int(0)
        for color in range(order.color_count[team.env]):
            stride = stride_of_color(color, team)
            for k in range(first_of_color(color, team, order), order.color_start[team.env, color + 1], stride):
                changed |= push_pair(entry_at(k, order), freeze, motions, contacts)
            sync_team(team)
        changed = any_of_team(changed, team)
        left = changed * (left - 1)
        if team.lane == 0:
            graph.push_out_sweeps[team.env] += 1
    return changed


@wp.kernel
def push_apart(lanes: int, envs: Environments, order: Order, graph: Graph, motions: Motions, contacts: Contacts):
    """One team per environment: separate all pairs, with the lower body frozen where the upper one rests on it.

    As in shock propagation, all levels are iterated together. Bodies caught between two frozen bodies are separated by
    further sweeps without freezing. If shock propagation is off, no body is frozen at all.
    """
    team = team_of(wp.tid(), lanes)
    env = team.env
    if graph.overlapping[env] == 0:
        return
    caught = int(1)
    if envs.shock_propagation[env] != ShockMode.OFF:
        caught = separate(1, PUSH_OUT_SWEEPS + graph.max_depth[env], team, order, graph, motions, contacts)
    if caught == 1:
        separate(0, PUSH_OUT_SWEEPS, team, order, graph, motions, contacts)
