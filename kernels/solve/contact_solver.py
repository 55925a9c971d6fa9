"""Contact solver for environments that a team sweeps over: all of its parts, in one launch.

An environment does not wait for the others between two parts. Where there are joints, their kernels are executed
between the parts, each of which then has a launch of its own (engine/joints.py).
"""

import warp as wp

from warp_rigid.kernels.common.team import MOST_REGISTERS, sync_team, team_of
from warp_rigid.kernels.enums import SolverPart
from warp_rigid.kernels.schema import Contacts, Environments, Graph, Motions, Order
from warp_rigid.kernels.solve.calm import sweep_calm_islands
from warp_rigid.kernels.solve.gauss_seidel import sweep_constraints, warm_start
from warp_rigid.kernels.solve.line_search import accept, scale_to_minimum, searched, store_before_shock, sum_energy
from warp_rigid.kernels.solve.rest import stop_resting_islands
from warp_rigid.kernels.solve.shock import is_propagated, propagate

wp.set_module_options({"enable_backward": False})


@wp.func
def has(parts: int, part: int):
    """Whether a launch executes a part."""
    return (parts & part) != 0


@wp.kernel(cuda_max_registers=MOST_REGISTERS)
def solve_contacts(
    parts: int,
    repetition: int,
    end: int,
    dt: float,
    lanes: int,
    envs: Environments,
    order: Order,
    graph: Graph,
    motions: Motions,
    contacts: Contacts,
):
    """One team per environment: execute some SolverParts; shock propagation from one repetition to `end` - 1."""
    team = team_of(wp.tid(), lanes)
    env = team.env
    if has(parts, SolverPart.WARM_START):
        if order.color_count[env] == 0:
            graph.converged[env] = 1
            return
        warm_start(team, envs, order, motions, contacts)
    for after_shock in range(2):
        if has(parts, SolverPart.SWEEPS):
            sweep_constraints(after_shock, team, envs, order, graph, motions, contacts)
            sync_team(team)
        if after_shock == 0:
            if has(parts, SolverPart.REST):
                stop_resting_islands(dt, team, envs, order, graph, motions, contacts)
                sync_team(team)
            if is_propagated(env, envs, graph):
                for _ in range(repetition, wp.min(end, envs.shock_iterations[env])):
                    if has(parts, SolverPart.PASSES):
                        store_before_shock(team, envs, order, motions, contacts)
                        sync_team(team)
                        propagate(team, envs, order, graph, motions, contacts)
                        sync_team(team)
                    if has(parts, SolverPart.ENERGY) and searched(env, envs, graph):
                        sum_energy(team, envs, order, graph, motions, contacts)
                        sync_team(team)
                    if has(parts, SolverPart.STEP_LENGTH) and searched(env, envs, graph):
                        accept(team, envs, order, graph, motions, contacts)
                        sync_team(team)
    if has(parts, SolverPart.CALM):
        sweep_calm_islands(dt, team, envs, order, graph, motions, contacts)
        sync_team(team)
        scale_to_minimum(team, envs, order, graph, motions, contacts)
