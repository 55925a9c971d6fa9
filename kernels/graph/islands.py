"""Islands of bodies in contact, and which of them are solved in rounds.

Islands are the connected components of the dynamic bodies: trees of bodies are joined in parallel, always the root with
the higher index below the one with the lower (Jaiganesh and Burtscher 2018), so that the root of an island is its
lowest body, in whatever order the threads run.

In environments of many bodies, islands are solved in rounds (rounds.py). Those of other environments, and those for
which rounds converge slowly, are solved in sweeps with shock propagation (shock.py): islands with joints, with masses
that differ much, with a body in very many pairs, and few bodies that bounce.

An island is a pile if most of its bodies have fallen there, and a structure if they were placed where they are. The
impulses of a pile of similar masses converge over several steps. Those of other islands must be found in each step. The
load of such a pile that moves has no order, and the line search accepts little of shock propagation. It is solved by
sweeps alone.
"""

import warp as wp

from warp_rigid.kernels.common.crowd import CROWDED, is_crowded
from warp_rigid.kernels.common.team import add_together, raise_to
from warp_rigid.kernels.constraints.records import is_active
from warp_rigid.kernels.enums import IslandSolver, Motion, Role, ShockMode
from warp_rigid.kernels.graph.heap_arrays import MOST_SHARING
from warp_rigid.kernels.schema import Bodies, Constraints, Environments, Graph, Motions, Shapes, State
from warp_rigid.kernels.tuning import (
    BUSY,
    COMPARABLE,
    EVEN,
    FLIGHT,
    HARDLY,
    LEAST_CALM,
    LOWEST_STRUCTURE,
    MOST_CALM,
    MOST_IN_MOTION,
    PILE_CONVERGED,
    PILE_ROUNDS,
    PILE_ROUNDS_PER_BODY,
    RESTING,
    RESTING_SHARE,
    STRUCTURE_CONVERGED,
    STRUCTURE_ROUNDING,
    STRUCTURE_ROUNDS,
    STRUCTURE_ROUNDS_AT_REST,
    STRUCTURE_ROUNDS_PER_BODY,
    SWEEPS_PER_LEVEL,
    SWEEPS_PER_LEVEL_OF_PILE,
)

wp.set_module_options({"enable_backward": False})


@wp.func
def root_of(b: int, parents: wp.array[int]):
    """The root of a body's tree."""
    root = int(b)
    parent = parents[root]
    while parent != root:
        root = parent
        parent = parents[root]
    return root


@wp.func
def join(a: int, b: int, parents: wp.array[int]):
    """Join the trees of two bodies."""
    upper = root_of(a, parents)
    lower = root_of(b, parents)
    while upper != lower:
        high = wp.max(upper, lower)
        lower = wp.min(upper, lower)
        upper = wp.atomic_cas(parents, high, high, lower)
        if upper == high:
            upper = lower
        else:
            upper = root_of(upper, parents)
            lower = root_of(lower, parents)


@wp.kernel
def start_islands(bodies: Bodies, graph: Graph):
    """One thread per body: each body is an island of its own."""
    b = wp.tid()
    if graph.unchanged[bodies.env[b]] == 0:
        graph.island[b] = b
    graph.touching[b] = 0
    graph.tied[b] = 0
    graph.island_bodies[b] = 0
    graph.fallen_votes[b] = 0
    graph.island_pairs[b] = 0
    graph.bouncing_votes[b] = 0
    graph.island_size[b] = 0.0
    # Below every height, for maxima.
    graph.island_low[b] = -1.0e30
    graph.island_high[b] = -1.0e30
    graph.island_speed[b] = 0.0
    graph.island_mass[b] = 0.0
    graph.island_inverse_mass[b] = 0.0
    graph.needs_sweeps[b] = 0
    graph.pressed[b] = 0
    graph.stuck[b] = 0
    graph.restless[b] = 0
    graph.accepted[b] = 1.0


