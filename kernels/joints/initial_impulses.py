"""Line searches where there are joints: the initial impulses of contacts, and what the sweeps have changed.

The initial impulses of contacts are those of the step before, as far as they reduce the energy.

At an impact, the impulses of a step are many times larger than what the next step requires. Sweeps reduce them again,
but different masses, joints, limits and friction make that slow, and what is left of them adds energy. After the first
sweep, all changes since the initial impulses were applied are therefore scaled, in each island, by the factor in [0, 1]
that minimizes the energy. At rest it is 1. Before that sweep, one body that lands would decide on the impulses of all
others of its island, and a heap would fall a little at each impact.

Sweeps over the contacts of mechanisms need not decrease the energy either: a visit takes a limit that is reached for a
joint that holds both ways, and the direct solution releases it again. What shock propagation and the sweeps after it
have changed is therefore scaled in the same way.
"""

import warp as wp

from warp_rigid.kernels.common.solver_body import START
from warp_rigid.kernels.common.team import Team, sync_team
from warp_rigid.kernels.constraints.contact import blend_row, scale_row
from warp_rigid.kernels.enums import Role
from warp_rigid.kernels.joints.arrays import Joints
from warp_rigid.kernels.joints.loads import is_visited
from warp_rigid.kernels.joints.mechanism import Activity, energy_terms
from warp_rigid.kernels.schema import Contacts, Environments, Graph, Motions, Order
from warp_rigid.kernels.solve.gauss_seidel import store_before_contacts, warm_start_pair
from warp_rigid.kernels.solve.line_search import (
    FIXED_POINT,
    accepted_share,
    add_terms,
    add_up,
    clear_sums,
    scale_change,
    store_terms,
)
from warp_rigid.kernels.solve.schedule import end_of_entries, entry_at, first_entry, first_of_color, stride_of_color
from warp_rigid.kernels.solve.shock import island_of

wp.set_module_options({"enable_backward": False, "max_unroll": 1})


@wp.func
def warm_start_others(team: Team, order: Order, motions: Motions, contacts: Contacts, joints: Joints):
    """Apply the initial impulses of all pairs that belong to no mechanism that is visited."""
    for color in range(order.color_count[team.env]):
        stride = stride_of_color(color, team)
        for k in range(first_of_color(color, team, order), order.color_start[team.env, color + 1], stride):
            entry = entry_at(k, order)
            if not is_visited(entry, joints):
                warm_start_pair(entry, motions, contacts)
        sync_team(team)


@wp.func
def store_before_impulses(team: Team, envs: Environments, motions: Motions, joints: Joints):
    """Store the velocities and the impulses of joints before the initial impulses are applied."""
    for j in range(joints.first_joint[team.env] + team.lane, joints.first_joint[team.env + 1], team.lanes):
        joints.start[j] = joints.total[j]
    store_before_contacts(team, envs, motions)


@wp.func
def island_of_joint(j: int, motions: Motions, joints: Joints, graph: Graph):
    """The island of a joint whose mechanism is solved with its contacts; -1 for others, which have no rows."""
    a = joints.body_a[j]
    b = joints.body_b[j]
    if joints.activity[wp.max(joints.of_body[a], joints.of_body[b])] != Activity.IN_CONTACT:
        return -1
    return graph.island[wp.where(motions.role[a] == Role.FREE, a, b)]


@wp.func
def blend_joint(j: int, graph: Graph, motions: Motions, joints: Joints):
    """Apply the step length of a line search to the impulses of a joint."""
    island = island_of_joint(j, motions, joints, graph)
    if island >= 0:
        t = wp.float64(accepted_share(island, graph))
        joints.total[j] = joints.start[j] + t * (joints.total[j] - joints.start[j])


@wp.func
def store_joint_terms(since: int, dt: float, team: Team, graph: Graph, motions: Motions, joints: Joints):
    """Store the contributions of joints to the sums of a line search, and the largest ones of each island.

    Joints that are solved before and after contribute nothing, except at limits.
    """
    for j in range(joints.first_joint[team.env] + team.lane, joints.first_joint[team.env + 1], team.lanes):
        island = island_of_joint(j, motions, joints, graph)
        if island >= 0:
            terms = energy_terms(j, since, dt, motions, joints)
            joints.terms[j] = terms
            wp.atomic_max(graph.largest, island, float(wp.max(wp.abs(terms[0]), wp.abs(terms[1]))))
    sync_team(team)


@wp.func
def add_joint_terms(team: Team, graph: Graph, motions: Motions, joints: Joints):
    """Add the contributions of joints, as `add_terms` those of constraints."""
    for j in range(joints.first_joint[team.env] + team.lane, joints.first_joint[team.env + 1], team.lanes):
        island = island_of_joint(j, motions, joints, graph)
        if island >= 0:
            terms = FIXED_POINT / wp.float64(graph.largest[island]) * joints.terms[j]
            add_up(island, wp.int64(terms[0]), wp.int64(terms[1]), graph)
    sync_team(team)


@wp.func
def scale_changes(
    since: int,
    team: Team,
    envs: Environments,
    order: Order,
    graph: Graph,
    motions: Motions,
    contacts: Contacts,
    joints: Joints,
):
    """Scale the changes since the start of the search by the factor of each island."""
    for b in range(envs.first_body[team.env] + team.lane, envs.first_body[team.env + 1], team.lanes):
        if motions.role[b] == Role.FREE:
            scale_change(b, accepted_share(graph.island[b], graph), since, motions)
    for j in range(joints.first_joint[team.env] + team.lane, joints.first_joint[team.env + 1], team.lanes):
        blend_joint(j, graph, motions, joints)
    for k in range(first_entry(team, order), end_of_entries(team.env, order), team.lanes):
        entry = entry_at(k, order)
        step_length = accepted_share(island_of(entry, motions, graph), graph)
        for c in range(entry.begin, entry.end):
            if since == START:
                blend_row(c, step_length, contacts)
            else:
                scale_row(c, step_length, contacts)
    sync_team(team)


@wp.func
def search_energy(
    since: int,
    dt: float,
    team: Team,
    envs: Environments,
    order: Order,
    graph: Graph,
    motions: Motions,
    contacts: Contacts,
    joints: Joints,
):
    """Scale the changes since the start of the search such that they minimize the energy of each island.

    The joints must have been solved. `since`: START or BEFORE_CONTACTS.
    """
    clear_sums(envs.first_body[team.env], envs.first_body[team.env + 1], team, graph)
    store_terms(since, team, order, graph, motions, contacts)
    store_joint_terms(since, dt, team, graph, motions, joints)
    add_terms(team, order, graph, motions)
    add_joint_terms(team, graph, motions, joints)
    scale_changes(since, team, envs, order, graph, motions, contacts, joints)
