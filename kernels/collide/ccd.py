"""Continuous collision detection: the motion of fast bodies is limited so that they cannot pass through other bodies.

The narrow phase finds contacts near the pose at the start of a step. Further along the motion, neither the position nor
the normal of a contact is known. Therefore, before the bodies move, pairs whose motion in the step is large compared
with the smaller of both sizes are traced with the velocities computed by the solver. Two convex solids are advanced
until they overlap (advancement.py). For other pairs, first the bounding sphere of a body, then the bounding spheres of
its clusters, then its samples and its centre are traced, each against the signed distance of the other body (trace.py).
From its time of impact on, a pair moves as one body for the rest of the step, with the slowest motion that the two can
share (course.py). The next step finds the contact there, with the true normal and the full speed, so that the bodies
rebound correctly. If the bodies stopped instead, those that fall behind them in a heap would run into them: by up to
0.6 sizes where 4096 boxes land at 10 m/s with two steps per frame. If they did not rotate together, the slower one
would leave its own contacts.
"""

import warp as wp

from warp_rigid.kernels.collide.advancement import impact_of_solids
from warp_rigid.kernels.collide.convex import are_solid
from warp_rigid.kernels.collide.course import (
    Course,
    Lead,
    common_motion,
    common_share,
    course_of,
    handled_gap,
    handled_gap_of_solids,
    is_driven,
    largest_motion,
    lead_of,
    onward_course,
    passage_of,
    place_at,
    relative_motion,
    stays_clear,
)
from warp_rigid.kernels.collide.culling import out_of_box
from warp_rigid.kernels.collide.near_samples import Suspects
from warp_rigid.kernels.collide.trace import Suspect, TraceTask, ball_of, look_at_samples, trace_ball, trace_suspect
from warp_rigid.kernels.common.capacity import usable_count
from warp_rigid.kernels.common.symmetry import Symmetry, spin_of_surface, symmetry_of
from warp_rigid.kernels.common.team import MOST_REGISTERS, next_place
from warp_rigid.kernels.enums import Role
from warp_rigid.kernels.schema import Bodies, Environments, Motions, Pairs, Shapes, State
from warp_rigid.kernels.tuning import ALLOWED_DEPTH, FAST_TRAVEL, LEFT_OF_DEPTH
from warp_rigid.kernels.update.predict import UNBOUNDED_EXTENT, smaller_size

wp.set_module_options({"enable_backward": False, "max_unroll": 4})


NEVER = wp.constant(wp.int64(2**62))
"""Value of `first_impact` without an impact; it is the time in units, times PAIR_NUMBERS, plus the pair otherwise."""
PAIR_NUMBERS = wp.constant(wp.int64(2**31))
UNITS_OF_TIME = wp.constant(2.0**20)
"""Units of the time of an impact in a step; rounded down, it is early by half a millionth of the step."""


@wp.func
def traced_size(a: int, b: int, shapes: Shapes, bodies: Bodies):
    """Size of the smaller body of a pair [m], or twice the thickness of the thinner walls if that is less."""
    wall = wp.min(shapes.shapes[bodies.shape[a]].wall, shapes.shapes[bodies.shape[b]].wall)
    return wp.min(smaller_size(a, b, shapes, bodies), 2.0 * wall)


@wp.func
def may_touch(shapes: Shapes, a: Course, b: Course, dt: float):
    """Whether the bounding sphere of the smaller of two bodies can reach the bounding box of the other in this step."""
    small = a
    large = b
    if b.radius < a.radius:
        small = b
        large = a
    center = place_at(small, large, wp.vec3(0.0, 0.0, 0.0), 0.0)
    return not out_of_box(center, small.radius + largest_motion(a, b, dt), large.shape, shapes)


@wp.func
def limit_travel(b: int, dt: float, motions: Motions):
    """Limit the displacement of a body to the distance covered by the broad phase. It has not been hit."""
    moves = motions.role[b] == Role.FREE or motions.role[b] == Role.KINEMATIC
    way = dt * wp.length(motions.solver_bodies[b].linear)
    share = wp.min(1.0, motions.max_travel[b] / wp.max(way, 1.0e-12))
    motions.next_time_of_impact[b] = share
    motions.next_course[b] = share * wp.where(moves, motions.solver_bodies[b].linear, wp.vec3(0.0, 0.0, 0.0))
    motions.next_shared_spin[b] = wp.vec3(0.0, 0.0, 0.0)
    motions.joined[b] = 0
    motions.next_carried[b] = 0
    motions.changed[b] = 0