@wp.kernel
def join_islands(threads: int, bodies: Bodies, constraints: Constraints, graph: Graph):
    """The threads share the constraints: join the islands of both bodies, and count the constraints of each body."""
    for k in range(wp.tid(), constraints.start[constraints.start.shape[0] - 1], threads):
        if is_active(k, constraints):
            a = constraints.body_a[k]
            b = constraints.body_b[k]
            dynamic_a = bodies.motion[a] == Motion.DYNAMIC
            dynamic_b = bodies.motion[b] == Motion.DYNAMIC
            if dynamic_a:
                wp.atomic_add(graph.touching, a, 1)
            if dynamic_b:
                wp.atomic_add(graph.touching, b, 1)
            if dynamic_a and dynamic_b and graph.unchanged[bodies.env[a]] == 0:
                join(a, b, graph.island)


@wp.func
def count_flight(b: int, dt: float, touching: int, state: State):
    """Count the steps of a body in free flight, and record whether it has fallen."""
    if touching > 0:
        state.flight_steps[b] = 0
        return
    state.flight_steps[b] += 1
    if dt * float(state.flight_steps[b]) >= FLIGHT:
        state.fallen[b] = 1


@wp.kernel
def vote(dt: float, shapes: Shapes, bodies: Bodies, envs: Environments, motions: Motions, graph: Graph, state: State):
    """One thread per body: the label of its island, and its part in what decides how the island is solved."""
    b = wp.tid()
    if bodies.motion[b] != Motion.DYNAMIC:
        return
    island = root_of(b, graph.island)
    graph.island[b] = island
    if motions.role[b] == Role.FREE:
        count_flight(b, dt, graph.touching[b], state)
    add_together(graph.island_bodies, island, 1)
    add_together(graph.fallen_votes, island, state.fallen[b])
    add_together(graph.island_pairs, island, graph.touching[b])
    size = shapes.shapes[bodies.shape[b]].size
    raise_to(island, wp.length(state.linear_velocity[b]) / size, graph.island_speed)
    raise_to(island, size, graph.island_size)
    depth = wp.dot(state.position[b], wp.normalize(envs.gravity[bodies.env[b]]))
    raise_to(island, depth, graph.island_low)
    raise_to(island, -depth, graph.island_high)
    raise_to(island, bodies.mass[b], graph.island_mass)
    raise_to(island, bodies.inverse_mass[b], graph.island_inverse_mass)
    add_together(graph.bouncing_votes, island, wp.where(bodies.restitution[b] > 0.0, 1, 0))
    if graph.tied[b] == 1 or graph.touching[b] > MOST_SHARING:
        graph.needs_sweeps[island] = 1


@wp.func
def mass_ratio(island: int, graph: Graph):
    """Largest ratio of the masses of two bodies of an island."""
    return graph.island_mass[island] * graph.island_inverse_mass[island]


@wp.func
def bounces(island: int, graph: Graph):
    """Whether few bodies, most of which have restitution, move: impacts are then solved one after another."""
    bouncing = 2 * graph.bouncing_votes[island] > graph.island_bodies[island]
    return bouncing and graph.island_bodies[island] <= CROWDED and graph.island_speed[island] > HARDLY


@wp.func
def rounds_converge(island: int, graph: Graph):
    """Whether rounds converge for an island, and solve its impacts."""
    if graph.needs_sweeps[island] == 1 or mass_ratio(island, graph) > COMPARABLE:
        return False
    return not bounces(island, graph)


@wp.func
def is_pile(island: int, graph: Graph):
    """Whether most bodies of an island have fallen there."""
    return 2 * graph.fallen_votes[island] > graph.island_bodies[island]


@wp.func
def height_of(island: int, graph: Graph):
    """Height of an island, in sizes of its largest body."""
    return (graph.island_low[island] + graph.island_high[island]) / graph.island_size[island]


@wp.func
def is_even_pile(island: int, graph: Graph):
    """Whether an island is a pile of bodies of similar mass."""
    return is_pile(island, graph) and mass_ratio(island, graph) <= EVEN


@wp.func
def is_moving_pile(island: int, graph: Graph):
    """Whether an island is an even pile that moves."""
    return is_even_pile(island, graph) and graph.island_speed[island] > BUSY


@wp.func
def has_no_order(island: int, graph: Graph):
    """Whether the load of an island has no order that shock propagation could follow.

    That is an even pile that moves, and is not a stack, in which each body is on one other.
    """
    if graph.needs_sweeps[island] == 1 or not is_moving_pile(island, graph):
        return False
    return graph.island_pairs[island] >= 2 * graph.island_bodies[island]


