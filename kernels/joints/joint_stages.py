"""Kernels of joints, in the order of a step: start, sweeps with contacts, projections, end."""

from enum import IntEnum

import warp as wp

from warp_rigid.kernels.collide.ccd import NEVER, motion_after, time_of
from warp_rigid.kernels.common.solver_body import BEFORE_CONTACTS, PUSH, START, VELOCITY
from warp_rigid.kernels.common.team import Team, any_of_team, part_of_team, sync_team, team_of
from warp_rigid.kernels.enums import JointNumber, Motion, Role, ShockMode
from warp_rigid.kernels.graph.islands import join
from warp_rigid.kernels.joints.arrays import Joints, VisitOrder
from warp_rigid.kernels.joints.factor import factorize
from warp_rigid.kernels.joints.impacts import add_rotor_speeds, bounce_pairs, leave_out_joined
from warp_rigid.kernels.joints.initial_impulses import (
    blend_joint,
    island_of_joint,
    search_energy,
    store_before_impulses,
    warm_start_others,
)
from warp_rigid.kernels.joints.loads import any_touched, find_touched, leave_out_of_shock, solve_joints, sweep_others
from warp_rigid.kernels.joints.mechanism import (
    Activity,
    activity_of,
    close_joints,
    energy_terms,
    needs_solution,
    project,
    settle_mechanism,
    start_mechanism,
    take_poses,
)
from warp_rigid.kernels.joints.parts import move_in_parts
from warp_rigid.kernels.joints.poses import coordinate_of, ends_of, take_pose, turn_in_step
from warp_rigid.kernels.joints.push import push_touching
from warp_rigid.kernels.joints.visit_coloring import color_visits, solve_touching
from warp_rigid.kernels.schema import (
    Bodies,
    Constraints,
    Contacts,
    Environments,
    Graph,
    Motions,
    Order,
    Pairs,
    Shapes,
    SleepState,
    State,
)
from warp_rigid.kernels.solve.gauss_seidel import report_sweeps, sweeps_of
from warp_rigid.kernels.solve.line_search import FIXED_POINT, add_up, searched
from warp_rigid.kernels.solve.restitution import bounce_groups, open_impacts, sweep_impacts
from warp_rigid.kernels.solve.shock import has_repetition, is_propagated
from warp_rigid.kernels.solve.simultaneous_impacts import find_bouncing
from warp_rigid.kernels.tuning import CONVERGED, PUSH_OUT_CONVERGED, PUSH_OUT_SWEEPS
from warp_rigid.kernels.update.integrate import rotational_energy

wp.set_module_options({"enable_backward": False, "max_unroll": 1})


class Launch(IntEnum):
    """When the sweeps are launched."""

    BEFORE_SHOCK = 0
    AFTER_SHOCK = 1
    AFTER_PASSES = 2
    """Right after the passes of shock propagation, which leave the joints out."""


class Phase(IntEnum):
    """Phases of the sweeps: initial impulses, a sweep, a line search, the last direct solution, and their end."""

    STARTING = 0
    SWEEPING = 1
    SEARCHING = 2
    ENDING = 3
    OVER = 4


@wp.kernel
def bound_travel(dt: float, lanes: int, bodies: Bodies, state: State, motions: Motions, joints: Joints):
    """One team per mechanism: the broad phase covers all displacements of its bodies that its energy permits.

    Joints pass on energy: the end of a whip becomes much faster in a step than its own velocity predicts. The kinetic
    energy is that before the joints act, which take some of it, relative to the common motion unless the mechanism is
    held.
    """
    team = team_of(wp.tid(), lanes)
    m = team.env
    mass = float(0.0)
    energy = float(0.0)
    momentum = wp.vec3(0.0, 0.0, 0.0)
    for i in range(joints.first_member[m], joints.first_member[m + 1]):
        b = joints.member[i]
        if motions.role[b] == Role.FREE:
            v = state.linear_velocity[b] + dt * motions.acceleration[b]
            w = state.angular_velocity[b] + dt * motions.spin_acceleration[b]
            mass += bodies.mass[b]
            momentum += bodies.mass[b] * v
            turned = wp.quatd(state.orientation[b])
            energy += 0.5 * bodies.mass[b] * wp.length_sq(v)
            energy += float(rotational_energy(turned, wp.vec3d(w), bodies.inertia[b]))
    common = float(0.0)
    if joints.anchored[m] == 0 and mass > 0.0:
        common = wp.length(momentum) / mass
        energy = wp.max(energy - 0.5 * mass * common * common, 0.0)
    for i in range(joints.first_member[m] + team.lane, joints.first_member[m + 1], lanes):
        b = joints.member[i]
        if motions.role[b] == Role.FREE:
            way = dt * (common + wp.sqrt(2.0 * energy / bodies.mass[b]))
            if way > motions.max_travel[b]:
                around = wp.vec3(way, way, way)
                motions.max_travel[b] = 1.01 * way
                motions.lower[b] = motions.lower[b] - around
                motions.upper[b] = motions.upper[b] + around


