"""Shock propagation: weight travels through a stack in two passes instead of many sweeps.

*Up*: in each contact between two levels the lower body is frozen (infinitely heavy), and what it did not take is kept
as its load. With `one_pass`, the method of 2003 (section 8.2), that is all: loads are never felt below. *Down* (after
Xiong, Leach, Thomas and Sueda 2025): the same once more, but now every body moves under its load, as the level above
has left it; the lower body of a contact stays frozen at the velocity that it had after the pass up, and its load grows
by what it does not take.

Both papers go from level to level and iterate each until nothing changes. What they arrive at does not need that order:
in the pass up a level depends on the levels below it alone, in the pass down on those above. So all levels are iterated
together, colour by colour, until nothing changes anywhere: levels settle one after another in as many sweeps, not in
as many times twenty, and the lanes of a large team have the whole scene to share.

What comes out is only a search direction: `line_search` decides how far to go in it. In a heap, whose bodies lean on
each other every way, that is hardly at all. So an island that has gone less than a tenth of the way for eight steps in
a row is left alone, and tried again in every eighth step.
"""

import warp as wp

from warp_rigid.kernels.common.packed import (
    LOADED,
    VELOCITY,
    entry_at,
    first_three,
    inverse_inertia_of,
    solver_body_quad,
    store_velocity,
)
from warp_rigid.kernels.common.team import Team, any_of_team, sync_team, team_of
from warp_rigid.kernels.enums import ShockMode
from warp_rigid.kernels.schema import Contacts, Environments, Graph, Motions, Order, PairRecord
from warp_rigid.kernels.solve.gauss_seidel import (
    CONVERGED,
    INEFFECTIVE_STEPS,
    BodyPair,
    first_of_color,
    forget_visits,
    is_done,
    load_bodies,
    note_change,
    solve_contact,
    solved_turn,
    store_bodies,
    stride_of_color,
)

wp.set_module_options({"enable_backward": False})


SHOCK_SWEEPS = wp.constant(4)
"""Most sweeps of a pass, and three for each body on the shortest way down. With two, a tower of thirty crossed layers
of beams falls."""

PAIR_ITERATIONS = wp.constant(4)
"""Most rounds over the contacts of a pair in a visit, if its upper body stands on nothing else. With one, a stack of 50
falls over."""

SHARED_ITERATIONS = wp.constant(2)
"""The same where a body stands on several. With one, the tower of beams falls; with eight, the first pair takes all
load, and a pyramid of 20 rows is pushed 1 mm out of shape."""

USEFUL = wp.constant(0.1)
"""Share of the way from which shock propagation has been of use to an island."""

NO_WAY = wp.constant(1.0e-3)
"""What changes velocities by less [m/s] tells nothing: the island is at rest."""

SKIPPED = wp.constant(2**30)
"""Stands for a visit after all others."""


@wp.func
def island_of(entry: PairRecord, motions: Motions, graph: Graph):
    """The island of a touching pair."""
    return graph.island[wp.where(motions.solver_bodies[entry.body_a].inverse_mass > 0.0, entry.body_a, entry.body_b)]


@wp.func
def skips_shock(ineffective_steps: int):
    """Whether an island goes without shock propagation in this step, by how long that has been of no use to it."""
    return ineffective_steps > INEFFECTIVE_STEPS


@wp.func
def next_ineffective_steps(ineffective_steps: int, way: float, share: float):
    """The same after this step, in which an island went a share of a way, its largest change of a velocity."""
    if skips_shock(ineffective_steps):
        return wp.where(ineffective_steps < 2 * INEFFECTIVE_STEPS - 1, ineffective_steps + 1, INEFFECTIVE_STEPS)
    if way < NO_WAY:
        return wp.where(ineffective_steps == INEFFECTIVE_STEPS, ineffective_steps + 1, ineffective_steps)
    return wp.where(share < USEFUL, ineffective_steps + 1, 0)


@wp.func
def skip_ineffective_islands(team: Team, order: Order, graph: Graph, motions: Motions):
    """Pass over the pairs of islands that go without shock propagation. Returns 1 if any pair remains to a lane."""
    remains = int(0)
    begin = order.color_start[team.env, 0]
    for k in range(begin + team.lane, order.color_start[team.env, order.color_count[team.env]], team.lanes):
        if skips_shock(graph.ineffective_steps[island_of(entry_at(k, order.entries), motions, graph)]):
            order.entries[k].visited = SKIPPED
        else:
            remains = 1
    return remains


@wp.func
def under_load(entry: PairRecord, body_pair: BodyPair, motions: Motions):
    """Two bodies, the upper as it moves under its load, the lower as it was after the pass up."""
    a = entry.body_a
    b = entry.body_b
    if body_pair.inverse_mass_a > 0.0:
        body_pair.linear_a = first_three(solver_body_quad(motions.solver_bodies, a, LOADED))
        body_pair.angular_a = first_three(solver_body_quad(motions.solver_bodies, a, LOADED + 1))
    if body_pair.inverse_mass_b > 0.0:
        body_pair.linear_b = first_three(solver_body_quad(motions.solver_bodies, b, LOADED))
        body_pair.angular_b = first_three(solver_body_quad(motions.solver_bodies, b, LOADED + 1))
    return body_pair