@wp.kernel
def open_iteration(is_first: int, dt: float, pairs: Pairs, motions: Motions, suspects: Suspects):
    """One thread per body: an iteration starts from the result of the last one, with empty lists."""
    b = wp.tid()
    if is_first == 1:
        limit_travel(b, dt, motions)
    turned = motions.next_time_of_impact[b] - motions.time_of_impact[b]
    motions.course_change[b] = motions.next_course[b] - motions.course[b]
    spin_change = motions.next_shared_spin[b] - motions.shared_spin[b]
    motions.spin_change[b] = spin_change + turned * motions.solver_bodies[b].angular
    motions.time_of_impact[b] = motions.next_time_of_impact[b]
    motions.course[b] = motions.next_course[b]
    motions.shared_spin[b] = motions.next_shared_spin[b]
    motions.carried[b] = motions.next_carried[b]
    motions.first_impact[b] = NEVER
    if b == 0:
        suspects.iteration[0] = wp.where(is_first == 1, 0, suspects.iteration[0] + 1)
        suspects.again[0] = 0
        suspects.sampled[0] = 0
        pairs.fast_count[0] = 0
        suspects.count[0] = 0
        suspects.reached_count[0] = 0
        suspects.cluster_count[0] = 0


@wp.func
def change_of(b: int, course: Course, state: State):
    """The change of a body's velocities in this step, as a motion."""
    change = course
    change.linear = course.linear - state.linear_velocity[b]
    change.angular = course.angular - state.angular_velocity[b]
    return change


@wp.func
def was_hit(a: int, b: int, first: Course, second: Course, size: float, dt: float, state: State):
    """Whether a body of a pair was hit in this step, so that it moves otherwise than the narrow phase expected."""
    return relative_motion(change_of(a, first, state), change_of(b, second, state), dt) > ALLOWED_DEPTH * size


@wp.func
def latest_change(b: int, course: Course, motions: Motions):
    """The change of a body's motion by the previous iteration, as a motion."""
    change = course
    change.linear = motions.course_change[b]
    change.angular = motions.spin_change[b]
    return change


@wp.func
def is_advanced(pair: int, shapes: Shapes, bodies: Bodies, pairs: Pairs):
    """Whether both bodies of a pair are convex solids, so that no samples are traced."""
    return are_solid(bodies.shape[pairs.body_a[pair]], bodies.shape[pairs.body_b[pair]], shapes)


@wp.func
def is_followed(a: int, b: int, iteration: int, iterations: int, motions: Motions):
    """Whether a pair is traced in an iteration.

    In the late iterations, those after `iterations`, immovable bodies hold what they stop. Impacts of bodies that
    nothing holds are not followed any more. There are as many late iterations; the one after them traces pairs with
    immovable bodies only, so that the last impacts take nothing through a wall.
    """
    if iteration < iterations:
        return True
    movable = motions.role[a] == Role.FREE and motions.role[b] == Role.FREE
    return lead_of(a, motions) != lead_of(b, motions) and iteration < 2 * iterations + wp.where(movable, 0, 1)


@wp.kernel
def list_fast_pairs(
    threads: int,
    dt: float,
    shapes: Shapes,
    bodies: Bodies,
    state: State,
    motions: Motions,
    envs: Environments,
    suspects: Suspects,
    pairs: Pairs,
):
    """The threads share the pairs: list those that must be traced, in any order.

    A body that is hit moves otherwise, so a further iteration traces the pairs whose relative motion has changed.
    """
    iteration = suspects.iteration[0]
    for pair in range(wp.tid(), pairs.start[pairs.start.shape[0] - 1], threads):
        a = pairs.body_a[pair]
        b = pairs.body_b[pair]
        if iteration == 0 or motions.changed[a] == 1 or motions.changed[b] == 1:
            size = traced_size(a, b, shapes, bodies)
            first = course_of(a, shapes, bodies, state, motions)
            second = course_of(b, shapes, bodies, state, motions)
            change = relative_motion(latest_change(a, first, motions), latest_change(b, second, motions), dt)
            suspects.untraced[pair] += change
            if not is_followed(a, b, iteration, envs.ccd_iterations[bodies.env[a]], motions):
                continue
            if iteration > 0 and suspects.untraced[pair] <= LEFT_OF_DEPTH * ALLOWED_DEPTH * size:
                continue
            suspects.untraced[pair] = 0.0
            way = relative_motion(first, second, dt)
            if way < ALLOWED_DEPTH * size or not may_touch(shapes, first, second, dt):
                continue
            if iteration == 0 and way <= FAST_TRAVEL * size and not was_hit(a, b, first, second, size, dt, state):
                continue
            if not stays_clear(first, second, pairs.axis[pair], dt, size, shapes):
                pairs.fast[wp.atomic_add(pairs.fast_count, 0, 1)] = pair
                suspects.impact[pair] = dt
                suspects.again[0] = 1
                if not is_advanced(pair, shapes, bodies, pairs):
                    suspects.sampled[0] = 1


