"""Shock propagation: transmits load through a stack in two passes instead of many sweeps.

*Upward pass*: in each contact between two levels, the lower body is frozen (infinite mass), and the impulse on it is
stored as its load. With `one_pass`, the method of 2003 (section 8.2), there is no second pass: loads have no effect on
the bodies below. *Downward pass* (after Xiong, Leach, Thomas and Sueda 2025): the pass is repeated, but each body now
moves under the load from the levels above. The lower body of a contact stays frozen at its velocity after the upward
pass, and the impulse on it is added to its load.

Both papers iterate one level after another until convergence. The result does not require this order: in the upward
pass a level depends only on the levels below it, in the downward pass only on those above. Therefore all levels are
iterated together, colour by colour, until nothing changes. The levels then converge one after another in as many
sweeps, instead of about twenty sweeps for each level, and the work of the whole scene is shared by the lanes of a team.

The result is only a search direction; `line_search` computes the step length. In a pile that moves, whose bodies lean
on each other in all directions, the step length is nearly zero, and shock propagation is omitted (islands.py).
"""

import warp as wp

from warp_rigid.kernels.common.solver_body import (
    UNDER_LOAD,
    BodyPair,
    inverse_inertia_of,
    inverse_mass_of,
    load_bodies,
    load_velocity,
    store_bodies,
    store_velocities,
    store_velocity,
)
from warp_rigid.kernels.common.team import Team, any_of_team, sync_team
from warp_rigid.kernels.constraints.contact import solve_row
from warp_rigid.kernels.enums import IslandSolver, ShockMode
from warp_rigid.kernels.graph.islands import is_moving_pile
from warp_rigid.kernels.schema import Contacts, Environments, Graph, Motions, Order, OrderRecord
from warp_rigid.kernels.solve.schedule import (
    Visited,
    end_of_entries,
    entry_at,
    first_entry,
    first_of_color,
    forget_visits,
    is_done,
    note_change,
    solved_stamp,
    stride_of_color,
)
from warp_rigid.kernels.tuning import CONVERGED, PAIR_ITERATIONS, SHARED_ITERATIONS, SHOCK_SWEEPS

wp.set_module_options({"enable_backward": False})


@wp.func
def has_repetition(repetition: int, env: int, envs: Environments):
    """Whether an environment has a repetition of shock propagation, counted from 0: others may have more of them."""
    return repetition < envs.shock_iterations[env]


@wp.func
def is_propagated(env: int, envs: Environments, graph: Graph):
    """Whether the passes of shock propagation are executed in an environment."""
    return (
        envs.shock_propagation[env] != ShockMode.OFF and graph.converged[env] == 0 and graph.sweeps_per_level[env] > 0
    )


@wp.func
def island_of(entry: OrderRecord, motions: Motions, graph: Graph):
    """The island of a constraint."""
    return graph.island[wp.where(motions.solver_bodies[entry.body_a].inverse_mass > 0.0, entry.body_a, entry.body_b)]


@wp.func
def skip_other_islands(team: Team, order: Order, graph: Graph, motions: Motions):
    """Skip the constraints of islands without shock propagation. Returns 1 if any constraint of the lane remains."""
    remains = int(0)
    for k in range(first_entry(team, order), end_of_entries(team.env, order), team.lanes):
        island = island_of(entry_at(k, order), motions, graph)
        if graph.solver[island] == IslandSolver.SWEEPS or graph.resting[island] == 1:
            order.entries[k].visited = Visited.SKIPPED
        else:
            remains = 1
    return remains


@wp.func
def under_load(entry: OrderRecord, pair: BodyPair, motions: Motions):
    """The pair with the upper body's velocity under its load, and the lower body's velocity after the upward pass."""
    a = entry.body_a
    b = entry.body_b
    if pair.inverse_mass_a > 0.0:
        pair.linear_a = load_velocity(a, UNDER_LOAD, motions)
        pair.angular_a = load_velocity(a, UNDER_LOAD + 1, motions)
    if pair.inverse_mass_b > 0.0:
        pair.linear_b = load_velocity(b, UNDER_LOAD, motions)
        pair.angular_b = load_velocity(b, UNDER_LOAD + 1, motions)
    return pair


@wp.func
def add_load(b: int, pair: BodyPair, motions: Motions):
    """Add the impulse on a frozen body to its load."""
    inverse_mass = inverse_mass_of(b, motions)
    if inverse_mass > 0.0:
        linear = load_velocity(b, UNDER_LOAD, motions) + inverse_mass * pair.frozen_impulse
        angular = load_velocity(b, UNDER_LOAD + 1, motions)
        store_velocity(
            b, UNDER_LOAD, linear, angular + inverse_inertia_of(b, motions) * pair.frozen_angular_impulse, motions
        )


