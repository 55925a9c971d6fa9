"""Contact impulses: projected Gauss-Seidel with the exact Coulomb cone.

A contact keeps its accumulated impulse (normal, two tangents). A visit first lets the normal part take away what
approach remains beyond the gap, never pulling; then the tangential part takes away the slip, inside the disk of radius
friction times normal part. Sticking is tried with the full tangential matrix, as in Guendelman et al. 2003, section 7;
if it leaves the disk, a projected step of the smallest safe length is taken, whose fixed point opposes the slip.

A team of lanes solves an environment. Its lanes share the pairs of a colour, which have no body in common, and meet
before the next colour; a lane keeps the two bodies of its pair at hand while it visits their contacts.
"""

import warp as wp

from warp_rigid.kernels.common.arithmetic import inverse_root, quotient, root
from warp_rigid.kernels.common.packed import (
    ANGULAR_IMPULSE,
    IMPULSE,
    VELOCITY,
    contact_row,
    entry_at,
    first_three,
    impulse_of,
    inverse_inertia_of,
    put_solver_body_quad,
    set_impulse,
    solver_body_quad,
)
from warp_rigid.kernels.common.tangents import world_vector
from warp_rigid.kernels.common.team import Team, any_of_team, sync_team, team_of
from warp_rigid.kernels.enums import ShockMode
from warp_rigid.kernels.schema import (
    COLORS,
    ContactRecord,
    Contacts,
    Environments,
    Graph,
    Motions,
    Order,
    PairRecord,
    State,
)

wp.set_module_options({"enable_backward": False})

CONVERGED = wp.constant(1.0e-6)
"""Contacts are solved when no visit changes a velocity by more than this [m/s]."""

DEEP = wp.constant(40.0)
"""Height of a heap from which it has to be solved to SETTLED, in bodies."""

COARSEST = wp.constant(25.0)
"""Times SETTLED to which a low heap has to be solved, at most."""

INEFFECTIVE_STEPS = wp.constant(8)
"""Steps in a row without use of shock propagation that make a heap of an island."""

SHOCK_INEFFECTIVE_SWEEPS = wp.constant(2)
"""More sweeps of a heap for each body on the shortest way down, since weight travels in it by sweeps alone. Without
them, a heap of thousands never comes to rest: it sinks into itself as fast as it is pushed apart."""


IN_TURN = wp.constant(COLORS - 1)
"""The colour of pairs that have to be solved one after another."""


@wp.struct
class BodyPair:
    """The two bodies of a pair at hand. A body that does not answer has no inverse mass.

    Nor does one that is frozen; `held` and `held_turn` are the impulses that it did not take [N s, N m s].
    """

    linear_a: wp.vec3
    angular_a: wp.vec3
    linear_b: wp.vec3
    angular_b: wp.vec3
    inverse_mass_a: float
    inverse_mass_b: float
    inverse_inertia_a: wp.mat33
    inverse_inertia_b: wp.mat33
    held: wp.vec3
    held_turn: wp.vec3
    change: float


@wp.func
def load_bodies(a: int, b: int, share_a: float, share_b: float, motions: Motions):
    """Fetch two bodies; one whose share is 0 is frozen."""
    body_pair = BodyPair()
    q = solver_body_quad(motions.solver_bodies, a, VELOCITY)
    body_pair.linear_a = first_three(q)
    body_pair.inverse_mass_a = wp.where(share_a > 0.0, q[3], 0.0)
    body_pair.angular_a = first_three(solver_body_quad(motions.solver_bodies, a, VELOCITY + 1))
    q = solver_body_quad(motions.solver_bodies, b, VELOCITY)
    body_pair.linear_b = first_three(q)
    body_pair.inverse_mass_b = wp.where(share_b > 0.0, q[3], 0.0)
    body_pair.angular_b = first_three(solver_body_quad(motions.solver_bodies, b, VELOCITY + 1))
    if share_a > 0.0:
        body_pair.inverse_inertia_a = inverse_inertia_of(a, motions)
    if share_b > 0.0:
        body_pair.inverse_inertia_b = inverse_inertia_of(b, motions)
    return body_pair


@wp.func
def store_bodies(a: int, b: int, body_pair: BodyPair, motions: Motions):
    """Store the velocities of the bodies that answer."""
    if body_pair.inverse_mass_a > 0.0:
        put_solver_body_quad(motions.solver_bodies, a, VELOCITY, body_pair.linear_a, body_pair.inverse_mass_a)
        put_solver_body_quad(motions.solver_bodies, a, VELOCITY + 1, body_pair.angular_a, 0.0)
    if body_pair.inverse_mass_b > 0.0:
        put_solver_body_quad(motions.solver_bodies, b, VELOCITY, body_pair.linear_b, body_pair.inverse_mass_b)
        put_solver_body_quad(motions.solver_bodies, b, VELOCITY + 1, body_pair.angular_b, 0.0)


