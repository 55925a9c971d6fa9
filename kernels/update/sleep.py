"""Sleeping: bodies at rest are put to sleep island by island, and woken when their island is disturbed.

A body is ready to sleep when it has been slow and has stayed close to a reference pose for SLEEP_DELAY, and for as long
as its acceleration by gravity and other forces takes to move a free body by SLEEP_FALL. A body that starts to move, or
is at the top of its trajectory, is therefore not ready. An island (bodies connected by contacts, except through static
bodies) falls asleep when all its bodies are ready and it is in contact with a static body. Bodies in free fall never
sleep.

The pose of sleeping bodies does not change, and their contacts are kept in the history. Their pairs are *dormant*: they
are listed, but neither searched for contacts nor solved. A whole island is woken when one of its bodies is changed by
the user, when a static body that it touches is moved or switched off, when the surface of a body that it touches runs,
or when a moving body touches it. The last is detected between the narrow phase and the solver, so that the impact acts
in the same step.
"""

import warp as wp

from warp_rigid.kernels.collide.broadphase import may_meet
from warp_rigid.kernels.common.surfaces import runs
from warp_rigid.kernels.constraints.build_contacts import store_contact
from warp_rigid.kernels.enums import Motion, Role
from warp_rigid.kernels.schema import (
    Bodies,
    Contacts,
    Environments,
    Graph,
    History,
    Motions,
    Pairs,
    Shapes,
    SleepState,
    State,
)
from warp_rigid.kernels.tuning import SLEEP_DELAY, SLEEP_FALL, SLEEP_SPEED, SLEEP_TRAVEL

wp.set_module_options({"enable_backward": False})


@wp.func
def angle_between(q: wp.quat, r: wp.quat):
    """Angle between two orientations [rad], for small angles."""
    d = wp.quat_inverse(q) * r
    return 2.0 * wp.length(wp.vec3(d[0], d[1], d[2]))


@wp.func
def differ(v: wp.vec3, w: wp.vec3):
    """Whether two vectors differ in any bit."""
    return v[0] != w[0] or v[1] != w[1] or v[2] != w[2]


@wp.func
def pose_differs(b: int, state: State, sleep_state: SleepState):
    """Whether a body's pose differs from the stored one."""
    q = state.orientation[b]
    r = sleep_state.orientation[b]
    turn = q[0] != r[0] or q[1] != r[1] or q[2] != r[2] or q[3] != r[3]
    return turn or differ(state.position[b], sleep_state.position[b])


@wp.func
def has_changed(b: int, state: State, motions: Motions, sleep_state: SleepState):
    """Whether a sleeping or static body was changed since the last step."""
    moved = pose_differs(b, state, sleep_state)
    if motions.role[b] != Role.ASLEEP:
        return moved or motions.role[b] == Role.KINEMATIC
    pushed = differ(state.force[b], sleep_state.force[b]) or differ(state.torque[b], sleep_state.torque[b])
    zero = wp.vec3(0.0, 0.0, 0.0)
    return moved or pushed or differ(state.linear_velocity[b], zero) or differ(state.angular_velocity[b], zero)


@wp.kernel
def find_changed(bodies: Bodies, state: State, motions: Motions, sleep_state: SleepState, envs: Environments):
    """One thread per body: mark bodies that were changed since the last step, and those whose surface runs.

    A moved static body counts as kinematic. Only in environments with sleeping enabled, so that others do not depend on
    the settings of these.
    """
    b = wp.tid()
    role = motions.role[b]
    if role == Role.ABSENT or role == Role.FREE or envs.sleeping[bodies.env[b]] == 0:
        return
    if runs(b, bodies):
        sleep_state.disturbed[b] = 1
    if has_changed(b, state, motions, sleep_state):
        sleep_state.disturbed[b] = 1
        envs.moving[bodies.env[b]] = envs.step[bodies.env[b]] + 1
        if role == Role.STATIC:
            motions.role[b] = Role.KINEMATIC


@wp.kernel
def wake_neighbors(history: History, sleep_state: SleepState):
    """One thread per body: mark islands to wake because of changes to this body or to its neighbours."""
    a = wp.tid()
    if sleep_state.disturbed[a] == 1 and sleep_state.asleep[a] == 1:
        sleep_state.wake[sleep_state.island[a]] = 1
    for row in range(history.pair_start[a], history.pair_start[a + 1]):
        if history.contact_start[row + 1] > history.contact_start[row]:
            b = history.body_b[row]
            if sleep_state.disturbed[a] == 1 and sleep_state.asleep[b] == 1:
                sleep_state.wake[sleep_state.island[b]] = 1
            if sleep_state.disturbed[b] == 1 and sleep_state.asleep[a] == 1:
                sleep_state.wake[sleep_state.island[a]] = 1


