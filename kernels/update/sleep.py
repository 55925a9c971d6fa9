"""Rest: bodies that have kept still fall asleep, island by island, and wake when anything disturbs their island.

A body is ready to sleep when it has been slow, and has stayed within a small box about a pose, for long enough: a real
history, so the top of a throw does not count. An island (bodies connected by contacts; what is fixed does not connect)
falls asleep when all its bodies are ready and it lies on something fixed: what falls freely never sleeps.

Sleepers keep their pose bit for bit, and the history keeps the contacts on which they lie. Their pairs are *dormant*:
listed, but neither searched nor solved. An island wakes whole when one of its bodies was changed from outside, when a
fixed body that it touches was moved or switched off, or when something that moves touches it; this is found between
the narrow phase and the solver, so that the blow is felt in the same step.
"""

import warp as wp

from warp_rigid.kernels.collide.broadphase import may_meet
from warp_rigid.kernels.constraints.contact import keep_contact
from warp_rigid.kernels.schema import (
    MOTION_DYNAMIC,
    Bodies,
    Contacts,
    Environments,
    Graph,
    History,
    Motions,
    Pairs,
    Rest,
    Shapes,
    State,
)
from warp_rigid.kernels.update.predict import ABSENT, ASLEEP, DRIVEN, FIXED, FREE

wp.set_module_options({"enable_backward": False})

DYNAMIC = wp.constant(MOTION_DYNAMIC)

SLOW = wp.constant(0.1)
"""Speed below which a body may be at rest, in its size a second; its surface turns no faster either."""

STILL = wp.constant(0.02)
"""Half-width of the box within which a body at rest stays, as a part of its size."""

PATIENCE = wp.constant(0.5)
"""How long a body must have kept still to fall asleep [s]."""


@wp.func
def turned(q: wp.quat, r: wp.quat):
    """Angle between two orientations, small ones [rad]."""
    d = wp.quat_inverse(q) * r
    return 2.0 * wp.length(wp.vec3(d[0], d[1], d[2]))


@wp.func
def differ(v: wp.vec3, w: wp.vec3):
    """Whether two vectors differ in any bit."""
    return v[0] != w[0] or v[1] != w[1] or v[2] != w[2]


@wp.func
def pose_differs(b: int, state: State, rest: Rest):
    """Whether a body is elsewhere than the pose that was kept."""
    q = state.orientation[b]
    r = rest.orientation[b]
    turn = q[0] != r[0] or q[1] != r[1] or q[2] != r[2] or q[3] != r[3]
    return turn or differ(state.position[b], rest.position[b])


@wp.func
def has_changed(b: int, state: State, motions: Motions, rest: Rest):
    """Whether a sleeping or fixed body is not as it was left."""
    moved = pose_differs(b, state, rest)
    if motions.role[b] != ASLEEP:
        return moved or motions.role[b] == DRIVEN
    pushed = differ(state.force[b], rest.force[b]) or differ(state.torque[b], rest.torque[b])
    zero = wp.vec3(0.0, 0.0, 0.0)
    return moved or pushed or differ(state.linear_velocity[b], zero) or differ(state.angular_velocity[b], zero)


@wp.kernel
def notice(bodies_per_env: int, state: State, motions: Motions, rest: Rest, envs: Environments):
    """One thread a body: what was changed since the last step. A fixed body that was moved counts as driven.

    Only where bodies may sleep: elsewhere it must not matter that they do in other environments.
    """
    b = wp.tid()
    role = motions.role[b]
    if role == ABSENT or role == FREE or envs.sleeping[b / bodies_per_env] == 0:
        return
    if has_changed(b, state, motions, rest):
        rest.disturbed[b] = 1
        envs.moving[b / bodies_per_env] = envs.step[b / bodies_per_env] + 1
        if role == FIXED:
            motions.role[b] = DRIVEN


@wp.kernel
def spread(history: History, rest: Rest):
    """One thread a body: name the islands that wake because of it or of what it lay on."""
    a = wp.tid()
    if rest.disturbed[a] == 1 and rest.asleep[a] == 1:
        rest.wake[rest.island[a]] = 1
    for row in range(history.pair_start[a], history.pair_start[a + 1]):
        if history.contact_start[row + 1] > history.contact_start[row]:
            b = history.body_b[row]
            if rest.disturbed[a] == 1 and rest.asleep[b] == 1:
                rest.wake[rest.island[b]] = 1
            if rest.disturbed[b] == 1 and rest.asleep[a] == 1:
                rest.wake[rest.island[a]] = 1


@wp.kernel
def touch(pairs: Pairs, rest: Rest):
    """One thread a pair: name the islands that wake because something that moves touches them."""
    pair = wp.tid()
    if pair >= pairs.start[pairs.start.shape[0] - 1] or pairs.contact_count[pair] == 0:
        return
    a = pairs.body_a[pair]
    b = pairs.body_b[pair]
    if rest.asleep[a] == 1:
        rest.wake[rest.island[a]] = 1
    if rest.asleep[b] == 1:
        rest.wake[rest.island[b]] = 1


@wp.kernel
def wake(bodies_per_env: int, motions: Motions, rest: Rest, envs: Environments):
    """One thread a body: wake the islands that were named."""
    b = wp.tid()
    if rest.asleep[b] == 1 and rest.wake[rest.island[b]] == 1:
        envs.moving[b / bodies_per_env] = envs.step[b / bodies_per_env] + 1
        rest.asleep[b] = 0
        rest.still[b] = 0
        if motions.role[b] == ASLEEP:
            motions.role[b] = FREE


@wp.func
def keep_pose(b: int, state: State, rest: Rest):
    """Measure motion from the present pose."""
    rest.position[b] = state.position[b]
    rest.orientation[b] = state.orientation[b]