@wp.func
def store_loaded_bodies(entry: PairRecord, body_pair: BodyPair, motions: Motions):
    """Store the velocities of the upper bodies as those under their load."""
    if body_pair.inverse_mass_a > 0.0:
        store_velocity(entry.body_a, LOADED, body_pair.linear_a, body_pair.angular_a, motions)
    if body_pair.inverse_mass_b > 0.0:
        store_velocity(entry.body_b, LOADED, body_pair.linear_b, body_pair.angular_b, motions)


@wp.func
def add_load(b: int, body_pair: BodyPair, motions: Motions):
    """Let a frozen body feel what it did not take."""
    inverse_mass = solver_body_quad(motions.solver_bodies, b, VELOCITY)[3]
    if inverse_mass > 0.0:
        linear = first_three(solver_body_quad(motions.solver_bodies, b, LOADED)) + inverse_mass * body_pair.held
        angular = first_three(solver_body_quad(motions.solver_bodies, b, LOADED + 1))
        store_velocity(b, LOADED, linear, angular + inverse_inertia_of(b, motions) * body_pair.held_turn, motions)


@wp.func
def rounds_of(entry: PairRecord, graph: Graph):
    """How often a visit of a pair goes over its contacts, at most."""
    several_a = entry.upper_a == 1 and graph.support_count[entry.body_a] > 1
    several_b = entry.upper_b == 1 and graph.support_count[entry.body_b] > 1
    return wp.where(several_a or several_b, SHARED_ITERATIONS, PAIR_ITERATIONS)


@wp.func
def visit_frozen(
    k: int, turn: int, solved: int, down: int, order: Order, graph: Graph, motions: Motions, contacts: Contacts
):
    """Solve the contacts of a pair, its lower body frozen if one is lower. Returns 1 if a velocity changed."""
    entry = entry_at(k, order.entries)
    if is_done(entry, graph):
        return 0
    share_a = float(entry.upper_a)
    share_b = float(entry.upper_b)
    body_pair = load_bodies(entry.body_a, entry.body_b, share_a, share_b, motions)
    if down == 1:
        body_pair = under_load(entry, body_pair, motions)
    changed = int(0)
    left = rounds_of(entry, graph)
    while left > 0:
        body_pair.change = 0.0
        for c in range(entry.begin, entry.end):
            body_pair = solve_contact(c, share_a, share_b, body_pair, contacts)
        left = wp.where(body_pair.change > CONVERGED, left - 1, 0)
        changed |= wp.where(body_pair.change > CONVERGED, 1, 0)
    if down == 1:
        store_loaded_bodies(entry, body_pair, motions)
    else:
        store_bodies(entry.body_a, entry.body_b, body_pair, motions)
    if entry.upper_a == 0:
        add_load(entry.body_a, body_pair, motions)
    if entry.upper_b == 0:
        add_load(entry.body_b, body_pair, motions)
    order.entries[k].visited = wp.where(body_pair.change > CONVERGED, turn - 1, solved)
    if changed == 1 and entry.upper_a + down > 0:
        note_change(entry.body_a, turn, motions, graph)
    if changed == 1 and entry.upper_b + down > 0:
        note_change(entry.body_b, turn, motions, graph)
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
    """One pass: iterate all levels together until no visit changes anything."""
    forget_visits(first, last, team, order, graph)
    remains = int(1)
    if mode == ShockMode.TWO_PASS:
        remains = skip_ineffective_islands(team, order, graph, motions)
    turn = int(1)
    left = any_of_team(remains, team) * (SHOCK_SWEEPS + 3 * graph.max_depth[team.env])
    while left > 0:
        changed = int(0)
        for color in range(order.color_count[team.env]):
            turn += 1
            stride = stride_of_color(color, team)
            for k in range(first_of_color(color, team, order), order.color_start[team.env, color + 1], stride):
                changed |= visit_frozen(k, turn, solved_turn(color, turn), down, order, graph, motions, contacts)
            sync_team(team)
        left = any_of_team(changed, team) * (left - 1)


@wp.kernel
def propagate(
    repetition: int,
    lanes: int,
    bodies_per_env: int,
    envs: Environments,
    order: Order,
    graph: Graph,
    motions: Motions,
    contacts: Contacts,
):
    """A team an environment: the pass up, and with two_pass the pass down."""
    team = team_of(wp.tid(), lanes, graph.gate)
    env = team.env
    mode = envs.shock_propagation[env]
    if mode == ShockMode.OFF or repetition >= envs.shock_iterations[env] or graph.converged[env] == 1:
        return
    first = env * bodies_per_env
    last = first + bodies_per_env
    zero = wp.vec3(0.0, 0.0, 0.0)
    for b in range(first + team.lane, last, lanes):
        store_velocity(b, LOADED, zero, zero, motions)
    for down in range(wp.where(mode == ShockMode.TWO_PASS, 2, 1)):
        if down == 1:
            for b in range(first + team.lane, last, lanes):
                solver_body = motions.solver_bodies[b]
                linear = solver_body.linear + solver_body.loaded_linear
                store_velocity(b, LOADED, linear, solver_body.angular + solver_body.loaded_angular, motions)
        solve_levels(mode, down, first, last, team, order, graph, motions, contacts)
    if mode == ShockMode.TWO_PASS:
        for b in range(first + team.lane, last, lanes):
            motions.solver_bodies[b].linear = motions.solver_bodies[b].loaded_linear
            motions.solver_bodies[b].angular = motions.solver_bodies[b].loaded_angular