@wp.func
def courses_of(pair: int, side: int, shapes: Shapes, bodies: Bodies, state: State, motions: Motions, pairs: Pairs):
    """The courses of a pair's bodies: that of its first (side 0) or second (1) body comes first."""
    a = pairs.body_a[pair]
    b = pairs.body_b[pair]
    own = course_of(wp.where(side == 0, a, b), shapes, bodies, state, motions)
    return own, course_of(wp.where(side == 0, b, a), shapes, bodies, state, motions)


@wp.func
def note_impact_of_body(b: int, changes: bool, impact: wp.int64, motions: Motions):
    """Note the first impact of a body. The joints of a mechanism stop also where its mean velocity does not change."""
    if motions.role[b] == Role.FREE and (changes or motions.joined[b] == 1):
        wp.atomic_min(motions.first_impact, b, impact)


@wp.func
def note_impact(
    pair: int,
    t: float,
    dt: float,
    shapes: Shapes,
    bodies: Bodies,
    state: State,
    pairs: Pairs,
    suspects: Suspects,
    motions: Motions,
):
    """Note an impact of a pair for those of its bodies whose motion it changes, if it is the first one of the body.

    After the first iteration, an impact after which the bodies hardly get deeper is ignored.
    """
    a = pairs.body_a[pair]
    b = pairs.body_b[pair]
    first, second = courses_of(pair, 0, shapes, bodies, state, motions, pairs)
    left = relative_motion(first, second, dt - t)
    wp.atomic_max(suspects.untraced, pair, left)
    if suspects.iteration[0] > 0 and left <= LEFT_OF_DEPTH * ALLOWED_DEPTH * traced_size(a, b, shapes, bodies):
        return
    impact = wp.int64(t / dt * UNITS_OF_TIME) * PAIR_NUMBERS + wp.int64(pair)
    first = onward_course(a, shapes, bodies, state, motions)
    second = onward_course(b, shapes, bodies, state, motions)
    share = common_share(a, b, first, second, motions)
    free = lead_of(a, motions) != lead_of(b, motions) or lead_of(a, motions) == 0
    note_impact_of_body(a, free and share > 0.0, impact, motions)
    note_impact_of_body(b, free and share < 1.0, impact, motions)


@wp.func
def passage_of_body(
    pair: int, side: int, dt: float, shapes: Shapes, bodies: Bodies, state: State, motions: Motions, pairs: Pairs
):
    """The courses of a pair's bodies, as `courses_of`, and the relative motion of the first of these."""
    own, other = courses_of(pair, side, shapes, bodies, state, motions, pairs)
    size = traced_size(pairs.body_a[pair], pairs.body_b[pair], shapes, bodies)
    return own, other, passage_of(own, other, dt, size, pairs.contact_count[pair] > 0, shapes)