@wp.func
def wake_partner(a: int, b: int, motions: Motions, sleep_state: SleepState):
    """Mark the island of a sleeping body b that is joined to a body which moves or was changed from outside."""
    awake = motions.role[a] == Role.FREE and sleep_state.asleep[a] == 0
    if sleep_state.asleep[b] == 1 and (awake or sleep_state.disturbed[a] == 1):
        sleep_state.wake[sleep_state.island[b]] = 1


@wp.kernel
def wake_joined(body_a: wp.array[int], body_b: wp.array[int], motions: Motions, sleep_state: SleepState):
    """One thread per joint: mark islands to wake because of it."""
    k = wp.tid()
    wake_partner(body_a[k], body_b[k], motions, sleep_state)
    wake_partner(body_b[k], body_a[k], motions, sleep_state)


@wp.kernel
def wake_touched(pairs: Pairs, sleep_state: SleepState):
    """One thread per pair: mark islands to wake because a moving body touches them."""
    pair = wp.tid()
    if pair >= pairs.start[pairs.start.shape[0] - 1] or pairs.contact_count[pair] == 0:
        return
    a = pairs.body_a[pair]
    b = pairs.body_b[pair]
    if sleep_state.asleep[a] == 1:
        sleep_state.wake[sleep_state.island[a]] = 1
    if sleep_state.asleep[b] == 1:
        sleep_state.wake[sleep_state.island[b]] = 1


@wp.kernel
def wake_islands(bodies: Bodies, motions: Motions, sleep_state: SleepState, envs: Environments):
    """One thread per body: wake the marked islands."""
    b = wp.tid()
    if sleep_state.asleep[b] == 1 and sleep_state.wake[sleep_state.island[b]] == 1:
        envs.moving[bodies.env[b]] = envs.step[bodies.env[b]] + 1
        sleep_state.asleep[b] = 0
        sleep_state.still_steps[b] = 0
        if motions.role[b] == Role.ASLEEP:
            motions.role[b] = Role.FREE


@wp.func
def keep_pose(b: int, state: State, sleep_state: SleepState):
    """Store the current pose as the reference for measuring motion."""
    sleep_state.position[b] = state.position[b]
    sleep_state.orientation[b] = state.orientation[b]


@wp.kernel
def track_motion(shapes: Shapes, bodies: Bodies, state: State, motions: Motions, sleep_state: SleepState):
    """One thread per body, after the position update: count the consecutive steps at rest."""
    b = wp.tid()
    role = motions.role[b]
    sleep_state.wake[b] = 0
    sleep_state.keeps_awake[b] = 0
    sleep_state.supported[b] = 0
    sleep_state.disturbed[b] = wp.where(role != Role.ABSENT and state.active[b] == 0, 1, 0)
    if role == Role.ASLEEP:
        return
    if role != Role.FREE:
        keep_pose(b, state, sleep_state)
        return
    size = shapes.shapes[bodies.shape[b]].size
    reach = motions.radius[b]
    speed = wp.max(wp.length(state.linear_velocity[b]), reach * wp.length(state.angular_velocity[b]))
    way = wp.length(state.position[b] - sleep_state.position[b]) + reach * angle_between(
        sleep_state.orientation[b], state.orientation[b]
    )
    sleep_state.still_steps[b] = sleep_state.still_steps[b] + 1
    if speed > SLEEP_SPEED * size or way > SLEEP_TRAVEL * size:
        sleep_state.still_steps[b] = 0
        keep_pose(b, state, sleep_state)


@wp.func
def has_had_time_to_move(time: float, size: float, acceleration: wp.vec3):
    """Whether a body that has hardly moved for some time [s] is at rest, and does not just begin to move.

    Large bodies, and all in weak gravity, need longer to move by a fraction of their size. Without an acceleration, a
    body at rest remains at rest.
    """
    a = wp.length(acceleration)
    return time >= SLEEP_DELAY and (a == 0.0 or 0.5 * a * time * time >= SLEEP_FALL * size)


@wp.kernel
def test_bodies_for_sleep(
    dt: float,
    shapes: Shapes,
    bodies: Bodies,
    envs: Environments,
    motions: Motions,
    graph: Graph,
    state: State,
    sleep_state: SleepState,
):
    """One thread per body: an island with a body that is not ready stays awake."""
    b = wp.tid()
    env = bodies.env[b]
    if motions.role[b] != Role.FREE:
        return
    sleep_state.still_steps[b] = sleep_state.still_steps[b] * envs.sleeping[env]
    time = dt * float(sleep_state.still_steps[b])
    size = shapes.shapes[bodies.shape[b]].size
    ready = has_had_time_to_move(time, size, motions.acceleration[b]) and envs.failed[env] == 0
    if not ready or state.active[b] == 0:
        sleep_state.keeps_awake[graph.island[b]] = 1


