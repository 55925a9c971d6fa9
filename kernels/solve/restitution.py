"""Restitution: impacts, solved before the velocity update (Guendelman et al. 2003, sections 4 and 6).

A body at rest has no velocity here, as gravity is added later. Resting bodies therefore do not bounce, and no threshold
speed is needed. Only approaching contacts that would close within the step take part; resting contacts are left to the
contact solver, and so are impacts without restitution in a pile that moves.

Pairs without restitution are solved one after another (pair_impact.py). The impulse of a pair is scaled down if it
would increase the energy. Pairs with restitution that approach at the same time are solved together
(simultaneous_impacts.py).
"""

import warp as wp

from warp_rigid.kernels.common.solver_body import load_bodies, store_bodies
from warp_rigid.kernels.common.team import Team, any_of_team, sync_team, team_of
from warp_rigid.kernels.enums import IslandSolver, ShockMode
from warp_rigid.kernels.schema import Contacts, Environments, Graph, Motions, Order, OrderRecord
from warp_rigid.kernels.solve.pair_impact import after_impact, relative_pull, set_targets
from warp_rigid.kernels.solve.schedule import (
    entry_at,
    first_of_color,
    forget_visits,
    is_done,
    note_change,
    solved_stamp,
    stride_of_color,
)
from warp_rigid.kernels.solve.simultaneous_impacts import bounce_together, find_bouncing

wp.set_module_options({"enable_backward": False})


@wp.func
def is_left_out(entry: OrderRecord, mode: int, graph: Graph):
    """Whether the impacts of a pair without restitution are left to the contact solver: in a pile that moves."""
    solver = wp.max(graph.solver[entry.body_a], graph.solver[entry.body_b])
    return mode == ShockMode.TWO_PASS and solver == IslandSolver.SWEEPS


@wp.func
def solve_impact(
    k: int,
    stamp: int,
    solved: int,
    dt: float,
    first: int,
    mode: int,
    order: Order,
    graph: Graph,
    motions: Motions,
    contacts: Contacts,
):
    """Solve the impacts of all contacts of a pair without restitution. Returns 1 if there was any."""
    entry = entry_at(k, order)
    if is_done(entry, graph):
        return 0
    order.entries[k].visited = solved
    if is_left_out(entry, mode, graph):
        return 0
    a = entry.body_a
    b = entry.body_b
    before = load_bodies(a, b, 1.0, 1.0, motions)
    pull = relative_pull(entry, first, motions)
    unit = motions.velocity_unit[a]
    if set_targets(entry.begin, entry.end, unit, before, pull, dt, contacts) == 0:
        return 0
    lag = 0.5 * dt * pull
    after = after_impact(entry.begin, entry.end, 1.0, 1.0, unit, lag, before, contacts)
    store_bodies(a, b, after, motions)
    order.entries[k].visited = stamp - 1
    note_change(a, stamp, motions, graph)
    note_change(b, stamp, motions, graph)
    return 1


@wp.func
def sweep_impacts(
    stamp: int,
    dt: float,
    envs: Environments,
    team: Team,
    order: Order,
    graph: Graph,
    motions: Motions,
    contacts: Contacts,
):
    """Solve the impacts of all pairs without restitution once, with the stamps after `stamp`. Returns 1 if any."""
    first = envs.collision_first[team.env]
    mode = envs.shock_propagation[team.env]
    collided = int(0)
    for color in range(order.color_count[team.env]):
        stamp += 1
        stride = stride_of_color(color, team)
        for k in range(first_of_color(color, team, order), order.color_start[team.env, color + 1], stride):
            collided |= solve_impact(
                k, stamp, solved_stamp(color, stamp), dt, first, mode, order, graph, motions, contacts
            )
        sync_team(team)
    return any_of_team(collided, team)


@wp.func
def bounce_groups(
    stamp: int,
    dt: float,
    envs: Environments,
    team: Team,
    order: Order,
    graph: Graph,
    motions: Motions,
    contacts: Contacts,
):
    """Solve the next groups of simultaneous impacts. Returns 1 if there were any."""
    first = envs.collision_first[team.env]
    begin = envs.first_body[team.env]
    end = envs.first_body[team.env + 1]
    collided = int(0)
    # A sweep passes an impact on by two spheres of a row.
    left = int(2)
    while left > 0:
        found = bounce_together(stamp, dt, first, begin, end, team, order, graph, motions, contacts)
        collided |= found
        left = found * (left - 1)
    return collided


@wp.func
def open_impacts(team: Team, envs: Environments, order: Order, graph: Graph):
    """Reset the stamps. Returns the maximum number of sweeps, 0 without constraints."""
    env = team.env
    if order.color_count[env] == 0:
        return 0
    forget_visits(envs.first_body[env], envs.first_body[env + 1], team, order, graph)
    sync_team(team)
    return envs.collision_iterations[env]


@wp.kernel
def solve_impacts(
    dt: float, lanes: int, envs: Environments, order: Order, graph: Graph, motions: Motions, contacts: Contacts
):
    """One team per environment: sweeps of impacts until there are none, at most `collision_iterations`."""
    team = team_of(wp.tid(), lanes)
    env = team.env
    left = int(open_impacts(team, envs, order, graph))
    if left == 0:
        return
    bounces = find_bouncing(team, order, contacts)
    stamp = int(1)
    while left > 0:
        collided = sweep_impacts(stamp, dt, envs, team, order, graph, motions, contacts)
        stamp += order.color_count[env] + 1
        if bounces == 1:
            collided |= bounce_groups(stamp, dt, envs, team, order, graph, motions, contacts)
        left = collided * (left - 1)
        if team.lane == 0:
            graph.impact_sweeps[env] += collided
