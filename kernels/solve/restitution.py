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

from warp_rigid.kernels.common.arithmetic import quotient
from warp_rigid.kernels.common.solver_body import BodyPair, first_three, load_bodies, store_bodies, with_impulse
from warp_rigid.kernels.common.tangents import world_vector
from warp_rigid.kernels.common.team import any_of_team, sync_team, team_of
from warp_rigid.kernels.constraints.contact import (
    IMPACT_IMPULSE,
    KIND,
    contact_velocity,
    friction_impulse,
    read_contact,
    read_impulse,
    set_target_impulse,
)
from warp_rigid.kernels.constraints.rows import Rows
from warp_rigid.kernels.schema import ContactRecord, Contacts, Environments, Graph, Motions, Order
from warp_rigid.kernels.solve.schedule import (
    CONVERGED,
    entry_at,
    first_of_color,
    forget_visits,
    is_done,
    note_change,
    solved_turn,
    stride_of_color,
)

wp.set_module_options({"enable_backward": False})

INNER_ITERATIONS = wp.constant(8)
"""Most rounds over the contacts of one pair."""

SLOWEST = wp.constant(1.0e-4)
"""Approach below which a contact is no collision [m/s]."""

NO_IMPACT = wp.constant(-1.0e10)
"""Target of a contact that does not collide in this step [m/s]."""


@wp.func
def rebound(row: ContactRecord, speed: float, pull: float, dt: float):
    """Normal velocity that a contact approaching at `speed` aims at, or NO_IMPACT. `pull`: acceleration together."""
    if speed < SLOWEST or row.bias_velocity > speed + dt * pull:
        return NO_IMPACT
    e = row.restitution
    if e == 0.0:
        return -row.bias_velocity
    lag = 0.5 * dt * pull * wp.min(speed / wp.max(dt * pull, 1.0e-9), 1.0)
    fall = 2.0 * pull * wp.max(row.gap, 0.0)
    squared = e * e * ((speed + lag) * (speed + lag) + fall) - fall
    if squared <= 0.0:
        return NO_IMPACT
    return wp.sqrt(squared) + lag


@wp.func
def set_targets(begin: int, end: int, pair: BodyPair, relative_pull: wp.vec3, dt: float, contacts: Contacts):
    """Give the pair's contacts their targets. Returns 1 if any collides."""
    colliding = int(0)
    for c in range(begin, end):
        row = read_contact(c, contacts.rows)
        speed = -wp.dot(contact_velocity(row, pair), row.normal)
        target = rebound(row, speed, wp.max(-wp.dot(relative_pull, row.normal), 0.0), dt)
        set_target_impulse(c, wp.vec3(0.0, 0.0, 0.0), target, contacts)
        if target > NO_IMPACT:
            colliding = 1
    return colliding


@wp.func
def collide_contact(c: int, pair: BodyPair, contacts: Contacts):
    """One visit inside a pair: bring the normal velocity to its target, the slip to zero within the cone."""
    stored = read_impulse(contacts.impulses, c, IMPACT_IMPULSE)
    target = stored[3]
    if target <= NO_IMPACT:
        return pair
    row = read_contact(c, contacts.rows)
    n = row.normal
    u = row.tangent
    v = wp.cross(n, u)
    old = first_three(stored)
    slip = contact_velocity(row, pair)
    k_normal = row.normal_a + row.normal_b
    normal = wp.max(old[0] + quotient(target - wp.dot(slip, n), k_normal), 0.0)
    gained = normal - old[0]
    sliding = wp.vec2(wp.dot(slip, u), wp.dot(slip, v)) + gained * (row.coupling_a + row.coupling_b)
    k = row.tangent_a + row.tangent_b
    before = wp.vec2(old[1], old[2])
    after = friction_impulse(before, sliding, k, row.friction * normal)
    pair = with_impulse(row.arm_a, row.arm_b, gained * n + (after[0] - old[1]) * u + (after[1] - old[2]) * v, pair)
    set_target_impulse(c, wp.vec3(normal, after[0], after[1]), target, contacts)
    change = k_normal * wp.abs(gained) + (k[0] + k[2]) * (wp.abs(after[0] - old[1]) + wp.abs(after[1] - old[2]))
    pair.change = wp.max(pair.change, change)
    return pair