@wp.kernel
def start_joints(dt: float, lanes: int, bodies: Bodies, state: State, motions: Motions, graph: Graph, joints: Joints):
    """One team per mechanism with contacts: rows at the start of the step, and factors for contacts.

    The velocities along locked rows are removed before impacts.
    """
    team = team_of(wp.tid(), lanes)
    m = team.env
    activity = activity_of(m, team, motions, graph, joints)
    if team.lane == 0:
        joints.activity[m] = activity
    if activity == Activity.IN_CONTACT:
        if team.lane == 0:
            joints.parts[m] = 0
        take_poses(m, team, state, joints)
        start_mechanism(m, dt, 1, team, bodies, motions, joints)
        factorize(m, dt, team, motions, joints)
        project(m, VELOCITY, team, motions, joints)


@wp.kernel
def join_joined_islands(bodies: Bodies, joints: Joints, graph: Graph):
    """One thread per joint: the islands of its bodies become one, which is solved in sweeps."""
    j = wp.tid()
    a = joints.body_a[j]
    b = joints.body_b[j]
    if joints.broken[j] == 1:
        return
    graph.tied[a] = 1
    graph.tied[b] = 1
    if bodies.motion[a] == Motion.DYNAMIC and bodies.motion[b] == Motion.DYNAMIC:
        join(a, b, graph.island)


@wp.kernel
def solve_impacts_with_joints(
    dt: float,
    lanes: int,
    envs: Environments,
    constraints: Constraints,
    order: Order,
    graph: Graph,
    motions: Motions,
    contacts: Contacts,
    joints: Joints,
):
    """One team per environment: as `solve_impacts`; those of mechanisms that have restitution follow in each sweep."""
    team = team_of(wp.tid(), lanes)
    env = team.env
    first = envs.collision_first[env]
    left = int(open_impacts(team, envs, order, graph))
    if left == 0:
        return
    joined = leave_out_joined(team, order, contacts, joints)
    sync_team(team)
    bounces = find_bouncing(team, order, contacts)
    stamp = int(1)
    while left > 0:
        collided = sweep_impacts(stamp, dt, envs, team, order, graph, motions, contacts)
        stamp += order.color_count[env] + 1
        if bounces == 1:
            collided |= bounce_groups(stamp, dt, envs, team, order, graph, motions, contacts)
        if joined == 1:
            add_rotor_speeds(-1.0, team, motions, joints)
            collided |= bounce_pairs(stamp, dt, first, team, constraints, graph, motions, contacts, joints)
            add_rotor_speeds(1.0, team, motions, joints)
        left = collided * (left - 1)
        if team.lane == 0:
            graph.impact_sweeps[env] += collided


@wp.kernel
def warm_start_with_joints(
    lanes: int,
    envs: Environments,
    constraints: Constraints,
    order: Order,
    graph: Graph,
    motions: Motions,
    contacts: Contacts,
    joints: Joints,
    visits: VisitOrder,
):
    """One team per environment: find mechanisms whose contacts are solved where the joints hold; colour their pairs.

    Apply the initial impulses of all other contacts.
    """
    team = team_of(wp.tid(), lanes)
    if find_touched(team, order, motions, joints) == 1:
        first = envs.first_body[team.env]
        last = envs.first_body[team.env + 1]
        leave_out_of_shock(first, last, team, order, motions, joints, graph)
        first_row = constraints.first_row[constraints.start[team.env]]
        color_visits(first, last, first_row, team, order, graph, motions, joints, visits)
    if envs.warm_starting[team.env] == 1:
        store_before_impulses(team, envs, motions, joints)
        warm_start_others(team, order, motions, contacts, joints)


