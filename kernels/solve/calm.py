"""Calm islands: further sweeps with Nesterov's momentum, until the velocities have converged.

A structure that carries load sideways, such as an arch or a card house, needs many sweeps from the first step on. Its
load has no order, so shock propagation is of little use, and an error of the velocities deforms it before the impulses
of earlier steps can correct the error. Islands whose bodies hardly move, and were placed where they are, are therefore
swept until no row changes a velocity any more. At rest the impulses of the last step solve the problem, and no such
sweep is needed. A structure that topples is swept further, too, but less often: its contacts turn in each step, and
impulses that have not converged would add energy. If a structure in motion is still far from its solution, as heavy
boxes that slide on a light tray are, it is swept as long as one at rest, without momentum. Piles of bodies whose masses
differ much are swept like structures that topple: the sweeps before converge slowly where heavy bodies are on light
ones.

The sweeps of an arch of n stones reduce the error by a fraction that decreases with the fourth power of n. With the
momentum b = (k - 1) / (k + 2) of sweep k (rounds.py), it decreases with the square of n: 27 stones need about 200
sweeps instead of thousands.
"""

import warp as wp

from warp_rigid.kernels.common.solver_body import START, VELOCITY, inverse_mass_of, load_velocity, store_velocity
from warp_rigid.kernels.common.team import Team, any_of_team, raise_to, sync_team
from warp_rigid.kernels.constraints.contact import extrapolate_row, store_start
from warp_rigid.kernels.enums import ShockMode
from warp_rigid.kernels.graph.islands import is_pile, most_in_motion
from warp_rigid.kernels.schema import Contacts, Environments, Graph, Motions, Order, OrderRecord
from warp_rigid.kernels.solve.gauss_seidel import solve_constraint
from warp_rigid.kernels.solve.rounds import momentum
from warp_rigid.kernels.solve.schedule import end_of_entries, entry_at, first_entry, first_of_color, stride_of_color
from warp_rigid.kernels.solve.shock import island_of
from warp_rigid.kernels.tuning import CALM_CONVERGED, DIVERGED, MOST_CALM, NEGLIGIBLE

wp.set_module_options({"enable_backward": False})


@wp.func
def limit_of(entry: OrderRecord, motions: Motions, graph: Graph):
    """Maximum number of further sweeps over a constraint."""
    # A body that is not dynamic sets no limit.
    limit = int(1 << 30)
    if inverse_mass_of(entry.body_a, motions) > 0.0:
        limit = graph.further_sweeps[entry.body_a]
    if inverse_mass_of(entry.body_b, motions) > 0.0:
        limit = wp.min(limit, graph.further_sweeps[entry.body_b])
    return limit


@wp.func
def store_calm_velocities(team: Team, envs: Environments, graph: Graph, motions: Motions):
    """Store the velocities of calm islands before the first sweep. Returns whether an environment has one."""
    found = int(0)
    for b in range(envs.first_body[team.env] + team.lane, envs.first_body[team.env + 1], team.lanes):
        if inverse_mass_of(b, motions) > 0.0 and graph.further_sweeps[b] > 0:
            found = 1
            linear = load_velocity(b, VELOCITY, motions)
            store_velocity(b, START, linear, load_velocity(b, VELOCITY + 1, motions), motions)
    return any_of_team(found, team)


@wp.func
def store_calm_impulses(team: Team, order: Order, graph: Graph, motions: Motions, contacts: Contacts):
    """Store the impulses of calm islands. Returns whether an environment has constraints of other islands."""
    others = int(0)
    for k in range(first_entry(team, order), end_of_entries(team.env, order), team.lanes):
        entry = entry_at(k, order)
        if limit_of(entry, motions, graph) == 0:
            others = 1
        else:
            for c in range(entry.begin, entry.end):
                store_start(c, contacts)
    return any_of_team(others, team)


@wp.func
def sweep_calm(
    done: int, moving: int, far: int, team: Team, order: Order, graph: Graph, motions: Motions, contacts: Contacts
):
    """Solve all constraints of calm islands once. Returns a lane's largest change [m/s].

    Where an island reaches its limit, the change is its residual. Structures whose limit is `moving` are swept beyond
    it as long as a row was `far` from its solution in the last sweep.
    """
    change = float(0.0)
    for color in range(order.color_count[team.env]):
        stride = stride_of_color(color, team)
        for k in range(first_of_color(color, team, order), order.color_start[team.env, color + 1], stride):
            entry = entry_at(k, order)
            limit = limit_of(entry, motions, graph)
            if far == 1 and limit == moving and done >= moving and not is_pile(island_of(entry, motions, graph), graph):
                limit = done + 1
            if done <= limit:
                change = wp.max(change, solve_constraint(entry, motions, contacts))
            if done == limit:
                raise_to(team.env, change, graph.residual)
        sync_team(team)
    return change