@wp.func
def energy_neutral_share(begin: int, end: int, before: BodyPair, after: BodyPair, lag: wp.vec3, contacts: Contacts):
    """Largest share in [0, 1] of the pair's impulse that gains no kinetic energy.

    With the share s the energy changes by s J.u + s^2 J.du / 2, u the time-centred relative velocities before (which
    differ from the stored ones by `lag`), du their change.
    """
    linear = float(0.0)
    quadratic = float(0.0)
    for c in range(begin, end):
        stored = read_impulse(contacts.impulses, c, IMPACT_IMPULSE)
        if stored[3] > NO_IMPACT:
            row = read_contact(c, contacts.rows)
            impulse = world_vector(row.normal, row.tangent, first_three(stored))
            slip = contact_velocity(row, before)
            linear += wp.dot(impulse, slip + lag)
            quadratic += 0.5 * wp.dot(impulse, contact_velocity(row, after) - slip)
    if linear + quadratic <= 0.0 or quadratic <= 0.0:
        return 1.0
    return wp.clamp(-linear / quadratic, 0.0, 1.0)


@wp.func
def solve_impact(
    k: int,
    turn: int,
    solved: int,
    dt: float,
    first: int,
    order: Order,
    graph: Graph,
    motions: Motions,
    rows: Rows,
):
    """Let the contacts of a pair collide together. Returns 1 if any did."""
    entry = entry_at(k, order)
    if entry.kind != KIND or is_done(entry, graph):
        return 0
    order.entries[k].visited = solved
    begin = entry.begin
    end = entry.end
    a = entry.body_a
    b = entry.body_b
    before = load_bodies(a, b, 1.0, 1.0, motions)
    relative_pull = float(first) * (motions.acceleration[a] - motions.acceleration[b])
    if set_targets(begin, end, before, relative_pull, dt, rows.contacts) == 0:
        return 0
    after = before
    left = int(INNER_ITERATIONS)
    while left > 0:
        after.change = 0.0
        for c in range(begin, end):
            after = collide_contact(c, after, rows.contacts)
        left = wp.where(after.change > CONVERGED, left - 1, 0)
    keep = energy_neutral_share(begin, end, before, after, 0.5 * dt * relative_pull, rows.contacts)
    after.linear_a = before.linear_a + keep * (after.linear_a - before.linear_a)
    after.angular_a = before.angular_a + keep * (after.angular_a - before.angular_a)
    after.linear_b = before.linear_b + keep * (after.linear_b - before.linear_b)
    after.angular_b = before.angular_b + keep * (after.angular_b - before.angular_b)
    store_bodies(a, b, after, motions)
    order.entries[k].visited = turn - 1
    note_change(a, turn, motions, graph)
    note_change(b, turn, motions, graph)
    return 1


@wp.kernel
def solve_impacts(
    dt: float,
    lanes: int,
    envs: Environments,
    order: Order,
    graph: Graph,
    motions: Motions,
    rows: Rows,
):
    """One team per environment: sweeps of pairwise impacts until none is left or the iterations are spent."""
    team = team_of(wp.tid(), lanes, graph.gate)
    env = team.env
    first = envs.collision_first[env]
    left = int(envs.collision_iterations[env])
    forget_visits(envs.first_body[env], envs.first_body[env + 1], team, order, graph)
    sync_team(team)
    turn = int(1)
    while left > 0:
        collided = int(0)
        for color in range(order.color_count[env]):
            turn += 1
            stride = stride_of_color(color, team)
            for k in range(first_of_color(color, team, order), order.color_start[env, color + 1], stride):
                collided |= solve_impact(k, turn, solved_turn(color, turn), dt, first, order, graph, motions, rows)
            sync_team(team)
        left = any_of_team(collided, team) * (left - 1)
