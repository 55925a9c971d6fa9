"""Projected Gauss-Seidel sweeps over the rows of all constraints, colour by colour.

A team of lanes solves an environment. A lane keeps the two bodies of a constraint in registers while it solves the
constraint's rows.
"""

import warp as wp

from warp_rigid.kernels.common.solver_body import BEFORE_CONTACTS, load_bodies, store_bodies, store_velocity
from warp_rigid.kernels.common.team import Team, any_of_team, sync_team
from warp_rigid.kernels.constraints.contact import apply_row, solve_row
from warp_rigid.kernels.constraints.load_distribution import distribute_contact_load
from warp_rigid.kernels.enums import IslandSolver, ShockMode
from warp_rigid.kernels.schema import Contacts, Environments, Graph, Motions, Order, OrderRecord
from warp_rigid.kernels.solve.schedule import entry_at, first_of_color, stride_of_color
from warp_rigid.kernels.tuning import CONVERGED, SWEEPS_PER_DEPTH

wp.set_module_options({"enable_backward": False})


@wp.func
def solve_constraint(entry: OrderRecord, motions: Motions, contacts: Contacts):
    """Solve the rows of a constraint, one after another. Returns the largest velocity change [m/s]."""
    pair = load_bodies(entry.body_a, entry.body_b, 1.0, 1.0, motions)
    for row in range(entry.begin, entry.end):
        pair = solve_row(row, 1.0, 1.0, pair, contacts)
    store_bodies(entry.body_a, entry.body_b, pair, motions)
    return pair.change


@wp.func
def warm_start_pair(entry: OrderRecord, motions: Motions, contacts: Contacts):
    """Apply the initial impulses of a constraint."""
    pair = load_bodies(entry.body_a, entry.body_b, 1.0, 1.0, motions)
    distribute_contact_load(entry.begin, entry.end, contacts)
    for row in range(entry.begin, entry.end):
        pair = apply_row(row, pair, contacts)
    store_bodies(entry.body_a, entry.body_b, pair, motions)


@wp.func
def store_before_contacts(team: Team, envs: Environments, motions: Motions):
    """Store the velocities before the initial impulses are applied."""
    for b in range(envs.first_body[team.env] + team.lane, envs.first_body[team.env + 1], team.lanes):
        body = motions.solver_bodies[b]
        store_velocity(b, BEFORE_CONTACTS, body.linear, body.angular, motions)
    sync_team(team)


@wp.func
def warm_start(team: Team, envs: Environments, order: Order, motions: Motions, contacts: Contacts):
    """Apply the initial impulses of the rows."""
    env = team.env
    if envs.warm_starting[env] == 0:
        return
    store_before_contacts(team, envs, motions)
    for color in range(order.color_count[env]):
        stride = stride_of_color(color, team)
        for k in range(first_of_color(color, team, order), order.color_start[env, color + 1], stride):
            warm_start_pair(entry_at(k, order), motions, contacts)
        sync_team(team)


@wp.func
def is_of_level(level: int, entry: OrderRecord, graph: Graph):
    """Whether a pair belongs to a level; level 0 has all pairs."""
    return level == 0 or wp.max(graph.level[entry.body_a], graph.level[entry.body_b]) == level


@wp.func
def sweep(level: int, team: Team, order: Order, graph: Graph, motions: Motions, contacts: Contacts):
    """Solve all constraints once, or those of one level if `level` is not 0. Returns a lane's largest change [m/s]."""
    change = float(0.0)
    for color in range(order.color_count[team.env]):
        stride = stride_of_color(color, team)
        for k in range(first_of_color(color, team, order), order.color_start[team.env, color + 1], stride):
            entry = entry_at(k, order)
            if is_of_level(level, entry, graph):
                change = wp.max(change, solve_constraint(entry, motions, contacts))
        sync_team(team)
    return change


@wp.func
def any_without_shock(team: Team, envs: Environments, graph: Graph):
    """1 if any island of an environment that has contacts is solved by sweeps alone."""
    found = int(0)
    for b in range(envs.first_body[team.env] + team.lane, envs.first_body[team.env + 1], team.lanes):
        if graph.touching[b] > 0 and graph.solver[b] == IslandSolver.SWEEPS:
            found = 1
    return any_of_team(found, team)


@wp.func
def sweeps_of(after_shock: int, team: Team, envs: Environments, graph: Graph):
    """Maximum number of sweeps before or after shock propagation."""
    env = team.env
    iterations = envs.contact_iterations[env]
    if envs.shock_propagation[env] != ShockMode.TWO_PASS:
        return iterations * (1 - after_shock)
    if after_shock == 0:
        return (iterations + 1) / 2
    if graph.converged[env] == 1:
        return 0
    return iterations / 2 + SWEEPS_PER_DEPTH * graph.max_depth[env] * any_without_shock(team, envs, graph)


@wp.func
def report_sweeps(sweeps: int, residual: float, team: Team, graph: Graph):
    """Record the number of sweeps and the residual of the step's last sweep; both are 0 before the first launch."""
    if team.lane == 0:
        graph.sweeps[team.env] += sweeps
        if sweeps > 0:
            graph.residual[team.env] = 0.0
    sync_team(team)
    if sweeps > 0:
        wp.atomic_max(graph.residual, team.env, residual)


@wp.func
def sweep_constraints(
    after_shock: int, team: Team, envs: Environments, order: Order, graph: Graph, motions: Motions, contacts: Contacts
):
    """Half of the contact iterations, before or after the two passes of shock propagation.

    With a single pass, all iterations come before it, as in 2003: bodies frozen in it must not move again, and the
    sweeps go level by level from the ground up. Sweeps end early once the velocities have converged; shock
    propagation is then skipped.
    """
    env = team.env
    unit = motions.velocity_unit[envs.first_body[env]]
    left = sweeps_of(after_shock, team, envs, graph)
    layered = wp.where(envs.shock_propagation[env] == ShockMode.ONE_PASS, 1, 0)
    unsolved = int(1)
    done = int(0)
    residual = float(0.0)
    while left > 0:
        change = float(0.0)
        for level in range(layered, layered * graph.level_count[env] + 1):
            change = wp.max(change, sweep(level, team, order, graph, motions, contacts))
        done += 1
        residual = change
        unsolved = any_of_team(wp.where(change > CONVERGED * unit, 1, 0), team)
        left = unsolved * (left - 1)
    if after_shock == 0:
        graph.converged[env] = 1 - unsolved
    report_sweeps(done, residual, team, graph)
