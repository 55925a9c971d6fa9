"""Contact graph: supports, levels with cycles collapsed, and depths.

Body j supports body p if p, moved by its own acceleration alone, presses against j at a contact. If p has no
acceleration, its velocity decides. The 2003 method (section 8.1) adds the velocity of p to the test. The acceleration
of one step is small in comparison, so the supports would change with every small vibration. No direction is defined as
"up", so the test is valid in any force field. The level of a body is one more than the highest level of its supports.
Bodies that support each other in a cycle are collapsed into one and share a level. Static bodies have level 0.

Levels are assigned from the ground up. In each round, every body whose supports all have levels is assigned a level. If
there is no such body, the remaining bodies depend on cycles: strongly connected components are found, and each is then
assigned a level like a single body. The depth of a body is the length of the shortest path of supports to the ground.
It determines how many sweeps are needed to transmit load to the ground.

In a pile at rest, the contacts and supports are the same in every step. Levels, depths, islands and colours depend on
nothing else, so they are kept. Levels and depths are only needed for shock propagation: the constraints of islands that
are solved in rounds (islands.py) have no edges in the graph of supports.
"""

from enum import IntEnum, IntFlag

import warp as wp

from warp_rigid.kernels.common.solver_body import BodyPair, first_three, load_bodies
from warp_rigid.kernels.common.team import Team, add_together, any_of_team, sync_team, team_of
from warp_rigid.kernels.constraints.contact import direction_and_approach
from warp_rigid.kernels.constraints.records import is_active, list_constraint
from warp_rigid.kernels.enums import IslandSolver, Motion
from warp_rigid.kernels.schema import Bodies, Constraints, Contacts, Environments, Graph, Motions, Pairs
from warp_rigid.kernels.tuning import SLANT

wp.set_module_options({"enable_backward": False})


class Level(IntEnum):
    """Levels and depths of bodies that have none."""

    UNKNOWN = -1
    UNSUPPORTED = 1 << 30


class Support(IntFlag):
    """Which bodies of a constraint are supported by the other one."""

    A_ON_B = 1
    B_ON_A = 2


@wp.func
def presses(pull: wp.vec3, n: wp.vec3, approach: float):
    """Whether a body moved by its acceleration `pull` alone presses against n; if it has none, `approach` decides."""
    if wp.length_sq(pull) > 0.0:
        return wp.dot(pull, n) < -SLANT * wp.length(pull)
    return approach > 0.0


@wp.func
def supports_of(k: int, pair: BodyPair, bodies: Bodies, motions: Motions, constraints: Constraints, contacts: Contacts):
    """Which bodies of a constraint are supported by the other one, as bits of Support."""
    a = constraints.body_a[k]
    b = constraints.body_b[k]
    first = constraints.first_row[k]
    supports = int(0)
    for row in range(first, first + constraints.row_count[k]):
        found = direction_and_approach(row, pair, contacts)
        n = first_three(found)
        approach = found[3]
        if bodies.motion[a] == Motion.DYNAMIC and presses(motions.acceleration[a], n, approach):
            supports = supports | Support.A_ON_B
        if bodies.motion[b] == Motion.DYNAMIC and presses(motions.acceleration[b], -n, approach):
            supports = supports | Support.B_ON_A
    return supports


@wp.func
def is_unchanged(k: int, env: int, supports: int, constraints: Constraints, graph: Graph):
    """Whether an active constraint had as many rows and the same supports in the last step, at the same index."""
    place = constraints.start_before[env] + k - constraints.start[env]
    last = constraints.last[k]
    if last < 0 or last != place:
        return False
    same_rows = constraints.row_count_before[last] == constraints.row_count[k]
    return same_rows and graph.supports_before[last] == supports


@wp.func
def reset_sums(env: int, graph: Graph):
    """Reset what the kernels of this stage sum up, and the statistics of the solver."""
    graph.active[env] = 0
    graph.altered[env] = 0
    graph.swept[env] = 0
    graph.sweeps_per_level[env] = 0
    graph.overlapping[env] = 0
    graph.sweeps[env] = 0
    graph.residual[env] = 0.0
    graph.impact_sweeps[env] = 0
    graph.impact_rounds[env] = 0
    graph.shock_sweeps[env] = 0
    graph.push_out_sweeps[env] = 0
    graph.rounds[env] = 0
    graph.push_out_rounds[env] = 0


@wp.kernel
def start_graph(threads: int, envs: Environments, pairs: Pairs, constraints: Constraints, graph: Graph):
    """The threads share the pairs and the environments: list the contact constraints, and reset sums."""
    count = pairs.start[pairs.start.shape[0] - 1]
    ends = constraints.start.shape[0]
    for i in range(wp.tid(), wp.max(count, ends), threads):
        if i < ends:
            constraints.start[i] = pairs.start[envs.first_body[i]]
        if i < ends - 1:
            reset_sums(i, graph)
        if i < count:
            list_constraint(i, pairs, constraints)


