"""Resting islands: stop what moves by errors of the solver only, instead of shock propagation.

In a wall or a slender stack at rest, the impulses of the last step balance gravity except for an error. Sweeps hardly
reduce it where the structure can bend: relative velocities below the tolerance, or below the rounding of impulses, add
up to ten times as much at the top of 25 bricks. With v(k) the velocities after step k, the same impulses start the next
step with 2 v(k) - v(k - 1), so that the error accelerates the structure from step to step.
Shock propagation does not remove velocities that are so small. Where bodies have several supports, its passes do not
even converge: no friction lets a body stick to two supports that are frozen at different velocities, so the impulses
change in each sweep until they reach the friction limit.

A contact that presses does not open, and one that sticks does not slide. If three contacts of a body with a body below,
not on a line, press, and two with a body below stick, it moves as little as those below. If this holds for each body of
an island, it is at rest, and all velocities are errors. As impulses have errors, too, it is required that they are far
from their limits and that the velocities are small. Such an island is stopped if it is not solved by the first sweeps.
The error then starts from zero again, and neither further sweeps nor shock propagation are needed. In the following
steps it is stopped again even if the sweeps converge: otherwise it would creep.
"""

import warp as wp

from warp_rigid.kernels.common.solver_body import VELOCITY, inverse_mass_of, load_velocity
from warp_rigid.kernels.common.team import Team, any_of_team, sync_team
from warp_rigid.kernels.constraints.contact import IMPULSE, impulse_of, read_contact
from warp_rigid.kernels.enums import IslandSolver, Motion, ShockMode
from warp_rigid.kernels.graph.heap_arrays import Rounds
from warp_rigid.kernels.graph.support import Level, Support
from warp_rigid.kernels.schema import Bodies, ContactRecord, Contacts, Environments, Graph, Motions, Order
from warp_rigid.kernels.solve.rounds import read_round_pair
from warp_rigid.kernels.solve.schedule import end_of_entries, entry_at, first_entry
from warp_rigid.kernels.solve.shock import island_of
from warp_rigid.kernels.tuning import AT_ONCE, CLEARANCE, DEEP_ENOUGH, NOT_ON_A_LINE, STOPPED_SPEED

wp.set_module_options({"enable_backward": False})


@wp.func
def speed_of(b: int, graph: Graph, motions: Motions):
    """Bound on the speed of a body's surface [m/s]."""
    size = graph.island_size[graph.island[b]]
    spin = wp.length(load_velocity(b, VELOCITY + 1, motions))
    return wp.length(load_velocity(b, VELOCITY, motions)) + size * spin


@wp.func
def has_swept_constraints(b: int, graph: Graph, motions: Motions):
    """Whether a body is dynamic and has constraints that are solved in sweeps."""
    dynamic = inverse_mass_of(b, motions) > 0.0
    return dynamic and graph.touching[b] + graph.tied[b] > 0 and graph.solver[b] != IslandSolver.ROUNDS


@wp.func
def presses(row: ContactRecord, impulse: wp.vec3, far: float):
    """Whether a normal impulse is far from zero."""
    return (row.normal_a + row.normal_b) * impulse[0] > far


@wp.func
def sticks(row: ContactRecord, impulse: wp.vec3, far: float):
    """Whether a tangential impulse is far from the friction limit."""
    left = row.friction * impulse[0] - wp.length(wp.vec2(impulse[1], impulse[2]))
    return (row.normal_a + row.normal_b) * left > far


@wp.func
def find_held(upper: int, begin: int, end: int, far: float, graph: Graph, contacts: Contacts):
    """Mark the upper body of a pair if three contacts that are not on a line press, and if two stick."""
    pressing = int(0)
    sticking = int(0)
    start = wp.vec3(0.0, 0.0, 0.0)
    side = wp.vec3(0.0, 0.0, 0.0)
    for c in range(begin, end):
        row = read_contact(c, contacts.rows)
        impulse = impulse_of(c, IMPULSE, contacts)
        if presses(row, impulse, far):
            place = row.arm_a - start
            if pressing == 0:
                start = row.arm_a
            elif pressing == 1:
                side = place
            elif wp.length(wp.cross(side, place)) > NOT_ON_A_LINE * wp.length(side) * wp.length(place):
                graph.pressed[upper] = 1
            pressing += 1
            sticking += wp.where(sticks(row, impulse, far), 1, 0)
    if sticking > 1:
        graph.stuck[upper] = 1


@wp.func
def moves_on(b: int, begin: int, motions: Motions, contacts: Contacts):
    """Whether a body of a constraint is not dynamic, but moves."""
    if inverse_mass_of(b, motions) > 0.0:
        return False
    speed = wp.length(load_velocity(b, VELOCITY, motions)) + wp.length(load_velocity(b, VELOCITY + 1, motions))
    return speed + wp.length(read_contact(begin, contacts.rows).surface) > 0.0


@wp.func
def find_slow(slow: float, first: int, last: int, team: Team, graph: Graph, motions: Motions):
    """Mark the deep islands whose bodies are slow and have no joints. Returns 1 if there are any.

    If the sweeps have converged, the bodies must also have been at rest at the start of the step.
    """
    for b in range(first + team.lane, last, team.lanes):
        graph.pressed[b] = 0
        graph.stuck[b] = 0
        graph.resting[b] = 0
    sync_team(team)
    for b in range(first + team.lane, last, team.lanes):
        if (
            has_swept_constraints(b, graph, motions)
            and graph.depth[b] >= DEEP_ENOUGH
            and graph.depth[b] < Level.UNSUPPORTED
        ):
            island = graph.island[b]
            if graph.converged[team.env] == 0 or graph.island_speed[island] == 0.0:
                graph.resting[island] = 1
    sync_team(team)
    for b in range(first + team.lane, last, team.lanes):
        if has_swept_constraints(b, graph, motions) and (graph.tied[b] == 1 or speed_of(b, graph, motions) > slow):
            graph.resting[graph.island[b]] = 0
    sync_team(team)
    found = int(0)
    for b in range(first + team.lane, last, team.lanes):
        found |= graph.resting[b]
    return any_of_team(found, team)


