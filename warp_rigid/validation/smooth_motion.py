"""Section I: bodies that roll over cells, land flush on each other, and are carried along circles."""

from operator import methodcaller

import numpy as np

from warp_rigid.scene.shapes import Box, Cylinder, Heightfield, Sphere
from warp_rigid.scenes.builders.grounds import EARTH
from warp_rigid.scenes.builders.scene_parts import body, in_space, static
from warp_rigid.validation.case import Cases, ValidationCase, absolute, at_most, case, measured
from warp_rigid.validation.experiment import Experiment

RADIUS, SPEED = 0.05, 1.5
HALF, SPIN = 0.05, 2.0
PLACES = (0.2, 0.4, 0.6, 0.9)
"""Distances of the boxes on a turntable from its axis, below the friction limit of 1.23 m [m]."""


def cases(quick: bool) -> Cases:
    """All cases of the section; fewer time steps if quick."""
    steps = (1 / 60, 1 / 240) if quick else (1 / 60, 1 / 120, 1 / 240, 1 / 480)
    return [rolling(steps), flush_landing(), turntable(steps, 2.0 if quick else 10.0)]


def rolling(steps) -> ValidationCase:
    """A ball that rolls over a height field of small cells."""
    motion = {"linear_velocity": (SPEED, 0, 0), "angular_velocity": (0, SPEED / RADIUS, 0)}
    ball = body(Sphere(RADIUS), position=(-1.13, 0.003, RADIUS), friction=1.0, **motion)

    def scene(cells: int):
        flat = Heightfield(np.zeros((cells + 1, cells + 1)), (4, 4))
        return in_space(static(flat, friction=1.0), ball, gravity=EARTH)

    experiments = tuple(
        Experiment(scene(cells), duration=1.5, dt=dt, label=f"{4 / cells:g} m, dt 1/{1 / dt:.0f}")
        for cells in (40, 320)
        for dt in steps
    )
    return case(
        "V100 ball that rolls over the triangles of flat ground",
        "free motion, closed form",
        measured("speed after 1.5 s", "m/s", lambda t: t.linear_velocity[-1, :, 1, 0], absolute(1e-3 * SPEED), SPEED),
        measured("error of the height", "m", lambda t: np.abs(t.position[:, :, 1, 2] - RADIUS).max(0), at_most(1e-4)),
        of=experiments,
    )


def flush_landing() -> ValidationCase:
    """A box that lands flush on a box of equal or double width, or bounces elastically on a narrower one."""

    def fall(label: str, ratio: float, drop: float, **surface) -> Experiment:
        below = static(Box((2 * HALF * ratio,) * 3), position=(0, 0, 2 * HALF * ratio), **surface)
        box = body(Box((2 * HALF,) * 3), position=(0, 0, 4 * HALF * ratio + 2 * HALF + drop), **surface)
        return Experiment(in_space(below, box, gravity=EARTH), duration=1.0, label=label)

    landings = [fall(f"width {ratio:g} : 1", ratio, 0.15, friction=0.6) for ratio in (1.0, 2.0)]
    bounces = [
        fall(f"overhang {far:g} : 1, elastic, friction {mu:g}", 1 / far, 2.5, friction=mu, restitution=1.0)
        for far in (2.0, 5.0, 10.0)
        for mu in (0.0, 0.5)
    ]
    return case(
        "V101 box that lands flush on an equal or wider box, or bounces on a narrower one",
        "symmetry",
        measured("largest spin", "rad/s", lambda t: np.abs(t.angular_velocity[:, :, 1]).max((0, 2)), at_most(1e-4)),
        measured("drift", "m", lambda t: np.abs(t.position[-1, :, 1, :2]).max(1), at_most(1e-4)),
        of=(*landings, *bounces),
    )


def turntable(steps, duration: float) -> ValidationCase:
    """Boxes that a turntable carries."""
    spinning = {"angular_velocity": (0, 0, SPIN), "friction": 0.5}
    table = methodcaller("add_kinematic", Cylinder(1.0, 0.05), position=(0, 0, -0.05), **spinning)

    def box(k: int, radius: float):
        way = np.array([np.cos(k), np.sin(k), 0.0])
        velocity = SPIN * radius * np.array([-way[1], way[0], 0])
        return body(Box((HALF,) * 3), position=radius * way + (0, 0, HALF), linear_velocity=velocity, **spinning)

    scene = in_space(table, *(box(*one) for one in enumerate(PLACES)), gravity=EARTH)

    def creep(trace):
        radius = np.linalg.norm(trace.position[:, :, 1:, :2], axis=3)
        return np.abs(radius - np.array(PLACES)).max((0, 2))

    return case(
        "V110 boxes on a turntable, below their friction limit",
        "circular motion, closed form",
        measured("largest change of the radius", "m", creep, at_most(1e-4)),
        of=tuple(Experiment(scene, duration=duration, dt=dt, label=f"dt 1/{1 / dt:.0f}") for dt in steps),
    )
