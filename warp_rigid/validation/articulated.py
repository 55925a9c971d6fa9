"""Section K: joints against closed forms, and mechanisms that carry loads much heavier than their links."""

import math
from functools import partial
from operator import methodcaller

import numpy as np

from warp_rigid import rotations, scenes
from warp_rigid.scene.joints import DistanceJoint, FixedJoint
from warp_rigid.scene.scene import Scene
from warp_rigid.scene.shapes import Box, Sphere
from warp_rigid.scenes.builders.jointed import gaps
from warp_rigid.scenes.builders.scene_parts import body, in_space
from warp_rigid.validation.case import OUTCOME, Check, ValidationCase, absolute, at_most, case, measured, relative
from warp_rigid.validation.common import G, complete_elliptic
from warp_rigid.validation.experiment import Experiment, Start, Trace

AMPLITUDES = (5.0, 90.0)
"""Amplitudes of the pendulum [degrees]."""
WELD = 100.0
"""Force that the weld withstands [N]."""
LOADS = (0.99, 0.999, 1.001, 1.01)
"""Loads of the weld as fractions of this force."""


def cases(quick: bool) -> list[ValidationCase]:
    """All cases of the section; shorter and with fewer bodies if quick."""
    return [
        pendulums(4.2 if quick else 60.0),
        chain(20 if quick else 100, 1.0 if quick else 60.0),
        pallet(1.0 if quick else 4.0),
        crane(3.0),
        bridge(10 if quick else 50, 4.0 if quick else 16.0),
        cradle(),
        welds(),
    ]


def opened(trace: Trace) -> np.ndarray:
    """Largest gap of a joint at any record, (envs,) [m]."""
    return gaps(trace.scene, trace.position, trace.orientation).max(axis=(0, 2))


def pendulum(degrees: float) -> Scene:
    """A sphere on a rod of 1 m without mass, let go at an angle."""
    angle = math.radians(degrees)
    scene = Scene(gravity=(0, 0, -G))
    start = (math.sin(angle), 0.0, -math.cos(angle))
    ball = scene.add_body(Sphere(0.05), position=start)
    scene.add_joint(DistanceJoint(1.0, 1.0), ball, anchor=start, anchor_b=(0, 0, 0))
    return scene


def exact_period(degrees: float) -> float:
    """Period of that pendulum, by the arithmetic-geometric mean [s]."""
    return 4.0 * complete_elliptic(math.sin(math.radians(degrees) / 2.0) ** 2) / math.sqrt(G)


def period_of(trace: Trace) -> list[float]:
    """Mean time between crossings of the vertical in one direction [s]."""
    x = trace.position[:, 0, 0, 0]
    before = np.flatnonzero((x[:-1] > 0.0) & (x[1:] <= 0.0))
    crossings = trace.time[before] + trace.time[1] * x[before] / (x[before] - x[before + 1])
    return [np.diff(crossings).mean()]


def pendulums(duration: float) -> ValidationCase:
    """Period and energy of a simple pendulum."""
    experiments = tuple(Experiment(partial(pendulum, a), duration, label=f"{a:g} degrees") for a in AMPLITUDES)

    def energy(trace):
        # Velocities are half a step older than positions, so the mean of two of them belongs to a position.
        v = 0.5 * (trace.linear_velocity[1:] + trace.linear_velocity[:-1])[:, :, 0]
        height = trace.position[:-1, :, 0, 2]
        total = 0.5 * (v * v).sum(axis=-1) + G * (height + 1.0)
        return np.abs(total / total[0] - 1.0).max(axis=0)

    return case(
        "V90 Simple pendulum",
        "arithmetic-geometric mean; conservation of energy",
        measured("period", "s", period_of, relative(1e-3), [exact_period(a) for a in AMPLITUDES]),
        measured("change of energy", "", energy, at_most(1e-3)),
        of=experiments,
    )


