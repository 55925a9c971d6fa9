"""Health checks every few steps: overlaps, energy gained without work, loads, lost precision, unsolved velocities.

They are not a stage of the recorded step: they read what it left, and change only `health` and the warnings.
"""

from enum import IntEnum

import warp as wp

from warp_rigid.kernels.common.surfaces import runs
from warp_rigid.kernels.enums import JointNumber, Motion, Role, WarningKind
from warp_rigid.kernels.joints.arrays import Joints
from warp_rigid.kernels.schema import Bodies, Environments, Graph, History, Motions, Pairs, Shapes, State
from warp_rigid.kernels.tuning import CALM_CONVERGED
from warp_rigid.kernels.update.integrate import rotational_energy
from warp_rigid.kernels.update.predict import smaller_size

wp.set_module_options({"enable_backward": False})

WATCHED_OVERLAP = wp.constant(0.05)
"""Overlap from which a contact is watched, as a fraction of the smaller body's size."""

SHRINKING = wp.constant(wp.float64(0.95))
"""An overlap that is less than this fraction of that of the last check shrinks."""

STUCK_CHECKS = wp.constant(wp.float64(4.0))
"""Consecutive checks without shrinking that make a warning."""

GAIN = wp.constant(wp.float64(0.02))
"""Gain of energy that makes a warning, as a fraction of the recent largest kinetic energy."""

LIFT = wp.constant(wp.float64(0.01))
"""The same as a height to which all bodies could be lifted, as a fraction of their size."""

FADING = wp.constant(wp.float64(0.9))
"""Factor for the largest kinetic energy from one check to the next."""

COARSE = wp.constant(5.0e-3)
"""Distance of neighbouring positions that makes a warning, as a fraction of a body's largest extent."""

UNSOLVED = wp.constant(0.1)
"""Residual that makes a warning, as a fraction of the velocity that gravity adds in a step. Boxes on a light tray that
slide with 15 % of it stop a third too early."""

UNSOLVED_CHECKS = wp.constant(3)
"""Consecutive checks with such a residual that make a warning: after an impact it is large for a short time."""

HEAVIEST_LOAD = wp.constant(1.0e5)
"""Contact force on a body that makes a warning, as a multiple of its weight."""

SPACING = wp.constant(2.0**-23)
"""Largest distance of neighbouring numbers in single precision, relative to them."""


class Health(IntEnum):
    """Components of `State.health`."""

    GAINED = 0
    KINETIC = 1
    DEEPEST = 2
    CHECKS = 3


@wp.func
def is_overloaded(b: int, impulse: float, dt: float, bodies: Bodies, motions: Motions):
    """Whether the impulse of a pair in a step is too large for a dynamic body: its error exceeds the weight."""
    weight = bodies.mass[b] * wp.length(motions.acceleration[b])
    return weight > 0.0 and impulse > HEAVIEST_LOAD * weight * dt


@wp.kernel
def check_overlaps(threads: int, shapes: Shapes, bodies: Bodies, pairs: Pairs, history: History, motions: Motions):
    """The threads share the pairs: the deepest of the deep overlaps of each body."""
    for pair in range(wp.tid(), pairs.start[pairs.start.shape[0] - 1], threads):
        depth = float(0.0)
        for c in range(history.contact_start[pair], history.contact_start[pair + 1]):
            depth = wp.max(depth, -history.gap[c])
        a = pairs.body_a[pair]
        b = pairs.body_b[pair]
        if depth > WATCHED_OVERLAP * smaller_size(a, b, shapes, bodies):
            wp.atomic_max(motions.overlap, a, depth)
            wp.atomic_max(motions.overlap, b, depth)


@wp.kernel
def check_loads(
    dt: float,
    threads: int,
    bodies: Bodies,
    pairs: Pairs,
    history: History,
    motions: Motions,
    envs: Environments,
):
    """The threads share the pairs: overloaded bodies."""
    for pair in range(wp.tid(), pairs.start[pairs.start.shape[0] - 1], threads):
        impulse = wp.vec3(0.0, 0.0, 0.0)
        for c in range(history.contact_start[pair], history.contact_start[pair + 1]):
            impulse += history.impulse[c]
        a = pairs.body_a[pair]
        b = pairs.body_b[pair]
        env = bodies.env[a]
        if is_overloaded(a, wp.length(impulse), dt, bodies, motions):
            wp.atomic_max(envs.overloaded, env, envs.first_body[env + 1] - a)
        if is_overloaded(b, wp.length(impulse), dt, bodies, motions):
            wp.atomic_max(envs.overloaded, env, envs.first_body[env + 1] - b)


@wp.kernel
def check_drives(bodies: Bodies, joints: Joints, envs: Environments):
    """One thread per joint: whether it does work or stores energy, as a motor, a spring or a rotor."""
    j = wp.tid()
    spring = joints.numbers[j, JointNumber.STIFFNESS]
    motor = joints.numbers[j, JointNumber.DAMPING] * wp.abs(joints.numbers[j, JointNumber.TARGET_VELOCITY])
    if joints.broken[j] == 0 and spring + motor + joints.numbers[j, JointNumber.ARMATURE] > 0.0:
        wp.atomic_max(envs.driven, bodies.env[joints.body_a[j]], 1)


@wp.func
def is_coarse(center: wp.vec3, shape: int, shapes: Shapes):
    """Whether neighbouring positions are too far apart for a shape: for its largest extent, or for its thickness."""
    extent = shapes.shapes[shape].upper - shapes.shapes[shape].lower
    step = SPACING * wp.max(wp.abs(center))
    return step > COARSE * wp.max(extent) or step > shapes.shapes[shape].size