@wp.func
def iterations_of(entry: OrderRecord, motions: Motions, graph: Graph):
    """Maximum iterations over the rows of a constraint per visit."""
    several_a = entry.upper_a == 1 and graph.support_count[entry.body_a] > 1
    several_b = entry.upper_b == 1 and graph.support_count[entry.body_b] > 1
    few = several_a or several_b or is_moving_pile(island_of(entry, motions, graph), graph)
    return wp.where(few, SHARED_ITERATIONS, PAIR_ITERATIONS)


@wp.func
def visit_frozen(
    k: int, stamp: int, solved: int, down: int, order: Order, graph: Graph, motions: Motions, contacts: Contacts
):
    """Solve a constraint with its lower body frozen, if one is lower. Returns 1 if a velocity changed."""
    entry = entry_at(k, order)
    if is_done(entry, graph):
        return 0
    mobility_a = float(entry.upper_a)
    mobility_b = float(entry.upper_b)
    pair = load_bodies(entry.body_a, entry.body_b, mobility_a, mobility_b, motions)
    if down == 1:
        pair = under_load(entry, pair, motions)
    changed = int(0)
    tolerance = CONVERGED * motions.velocity_unit[entry.body_a]
    left = iterations_of(entry, motions, graph)
    while left > 0:
        pair.change = 0.0
        for row in range(entry.begin, entry.end):
            pair = solve_row(row, mobility_a, mobility_b, pair, contacts)
        left = wp.where(pair.change > tolerance, left - 1, 0)
        changed |= wp.where(pair.change > tolerance, 1, 0)
    if down == 1:
        store_velocities(entry.body_a, entry.body_b, UNDER_LOAD, pair, motions)
    else:
        store_bodies(entry.body_a, entry.body_b, pair, motions)
    if entry.upper_a == 0:
        add_load(entry.body_a, pair, motions)
    if entry.upper_b == 0:
        add_load(entry.body_b, pair, motions)
    order.entries[k].visited = wp.where(pair.change > tolerance, stamp - 1, solved)
    if changed == 1 and entry.upper_a + down > 0:
        note_change(entry.body_a, stamp, motions, graph)
    if changed == 1 and entry.upper_b + down > 0:
        note_change(entry.body_b, stamp, motions, graph)
    return changed


@wp.func
def solve_levels(
    mode: int,
    down: int,
    first: int,
    last: int,
    team: Team,
    order: Order,
    graph: Graph,
    motions: Motions,
    contacts: Contacts,
):
    """One pass: iterate all levels together until convergence."""
    forget_visits(first, last, team, order, graph)
    remains = int(1)
    if mode == ShockMode.TWO_PASS:
        remains = skip_other_islands(team, order, graph, motions)
    stamp = int(1)
    sweeps = int(0)
    left = any_of_team(remains, team) * (SHOCK_SWEEPS + graph.sweeps_per_level[team.env] * graph.max_depth[team.env])
    while left > 0:
        changed = int(0)
        sweeps += 1
        for color in range(order.color_count[team.env]):
            stamp += 1
            stride = stride_of_color(color, team)
            for k in range(first_of_color(color, team, order), order.color_start[team.env, color + 1], stride):
                changed |= visit_frozen(k, stamp, solved_stamp(color, stamp), down, order, graph, motions, contacts)
            sync_team(team)
        left = any_of_team(changed, team) * (left - 1)
    if team.lane == 0:
        graph.shock_sweeps[team.env] += sweeps


@wp.func
def propagate(team: Team, envs: Environments, order: Order, graph: Graph, motions: Motions, contacts: Contacts):
    """The upward pass and, with two_pass, the downward pass."""
    env = team.env
    mode = envs.shock_propagation[env]
    first = envs.first_body[env]
    last = envs.first_body[env + 1]
    zero = wp.vec3(0.0, 0.0, 0.0)
    for b in range(first + team.lane, last, team.lanes):
        store_velocity(b, UNDER_LOAD, zero, zero, motions)
    for down in range(wp.where(mode == ShockMode.TWO_PASS, 2, 1)):
        if down == 1:
            for b in range(first + team.lane, last, team.lanes):
                solver_body = motions.solver_bodies[b]
                linear = solver_body.linear + solver_body.loaded_linear
                store_velocity(b, UNDER_LOAD, linear, solver_body.angular + solver_body.loaded_angular, motions)
        solve_levels(mode, down, first, last, team, order, graph, motions, contacts)
    if mode == ShockMode.TWO_PASS:
        for b in range(first + team.lane, last, team.lanes):
            motions.solver_bodies[b].linear = motions.solver_bodies[b].loaded_linear
            motions.solver_bodies[b].angular = motions.solver_bodies[b].loaded_angular