@wp.kernel
def sweep_with_joints(
    launch: int,
    repetition: int,
    dt: float,
    lanes: int,
    envs: Environments,
    order: Order,
    graph: Graph,
    motions: Motions,
    contacts: Contacts,
    joints: Joints,
    visits: VisitOrder,
):
    """One team per environment: as `sweep_constraints`, with a direct solution of each mechanism after each sweep.

    After the passes of a repetition of shock propagation, it is the direct solution alone.
    """
    team = team_of(wp.tid(), lanes)
    env = team.env
    if launch == Launch.AFTER_PASSES and not has_repetition(repetition, env, envs):
        return
    unit = motions.velocity_unit[envs.first_body[env]]
    touched = any_touched(team, joints)
    has_joints = joints.first_joint[env] < joints.first_joint[env + 1]
    starts = (
        launch == Launch.BEFORE_SHOCK and envs.warm_starting[env] == 1 and has_joints and order.color_count[env] > 0
    )
    left = wp.where(is_propagated(env, envs, graph), 1, 0)
    if launch != Launch.AFTER_PASSES:
        left = sweeps_of(launch, team, envs, graph)
    layered = wp.where(envs.shock_propagation[env] == ShockMode.ONE_PASS and touched == 0, 1, 0)
    unsolved = int(1)
    done = int(0)
    residual = float(0.0)
    is_searched = launch == Launch.AFTER_SHOCK and searched(env, envs, graph)
    phase = int(wp.where(starts, Phase.STARTING, phase_after(Phase.STARTING, left, touched, is_searched)))
    while phase != Phase.OVER:
        change = sweep_once(phase, launch, touched, layered, dt, team, order, graph, motions, contacts, joints, visits)
        if phase == Phase.SWEEPING:
            residual = change
            done += 1
            unsolved = any_of_team(wp.where(residual > CONVERGED * unit, 1, 0), team)
            left = unsolved * (left - 1)
        if phase == Phase.SEARCHING:
            since = wp.where(launch == Launch.BEFORE_SHOCK, BEFORE_CONTACTS, START)
            search_energy(since, dt, team, envs, order, graph, motions, contacts, joints)
        is_first = starts and done == 1 and phase == Phase.SWEEPING
        phase = wp.where(is_first, Phase.SEARCHING, phase_after(phase, left, touched, is_searched))
    if launch == Launch.BEFORE_SHOCK:
        graph.converged[env] = 1 - unsolved
    if launch != Launch.AFTER_PASSES:
        report_sweeps(done, residual, team, graph)


@wp.func
def phase_after(phase: int, left: int, touched: int, is_searched: bool):
    """The phase that follows, with the number of sweeps left.

    At last, where they have contacts, the mechanisms are solved once more, so that no limit pulls, before a line search
    if `is_searched`.
    """
    if left > 0:
        return Phase.SWEEPING
    if touched == 0 or phase == Phase.ENDING or (phase == Phase.SEARCHING and is_searched):
        return Phase.OVER
    return wp.where(is_searched, Phase.SEARCHING, Phase.ENDING)


@wp.func
def sweep_once(
    phase: int,
    launch: int,
    touched: int,
    layered: int,
    dt: float,
    team: Team,
    order: Order,
    graph: Graph,
    motions: Motions,
    contacts: Contacts,
    joints: Joints,
    visits: VisitOrder,
):
    """One sweep, and a direct solution of each mechanism. Returns a lane's largest change [m/s].

    Before the first sweep (STARTING) it applies initial impulses; before a line search and at the end it is the direct
    solution alone.
    """
    change = float(0.0)
    if phase == Phase.SWEEPING and launch != Launch.AFTER_PASSES:
        for level in range(layered, layered * graph.level_count[team.env] + 1):
            change = wp.max(change, sweep_others(level, team, order, graph, motions, contacts, joints))
    if phase != Phase.STARTING:
        change = wp.max(change, solve_joints(team, dt, motions, joints))
    if touched == 1 and phase <= Phase.SWEEPING:
        start = wp.where(phase == Phase.STARTING, 1, 0)
        change = wp.max(change, solve_touching(start, team, order, motions, contacts, joints, visits))
    return change


