"""Section H: bodies on feet that slide and spin until they stop."""

from functools import cache

import numpy as np

from warp_rigid.scene.shapes import Box, Compound, Sphere
from warp_rigid.scenes.builders.scene_parts import body, on_ground
from warp_rigid.validation.case import Cases, Curve, case, measured, relative
from warp_rigid.validation.common import G, first_time
from warp_rigid.validation.experiment import Experiment, Trace, of_body

MU = 0.3
RING_RADIUS, FOOT_RADIUS = 0.5, 0.005
"""Radius of the ring on which the feet stand, and of a foot [m]."""
BOX_HALF = (0.3, 0.2, 0.1)
MOTIONS = ((2.0, 0.5), (2.0, 2.0), (1.0, 4.0))
"""Speed along x [m/s], and spin about z [rad/s] times 1 m, at the start."""
STOPPED = 2e-3
"""Speed below which a body counts as stopped, of its centre and of its feet by the spin [m/s]."""


def cases(quick: bool) -> Cases:
    """All cases of the section; fewer feet if quick."""
    return [rings((3, 24) if quick else (3, 6, 12, 24)), box_on_four_corners()]


def ring_feet(count: int, radius: float = RING_RADIUS) -> np.ndarray:
    """Positions of the feet of a ring in its frame, (count, 3) [m]."""
    angle = 2.0 * np.pi * np.arange(count) / count
    return radius * np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1)


def stop(feet: np.ndarray, height: float, gyration: float, speed: float, spin: float) -> tuple[float, float, float]:
    """Time [s], way along x [m] and angle [rad] until a body on feet stops, by the equations of motion.

    Each foot is pushed back along its velocity by `MU` times its load. The loads hold the body level. Statics
    determines those of three feet; those of more feet are taken as linear in the position of the foot, as on an elastic
    ground, so that they are equal where the centre of mass is low.

    Args:
        feet: (n, 3) positions about the vertical through the centre of mass [m].
        height: of the centre of mass above the feet [m].
        gyration: radius of gyration about the vertical [m].
        speed: along x at the start [m/s].
        spin: about z at the start [rad/s].
    """
    basis = np.concatenate([np.ones((len(feet), 1)), feet[:, :2]], axis=1)
    dt, reach = 1e-4, np.linalg.norm(feet[:, :2], axis=1).max()
    state = np.array([0.0, 0.0, 0.0, speed, 0.0, spin])
    time = 0.0

    def rate(state):
        _, _, angle, vx, vy, w = state
        rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        arm = basis[:, 1:] @ rotation.T
        slip = np.stack([vx - w * arm[:, 1], vy + w * arm[:, 0]], axis=1)
        way = -slip / np.maximum(np.linalg.norm(slip, axis=1), 1e-9)[:, None]
        # Loads a + b . arm over the mass: sum g, and no torque of loads and friction about the horizontal axes.
        columns = np.concatenate([np.ones((len(arm), 1)), arm], axis=1)
        system = np.stack([columns.sum(axis=0), *((arm + height * MU * way).T @ columns)])
        load = columns @ np.linalg.solve(system, [G, 0.0, 0.0])
        push = MU * load[:, None] * way
        torque = (arm[:, 0] * push[:, 1] - arm[:, 1] * push[:, 0]).sum() / gyration**2
        return np.array([vx, vy, w, *push.sum(axis=0), torque])

    while np.hypot(state[3], state[4]) + abs(state[5]) * reach > STOPPED:
        middle = state + 0.5 * dt * rate(state)
        state = state + dt * rate(middle)
        time += dt
    return time, float(np.hypot(state[0], state[1])), float(state[2])


def stops(trace: Trace) -> np.ndarray:
    """Time [s], way [m] and angle [rad] of each environment until it stops, (3, envs)."""
    speed = np.linalg.norm(trace.linear_velocity[:, :, 1], axis=-1)
    spin = trace.angular_velocity[:, :, 1, 2]
    reach = np.linalg.norm(BOX_HALF[:2]) if isinstance(trace.scene.bodies[1].shape, Box) else RING_RADIUS
    time = first_time(trace, speed + np.abs(spin) * reach < STOPPED)
    way = np.linalg.norm(trace.position[-1, :, 1, :2] - trace.position[0, :, 1, :2], axis=-1)
    angle = np.trapezoid(spin, trace.time, axis=0)
    return np.stack([time, way, angle])


def slide(shape, height, label) -> Experiment:
    """Experiment: a body that slides and spins on level ground, an environment for each of MOTIONS."""
    scene = on_ground(body(shape, position=(0, 0, height), friction=MU), friction=MU)
    names = tuple(f"{speed:g} m/s, {w:g} rad/s" for speed, w in MOTIONS)
    velocity, spin = [(speed, 0.0, 0.0) for speed, _ in MOTIONS], [(0.0, 0.0, w) for _, w in MOTIONS]
    starts = of_body(linear_velocity=velocity, angular_velocity=spin)
    return Experiment(scene, 1.5, names, starts, label=label)


def stop_checks(*bodies):
    """Checks of time, way and angle of all experiments of a case against the equations of motion.

    Args:
        *bodies: feet, height and gyration of each experiment, as in `stop`.
    """
    kinds = (("time to stop", "s"), ("way to stop", "m"), ("angle to stop", "rad"))

    @cache
    def exact():
        """References (3, variants), computed when they are needed."""
        found = [stop(feet, height, k, *motion) for feet, height, k in bodies for motion in MOTIONS]
        return np.array(found).T

    def check(name, unit, k):
        return measured(name, unit, lambda t: stops(t)[k], relative(0.02), lambda _: exact()[k])

    return tuple(check(*kind, k) for k, kind in enumerate(kinds))


def rings(counts):
    """A light ring on feet close to the ground, all with the same load."""

    def ring(count):
        return Compound([(Sphere(FOOT_RADIUS), place, (0, 0, 0, 1)) for place in ring_feet(count)])

    return case(
        "V75 ring of feet that slides and spins, mu 0.3",
        "equations of motion with the loads of statics; Farkas 2003",
        *stop_checks(*((ring_feet(n), FOOT_RADIUS, RING_RADIUS) for n in counts)),
        of=tuple(slide(ring(n), FOOT_RADIUS, f"{n} feet") for n in counts),
        curve=Curve("speed", "m/s", lambda t: np.linalg.norm(t.linear_velocity[:, :, 1], axis=-1)),
    )


def box_on_four_corners():
    """A box on its four lower corners, whose loads follow from statics."""
    corners = np.array([(x, y, 0.0) for x in (-BOX_HALF[0], BOX_HALF[0]) for y in (-BOX_HALF[1], BOX_HALF[1])])
    gyration = np.sqrt((BOX_HALF[0] ** 2 + BOX_HALF[1] ** 2) / 3.0)
    return case(
        "V75 box on its four corners that slides and spins, mu 0.3",
        "equations of motion with the loads of statics",
        *stop_checks((corners, BOX_HALF[2], gyration)),
        of=slide(Box(BOX_HALF), BOX_HALF[2], ""),
        curve=Curve("speed", "m/s", lambda t: np.linalg.norm(t.linear_velocity[:, :, 1], axis=-1)),
    )