@wp.kernel
def test_support_for_sleep(pairs: Pairs, motions: Motions, bodies: Bodies, graph: Graph, sleep_state: SleepState):
    """One thread per pair: whether an island is in contact with a static or a kinematic body."""
    pair = wp.tid()
    if pairs.contact_start[pair + 1] == pairs.contact_start[pair]:
        return
    a = pairs.body_a[pair]
    b = pairs.body_b[pair]
    if bodies.motion[a] == Motion.DYNAMIC and bodies.motion[b] == Motion.DYNAMIC:
        return
    upper = wp.where(bodies.motion[a] == Motion.DYNAMIC, a, b)
    moves = motions.role[a] == Role.KINEMATIC or motions.role[b] == Role.KINEMATIC
    if moves or runs(a, bodies) or runs(b, bodies):
        sleep_state.keeps_awake[graph.island[upper]] = 1
    else:
        sleep_state.supported[graph.island[upper]] = 1


@wp.kernel
def put_islands_to_sleep(motions: Motions, graph: Graph, state: State, sleep_state: SleepState):
    """One thread per body: put the islands that are ready to sleep, and store their poses and external forces."""
    b = wp.tid()
    if motions.role[b] == Role.ASLEEP:
        graph.level[b] = sleep_state.level[b]
    if motions.role[b] != Role.FREE:
        return
    island = graph.island[b]
    if sleep_state.keeps_awake[island] == 1 or sleep_state.supported[island] == 0:
        return
    sleep_state.asleep[b] = 1
    sleep_state.island[b] = island
    sleep_state.level[b] = graph.level[b]
    sleep_state.force[b] = state.force[b]
    sleep_state.torque[b] = state.torque[b]
    keep_pose(b, state, sleep_state)
    state.linear_velocity[b] = wp.vec3(0.0, 0.0, 0.0)
    state.angular_velocity[b] = wp.vec3(0.0, 0.0, 0.0)
    state.angular_velocity_remainder[b] = wp.vec3(0.0, 0.0, 0.0)


@wp.func
def history_row_if_asleep(pair: int, motions: Motions, pairs: Pairs):
    """Row in the history of a pair that slept in this step, -1 for any other."""
    if pairs.dormant[pair] == 0 or may_meet(motions.role[pairs.body_a[pair]], motions.role[pairs.body_b[pair]]):
        return -1
    return pairs.dormant[pair] - 1


@wp.kernel
def count_history(threads: int, history: History, motions: Motions, pairs: Pairs):
    """The threads share the pairs: keep the contact count and search data of pairs that slept in this step."""
    for pair in range(wp.tid(), pairs.start[pairs.start.shape[0] - 1], threads):
        row = history_row_if_asleep(pair, motions, pairs)
        if row >= 0:
            pairs.contact_count[pair] = history.contact_start[row + 1] - history.contact_start[row]
            pairs.searched[pair] = history.searched[row]
            pairs.searched_orientation[pair] = history.searched_orientation[row]
            pairs.searched_position[pair] = history.searched_position[row]
            pairs.axis[pair] = history.axis[row]


@wp.func
def copy_contact(row: int, target: int, source: History, history: History):
    """Copy a row of a history to a row of another."""
    history.key[target] = source.key[row]
    history.impulse[target] = source.impulse[row]
    history.angular_impulse[target] = source.angular_impulse[row]
    history.position[target] = source.position[row]
    history.normal[target] = source.normal[row]
    history.gap[target] = source.gap[row]


@wp.kernel
def merge_history(threads: int, pairs: Pairs, contacts: Contacts, history: History, motions: Motions, kept: History):
    """The threads share the pairs: merge this step's contacts with those of pairs that slept.

    If the capacity is exceeded, `kept` has no rows, and the step is repeated with larger pools.
    """
    for pair in range(wp.tid(), pairs.start[pairs.start.shape[0] - 1], threads):
        first = kept.contact_start[pair]
        row = history_row_if_asleep(pair, motions, pairs)
        for k in range(kept.contact_start[pair + 1] - first):
            if row >= 0:
                copy_contact(history.contact_start[row] + k, first + k, history, kept)
            else:
                store_contact(first + k, pairs.contact_start[pair] + k, contacts, kept)


@wp.kernel
def replace_history(threads: int, kept: History, history: History):
    """The threads share the contacts: copy the merged contacts to the history."""
    for c in range(wp.tid(), kept.contact_start[kept.contact_start.shape[0] - 1], threads):
        copy_contact(c, c, kept, history)