@wp.kernel
def find_support(
    threads: int, bodies: Bodies, motions: Motions, contacts: Contacts, constraints: Constraints, graph: Graph
):
    """The threads share the constraints: the supports of each, and whether any differs from those of the last step."""
    for k in range(wp.tid(), constraints.start[constraints.start.shape[0] - 1], threads):
        supports = int(0)
        if is_active(k, constraints):
            a = constraints.body_a[k]
            env = bodies.env[a]
            pair = load_bodies(a, constraints.body_b[k], 0.0, 0.0, motions)
            supports = supports_of(k, pair, bodies, motions, constraints, contacts)
            add_together(graph.active, env, 1)
            if not is_unchanged(k, env, supports, constraints, graph):
                graph.altered[env] = 1
        graph.supports[k] = supports


@wp.kernel
def compare_graph(graph: Graph):
    """One thread per environment: whether the graph is the same as in the last step."""
    env = wp.tid()
    active = graph.active[env] + 1
    graph.unchanged[env] = wp.where(graph.altered[env] == 0 and graph.active_before[env] == active, 1, 0)
    graph.active_before[env] = active


@wp.func
def is_swept(k: int, constraints: Constraints, graph: Graph):
    """Whether a constraint has rows in this step and is solved in sweeps."""
    solver = wp.max(graph.solver[constraints.body_a[k]], graph.solver[constraints.body_b[k]])
    return is_active(k, constraints) and solver != IslandSolver.ROUNDS


@wp.func
def upper_of(edge: int, constraints: Constraints, graph: Graph):
    """The supported body of an edge, -1 if there is none. Each constraint has two edges, one for each direction."""
    k = edge / 2
    if not is_swept(k, constraints, graph):
        return -1
    if edge % 2 == 0:
        return wp.where((graph.supports[k] & Support.A_ON_B) != 0, constraints.body_a[k], -1)
    return wp.where((graph.supports[k] & Support.B_ON_A) != 0, constraints.body_b[k], -1)


@wp.func
def lower_of(edge: int, constraints: Constraints):
    """The supporting body of an edge, valid if `upper_of` is not -1."""
    return wp.where(edge % 2 == 0, constraints.body_b[edge / 2], constraints.body_a[edge / 2])


@wp.func
def climb(first_edge: int, last_edge: int, first: int, last: int, team: Team, constraints: Constraints, graph: Graph):
    """One round: assign levels to bodies, or cycles, whose supports all have levels. Returns 1 if any was assigned."""
    for b in range(first, last, team.lanes):
        graph.waiting[b] = 0
        graph.highest[b] = 0
    sync_team(team)
    for edge in range(first_edge, last_edge, team.lanes):
        upper = upper_of(edge, constraints, graph)
        if upper >= 0 and graph.level[upper] == Level.UNKNOWN:
            lower = lower_of(edge, constraints)
            cycle = graph.cycle[upper]
            if graph.level[lower] != Level.UNKNOWN:
                wp.atomic_max(graph.highest, cycle, graph.level[lower])
            elif graph.cycle[lower] != cycle:
                graph.waiting[cycle] = 1
    sync_team(team)
    got = int(0)
    for b in range(first, last, team.lanes):
        if graph.level[b] == Level.UNKNOWN and graph.waiting[graph.cycle[b]] == 0:
            graph.level[b] = graph.highest[graph.cycle[b]] + 1
            got = 1
    return any_of_team(got, team)


@wp.func
def passes_of(team: Team):
    """Passes of a lane over its part between two barriers: propagation needs no fixed order, and barriers are slow."""
    return wp.min(team.lanes, 4)


@wp.func
def is_open(b: int, graph: Graph):
    """Whether a body has no level yet and is in no known cycle."""
    return graph.level[b] == Level.UNKNOWN and graph.within[b] == 0


@wp.func
def spread_labels(
    first_edge: int, last_edge: int, first: int, last: int, team: Team, constraints: Constraints, graph: Graph
):
    """One iteration: an open body takes the highest label of its open supports. Returns 1 if any label changed.

    The label of a body is itself a reachable body, so the body also takes the label of its label (pointer jumping).
    """
    changed = int(0)
    for _ in range(passes_of(team)):
        for edge in range(first_edge, last_edge, team.lanes):
            upper = upper_of(edge, constraints, graph)
            lower = lower_of(edge, constraints)
            if upper >= 0 and is_open(upper, graph) and is_open(lower, graph):
                if graph.cycle[lower] > graph.cycle[upper]:
                    wp.atomic_max(graph.cycle, upper, graph.cycle[lower])
                    changed = 1
        for b in range(first, last, team.lanes):
            if is_open(b, graph) and graph.cycle[graph.cycle[b]] > graph.cycle[b]:
                wp.atomic_max(graph.cycle, b, graph.cycle[graph.cycle[b]])
                changed = 1
    return any_of_team(changed, team)