@wp.func
def leave_out_free(
    far: float, first: int, last: int, team: Team, order: Order, graph: Graph, motions: Motions, contacts: Contacts
):
    """Leave out the islands with moving ground, or with a body that those below it do not hold."""
    for k in range(first_entry(team, order), end_of_entries(team.env, order), team.lanes):
        entry = entry_at(k, order)
        island = island_of(entry, motions, graph)
        if graph.resting[island] == 1:
            if moves_on(entry.body_a, entry.begin, motions, contacts) or moves_on(
                entry.body_b, entry.begin, motions, contacts
            ):
                graph.resting[island] = 0
            elif entry.upper_a + entry.upper_b == 1:
                upper = wp.where(entry.upper_a == 1, entry.body_a, entry.body_b)
                find_held(upper, entry.begin, entry.end, far, graph, contacts)
    sync_team(team)
    for b in range(first + team.lane, last, team.lanes):
        if has_swept_constraints(b, graph, motions) and graph.pressed[b] * graph.stuck[b] == 0:
            graph.resting[graph.island[b]] = 0
    sync_team(team)


@wp.func
def stop_resting_islands(
    dt: float, team: Team, envs: Environments, order: Order, graph: Graph, motions: Motions, contacts: Contacts
):
    """Stop the islands at rest. If there are no others, nothing is left to solve."""
    env = team.env
    if envs.shock_propagation[env] != ShockMode.TWO_PASS or envs.warm_starting[env] * graph.swept[env] == 0:
        return
    first = envs.first_body[env]
    last = envs.first_body[env + 1]
    slow = STOPPED_SPEED * dt * wp.length(envs.gravity[env])
    if find_slow(slow, first, last, team, graph, motions) == 0:
        return
    leave_out_free(CLEARANCE * slow, first, last, team, order, graph, motions, contacts)
    others = int(0)
    for b in range(first + team.lane, last, team.lanes):
        if has_swept_constraints(b, graph, motions):
            if graph.resting[graph.island[b]] == 1:
                motions.solver_bodies[b].linear = wp.vec3(0.0, 0.0, 0.0)
                motions.solver_bodies[b].angular = wp.vec3(0.0, 0.0, 0.0)
            else:
                others = 1
    others = any_of_team(others, team)
    if team.lane == 0 and others == 0:
        graph.converged[env] = 1


@wp.kernel
def find_held_bodies(
    dt: float, threads: int, envs: Environments, rounds: Rounds, graph: Graph, motions: Motions, contacts: Contacts
):
    """The threads share the pairs that are solved in rounds: mark the bodies that those below hold."""
    for k in range(wp.tid(), rounds.count[0], threads):
        entry = read_round_pair(k, rounds.pairs)
        supports = graph.supports[entry.constraint]
        if moves_on(entry.body_a, entry.begin, motions, contacts) or moves_on(
            entry.body_b, entry.begin, motions, contacts
        ):
            graph.restless[graph.island[wp.where(entry.slot_a >= 0, entry.body_a, entry.body_b)]] = 1
        elif supports == Support.A_ON_B or supports == Support.B_ON_A:
            upper = wp.where(supports == Support.A_ON_B, entry.body_a, entry.body_b)
            far = CLEARANCE * STOPPED_SPEED * dt * wp.length(envs.gravity[entry.env])
            find_held(upper, entry.begin, entry.end, far, graph, contacts)


@wp.kernel
def find_restless_islands(
    dt: float, bodies: Bodies, envs: Environments, rounds: Rounds, graph: Graph, motions: Motions
):
    """One thread per body that is solved in rounds: mark its island if the body is not held, or is not slow.

    If the rounds have ended at once, the bodies must also have been at rest at the start of the step.
    """
    b = wp.tid()
    if graph.solver[b] != IslandSolver.ROUNDS or bodies.motion[b] != Motion.DYNAMIC:
        return
    island = graph.island[b]
    slow = CLEARANCE * STOPPED_SPEED * dt * wp.length(envs.gravity[bodies.env[b]])
    started = rounds.last_change[bodies.env[b]] >= AT_ONCE or graph.island_speed[island] == 0.0
    if not started or graph.pressed[b] * graph.stuck[b] == 0 or speed_of(b, graph, motions) > slow:
        graph.restless[island] = 1


@wp.kernel
def stop_resting_bodies(bodies: Bodies, envs: Environments, graph: Graph, motions: Motions):
    """One thread per body that is solved in rounds: stop it if its island is at rest."""
    b = wp.tid()
    if graph.solver[b] == IslandSolver.ROUNDS and bodies.motion[b] == Motion.DYNAMIC and graph.touching[b] > 0:
        if graph.restless[graph.island[b]] == 0 and envs.warm_starting[bodies.env[b]] == 1:
            motions.solver_bodies[b].linear = wp.vec3(0.0, 0.0, 0.0)
            motions.solver_bodies[b].angular = wp.vec3(0.0, 0.0, 0.0)