@wp.kernel
def store_joint_start(repetition: int, lanes: int, envs: Environments, graph: Graph, joints: Joints):
    """One team per environment: store the impulses of joints before a repetition of shock propagation."""
    team = team_of(wp.tid(), lanes)
    if not has_repetition(repetition, team.env, envs) or not is_propagated(team.env, envs, graph):
        return
    for j in range(joints.first_joint[team.env] + team.lane, joints.first_joint[team.env + 1], lanes):
        joints.start[j] = joints.total[j]


@wp.kernel
def add_energy_of_joints(
    repetition: int, dt: float, lanes: int, envs: Environments, graph: Graph, motions: Motions, joints: Joints
):
    """One team per environment: the contributions of joints to the sums of the line search."""
    team = team_of(wp.tid(), lanes)
    if not has_repetition(repetition, team.env, envs) or not searched(team.env, envs, graph):
        return
    for j in range(joints.first_joint[team.env] + team.lane, joints.first_joint[team.env + 1], lanes):
        island = island_of_joint(j, motions, joints, graph)
        if island >= 0:
            terms = energy_terms(j, START, dt, motions, joints) * wp.float64(1.0 / graph.largest[island])
            for k in range(2):
                terms[k] = FIXED_POINT * wp.clamp(terms[k], -wp.float64(65536.0), wp.float64(65536.0))
            add_up(island, wp.int64(terms[0]), wp.int64(terms[1]), graph)


@wp.kernel
def blend_joints(repetition: int, lanes: int, envs: Environments, graph: Graph, motions: Motions, joints: Joints):
    """One team per environment: apply the step length of the line search to the impulses of joints."""
    team = team_of(wp.tid(), lanes)
    if not has_repetition(repetition, team.env, envs) or not searched(team.env, envs, graph):
        return
    for j in range(joints.first_joint[team.env] + team.lane, joints.first_joint[team.env + 1], lanes):
        blend_joint(j, graph, motions, joints)


@wp.kernel
def push_joined(
    lanes: int,
    envs: Environments,
    order: Order,
    graph: Graph,
    motions: Motions,
    contacts: Contacts,
    joints: Joints,
    visits: VisitOrder,
):
    """One team per environment, after the push-out of single bodies: separate the contacts of mechanisms."""
    team = team_of(wp.tid(), lanes)
    env = team.env
    if graph.overlapping[env] == 0 or any_touched(team, joints) == 0:
        return
    part = part_of_team(team)
    first = joints.first_mechanism[env] + team.lane / part.lanes
    for m in range(first, joints.first_mechanism[env + 1], team.lanes / part.lanes):
        if needs_solution(m, joints):
            project(m, PUSH, part, motions, joints)
    sync_team(team)
    unit = motions.velocity_unit[envs.first_body[env]]
    left = int(PUSH_OUT_SWEEPS)
    while left > 0:
        change = push_touching(team, order, motions, contacts, joints, visits)
        left = any_of_team(wp.where(change > PUSH_OUT_CONVERGED * unit, 1, 0), team) * (left - 1)


@wp.kernel
def move_untouched(dt: float, lanes: int, bodies: Bodies, state: State, motions: Motions, joints: Joints):
    """One team per mechanism without contacts: it moves in parts of the step, at whose ends the joints hold."""
    team = team_of(wp.tid(), lanes)
    if joints.activity[team.env] == Activity.UNTOUCHED:
        move_in_parts(team.env, dt, team, bodies, state, motions, joints)


@wp.kernel
def settle_joints(
    after_push: int, dt: float, lanes: int, bodies: Bodies, state: State, motions: Motions, joints: Joints
):
    """One team per mechanism with contacts: the joints hold at the predicted poses.

    Before the sweeps, this is the first solution with the forces of the step, without the initial impulses of contacts:
    these may give light bodies velocities at which predicted poses mean nothing. After the push-out (`after_push`), its
    motion obeys the joints, too; mechanisms without contacts whose joints do not hold yet are solved once more.
    """
    team = team_of(wp.tid(), lanes)
    m = team.env
    if after_push == 0 and joints.activity[m] != Activity.IN_CONTACT:
        return
    if after_push == 1:
        if not needs_solution(m, joints):
            return
        project(m, PUSH, team, motions, joints)
    settle_mechanism(m, dt, after_push, 0, team, bodies, state, motions, joints)