@wp.kernel
def advance_solids(
    teams: int,
    lanes: int,
    dt: float,
    shapes: Shapes,
    bodies: Bodies,
    state: State,
    pairs: Pairs,
    suspects: Suspects,
    motions: Motions,
):
    """The teams share the listed pairs: note the first impact of those of convex solids.

    Each lane takes a part of the step. Those after the impact end at once, and a pair that needs many advances does not
    keep the others waiting.
    """
    lane = wp.tid() % lanes
    begin = dt * float(lane) / float(lanes)
    end = dt * float(lane + 1) / float(lanes)
    for k in range(wp.tid() / lanes, pairs.fast_count[0], teams):
        pair = pairs.fast[k]
        if is_advanced(pair, shapes, bodies, pairs):
            a = pairs.body_a[pair]
            b = pairs.body_b[pair]
            first, second = courses_of(pair, 0, shapes, bodies, state, motions, pairs)
            if symmetry_of(a, shapes, bodies) == Symmetry.BALL:
                first.angular = wp.vec3(0.0, 0.0, 0.0)
            if symmetry_of(b, shapes, bodies) == Symmetry.BALL:
                second.angular = wp.vec3(0.0, 0.0, 0.0)
            first.roll = first.angular - spin_of_surface(a, first.angular, shapes, bodies, state)
            size = traced_size(a, b, shapes, bodies)
            near = handled_gap_of_solids(first, second, size, pairs.contact_count[pair] > 0)
            t = impact_of_solids(first, second, pairs.axis[pair], near, begin, end, size, shapes)
            if t < end:
                note_impact(pair, t, dt, shapes, bodies, state, pairs, suspects, motions)


@wp.kernel
def list_reached(
    threads: int,
    dt: float,
    shapes: Shapes,
    bodies: Bodies,
    state: State,
    motions: Motions,
    pairs: Pairs,
    suspects: Suspects,
):
    """The threads share both bodies of the listed pairs: list those whose bounding sphere reaches the other body.

    The centre of a convex body is traced as a sample.
    """
    for k in range(wp.tid(), 2 * pairs.fast_count[0], threads):
        task = TraceTask()
        task.pair = pairs.fast[k / 2]
        task.side = k % 2
        task.lanes = 1
        if is_advanced(task.pair, shapes, bodies, pairs):
            continue
        own, other, passage = passage_of_body(task.pair, task.side, dt, shapes, bodies, state, motions, pairs)
        if own.radius <= UNBOUNDED_EXTENT:
            body = ball_of(own, -1, shapes)
            begin = trace_ball(shapes, own, other, -1, body, dt, passage)
            if begin < dt:
                look_at_samples(shapes, own, other, body, begin, passage, task, suspects)
                place = next_place(suspects.reached_count, 0)
                suspects.reached[place / 2, place % 2] = 2 * task.pair + task.side


@wp.kernel(cuda_max_registers=MOST_REGISTERS)
def list_clusters(
    teams: int,
    lanes: int,
    dt: float,
    shapes: Shapes,
    bodies: Bodies,
    state: State,
    motions: Motions,
    pairs: Pairs,
    suspects: Suspects,
):
    """The teams share the bodies that reach others: list their clusters that do. Those that do not fit are counted."""
    lane = wp.tid() % lanes
    for k in range(wp.tid() / lanes, suspects.reached_count[0], teams):
        body = suspects.reached[k / 2, k % 2]
        own, other, passage = passage_of_body(body / 2, body % 2, dt, shapes, bodies, state, motions, pairs)
        first = shapes.shapes[own.shape].cluster_start + lane
        for cluster in range(first, shapes.shapes[own.shape].cluster_end, lanes):
            begin = trace_ball(shapes, own, other, cluster, ball_of(own, cluster, shapes), dt, passage)
            if begin < dt:
                place = next_place(suspects.cluster_count, 0)
                if place >= 0 and place < suspects.cluster.shape[0]:
                    suspects.cluster[place] = cluster
                    suspects.cluster_body[place] = body
                    suspects.cluster_begin[place] = begin


@wp.kernel(cuda_max_registers=MOST_REGISTERS)
def list_suspects(
    which: int,
    teams: int,
    lanes: int,
    dt: float,
    shapes: Shapes,
    bodies: Bodies,
    state: State,
    motions: Motions,
    pairs: Pairs,
    wanted_row: wp.array[int],
    suspects: Suspects,
    wanted: wp.array2d[int],
):
    """The teams share the listed clusters: list their samples that must be traced. Record the number of clusters."""
    count = usable_count(wp.tid(), which, suspects.cluster_count[0], suspects.cluster.shape[0], wanted_row, wanted)
    task = TraceTask()
    task.lane = wp.tid() % lanes
    task.lanes = lanes
    for k in range(wp.tid() / lanes, count, teams):
        task.pair = suspects.cluster_body[k] / 2
        task.side = suspects.cluster_body[k] % 2
        own, other, passage = passage_of_body(task.pair, task.side, dt, shapes, bodies, state, motions, pairs)
        ball = ball_of(own, suspects.cluster[k], shapes)
        look_at_samples(shapes, own, other, ball, suspects.cluster_begin[k], passage, task, suspects)


