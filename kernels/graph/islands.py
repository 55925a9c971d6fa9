"""Islands of bodies in contact, and which of them are solved in rounds.

Islands are the connected components of the dynamic bodies: trees of bodies are joined in parallel, always the root with
the higher index below the one with the lower (Jaiganesh and Burtscher 2018), so that the root of an island is its
lowest body, independent of the order of the threads.

An island is a heap if it consists of bodies that have landed after a free flight, in an environment of many bodies.
Heaps are solved in rounds (rounds.py), all other islands in sweeps, with shock propagation where it is effective
(shock.py). Islands merge and split, so each body stores for how many steps shock propagation has been ineffective for
its island, and the majority of the bodies decides: a body votes for a heap if this number is positive, or if it lands
after a free flight. Once the bodies of a heap of moderate size are nearly at rest, shock propagation is tried again.
"""

import warp as wp

from warp_rigid.kernels.common.crowd import is_crowded
from warp_rigid.kernels.common.team import add_together, raise_to
from warp_rigid.kernels.constraints.records import is_active
from warp_rigid.kernels.enums import IslandSolver, Motion, ShockMode
from warp_rigid.kernels.graph.heap_arrays import MOST_SHARING
from warp_rigid.kernels.schema import Bodies, Constraints, Environments, Graph, Shapes, State

wp.set_module_options({"enable_backward": False})

MOST_PAIRS = wp.constant(MOST_SHARING)
"""Maximum number of pairs that share a body's mass in a heap."""

PATIENCE = wp.constant(8)
"""Consecutive ineffective steps after which an island is solved without shock propagation. Where it must be solved in
sweeps, shock propagation is tried again after as many steps."""

TRIAL_INTERVAL = wp.constant(64)
"""Steps between two trials of shock propagation in a large heap that rounds do not solve."""

LARGE, HUGE = wp.constant(64), wp.constant(1024)
"""Bodies of the smallest and of the largest heap in which shock propagation is tried again. A trial is executed by a
single team of lanes: with 100 000 bodies it takes seconds."""

LANDED = wp.constant(1024)
"""Ineffective steps from which an island is solved in rounds. Only bodies that have landed after a free flight count so
many: in structures that were built up, such as a tower that topples or a large pyramid, sweeps converge faster."""

CALM = wp.constant(0.5)
"""Largest speed of a body in a trial, in sizes of the body per second. Shock propagation transmits load at rest."""

FLIGHT = wp.constant(0.05)
"""Time without contact after which a body is presumed to land on a heap [s]."""

SIMILAR, COMPARABLE = wp.constant(10.0), wp.constant(100.0)
"""Largest ratio of masses in an island that is presumed to be a heap, and in one that is solved in rounds. Rounds
converge slowly with heavy bodies on light ones, and shock propagation does not."""

ROUNDS, ROUNDS_PER_BODY = wp.constant(4.0), wp.constant(0.3)
"""Maximum number of rounds, as a multiple of `contact_iterations`: a constant part, and a part for each body that load
passes down to the ground: along the edge of a cube of as many bodies, or along the height if that is larger."""

RESTING = wp.constant(0.01)
"""Largest speed of a body in an island that is swept until it has converged (calm.py), in sizes of the body per second.
Most of its bodies must have been placed where they are: a pile of fallen bodies converges over several steps."""

RESTING_SHARE = wp.constant(0.1)
"""Speed that always counts as slow for this purpose, as a fraction of that which gravity adds in a step. Bodies move so
fast because their contacts were not solved: a tall cylinder would rock indefinitely."""

LEAST_CALM, MOST_CALM = wp.constant(6), wp.constant(30)
"""Maximum number of these sweeps as a multiple of `contact_iterations`: the number of bodies, within these bounds. The
foot of a tall cylinder needs 30 to 50 sweeps."""

MOST_IN_MOTION = wp.constant(3)
"""The same for several bodies that were placed where they are and move, such as a tower that topples. Without these
sweeps, impulses that have not converged add up to 2e-4 of its potential energy; with them, 2e-10."""

LOWEST = wp.constant(-1.0e30)


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
    graph.heap_votes[b] = 0
    graph.heap_steps[b] = 0
    graph.flight_votes[b] = 0
    graph.fallen_votes[b] = 0
    graph.island_size[b] = 0.0
    graph.island_low[b] = LOWEST
    graph.island_high[b] = LOWEST
    graph.island_speed[b] = 0.0
    graph.island_mass[b] = 0.0
    graph.island_inverse_mass[b] = 0.0
    graph.needs_sweeps[b] = 0


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