@wp.kernel
def join_courses(lanes: int, bodies: Bodies, motions: Motions, joints: Joints):
    """One team per mechanism, before an iteration of ccd.py: its bodies rotate for the same time, and move on alike.

    The course of a body that moved in parts is its mean velocity.

    A mechanism would move on with the mean velocity of its bodies; if it is held to the world, it would stop.
    """
    team = team_of(wp.tid(), lanes)
    m = team.env
    if joints.activity[m] == Activity.STILL:
        return
    for i in range(joints.first_member[m] + team.lane, joints.first_member[m + 1], lanes):
        b = joints.member[i]
        if joints.parts[m] > 1 and motions.joined[b] == 0 and motions.role[b] == Role.FREE:
            motions.course[b] = motions.course[b] + motions.solver_bodies[b].push_linear
            motions.solver_bodies[b].push_linear = wp.vec3(0.0, 0.0, 0.0)
    sync_team(team)
    share = float(1.0)
    mass = float(0.0)
    momentum = wp.vec3(0.0, 0.0, 0.0)
    for i in range(joints.first_member[m], joints.first_member[m + 1]):
        b = joints.member[i]
        if motions.role[b] == Role.FREE:
            share = wp.min(share, motions.time_of_impact[b])
    for i in range(joints.first_member[m], joints.first_member[m + 1]):
        b = joints.member[i]
        if motions.role[b] == Role.FREE:
            mass += bodies.mass[b]
            momentum += bodies.mass[b] * (share / motions.time_of_impact[b]) * motions.course[b]
    sync_team(team)
    onward = wp.where(joints.anchored[m] == 1, wp.vec3(0.0, 0.0, 0.0), momentum / mass)
    for i in range(joints.first_member[m] + team.lane, joints.first_member[m + 1], lanes):
        b = joints.member[i]
        if motions.role[b] == Role.FREE:
            motions.course[b] = (share / motions.time_of_impact[b]) * motions.course[b]
            motions.next_course[b] = motions.course[b]
            motions.time_of_impact[b] = share
            motions.next_time_of_impact[b] = share
            motions.onward[b] = onward
            motions.joined[b] = 1


@wp.kernel
def share_impacts(
    dt: float, lanes: int, shapes: Shapes, bodies: Bodies, state: State, pairs: Pairs, motions: Motions, joints: Joints
):
    """One team per mechanism, after an iteration: at its first impact, its joints stop, and it moves on as a whole.

    The motion after the impact of the body that is hit is that of all its bodies, without rotation.
    """
    team = team_of(wp.tid(), lanes)
    m = team.env
    if joints.activity[m] == Activity.STILL:
        return
    hit = joints.member[joints.first_member[m]]
    for i in range(joints.first_member[m], joints.first_member[m + 1]):
        if motions.first_impact[joints.member[i]] < motions.first_impact[hit]:
            hit = joints.member[i]
    first = motions.first_impact[hit]
    if first == NEVER:
        return
    t = time_of(first)
    after = motion_after(hit, first, dt, shapes, bodies, state, pairs, motions)
    if joints.anchored[m] == 1:
        after.linear = wp.vec3(0.0, 0.0, 0.0)
    for i in range(joints.first_member[m] + team.lane, joints.first_member[m + 1], lanes):
        b = joints.member[i]
        if motions.role[b] == Role.FREE:
            motions.next_course[b] = t * motions.course[b] + (1.0 - t) * after.linear
            motions.next_shared_spin[b] = wp.vec3(0.0, 0.0, 0.0)
            motions.next_time_of_impact[b] = t * motions.time_of_impact[b]
            motions.changed[b] = 1