@wp.kernel
def trace_suspects(
    which: int,
    threads: int,
    dt: float,
    shapes: Shapes,
    bodies: Bodies,
    state: State,
    pairs: Pairs,
    wanted_row: wp.array[int],
    suspects: Suspects,
    motions: Motions,
    wanted: wp.array2d[int],
):
    """The threads share the listed samples: note the first impact of each pair. Record the number of samples.

    A trace ends at the earliest impact that is known so far, which cannot change the result. If there are more samples
    than fit, the step is void, and none is traced.
    """
    count = usable_count(wp.tid(), which, suspects.count[0], suspects.pair.shape[0], wanted_row, wanted)
    for k in range(wp.tid(), count, threads):
        pair = suspects.pair[k]
        own, other = courses_of(pair, suspects.side[k], shapes, bodies, state, motions, pairs)
        size = traced_size(pairs.body_a[pair], pairs.body_b[pair], shapes, bodies)
        near = handled_gap(own, other, dt, size, pairs.contact_count[pair] > 0, shapes)
        suspect = Suspect()
        suspect.sample = suspects.sample[k]
        suspect.begin = suspects.begin[k]
        suspect.allowed = suspects.allowed[k]
        end = suspects.impact[pair]
        t = trace_suspect(shapes, own, other, suspect, near, size, end)
        if t < end:
            wp.atomic_min(suspects.impact, pair, t)
            note_impact(pair, t, dt, shapes, bodies, state, pairs, suspects, motions)


@wp.func
def time_of(impact: wp.int64):
    """Time of an impact in `first_impact`, as a fraction of the step."""
    return float(impact / PAIR_NUMBERS) / UNITS_OF_TIME


@wp.func
def motion_after(
    b: int, impact: wp.int64, dt: float, shapes: Shapes, bodies: Bodies, state: State, pairs: Pairs, motions: Motions
):
    """The motion of a body after an impact in `first_impact`."""
    pair = int(impact % PAIR_NUMBERS)
    t = dt * time_of(impact)
    return common_motion(b, pairs.body_a[pair], pairs.body_b[pair], t, dt, shapes, bodies, state, motions)


@wp.kernel
def change_courses(
    dt: float,
    shapes: Shapes,
    bodies: Bodies,
    state: State,
    envs: Environments,
    pairs: Pairs,
    suspects: Suspects,
    motions: Motions,
):
    """One thread per body: from its first impact on, it moves with the other body.

    Unless a kinematic body drives it, it stays within the reach of the broad phase. From the late iterations on, an
    immovable body leads: a body that it stopped keeps its motion, and others take that over. If instead each body that
    is hit in the last iteration stopped, the walls of a falling container would stop, and its content would pass them.
    """
    b = wp.tid()
    if motions.role[b] != Role.FREE and suspects.iteration[0] + 1 >= envs.ccd_iterations[bodies.env[b]]:
        motions.next_carried[b] = Lead.HOLDER
    impact = motions.first_impact[b]
    motions.changed[b] = wp.where(impact == NEVER, 0, 1)
    if impact == NEVER:
        return
    t = time_of(impact)
    after = motion_after(b, impact, dt, shapes, bodies, state, pairs, motions)
    first = pairs.body_a[int(impact % PAIR_NUMBERS)]
    second = pairs.body_b[int(impact % PAIR_NUMBERS)]
    if not is_driven(first, second, motions):
        after.linear *= wp.min(1.0, motions.max_travel[b] / wp.max(dt * wp.length(after.linear), 1.0e-12))
    motions.next_course[b] = t * motions.course[b] + (1.0 - t) * after.linear
    motions.next_shared_spin[b] = t * motions.shared_spin[b] + (1.0 - t) * after.angular
    motions.next_time_of_impact[b] = t * motions.time_of_impact[b]
    motions.next_carried[b] = wp.max(wp.max(lead_of(first, motions), lead_of(second, motions)) - 1, 0)