@wp.func
def solver_of(island: int, mode: int, crowded: bool, graph: Graph):
    """The IslandSolver of an island."""
    if mode == ShockMode.OFF:
        return int(IslandSolver.SWEEPS)
    if mode == ShockMode.TWO_PASS and crowded and rounds_converge(island, graph):
        return int(IslandSolver.ROUNDS)
    if mode == ShockMode.TWO_PASS and has_no_order(island, graph):
        return int(IslandSolver.SWEEPS)
    return int(IslandSolver.SHOCK)


@wp.func
def most_rounds(island: int, iterations: int, graph: Graph):
    """Maximum number of rounds for an island; they converge with the root of the ratio of masses."""
    path = wp.max(wp.pow(float(graph.island_bodies[island]), 1.0 / 3.0), height_of(island, graph))
    if is_pile(island, graph):
        more = wp.sqrt(wp.max(mass_ratio(island, graph) / EVEN, 1.0))
        return int(float(iterations) * (PILE_ROUNDS + PILE_ROUNDS_PER_BODY * path) * more)
    least = wp.where(graph.island_speed[island] > HARDLY, STRUCTURE_ROUNDS, STRUCTURE_ROUNDS_AT_REST)
    return int(float(iterations) * (least + STRUCTURE_ROUNDS_PER_BODY * path))


@wp.func
def tolerance_of(island: int, gained: float, unit: float, graph: Graph):
    """Change of a velocity with which the rounds of an island end; gravity adds `gained` in a step [m/s].

    `unit`: that of the island's `Motions.velocity_unit`.
    """
    if is_pile(island, graph):
        return PILE_CONVERGED * unit
    speed = graph.island_speed[island] * graph.island_size[island]
    return wp.max(
        STRUCTURE_CONVERGED * gained * wp.max(height_of(island, graph), LOWEST_STRUCTURE), STRUCTURE_ROUNDING * speed
    )


@wp.func
def most_in_motion(iterations: int):
    """Maximum number of sweeps with momentum for an island in motion; one that hardly moves has more (calm.py)."""
    return MOST_IN_MOTION * iterations - 1


@wp.func
def most_further_sweeps(b: int, island: int, solver: int, dt: float, env: int, envs: Environments, graph: Graph):
    """Maximum number of sweeps with momentum for a body's contacts. Joints and other constraints have none.

    In motion there are none without warm starting: from zero, impulses that have not converged do not add energy.
    """
    if graph.touching[b] == 0 or graph.tied[b] == 1 or solver == IslandSolver.ROUNDS:
        return 0
    count = graph.island_bodies[island]
    if is_even_pile(island, graph):
        return 0
    gained = dt * wp.length(envs.gravity[env])
    resting = wp.max(RESTING, RESTING_SHARE * gained / graph.island_size[island])
    if graph.island_speed[island] < resting:
        return envs.contact_iterations[env] * wp.clamp(count, LEAST_CALM, MOST_CALM)
    if count == 1:
        return 0
    return most_in_motion(envs.contact_iterations[env]) * envs.warm_starting[env]


@wp.kernel
def choose_solver(dt: float, bodies: Bodies, envs: Environments, graph: Graph):
    """One thread per body: how its island is solved in this step."""
    b = wp.tid()
    if bodies.motion[b] != Motion.DYNAMIC:
        return
    env = bodies.env[b]
    island = graph.island[b]
    solver = solver_of(island, envs.shock_propagation[env], is_crowded(env, envs), graph)
    # Levels and colours are only found for islands that are not solved in rounds.
    if (graph.solver[b] == IslandSolver.ROUNDS) != (solver == IslandSolver.ROUNDS):
        graph.unchanged[env] = 0
    graph.solver[b] = solver
    graph.further_sweeps[b] = most_further_sweeps(b, island, solver, dt, env, envs, graph)
    if graph.touching[b] > 0 and solver != IslandSolver.ROUNDS:
        graph.swept[env] = 1
    if graph.touching[b] + graph.tied[b] > 0 and solver == IslandSolver.SHOCK:
        loose = is_pile(island, graph) and graph.needs_sweeps[island] == 0
        per_level = wp.where(loose, SWEEPS_PER_LEVEL_OF_PILE, SWEEPS_PER_LEVEL)
        wp.atomic_max(graph.sweeps_per_level, env, per_level)
