"""Section I: bodies on conveyor belts, which are static bodies whose surface runs."""

from collections.abc import Callable
from functools import cache, partial
from typing import Any

import numpy as np

from warp_rigid.engine.settings import Settings
from warp_rigid.engine.simulator import Simulator
from warp_rigid.scene.scene import Scene
from warp_rigid.scene.shapes import Box, Compound, Sphere
from warp_rigid.scenes.builders.scene_parts import body, in_space, static
from warp_rigid.validation.case import Cases, Check, Curve, absolute, case, measured, relative
from warp_rigid.validation.common import G, first_time
from warp_rigid.validation.experiment import DT, Experiment, Start, Trace, per_env
from warp_rigid.validation.sliding import ring_feet

HALF = 0.1
BELTS = ((0.5, 0.3), (1.0, 0.5), (2.0, 0.5), (2.0, 0.8))
"""Speed [m/s] and friction of the belts with one parcel each."""
STACK_FRICTION, STACK_TIME = 0.2, 1.0
"""Friction of the belt below a stack, which topples from 1/3 on, and the time for which it runs at 1 m/s [s]."""
RADIUS, FOOT, PLATE_FRICTION, PLATE_TIME = 0.3, 0.005, 0.3, 0.35
"""Of a plate on three feet: distance of the feet from its centre and their radius [m], friction, time compared [s]."""


def cases(quick: bool) -> Cases:
    """All cases of the section; at one time step if quick."""
    return [parcels((DT,) if quick else (1 / 60, DT, 1 / 960)), stack(), plate_across_the_edge()]


def on_belt(*bodies, friction: float = 0.5) -> Callable[[], Scene]:
    """A function that builds a scene: a belt along x at rest, with its upper face at z = 0, and bodies on it."""
    belt = static(Box((10, 1, 0.1)), position=(0, 0, -0.1), friction=friction, name="belt")
    return in_space(belt, *bodies, gravity=(0, 0, -G))


def slip_by_steps(speed: float, friction: float, dt: float) -> float:
    """Way of the belt less that of a parcel, by the steps with which the parcel gets its speed [m]."""
    gained = friction * G * dt * np.arange(1, int(speed / (friction * G * dt)) + 2)
    return float(dt * (speed - np.minimum(gained, speed)).sum())


def parcels(steps):
    """A parcel at rest on a running belt accelerates until it moves with it."""
    speed, friction = np.array(BELTS).T
    velocity = np.zeros((len(BELTS), 1, 3))
    velocity[:, 0, 0] = speed
    scene = on_belt(body(Box((HALF,) * 3), position=(0, 0, HALF)))
    names = tuple(f"{v:g} m/s, mu {mu:g}" for v, mu in BELTS)
    starts = Start("surface_velocity", velocity, bodies=["belt"]), per_env("friction", friction)

    def arrival(trace: Trace) -> np.ndarray:
        """Time of the last step that still accelerates, and of the share of the next one [s]."""
        moving = trace.linear_velocity[:, :, 1, 0]
        whole = first_time(trace, moving > speed * (1.0 - 1e-4)) - trace.experiment.dt
        before = moving[np.rint(whole / trace.experiment.dt).astype(int), np.arange(len(speed))]
        return whole + (speed - before) / (friction * G)

    def slip(trace: Trace) -> np.ndarray:
        return speed * trace.time[-1] - trace.position[-1, :, 1, 0]

    in_time = np.tile(speed / (friction * G), len(steps))
    by_steps = [slip_by_steps(v, mu, dt) for dt in steps for v, mu in BELTS]
    return case(
        "V108 parcel on a belt",
        "Coulomb's law: v / (mu g), and the sum of the steps for v^2 / (2 mu g)",
        measured("time to the speed of the belt", "s", arrival, relative(0.01), in_time),
        measured("slip until then", "m", slip, relative(0.01), by_steps),
        of=[Experiment(scene, 0.6, names, starts, dt=dt, label=f"dt 1/{round(1 / dt)}") for dt in steps],
        curve=Curve("speed", "m/s", lambda t: t.linear_velocity[:, :, 1, 0]),
    )