@wp.kernel
def vote(dt: float, shapes: Shapes, bodies: Bodies, envs: Environments, state: State, graph: Graph):
    """One thread per body: the label of its island, and its vote on whether the island is a heap."""
    b = wp.tid()
    if bodies.motion[b] != Motion.DYNAMIC:
        return
    island = root_of(b, graph.island)
    graph.island[b] = island
    steps = state.heap_steps[b]
    add_together(graph.island_bodies, island, 1)
    add_together(graph.heap_votes, island, wp.where(steps > 0, 1, 0))
    landed = -dt * float(steps) >= FLIGHT and bodies.restitution[b] == 0.0 and is_crowded(bodies.env[b], envs)
    add_together(graph.flight_votes, island, wp.where(landed, 1, 0))
    add_together(graph.fallen_votes, island, state.fallen[b])
    if steps > graph.heap_steps[island]:
        wp.atomic_max(graph.heap_steps, island, steps)
    size = shapes.shapes[bodies.shape[b]].size
    raise_to(island, wp.length(state.linear_velocity[b]) / size, graph.island_speed)
    raise_to(island, size, graph.island_size)
    depth = wp.dot(state.position[b], wp.normalize(envs.gravity[bodies.env[b]]))
    raise_to(island, depth, graph.island_low)
    raise_to(island, -depth, graph.island_high)
    raise_to(island, bodies.mass[b], graph.island_mass)
    raise_to(island, bodies.inverse_mass[b], graph.island_inverse_mass)
    if graph.tied[b] == 1 or graph.touching[b] > MOST_PAIRS:
        graph.needs_sweeps[island] = 1


@wp.func
def mass_ratio(island: int, graph: Graph):
    """Largest ratio of the masses of two bodies of an island."""
    return graph.island_mass[island] * graph.island_inverse_mass[island]


@wp.func
def steps_as_heap(island: int, graph: Graph):
    """For how many steps shock propagation was ineffective for an island, if for the majority of its bodies.

    Bodies that land without restitution count as bodies of a heap, unless the masses of the island differ much.
    """
    landed = wp.where(mass_ratio(island, graph) <= SIMILAR, graph.flight_votes[island], 0)
    if 2 * (graph.heap_votes[island] + landed) <= graph.island_bodies[island]:
        return 0
    return wp.max(graph.heap_steps[island], wp.where(landed > 0, int(LANDED), 0))


@wp.func
def solver_without_shock(steps: int, island: int, crowded: bool, graph: Graph):
    """The IslandSolver of an island for which shock propagation has been ineffective for a number of steps."""
    if crowded and steps >= LANDED and graph.needs_sweeps[island] == 0 and mass_ratio(island, graph) <= COMPARABLE:
        return int(IslandSolver.ROUNDS)
    return int(IslandSolver.SWEEPS)


@wp.func
def is_trial(steps: int, island: int, solver: int, graph: Graph):
    """Whether shock propagation is tried in an island after a number of ineffective steps."""
    if solver == IslandSolver.SWEEPS:
        return steps % PATIENCE == 0
    count = graph.island_bodies[island]
    return graph.island_speed[island] < CALM and LARGE <= count and count <= HUGE and steps % TRIAL_INTERVAL == 0


@wp.func
def solver_of(steps: int, island: int, mode: int, crowded: bool, graph: Graph):
    """The IslandSolver of an island after a number of ineffective steps."""
    if mode == ShockMode.OFF:
        return int(IslandSolver.SWEEPS)
    solver = solver_without_shock(steps, island, crowded, graph)
    if mode == ShockMode.ONE_PASS or steps < PATIENCE or is_trial(steps, island, solver, graph):
        return int(IslandSolver.SHOCK)
    return solver


@wp.func
def most_rounds(island: int, iterations: int, graph: Graph):
    """Maximum number of rounds for an island."""
    width = wp.pow(float(graph.island_bodies[island]), 1.0 / 3.0)
    height = (graph.island_low[island] + graph.island_high[island]) / graph.island_size[island]
    return int(float(iterations) * (ROUNDS + ROUNDS_PER_BODY * wp.max(width, height)))


@wp.func
def most_further_sweeps(b: int, island: int, solver: int, dt: float, env: int, envs: Environments, graph: Graph):
    """Maximum number of sweeps with momentum for a body's contacts. Joints and other constraints have none.

    In motion there are none without warm starting: from zero, impulses that have not converged do not add energy.
    """
    if graph.touching[b] == 0 or graph.tied[b] == 1 or solver == IslandSolver.ROUNDS:
        return 0
    count = graph.island_bodies[island]
    if 2 * graph.fallen_votes[island] > count:
        return 0
    gained = dt * wp.length(envs.gravity[env])
    resting = wp.max(RESTING, RESTING_SHARE * gained / graph.island_size[island])
    if graph.island_speed[island] < resting:
        return envs.contact_iterations[env] * wp.clamp(count, LEAST_CALM, MOST_CALM)
    if count == 1:
        return 0
    return envs.contact_iterations[env] * MOST_IN_MOTION * envs.warm_starting[env]


@wp.kernel
def choose_solver(dt: float, bodies: Bodies, envs: Environments, graph: Graph):
    """One thread per body: how its island is solved in this step."""
    b = wp.tid()
    if bodies.motion[b] != Motion.DYNAMIC:
        return
    env = bodies.env[b]
    island = graph.island[b]
    steps = steps_as_heap(island, graph)
    graph.ineffective_steps[b] = steps
    solver = solver_of(steps, island, envs.shock_propagation[env], is_crowded(env, envs), graph)
    # Levels and colours are only found for islands that are not solved in rounds.
    if (graph.solver[b] == IslandSolver.ROUNDS) != (solver == IslandSolver.ROUNDS):
        graph.unchanged[env] = 0
    graph.solver[b] = solver
    graph.further_sweeps[b] = most_further_sweeps(b, island, solver, dt, env, envs, graph)
    if graph.touching[b] > 0 and solver != IslandSolver.ROUNDS:
        graph.swept[env] = 1