@wp.kernel
def check_bodies(shapes: Shapes, bodies: Bodies, motions: Motions, state: State, envs: Environments):
    """One thread per body: its kinetic energy, and whether its overlap does not shrink or its position is coarse."""
    b = wp.tid()
    depth = wp.float64(motions.overlap[b])
    health = state.health[b]
    if bodies.motion[b] != Motion.DYNAMIC:
        return
    if motions.role[b] != Role.FREE:
        state.health[b] = wp.vec4d(health[Health.GAINED], wp.float64(0.0), wp.float64(0.0), wp.float64(0.0))
        return
    env = bodies.env[b]
    rank = envs.first_body[env + 1] - b
    checks = wp.float64(0.0)
    if (
        depth > wp.float64(0.0)
        and depth > SHRINKING * health[Health.DEEPEST]
        and health[Health.DEEPEST] > wp.float64(0.0)
    ):
        checks = health[Health.CHECKS] + wp.float64(1.0)
    v = wp.vec3d(state.linear_velocity[b])
    w = wp.vec3d(state.angular_velocity[b])
    kinetic = wp.float64(0.5 * bodies.mass[b]) * wp.dot(v, v) + rotational_energy(
        wp.quatd(state.orientation[b]), w, bodies.inertia[b]
    )
    state.health[b] = wp.vec4d(health[Health.GAINED], kinetic, depth, checks)
    if checks >= STUCK_CHECKS:
        wp.atomic_max(envs.stuck, env, rank)
    if is_coarse(motions.center[b], bodies.shape[b], shapes):
        wp.atomic_max(envs.coarse, env, rank)


@wp.func
def warn(env: int, kind: int, body: int, envs: Environments):
    """Record the first warning of a kind: the number of completed steps, and the body."""
    steps = envs.warned_step[env]
    bodies = envs.warned_body[env]
    if steps[kind] == 0:
        steps[kind] = envs.step[env]
        bodies[kind] = body
        envs.warned_step[env] = steps
        envs.warned_body[env] = bodies


@wp.func
def check_energy(env: int, shapes: Shapes, bodies: Bodies, motions: Motions, state: State, envs: Environments):
    """Compare the energy gained without work, summed over the bodies, with its least value.

    Contacts only take energy, so the sum only falls, apart from rounding and the errors of the solver. Bodies and
    ground that are moved do work on others; then the sum starts anew.
    """
    gained = wp.float64(0.0)
    kinetic = wp.float64(0.0)
    lift = wp.float64(0.0)
    driven = envs.driven[env]
    envs.driven[env] = 0
    fastest = int(0)
    most = wp.float64(-1.0)
    first = envs.first_body[env]
    for b in range(first, envs.first_body[env + 1]):
        health = state.health[b]
        if bodies.motion[b] != Motion.DYNAMIC:
            moved = health[Health.GAINED] > wp.float64(0.0) or shapes.shapes[bodies.shape[b]].rise > 0.0
            if moved or runs(b, bodies):
                driven = 1
            state.health[b] = wp.vec4d()
        else:
            gained += health[Health.GAINED]
            kinetic += health[Health.KINETIC]
            weight = bodies.mass[b] * wp.length(motions.acceleration[b])
            lift += wp.float64(weight * shapes.shapes[bodies.shape[b]].size)
            if health[Health.KINETIC] > most:
                most = health[Health.KINETIC]
                fastest = b - first
    before = envs.health[env]
    largest = wp.max(kinetic, FADING * before[1])
    least = wp.min(gained, before[0])
    if driven == 1:
        least = gained
    elif gained - least > GAIN * largest + LIFT * lift:
        warn(env, WarningKind.ENERGY, fastest, envs)
    envs.health[env] = wp.vec2d(least, largest)


@wp.func
def check_residual(env: int, dt: float, motions: Motions, graph: Graph, state: State, envs: Environments):
    """Compare the recent residual with what gravity adds to a velocity in it.

    It is not done where most bodies in contact have fallen: the impulses of a pile converge over several steps. A
    change with which sweeps end is not large, however weak gravity is.
    """
    most = float(0.0)
    fastest = int(0)
    placed = int(0)
    gained = float(0.0)
    first = envs.first_body[env]
    for b in range(first, envs.first_body[env + 1]):
        if graph.touching[b] > 0:
            placed += 1 - 2 * state.fallen[b]
            gained = wp.max(gained, dt * wp.length(motions.acceleration[b]))
            speed = wp.length(state.linear_velocity[b])
            if speed > most:
                most = speed
                fastest = b - first
    large = wp.max(UNSOLVED * gained, CALM_CONVERGED * motions.velocity_unit[first])
    checks = wp.where(placed > 0 and envs.recent_residual[env] > large, envs.unsolved[env] + 1, 0)
    envs.unsolved[env] = checks
    if checks >= UNSOLVED_CHECKS:
        warn(env, WarningKind.RESIDUAL, fastest, envs)


@wp.kernel
def check_environments(
    dt: float, shapes: Shapes, bodies: Bodies, motions: Motions, graph: Graph, state: State, envs: Environments
):
    """One thread per environment: record the warnings."""
    env = wp.tid()
    count = envs.first_body[env + 1] - envs.first_body[env]
    stuck = envs.stuck[env]
    coarse = envs.coarse[env]
    overloaded = envs.overloaded[env]
    envs.stuck[env] = 0
    envs.coarse[env] = 0
    envs.overloaded[env] = 0
    if envs.failed[env] == 1:
        return
    if stuck > 0:
        warn(env, WarningKind.OVERLAP, count - stuck, envs)
    if coarse > 0:
        warn(env, WarningKind.PRECISION, count - coarse, envs)
    if overloaded > 0:
        warn(env, WarningKind.LOAD, count - overloaded, envs)
    check_energy(env, shapes, bodies, motions, state, envs)
    check_residual(env, dt, motions, graph, state, envs)