@wp.func
def slip_between(row: ContactRecord, body_pair: BodyPair):
    """Velocity of the first body relative to the second at a contact."""
    va = body_pair.linear_a + wp.cross(body_pair.angular_a, row.arm_a)
    return va - body_pair.linear_b - wp.cross(body_pair.angular_b, row.arm_b) + row.surface


@wp.func
def with_impulse(row: ContactRecord, impulse: wp.vec3, body_pair: BodyPair):
    """The bodies after a world impulse on the first at a contact, and its opposite on the second."""
    body_pair.linear_a += body_pair.inverse_mass_a * impulse
    body_pair.angular_a += body_pair.inverse_inertia_a * wp.cross(row.arm_a, impulse)
    body_pair.linear_b -= body_pair.inverse_mass_b * impulse
    body_pair.angular_b -= body_pair.inverse_inertia_b * wp.cross(row.arm_b, impulse)
    return body_pair


@wp.func
def with_angular_impulse(angular_impulse: wp.vec3, body_pair: BodyPair):
    """The bodies after a world angular impulse on the first, and its opposite on the second."""
    body_pair.angular_a += body_pair.inverse_inertia_a * angular_impulse
    body_pair.angular_b -= body_pair.inverse_inertia_b * angular_impulse
    return body_pair


@wp.func
def friction_impulse(old: wp.vec2, slip: wp.vec2, k: wp.vec3, limit: float):
    """New tangential impulse from the old one, the slip, the tangential matrix (11, 12, 22) and the disk's radius."""
    inverse = quotient(1.0, wp.max(k[0] * k[2] - k[1] * k[1], 1.0e-30))
    stick = old - inverse * wp.vec2(k[2] * slip[0] - k[1] * slip[1], k[0] * slip[1] - k[1] * slip[0])
    if wp.length_sq(stick) <= limit * limit:
        return stick
    mean = 0.5 * (k[0] + k[2])
    deviation = 0.5 * (k[0] - k[2])
    largest = mean + root(deviation * deviation + k[1] * k[1])
    slide = old - quotient(1.0, largest) * slip
    squared = wp.length_sq(slide)
    if squared > limit * limit:
        slide = slide * (limit * inverse_root(squared))
    return slide


@wp.func
def resist_turning(c: int, load: float, row: ContactRecord, body_pair: BodyPair, contacts: Contacts):
    """Rolling and spinning friction: torques up to a coefficient [m] times the normal impulse."""
    n = row.normal
    u = row.tangent
    v = wp.cross(n, u)
    k = body_pair.inverse_inertia_a + body_pair.inverse_inertia_b
    old = impulse_of(c, ANGULAR_IMPULSE, contacts)
    limit = row.spinning_friction * load
    spin = wp.dot(body_pair.angular_a - body_pair.angular_b, n)
    about_normal = wp.clamp(old[0] - quotient(spin, wp.max(wp.dot(n, k * n), 1.0e-30)), -limit, limit)
    body_pair = with_angular_impulse((about_normal - old[0]) * n, body_pair)
    spins = body_pair.angular_a - body_pair.angular_b
    matrix = wp.vec3(wp.dot(u, k * u), wp.dot(u, k * v), wp.dot(v, k * v))
    slip = wp.vec2(wp.dot(spins, u), wp.dot(spins, v))
    rolling = friction_impulse(wp.vec2(old[1], old[2]), slip, matrix, row.rolling_friction * load)
    body_pair = with_angular_impulse((rolling[0] - old[1]) * u + (rolling[1] - old[2]) * v, body_pair)
    new = wp.vec3(about_normal, rolling[0], rolling[1])
    set_impulse(c, ANGULAR_IMPULSE, new, contacts)
    if body_pair.inverse_mass_a * body_pair.inverse_mass_b == 0.0:
        body_pair.held_turn += wp.where(body_pair.inverse_mass_a > 0.0, -1.0, 1.0) * world_vector(n, u, new - old)
    return body_pair