def stack():
    """A stack of three on a belt that starts and stops: it travels as far as the belt."""

    def compute(device: str) -> Any:
        boxes = [body(Box((HALF,) * 3), position=(0, 0, HALF * (1 + 2 * k)), friction=0.8) for k in range(3)]
        sim = Simulator(on_belt(*boxes, friction=STACK_FRICTION)(), settings=Settings(dt=DT), device=device)
        for velocity in (1.0, 0.0):
            sim.set("surface_velocity", (velocity, 0, 0), bodies=["belt"])
            sim.step(round(STACK_TIME / DT))
        return sim.get("position")[0, 1:].astype(np.float64)

    return case(
        "V108 stack of three on a belt that starts and stops",
        "Coulomb's law: what the start takes from the way, the stop returns",
        Check("way", "m", lambda place: place[:, 0], relative(0.01), STACK_TIME),
        Check("shift within the stack", "m", lambda place: place[:, 0] - place[0, 0], absolute(1e-3)),
        Check("height", "m", lambda place: place[:, 2], relative(0.01), HALF * np.array([1, 3, 5])),
        compute=compute,
        labels=("lower", "middle", "upper"),
    )


@cache
def plate_motion() -> tuple[float, float, float]:
    """Place x, y [m] and angle [rad] of the plate after PLATE_TIME, by the equations of motion.

    The three loads are equal, as the feet are low. Each foot is pushed by PLATE_FRICTION times its load against its
    velocity relative to the surface below it, which runs along y at 1 m/s where x < 0.
    """
    dt, state, feet = 1e-5, np.zeros(6), ring_feet(3, RADIUS)
    for _ in range(round(PLATE_TIME / dt)):
        angle, spin = state[2], state[5]
        rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        arm = feet[:, :2] @ rotation.T
        slip = state[3:5] + spin * np.stack([-arm[:, 1], arm[:, 0]], axis=1)
        slip[:, 1] -= np.where(state[0] + arm[:, 0] < 0.0, 1.0, 0.0)
        push = -PLATE_FRICTION * G / 3.0 * slip / np.maximum(np.linalg.norm(slip, axis=1), 1e-9)[:, None]
        torque = (arm[:, 0] * push[:, 1] - arm[:, 1] * push[:, 0]).sum() / RADIUS**2
        state[3:] += dt * np.array([*push.sum(axis=0), torque])
        state[:3] += dt * state[3:]
    return float(state[0]), float(state[1]), float(state[2])


def plate_across_the_edge():
    """A plate on three feet, two of which are on a belt and one on the table beside it, which turns the plate."""
    table = partial(static, Box((1, 1, 0.1)), friction=PLATE_FRICTION)
    belt = table(position=(-1, 0, -0.1), surface_velocity=(0, 1, 0))
    plate = Compound([(Sphere(FOOT), place, (0, 0, 0, 1)) for place in ring_feet(3, RADIUS)])
    on_feet = body(plate, position=(0, 0, FOOT), friction=PLATE_FRICTION)
    scene = in_space(belt, table(position=(1, 0, -0.1)), on_feet, gravity=(0, 0, -G))

    def motion(trace: Trace) -> np.ndarray:
        x, y, _ = trace.position[-1, 0, 2]
        return np.array([x, y, np.trapezoid(trace.angular_velocity[:, 0, 2, 2], trace.time)])

    return case(
        "V108 plate on three feet across the edge of a belt",
        "equations of motion with equal loads",
        measured("way along the belt", "m", lambda t: motion(t)[1:2], relative(0.02), lambda _: plate_motion()[1]),
        measured("angle", "rad", lambda t: motion(t)[2:], relative(0.02), lambda _: plate_motion()[2]),
        of=Experiment(scene, PLATE_TIME),
        curve=Curve("angular velocity", "rad/s", lambda t: t.angular_velocity[:, :, 2, 2]),
    )
