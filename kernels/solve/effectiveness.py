"""Effectiveness of shock propagation: which islands do without it in the next steps (islands.py)."""

import warp as wp

from warp_rigid.kernels.enums import IslandSolver, Motion, Role
from warp_rigid.kernels.graph.heap_arrays import Rounds
from warp_rigid.kernels.graph.islands import FLIGHT, PATIENCE
from warp_rigid.kernels.schema import Bodies, Environments, Graph, Motions, State
from warp_rigid.kernels.solve.line_search import accepted_share, searched

wp.set_module_options({"enable_backward": False})

USEFUL = wp.constant(0.1)
"""Step length from which shock propagation counts as effective for an island."""

NO_WAY = wp.constant(2.5e-2)
"""Velocity change below which effectiveness is not judged, as the island is at rest [`Motions.velocity_unit`]."""


@wp.func
def steps_after_shock(steps: int, island: int, unit: float, graph: Graph):
    """Ineffective steps after a step with shock propagation, from the step length and the velocity change."""
    if graph.max_velocity_change[island] < NO_WAY * unit:
        return wp.where(steps >= PATIENCE, steps + 1, steps)
    return wp.where(accepted_share(island, graph) < USEFUL, steps + 1, 0)


@wp.kernel
def count_ineffective_steps(
    dt: float, bodies: Bodies, envs: Environments, motions: Motions, graph: Graph, rounds: Rounds, state: State
):
    """One thread per body: count the ineffective steps of its island, or the steps of a free flight.

    Steps in which sweeps or rounds have converged are not counted: shock propagation was not needed.
    """
    b = wp.tid()
    if motions.role[b] != Role.FREE or bodies.motion[b] != Motion.DYNAMIC:
        return
    env = bodies.env[b]
    if graph.touching[b] == 0:
        if state.heap_steps[b] <= 0:
            state.heap_steps[b] -= 1
        if -dt * float(state.heap_steps[b]) >= FLIGHT:
            state.fallen[b] = 1
        return
    steps = graph.ineffective_steps[b]
    if graph.solver[b] == IslandSolver.ROUNDS:
        steps = 0
    elif searched(env, envs, graph):
        if graph.solver[b] == IslandSolver.SHOCK:
            steps = steps_after_shock(steps, graph.island[b], motions.velocity_unit[b], graph)
        else:
            steps += 1
    state.heap_steps[b] = steps