@wp.kernel
def close_stopped(dt: float, lanes: int, bodies: Bodies, state: State, motions: Motions, joints: Joints):
    """One team per mechanism, after the last iteration: where its joints stopped, they hold."""
    team = team_of(wp.tid(), lanes)
    m = team.env
    if joints.activity[m] == Activity.STILL:
        return
    stopped = joints.unsettled[m]
    for i in range(joints.first_member[m], joints.first_member[m + 1]):
        b = joints.member[i]
        if motions.role[b] == Role.FREE and motions.next_time_of_impact[b] < 1.0:
            stopped = 1
    if stopped == 1:
        close_joints(m, dt, team, bodies, state, motions, joints)


@wp.kernel
def end_joints(dt: float, envs: Environments, bodies: Bodies, motions: Motions, joints: Joints, graph: Graph):
    """One thread per joint, after the position update: its impulse, none if it holds nothing, and whether it breaks."""
    j = wp.tid()
    a = joints.body_a[j]
    b = joints.body_b[j]
    if joints.broken[j] == 1 or motions.role[a] == Role.ABSENT or motions.role[b] == Role.ABSENT:
        joints.impulse[j] = wp.vec3(0.0, 0.0, 0.0)
        joints.angular_impulse[j] = wp.vec3(0.0, 0.0, 0.0)
        return
    free = motions.role[a] == Role.FREE or motions.role[b] == Role.FREE
    if not free or envs.failed[bodies.env[a]] == 1:
        return
    linear = wp.vec3d()
    angular = wp.vec3d()
    for k in range(3):
        for i in range(3):
            linear[i] = linear[i] + joints.total[j][k] * joints.linear[j][k, i]
            angular[i] = angular[i] + joints.total[j][3 + k] * joints.angular_a[j][3 + k, i]
    joints.impulse[j] = wp.vec3(linear)
    joints.angular_impulse[j] = wp.vec3(angular)
    force = float(wp.length(linear)) / dt
    torque = float(wp.length(angular)) / dt
    if force > joints.numbers[j, JointNumber.BREAK_FORCE] or torque > joints.numbers[j, JointNumber.BREAK_TORQUE]:
        joints.broken[j] = 1
        # The next step computes islands, levels and colours again.
        graph.active_before[bodies.env[a]] = 0


@wp.kernel
def note_coordinates(dt: float, lanes: int, state: State, motions: Motions, joints: Joints):
    """One team per mechanism, after the position update: its joints' coordinates; angles count full turns."""
    team = team_of(wp.tid(), lanes)
    m = team.env
    for i in range(joints.first_member[m] + team.lane, joints.first_member[m + 1], lanes):
        take_pose(joints.member[i], state, joints)
    sync_team(team)
    for place in range(joints.first_place[m] + team.lane, joints.first_place[m + 1], lanes):
        j = joints.sequence[place]
        near = joints.position[j] + turn_in_step(j, dt, state, motions, joints)
        joints.position[j] = float(coordinate_of(joints.coordinate[j], ends_of(j, joints), near))


@wp.func
def is_motor(j: int, joints: Joints):
    """Whether a joint has a drive with a target velocity."""
    target = joints.numbers[j, JointNumber.TARGET_VELOCITY] * joints.numbers[j, JointNumber.DAMPING]
    return target != 0.0 and joints.numbers[j, JointNumber.MAX_FORCE] > 0.0


@wp.kernel
def support_joined(bodies: Bodies, motions: Motions, graph: Graph, joints: Joints, sleep_state: SleepState):
    """One thread per joint: an island that hangs from the world or a static body counts as supported.

    An island with a drive that has a target velocity stays awake.
    """
    j = wp.tid()
    a = joints.body_a[j]
    b = joints.body_b[j]
    upper = wp.where(bodies.motion[a] == Motion.DYNAMIC, a, b)
    fixed = joints.to_world[j] == 1 or bodies.motion[a] != Motion.DYNAMIC or bodies.motion[b] != Motion.DYNAMIC
    if joints.broken[j] == 1 or motions.role[upper] != Role.FREE:
        return
    if is_motor(j, joints):
        sleep_state.keeps_awake[graph.island[upper]] = 1
    if not fixed:
        return
    if motions.role[a] == Role.KINEMATIC or motions.role[b] == Role.KINEMATIC:
        sleep_state.keeps_awake[graph.island[upper]] = 1
    else:
        sleep_state.supported[graph.island[upper]] = 1