@wp.func
def solve_contact(c: int, share_a: float, share_b: float, body_pair: BodyPair, contacts: Contacts):
    """Solve one contact against the velocities at hand; notes by how much it changed them [m/s].

    A share of 0 freezes that body: it weighs nothing in the contact, and what it did not take is held.
    """
    row = contact_row(c, contacts)
    k_normal = share_a * row.normal_a + share_b * row.normal_b
    if k_normal < 1.0e-12:
        return body_pair
    n = row.normal
    u = row.tangent
    v = wp.cross(n, u)
    old = impulse_of(c, IMPULSE, contacts)
    slip = slip_between(row, body_pair)
    normal = wp.max(old[0] - quotient(wp.dot(slip, n) + row.bias_velocity, k_normal), 0.0)
    gained = normal - old[0]
    coupling = gained * (share_a * row.coupling_a + share_b * row.coupling_b)
    k = share_a * row.tangent_a + share_b * row.tangent_b
    before = wp.vec2(old[1], old[2])
    sliding = wp.vec2(wp.dot(slip, u), wp.dot(slip, v)) + coupling
    after = friction_impulse(before, sliding, k, row.friction * normal)
    impulse = gained * n + (after[0] - old[1]) * u + (after[1] - old[2]) * v
    body_pair = with_impulse(row, impulse, body_pair)
    set_impulse(c, IMPULSE, wp.vec3(normal, after[0], after[1]), contacts)
    if share_a == 0.0:
        body_pair.held += impulse
        body_pair.held_turn += wp.cross(row.arm_a, impulse)
    if share_b == 0.0:
        body_pair.held -= impulse
        body_pair.held_turn -= wp.cross(row.arm_b, impulse)
    if row.rolling_friction + row.spinning_friction > 0.0:
        body_pair = resist_turning(c, normal, row, body_pair, contacts)
    change = k_normal * wp.abs(gained) + (k[0] + k[2]) * (wp.abs(after[0] - old[1]) + wp.abs(after[1] - old[2]))
    body_pair.change = wp.max(body_pair.change, change)
    return body_pair


@wp.func
def tolerance_without_shock(env: int, graph: Graph):
    """Change of a velocity in a visit with which a heap counts as solved [m/s].

    A sweep brings bodies n high nearer to the solution by about 1 / n^2, so what is left is n^2 times what the last
    sweep changed: in a low heap little, of the size of what positions are rounded to.
    """
    ratio = DEEP / float(wp.max(graph.max_depth[env], 1))
    return CONVERGED * wp.clamp(ratio * ratio, 1.0, COARSEST)


@wp.func
def solve_pair(entry: PairRecord, motions: Motions, contacts: Contacts):
    """Visit the contacts of a pair, one after another. Returns by how much they changed a velocity [m/s]."""
    body_pair = load_bodies(entry.body_a, entry.body_b, 1.0, 1.0, motions)
    for c in range(entry.begin, entry.end):
        body_pair = solve_contact(c, 1.0, 1.0, body_pair, contacts)
    store_bodies(entry.body_a, entry.body_b, body_pair, motions)
    return body_pair.change


@wp.func
def first_of_color(color: int, team: Team, order: Order):
    """Where in the order a lane begins with a colour. Pairs that have to be solved in turn are the first lane's."""
    if color == IN_TURN and team.lane > 0:
        return order.color_start[team.env, color + 1]
    return order.color_start[team.env, color] + team.lane


@wp.func
def stride_of_color(color: int, team: Team):
    """How far a lane goes from one pair of a colour to its next."""
    return wp.where(color == IN_TURN, 1, team.lanes)


@wp.func
def forget_visits(first: int, last: int, team: Team, order: Order, graph: Graph):
    """Begin to keep account of visits: all bodies, from `first` to before `last`, have changed, no pair was visited."""
    for b in range(first + team.lane, last, team.lanes):
        graph.changed[b] = 1
    begin = order.color_start[team.env, 0]
    for k in range(begin + team.lane, order.color_start[team.env, order.color_count[team.env]], team.lanes):
        order.entries[k].visited = 0


@wp.func
def is_done(entry: PairRecord, graph: Graph):
    """Whether a pair was solved after its bodies last changed."""
    return entry.visited >= wp.max(graph.changed[entry.body_a], graph.changed[entry.body_b])


@wp.func
def solved_turn(color: int, turn: int):
    """The turn to note in a pair that is solved now; of those solved one after another, the next may undo it."""
    return wp.where(color == IN_TURN, turn - 1, turn)


@wp.func
def note_change(b: int, turn: int, motions: Motions, graph: Graph):
    """Remember when the velocity changed that others see of a dynamic body."""
    if solver_body_quad(motions.solver_bodies, b, VELOCITY)[3] > 0.0:
        graph.changed[b] = turn


