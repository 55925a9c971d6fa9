"""Initial impulses of contacts where there are joints: those of the step before, as far as they reduce the energy.

At an impact, the impulses of a step are many times larger than what the next step requires. Sweeps reduce them again,
but joints, limits and friction make that slow, and what is left of them adds energy. The initial impulses of the
contacts of mechanisms are therefore scaled, in each island, by the factor in [0, 1] that minimizes the energy. At rest
it is 1.
"""

import warp as wp

from warp_rigid.kernels.common.solver_body import START, load_velocity, store_velocity
from warp_rigid.kernels.common.team import Team, sync_team
from warp_rigid.kernels.constraints import contact
from warp_rigid.kernels.constraints.rows import Rows
from warp_rigid.kernels.enums import Role
from warp_rigid.kernels.joints.arrays import Joints
from warp_rigid.kernels.joints.loads import is_visited, solve_joints, solve_touching
from warp_rigid.kernels.schema import Graph, Motions, Order
from warp_rigid.kernels.solve.gauss_seidel import warm_start_pair
from warp_rigid.kernels.solve.line_search import energy_of
from warp_rigid.kernels.solve.schedule import (
    end_of_entries,
    entry_at,
    first_entry,
    first_of_color,
    stride_of_color,
)
from warp_rigid.kernels.solve.shock import island_of

wp.set_module_options({"enable_backward": False, "max_unroll": 1})


@wp.func
def warm_start_others(team: Team, order: Order, motions: Motions, rows: Rows, joints: Joints):
    """Apply the initial impulses of all pairs that belong to no mechanism that is visited."""
    for color in range(order.color_count[team.env]):
        stride = stride_of_color(color, team)
        for k in range(first_of_color(color, team, order), order.color_start[team.env, color + 1], stride):
            entry = entry_at(k, order)
            if not is_visited(entry, joints):
                warm_start_pair(entry, motions, rows)
        sync_team(team)


@wp.func
def store_before_impulses(
    first: int, last: int, team: Team, order: Order, motions: Motions, rows: Rows, joints: Joints
):
    """Store velocities and impulses of joints without those of contacts, which start at 0."""
    none = wp.vec3(0.0, 0.0, 0.0)
    for b in range(first + team.lane, last, team.lanes):
        body = motions.solver_bodies[b]
        store_velocity(b, START, body.linear, body.angular, motions)
        joints.search[b] = wp.vec2d()
    for j in range(joints.first_joint[team.env] + team.lane, joints.first_joint[team.env + 1], team.lanes):
        joints.start[j] = joints.total[j]
    for k in range(first_entry(team, order), end_of_entries(team.env, order), team.lanes):
        entry = entry_at(k, order)
        if entry.visited > 0:
            for c in range(entry.begin, entry.end):
                contact.set_impulse(c, contact.START_IMPULSE, none, rows.contacts)
                contact.set_impulse(c, contact.START_ANGULAR_IMPULSE, none, rows.contacts)
    sync_team(team)


@wp.func
def factor_of(island: int, joints: Joints):
    """Factor on the initial impulses of an island."""
    sums = joints.search[island]
    if sums[1] <= wp.float64(0.0):
        return 1.0
    return float(wp.clamp(sums[0] / sums[1], wp.float64(0.0), wp.float64(1.0)))


@wp.func
def scale_impulses(
    first: int, last: int, team: Team, order: Order, graph: Graph, motions: Motions, rows: Rows, joints: Joints
):
    """Scale what the initial impulses have changed, island by island."""
    for b in range(first + team.lane, last, team.lanes):
        if motions.role[b] == Role.FREE:
            t = factor_of(graph.island[b], joints)
            body = motions.solver_bodies[b]
            linear = load_velocity(b, START, motions)
            angular = load_velocity(b, START + 1, motions)
            motions.solver_bodies[b].linear = linear + t * (body.linear - linear)
            motions.solver_bodies[b].angular = angular + t * (body.angular - angular)
    for j in range(joints.first_joint[team.env] + team.lane, joints.first_joint[team.env + 1], team.lanes):
        a = joints.body_a[j]
        free = wp.where(motions.role[a] == Role.FREE, a, joints.body_b[j])
        share = wp.float64(factor_of(graph.island[free], joints))
        joints.total[j] = joints.start[j] + share * (joints.total[j] - joints.start[j])
    for k in range(first_entry(team, order), end_of_entries(team.env, order), team.lanes):
        entry = entry_at(k, order)
        if entry.visited > 0:
            factor = factor_of(island_of(entry, motions, graph), joints)
            for c in range(entry.begin, entry.end):
                contact.blend_row(c, factor, rows.contacts)
    sync_team(team)


@wp.func
def warm_start_touching(
    dt: float,
    first: int,
    last: int,
    team: Team,
    order: Order,
    graph: Graph,
    motions: Motions,
    rows: Rows,
    joints: Joints,
):
    """Apply the initial impulses of the contacts of mechanisms; bodies from `first` to `last` - 1."""
    store_before_impulses(first, last, team, order, motions, rows, joints)
    solve_touching(1, team, order, motions, rows, joints)
    solve_joints(team, dt, motions, joints)
    if team.lane == 0:
        for k in range(order.color_start[team.env, 0], end_of_entries(team.env, order)):
            entry = entry_at(k, order)
            if entry.visited > 0:
                island = island_of(entry, motions, graph)
                joints.search[island] = joints.search[island] + wp.vec2d(energy_of(entry, motions, rows))
    sync_team(team)
    scale_impulses(first, last, team, order, graph, motions, rows, joints)
