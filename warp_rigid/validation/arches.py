"""Section H: arches over the range of time steps, and structures at rest, which must not climb."""

import numpy as np

from warp_rigid.scenes.builders import stacks
from warp_rigid.scenes.builders.scene_parts import bodies, on_ground
from warp_rigid.validation.case import OUTCOME, Cases, Check, Curve, at_most, case, each, measured
from warp_rigid.validation.common import largest_rise
from warp_rigid.validation.experiment import Experiment, Trace
from warp_rigid.validation.towers import card_house_scene, pyramid_scene

RADIUS = 5.0
"""Mean radius of the arches [m]."""
RATES = (60, 120, 240, 480)
"""Steps per second."""


def cases(quick: bool) -> Cases:
    """All cases of the section; fewer time steps and shorter if quick."""
    return [arches(RATES[:1] if quick else RATES, 2.0 if quick else 10.0), climbing(quick)]


def arch_scene(stones: int, ratio: float, friction: float):
    """A function that builds a semicircular arch on level ground."""
    return on_ground(bodies(*stacks.arch(stones, RADIUS, ratio * RADIUS), friction=friction), friction=friction)


def crown(trace: Trace) -> np.ndarray:
    """Displacement of the middle stone, upwards, (records, envs) [m]."""
    return trace.moved[:, :, len(trace.dynamic) // 2, 2]


def arches(rates, duration):
    """Arches that must stand, fall or slide apart at every time step.

    The least thickness with which a semicircular arch of rigid stones stands is 0.1061 radii for 15 stones and 0.1067
    for 27 (linear programming with a large friction). It slides apart below a friction of about 0.31.
    """
    variants = {
        "15 stones, t/R 0.125": (15, 0.125, 0.8, False),
        "27 stones, t/R 0.16": (27, 0.16, 0.8, False),
        "15 stones, t/R 0.095": (15, 0.095, 0.8, True),
        "15 stones, t/R 0.125, mu 0.25": (15, 0.125, 0.25, True),
    }
    experiments = tuple(
        at_rate(name, arch_scene(stones, ratio, friction), duration, rate)
        for name, (stones, ratio, friction, _) in variants.items()
        for rate in rates
    )
    must_fall = np.repeat([falls for *_, falls in variants.values()], len(rates))

    def farthest(trace):
        return [np.abs(crown(trace)).max()]

    standing, falling = np.flatnonzero(~must_fall), np.flatnonzero(must_fall)
    return case(
        f"V70 semicircular arches over the range of time steps, {duration:g} s",
        "limit analysis of rigid stones (linear programming)",
        measured("largest displacement of the crown", "m", farthest, at_most(1e-3), rows=standing),
        measured("falls", "", lambda t: [crown(t).min() < -0.25 * RADIUS], OUTCOME, 1, rows=falling, itemized=True),
        of=experiments,
        curve=Curve("displacement of the crown", "m", crown),
    )


def at_rate(name, scene, duration, rate) -> Experiment:
    """Experiment: a structure with so many steps per second, recorded 30 times per second."""
    return Experiment(scene, duration, dt=1 / rate, every=max(1, rate // 30), label=f"{name}, dt 1/{rate}")


def climbing(quick):
    """Structures at rest, whose centre of mass must not rise."""
    rates, duration = (RATES[:1], 2.0) if quick else (RATES, 10.0)
    structures = {
        "arch of 27 stones": (arch_scene(27, 0.16, 0.8), 2.0 * RADIUS),
        "pyramid of 8 rows": (pyramid_scene(8), 1.6),
        "10 crossed layers": (on_ground(bodies(*stacks.crossed_layers(10))), 2.0),
        "card house": (card_house_scene(2), 0.4),
    }
    sizes = np.repeat([size for _, size in structures.values()], len(rates))

    def rise(trace):
        weight = trace.mass[0, trace.dynamic] / trace.mass[0, trace.dynamic].sum()
        height = trace.center[:, 0, trace.dynamic, 2] @ weight
        return largest_rise(height[:, None])

    return case(
        f"V71 structures at rest do not climb, {duration:g} s",
        "statics: the centre of mass does not rise by itself",
        Check("rise of the centre of mass over the size", "", lambda s: each(rise)(s) / sizes, at_most(1e-5)),
        of=tuple(at_rate(name, scene, duration, rate) for name, (scene, _) in structures.items() for rate in rates),
    )