@wp.kernel
def watch_stillness(shapes: Shapes, bodies: Bodies, state: State, motions: Motions, rest: Rest):
    """One thread a body, after it has moved: count the steps for which it has kept still."""
    b = wp.tid()
    role = motions.role[b]
    rest.wake[b] = 0
    rest.restless[b] = 0
    rest.grounded[b] = 0
    rest.disturbed[b] = wp.where(role != ABSENT and state.active[b] == 0, 1, 0)
    if role == ASLEEP:
        return
    if role != FREE:
        keep_pose(b, state, rest)
        return
    size = shapes.shapes[bodies.shape[b]].size
    reach = motions.radius[b]
    speed = wp.max(wp.length(state.linear_velocity[b]), reach * wp.length(state.angular_velocity[b]))
    way = wp.length(state.position[b] - rest.position[b]) + reach * turned(rest.orientation[b], state.orientation[b])
    rest.still[b] = rest.still[b] + 1
    if speed > SLOW * size or way > STILL * size:
        rest.still[b] = 0
        keep_pose(b, state, rest)


@wp.kernel
def ask_bodies(
    dt: float, bodies_per_env: int, envs: Environments, motions: Motions, graph: Graph, state: State, rest: Rest
):
    """One thread a body: an island with a body that is not ready stays awake."""
    b = wp.tid()
    env = b / bodies_per_env
    if motions.role[b] != FREE:
        return
    rest.still[b] = rest.still[b] * envs.sleeping[env]
    ready = dt * float(rest.still[b]) >= PATIENCE and envs.failed[env] == 0
    if not ready or state.active[b] == 0:
        rest.restless[graph.island[b]] = 1


@wp.kernel
def ask_ground(pairs: Pairs, motions: Motions, bodies: Bodies, graph: Graph, rest: Rest):
    """One thread a pair: whether an island lies on something fixed, or on something that moves."""
    pair = wp.tid()
    if pairs.contact_start[pair + 1] == pairs.contact_start[pair]:
        return
    a = pairs.body_a[pair]
    b = pairs.body_b[pair]
    if bodies.motion[a] == DYNAMIC and bodies.motion[b] == DYNAMIC:
        return
    upper = wp.where(bodies.motion[a] == DYNAMIC, a, b)
    if motions.role[a] == DRIVEN or motions.role[b] == DRIVEN:
        rest.restless[graph.island[upper]] = 1
    else:
        rest.grounded[graph.island[upper]] = 1


@wp.kernel
def fall_asleep(motions: Motions, graph: Graph, state: State, rest: Rest):
    """One thread a body: islands that are ready fall asleep, in the pose and under the forces that they have."""
    b = wp.tid()
    if motions.role[b] == ASLEEP:
        graph.level[b] = rest.level[b]
    if motions.role[b] != FREE:
        return
    island = graph.island[b]
    if rest.restless[island] == 1 or rest.grounded[island] == 0:
        return
    rest.asleep[b] = 1
    rest.island[b] = island
    rest.level[b] = graph.level[b]
    rest.force[b] = state.force[b]
    rest.torque[b] = state.torque[b]
    keep_pose(b, state, rest)
    state.linear_velocity[b] = wp.vec3(0.0, 0.0, 0.0)
    state.angular_velocity[b] = wp.vec3(0.0, 0.0, 0.0)
    state.spin_rest[b] = wp.vec3(0.0, 0.0, 0.0)


@wp.func
def row_asleep(pair: int, motions: Motions, pairs: Pairs):
    """Row in the history of a pair that has slept through this step, -1 of any other."""
    if pairs.dormant[pair] == 0 or may_meet(motions.role[pairs.body_a[pair]], motions.role[pairs.body_b[pair]]):
        return -1
    return pairs.dormant[pair] - 1


@wp.kernel
def count_kept(threads: int, history: History, motions: Motions, pairs: Pairs):
    """The threads share the pairs: what the history knows of a pair that has slept, it keeps, its contacts too."""
    for pair in range(wp.tid(), pairs.start[pairs.start.shape[0] - 1], threads):
        row = row_asleep(pair, motions, pairs)
        if row >= 0:
            pairs.contact_count[pair] = history.contact_start[row + 1] - history.contact_start[row]
            pairs.seen[pair] = history.seen[row]
            pairs.seen_turn[pair] = history.seen_turn[row]
            pairs.seen_shift[pair] = history.seen_shift[row]


@wp.func
def copy_contact(row: int, target: int, source: History, history: History):
    """Copy a row of a history to a row of another."""
    history.key[target] = source.key[row]
    history.impulse[target] = source.impulse[row]
    history.twist[target] = source.twist[row]
    history.position[target] = source.position[row]
    history.normal[target] = source.normal[row]
    history.gap[target] = source.gap[row]


@wp.kernel
def carry(threads: int, pairs: Pairs, contacts: Contacts, history: History, motions: Motions, kept: History):
    """The threads share the pairs: this step's contacts, and those of pairs that slept, to their rows.

    If all do not fit, `kept` has no rows, and the step is repeated with larger pools.
    """
    for pair in range(wp.tid(), pairs.start[pairs.start.shape[0] - 1], threads):
        first = kept.contact_start[pair]
        row = row_asleep(pair, motions, pairs)
        for k in range(kept.contact_start[pair + 1] - first):
            if row >= 0:
                copy_contact(history.contact_start[row] + k, first + k, history, kept)
            else:
                keep_contact(first + k, pairs.contact_start[pair] + k, contacts, kept)


@wp.kernel
def put_back(threads: int, kept: History, history: History):
    """The threads share the contacts: what was kept becomes the history."""
    for c in range(wp.tid(), kept.contact_start[kept.contact_start.shape[0] - 1], threads):
        copy_contact(c, c, kept, history)