@wp.func
def sweeps_without_momentum(change: float, start: float, gained: float, most: int, moving: int, team: Team):
    """Momentum has diverged in the islands that have at most so many sweeps: those that move, or all.

    In boxes that slide with their tray, it diverges once a row changes a velocity by more than before the first sweep
    (`start`). In islands at rest, such changes are still reduced unless they exceed those by gravity (`gained`), too.
    """
    if any_of_team(wp.where(change > wp.max(start, NEGLIGIBLE * gained), 1, 0), team) == 0:
        return 0
    limit = DIVERGED * wp.max(start, gained)
    return wp.where(any_of_team(wp.where(change > limit, 1, 0), team) == 1, most, moving)


@wp.func
def momentum_of(done: int, limit: int, least: int):
    """Momentum after a sweep over an island that has at most `limit` of them; 0 if it has at most `least`."""
    return wp.where(limit > least, momentum(done, limit), 0.0)


@wp.func
def extrapolate(
    done: int,
    least: int,
    team: Team,
    envs: Environments,
    order: Order,
    graph: Graph,
    motions: Motions,
    contacts: Contacts,
):
    """Extrapolate velocities and impulses from their change since the sweep before."""
    env = team.env
    for b in range(envs.first_body[env] + team.lane, envs.first_body[env + 1], team.lanes):
        if inverse_mass_of(b, motions) > 0.0 and done <= graph.further_sweeps[b]:
            beta = momentum_of(done, graph.further_sweeps[b], least)
            linear = load_velocity(b, VELOCITY, motions)
            angular = load_velocity(b, VELOCITY + 1, motions)
            motions.solver_bodies[b].linear = linear + beta * (linear - load_velocity(b, START, motions))
            motions.solver_bodies[b].angular = angular + beta * (angular - load_velocity(b, START + 1, motions))
            store_velocity(b, START, linear, angular, motions)
    for k in range(first_entry(team, order), end_of_entries(env, order), team.lanes):
        entry = entry_at(k, order)
        limit = limit_of(entry, motions, graph)
        if done <= limit:
            for c in range(entry.begin, entry.end):
                extrapolate_row(c, momentum_of(done, limit, least), contacts)
    sync_team(team)


@wp.func
def sweep_calm_islands(
    dt: float, team: Team, envs: Environments, order: Order, graph: Graph, motions: Motions, contacts: Contacts
):
    """Sweep over the calm islands that have not converged.

    If the largest change has not halved within half of the sweeps, the rest is left to the next step.
    """
    env = team.env
    if graph.converged[env] == 1 or envs.shock_propagation[env] != ShockMode.TWO_PASS:
        return
    still = CALM_CONVERGED * motions.velocity_unit[envs.first_body[env]]
    if graph.residual[env] <= still:
        return
    if store_calm_velocities(team, envs, graph, motions) == 0:
        return
    others = store_calm_impulses(team, order, graph, motions, contacts)
    most = MOST_CALM * envs.contact_iterations[env]
    start = float(graph.residual[env])
    goal = float(start)
    least = int(0)
    gained = dt * wp.length(envs.gravity[env])
    moving = most_in_motion(envs.contact_iterations[env])
    sync_team(team)
    if team.lane == 0:
        graph.residual[env] = float(others) * start
    sync_team(team)
    change = float(0.0)
    done = int(0)
    halved = int(0)
    unsolved = int(1)
    far = int(1)
    while unsolved == 1 and done < most and 2 * (done - halved) < most:
        done += 1
        change = sweep_calm(done, moving, far, team, order, graph, motions, contacts)
        unsolved = any_of_team(wp.where(change > still, 1, 0), team)
        if far == 1 and done >= moving:
            far = any_of_team(wp.where(change > NEGLIGIBLE * gained, 1, 0), team)
            raise_to(env, float(1 - far) * change, graph.residual)
        if any_of_team(wp.where(change > goal, 1, 0), team) == 0:
            goal *= 0.5
            halved = done
        least = wp.max(least, sweeps_without_momentum(change, start, gained, most, moving, team))
        if unsolved == 1 and done < most:
            extrapolate(done, least, team, envs, order, graph, motions, contacts)
    if team.lane == 0:
        graph.sweeps[env] += done
    raise_to(env, change, graph.residual)