@wp.kernel
def warm_start(
    lanes: int,
    bodies_per_env: int,
    envs: Environments,
    order: Order,
    graph: Graph,
    motions: Motions,
    contacts: Contacts,
):
    """A team an environment: apply the impulses that the contacts start from."""
    team = team_of(wp.tid(), lanes, graph.gate)
    env = team.env
    if envs.warm_starting[env] == 0:
        return
    for color in range(order.color_count[env]):
        stride = stride_of_color(color, team)
        for k in range(first_of_color(color, team, order), order.color_start[env, color + 1], stride):
            entry = entry_at(k, order.entries)
            body_pair = load_bodies(entry.body_a, entry.body_b, 1.0, 1.0, motions)
            for c in range(entry.begin, entry.end):
                row = contact_row(c, contacts)
                body_pair = with_impulse(
                    row, world_vector(row.normal, row.tangent, impulse_of(c, IMPULSE, contacts)), body_pair
                )
                body_pair = with_angular_impulse(
                    world_vector(row.normal, row.tangent, impulse_of(c, ANGULAR_IMPULSE, contacts)), body_pair
                )
            store_bodies(entry.body_a, entry.body_b, body_pair, motions)
        sync_team(team)


@wp.func
def sweep(level: int, team: Team, order: Order, graph: Graph, motions: Motions, contacts: Contacts):
    """Visit all pairs once, or those of one level, if it is not 0. Returns a lane's largest change [m/s]."""
    change = float(0.0)
    for color in range(order.color_count[team.env]):
        stride = stride_of_color(color, team)
        for k in range(first_of_color(color, team, order), order.color_start[team.env, color + 1], stride):
            entry = entry_at(k, order.entries)
            if level == 0 or wp.max(graph.level[entry.body_a], graph.level[entry.body_b]) == level:
                change = wp.max(change, solve_pair(entry, motions, contacts))
        sync_team(team)
    return change


@wp.func
def find_shock_ineffective(bodies_per_env: int, team: Team, state: State, graph: Graph):
    """Note whether shock propagation has been of no use to any island of an environment."""
    first = team.env * bodies_per_env
    found = int(0)
    for b in range(first + team.lane, first + bodies_per_env, team.lanes):
        found |= wp.where(state.shock_ineffective_steps[b] >= INEFFECTIVE_STEPS, 1, 0)
    found = any_of_team(found, team)
    if team.lane == 0:
        graph.shock_ineffective[team.env] = found
    sync_team(team)


@wp.func
def sweeps_of(env: int, after_shock: int, envs: Environments, graph: Graph):
    """Most sweeps before or after shock propagation."""
    iterations = envs.contact_iterations[env]
    if envs.shock_propagation[env] != ShockMode.TWO_PASS:
        return iterations * (1 - after_shock)
    if after_shock == 0:
        return (iterations + 1) / 2
    if graph.converged[env] == 1:
        return 0
    return iterations / 2 + SHOCK_INEFFECTIVE_SWEEPS * graph.max_depth[env] * graph.shock_ineffective[env]


@wp.func
def spare_sweeps(env: int, envs: Environments, graph: Graph):
    """Sweeps that follow at once in a heap of which the first half leaves little."""
    return wp.where(
        envs.shock_propagation[env] == ShockMode.TWO_PASS,
        graph.shock_ineffective[env] * envs.contact_iterations[env] / 2,
        0,
    )


@wp.kernel
def sweep_contacts(
    after_shock: int,
    lanes: int,
    bodies_per_env: int,
    envs: Environments,
    order: Order,
    graph: Graph,
    motions: Motions,
    contacts: Contacts,
    state: State,
):
    """A team an environment: half of the contact iterations, before or after the two passes of shock propagation.

    A single pass comes after all of them, as in 2003: what it has frozen is not to be moved again, and sweeps prepare
    it best from the ground up. Sweeps end early when one changes nothing, and what is settled then needs no shock
    propagation. Nor do heaps of which the first half leaves little: there the second half follows at once.
    """
    team = team_of(wp.tid(), lanes, graph.gate)
    env = team.env
    spare = int(0)
    if after_shock == 0:
        find_shock_ineffective(bodies_per_env, team, state, graph)
        spare = spare_sweeps(env, envs, graph)
    left = sweeps_of(env, after_shock, envs, graph)
    layered = wp.where(envs.shock_propagation[env] == ShockMode.ONE_PASS, 1, 0)
    unsolved = int(1)
    calm = int(0)
    while left > 0:
        change = float(0.0)
        for level in range(layered, layered * graph.level_count[env] + 1):
            change = wp.max(change, sweep(level, team, order, graph, motions, contacts))
        unsolved = any_of_team(wp.where(change > CONVERGED, 1, 0), team)
        left = unsolved * (left - 1)
        if left == 0 and unsolved * spare > 0:
            calm = 1 - any_of_team(wp.where(change > tolerance_without_shock(env, graph), 1, 0), team)
            left = calm * spare
            spare = 0
    if after_shock == 0 and team.lane == 0:
        graph.converged[env] = wp.max(1 - unsolved, calm)