def chain(links: int, duration: float) -> ValidationCase:
    """A chain that swings with a ball a thousand times heavier than a link."""
    experiment = Experiment(partial(scenes.load, "chain", links=links), duration, every=4)
    gap = measured("largest gap of a joint", "m", opened, at_most(1e-4))
    return case(f"V91 Chain of {links} links, 1000 : 1", "closed joints", gap, of=experiment)


def pallet(duration: float) -> ValidationCase:
    """Twelve boxes, welded in closed loops, fall and rest; mujoco_warp#1510 measured 8.6 mm in float32."""

    def drift(trace):
        own = trace.position[:, :, 1:] - trace.position[:, :, 1:2]
        back = rotations.inverse(trace.orientation[:, :, 1])[:, :, None]
        moved = rotations.rotate(back, own) - (trace.position[0, :, 1:] - trace.position[0, :, 1:2])
        return np.linalg.norm(moved, axis=-1).max(axis=(0, 2))

    experiment = Experiment(partial(scenes.load, "pallet"), duration)
    moved = measured("displacement of a box relative to the first", "m", drift, at_most(4e-5))
    return case("V92 Pallet of twelve welded boxes", "mujoco_warp#1510", moved, of=experiment)


def crane(duration: float) -> ValidationCase:
    """A crane lifts the upper box of a pile: the others must not move."""

    def moved(trace):
        return np.linalg.norm(trace.moved[:, :, :5], axis=-1).max(axis=(0, 2))

    others = measured("displacement of the other boxes", "m", moved, at_most(1e-4))
    return case("V93 Crane", "bodies at rest", others, of=Experiment(partial(scenes.load, "crane"), duration))


def bridge(planks: int, duration: float) -> ValidationCase:
    """A rope bridge under a load a thousand times heavier than a plank."""

    def speed(trace):
        return np.linalg.norm(trace.linear_velocity[-1], axis=-1).max(axis=-1)

    experiment = Experiment(partial(scenes.load, "bridge", planks=planks), duration, every=4)
    return case(
        f"V94 Rope bridge of {planks} planks, 1000 : 1",
        "closed joints, rest",
        measured("largest gap of a joint", "m", opened, at_most(1e-4)),
        measured("speed at the end", "m/s", speed, at_most(0.05)),
        of=experiment,
    )


def cradle() -> ValidationCase:
    """Newton's cradle on strings: speeds after the impact over that of the first ball before it."""

    def speeds(trace):
        speed = np.abs(trace.linear_velocity[:, 0, :, 0])
        first = int(np.argmax(speed[:, -1] > 0.5 * speed.max()))
        return speed[first + 2] / speed[:first, 0].max()

    experiment = Experiment(partial(scenes.load, "cradle"), 0.6)
    labels = tuple(f"ball {k}" for k in range(1, 6))
    check = Check("speed after the impact", "", lambda s: speeds(s[0]), absolute(0.02), [0, 0, 0, 0, 1], labels=labels)
    return case("V95 Newton's cradle on strings", "conservation of momentum and energy", check, of=experiment)


def welds() -> ValidationCase:
    """A box hangs from a weld without gravity, under loads next to the force that the weld withstands."""
    weld = methodcaller("add_joint", FixedJoint(), 0, anchor=(0, 0, 0.1), break_force=WELD)
    scene = in_space(body(Box((0.1, 0.1, 0.1)), mass=2.0), weld)
    load = np.array([[(0.0, 0.0, -WELD * share)] for share in LOADS])
    labels = tuple(f"{share:g} of the limit" for share in LOADS)
    experiment = Experiment(scene, 0.25, labels, (Start("force", load),))

    check = measured(
        "weld breaks", "", lambda t: t.displacement.max(axis=0) > 1e-3, OUTCOME, [float(share > 1.0) for share in LOADS]
    )
    return case("V96 Weld under a load", "its limit", check, of=experiment)