@wp.func
def spread_within(first_edge: int, last_edge: int, team: Team, constraints: Constraints, graph: Graph):
    """One iteration: bodies reached from the body of their own label are in its cycle. Returns 1 if any changed."""
    changed = int(0)
    for _ in range(passes_of(team)):
        for edge in range(first_edge, last_edge, team.lanes):
            upper = upper_of(edge, constraints, graph)
            lower = lower_of(edge, constraints)
            if upper >= 0 and graph.within[upper] == 1 and is_open(lower, graph):
                if graph.cycle[lower] == graph.cycle[upper]:
                    graph.within[lower] = 1
                    changed = 1
    return any_of_team(changed, team)


@wp.func
def find_cycles(
    first_edge: int, last_edge: int, first: int, last: int, team: Team, constraints: Constraints, graph: Graph
):
    """Find at least one strongly connected component among the bodies without a level.

    The label of a body is the highest body index that it reaches through its supports. The bodies that this body
    reaches, and that have the same label, are its component (Orzan 2004, colouring). Bodies in no component found so
    far are labelled with their own index again.
    """
    while spread_labels(first_edge, last_edge, first, last, team, constraints, graph) == 1:
        sync_team(team)
    for b in range(first, last, team.lanes):
        if is_open(b, graph) and graph.cycle[b] == b:
            graph.within[b] = 1
    sync_team(team)
    while spread_within(first_edge, last_edge, team, constraints, graph) == 1:
        sync_team(team)
    for b in range(first, last, team.lanes):
        if is_open(b, graph):
            graph.cycle[b] = b
    sync_team(team)


@wp.func
def find_levels(team: Team, envs: Environments, bodies: Bodies, constraints: Constraints, graph: Graph):
    """The level of each body, with cycles collapsed."""
    env = team.env
    first = envs.first_body[env] + team.lane
    last = envs.first_body[env + 1]
    first_edge = 2 * constraints.start[env] + team.lane
    last_edge = 2 * constraints.start[env + 1]
    for b in range(first, last, team.lanes):
        graph.level[b] = wp.where(bodies.motion[b] == Motion.DYNAMIC, Level.UNKNOWN, 0)
        graph.cycle[b] = b
        graph.within[b] = 0
    left = int(1)
    while left == 1:
        if climb(first_edge, last_edge, first, last, team, constraints, graph) == 0:
            find_cycles(first_edge, last_edge, first, last, team, constraints, graph)
        left = int(0)
        for b in range(first, last, team.lanes):
            if graph.level[b] == Level.UNKNOWN:
                left = 1
        left = any_of_team(left, team)


@wp.func
def find_depths(team: Team, envs: Environments, bodies: Bodies, constraints: Constraints, graph: Graph):
    """Length of the shortest path of supports from each body to the ground, and the maximum.

    In a heap it is much smaller than the level, which counts the longest path. Unsupported bodies have no depth.
    """
    env = team.env
    first = envs.first_body[env]
    last = envs.first_body[env + 1]
    for b in range(first + team.lane, last, team.lanes):
        graph.depth[b] = wp.where(bodies.motion[b] == Motion.DYNAMIC, Level.UNSUPPORTED, 0)
    if team.lane == 0:
        graph.max_depth[env] = 0
    changed = int(1)
    while changed == 1:
        sync_team(team)
        changed = int(0)
        for _ in range(passes_of(team)):
            for edge in range(2 * constraints.start[env] + team.lane, 2 * constraints.start[env + 1], team.lanes):
                upper = upper_of(edge, constraints, graph)
                lower = lower_of(edge, constraints)
                if upper >= 0 and graph.depth[lower] + 1 < graph.depth[upper]:
                    wp.atomic_min(graph.depth, upper, graph.depth[lower] + 1)
                    changed = 1
        changed = any_of_team(changed, team)
    for b in range(first + team.lane, last, team.lanes):
        if graph.depth[b] < Level.UNSUPPORTED:
            wp.atomic_max(graph.max_depth, env, graph.depth[b])


@wp.kernel
def find_structure(lanes: int, envs: Environments, bodies: Bodies, constraints: Constraints, graph: Graph):
    """One team per environment: levels and depths, where the graph has changed and shock propagation needs them."""
    team = team_of(wp.tid(), lanes)
    if graph.unchanged[team.env] == 1 or graph.swept[team.env] == 0:
        return
    find_levels(team, envs, bodies, constraints, graph)
    find_depths(team, envs, bodies, constraints, graph)
