"""Initial impulses: those of the last step, as far as they do not increase the energy.

At an impact, the impulses of a step are many times larger than what the next step requires. Sweeps reduce them again,
but too few follow in a pile that moves, and what is left of them adds energy. With a factor t on the initial impulses
of an island, the energy of the contact problem (line_search.py) changes along a parabola that is 0 at t = 0. If its
minimum is before t = 1/2, it is positive at t = 1, and the impulses are scaled to the minimum. In islands that hardly
move, and without two-pass shock propagation, they never are: the few sweeps could not build them up again.
"""

import warp as wp

from warp_rigid.kernels.common.solver_body import (
    START,
    inverse_mass_of,
    load_bodies,
    load_velocity,
    store_bodies,
    store_velocity,
)
from warp_rigid.kernels.common.team import Team, any_of_team, sync_team, team_of
from warp_rigid.kernels.constraints.contact import (
    START_ANGULAR_IMPULSE,
    START_IMPULSE,
    apply_row,
    blend_row,
    set_impulse,
)
from warp_rigid.kernels.constraints.load_distribution import distribute_contact_load
from warp_rigid.kernels.enums import ShockMode
from warp_rigid.kernels.schema import Contacts, Environments, Graph, Motions, Order, OrderRecord
from warp_rigid.kernels.solve.line_search import accepted_share, add_terms, clear_sums, store_terms
from warp_rigid.kernels.solve.schedule import (
    end_of_entries,
    entry_at,
    first_entry,
    first_of_color,
    stride_of_color,
)
from warp_rigid.kernels.solve.shock import island_of
from warp_rigid.kernels.tuning import HARDLY

wp.set_module_options({"enable_backward": False})


@wp.func
def warm_start_pair(entry: OrderRecord, motions: Motions, contacts: Contacts):
    """Apply the initial impulses of a constraint."""
    pair = load_bodies(entry.body_a, entry.body_b, 1.0, 1.0, motions)
    distribute_contact_load(entry.begin, entry.end, contacts)
    for row in range(entry.begin, entry.end):
        pair = apply_row(row, pair, contacts)
    store_bodies(entry.body_a, entry.body_b, pair, motions)


@wp.func
def any_moves(team: Team, envs: Environments, graph: Graph):
    """1 if an island of an environment moves more than hardly, and has two-pass shock propagation."""
    moves = int(0)
    if envs.shock_propagation[team.env] != ShockMode.TWO_PASS:
        return moves
    for b in range(envs.first_body[team.env] + team.lane, envs.first_body[team.env + 1], team.lanes):
        moves |= wp.where(graph.island_speed[b] > HARDLY, 1, 0)
    return any_of_team(moves, team)


@wp.func
def store_without_impulses(team: Team, envs: Environments, order: Order, motions: Motions, contacts: Contacts):
    """Store the velocities, and impulses of 0, as the start of a line search."""
    for b in range(envs.first_body[team.env] + team.lane, envs.first_body[team.env + 1], team.lanes):
        store_velocity(b, START, motions.solver_bodies[b].linear, motions.solver_bodies[b].angular, motions)
    for k in range(first_entry(team, order), end_of_entries(team.env, order), team.lanes):
        entry = entry_at(k, order)
        for row in range(entry.begin, entry.end):
            set_impulse(row, START_IMPULSE, wp.vec3(0.0, 0.0, 0.0), contacts)
            set_impulse(row, START_ANGULAR_IMPULSE, wp.vec3(0.0, 0.0, 0.0), contacts)
    sync_team(team)


@wp.func
def kept_share(island: int, graph: Graph):
    """Factor on the initial impulses of an island."""
    t = accepted_share(island, graph)
    return wp.where(t < 0.5 and graph.island_speed[island] > HARDLY, t, 1.0)


@wp.func
def limit_impulses(team: Team, envs: Environments, order: Order, graph: Graph, motions: Motions, contacts: Contacts):
    """Scale the initial impulses of each island that would increase the energy, and what they have changed."""
    first = envs.first_body[team.env]
    last = envs.first_body[team.env + 1]
    clear_sums(first, last, team, graph)
    store_terms(team, order, graph, motions, contacts)
    add_terms(team, order, graph, motions)
    sync_team(team)
    for b in range(first + team.lane, last, team.lanes):
        t = kept_share(graph.island[b], graph)
        if t < 1.0 and inverse_mass_of(b, motions) > 0.0:
            linear = load_velocity(b, START, motions)
            angular = load_velocity(b, START + 1, motions)
            motions.solver_bodies[b].linear = linear + t * (motions.solver_bodies[b].linear - linear)
            motions.solver_bodies[b].angular = angular + t * (motions.solver_bodies[b].angular - angular)
    for k in range(first_entry(team, order), end_of_entries(team.env, order), team.lanes):
        entry = entry_at(k, order)
        t = kept_share(island_of(entry, motions, graph), graph)
        if t < 1.0:
            for row in range(entry.begin, entry.end):
                blend_row(row, t, contacts)
    sync_team(team)


@wp.kernel
def warm_start(lanes: int, envs: Environments, order: Order, graph: Graph, motions: Motions, contacts: Contacts):
    """One team per environment: apply the initial impulses of the rows."""
    team = team_of(wp.tid(), lanes)
    env = team.env
    if envs.warm_starting[env] == 0 or order.color_count[env] == 0:
        return
    moves = any_moves(team, envs, graph)
    if moves == 1:
        store_without_impulses(team, envs, order, motions, contacts)
    for color in range(order.color_count[env]):
        stride = stride_of_color(color, team)
        for k in range(first_of_color(color, team, order), order.color_start[env, color + 1], stride):
            warm_start_pair(entry_at(k, order), motions, contacts)
        sync_team(team)
    if moves == 1:
        limit_impulses(team, envs, order, graph, motions, contacts)
