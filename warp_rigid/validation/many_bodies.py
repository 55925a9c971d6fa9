"""Sections G and H: granular piles, for which order and trend are known, and a heap at 60 Hz."""

import numpy as np

from warp_rigid.scene.shapes import Sphere
from warp_rigid.scenes.builders import piles, stacks
from warp_rigid.scenes.builders.bodies import add_bodies
from warp_rigid.scenes.builders.scene_parts import bodies, on_ground
from warp_rigid.validation.case import AT_LEAST, Cases, Check, Curve, Miss, at_most, case, each, measured
from warp_rigid.validation.experiment import Experiment, per_env


def cases(quick: bool) -> Cases:
    """All cases of the section; only the bin, with fewer boxes, is quick."""
    if quick:
        return [bins_of_boxes(64, 8)]
    return [heap(), bins_of_boxes(1000, 9, Miss(RESTLESS, 5e-2))]


def heap(base=6):
    """Square pyramids of balls collapse without friction; more friction preserves more of the height."""
    radius = 0.05
    friction = np.array([0.0, 0.1, 0.2, 0.6, 0.6, 0.6])
    rolling = np.array([0.0, 0.0, 0.0, 0.0, 2e-3, 1e-2])
    names = tuple(f"mu {mu:g}, rolling {1e3 * c:g} mm" for mu, c in zip(friction, rolling, strict=True))

    def kept(trace, time=3.0):
        height = trace.position[:, :, 1:, 2].mean(axis=2) - radius
        return height[np.searchsorted(trace.time, time - 1e-9)] / height[0]

    def increase(subject):
        return np.diff(kept(subject[0], 0.5))

    count = base * (base + 1) * (2 * base + 1) // 6
    scene = on_ground(bodies(Sphere(radius), stacks.ball_pyramid(base, radius)))
    starts = per_env("friction", friction), per_env("rolling_friction", rolling)
    more = "increase of the height kept after 0.5 s over less friction"
    return case(
        f"V60 heaps of {count} balls, 3 s from a square pyramid",
        "Zhou 2001 and 2002: order and trend",
        measured("height kept without friction", "", kept, at_most(0.05), rows=slice(1)),
        Check(more, "", increase, AT_LEAST, 0.02, labels=names[1:]),
        measured("height kept with most friction", "", kept, AT_LEAST, 0.9, rows=slice(-1, None)),
        of=Experiment(scene, 3.0, names, starts, every=24),
    )


RESTLESS = "a box that is held at two opposite corners rotates about the line through them; no contact force brakes it"
BIN_FRICTION, BIN_RESTING = 0.5, 1e-4
"""Friction in the bin, and speed below which all of its boxes rest [m/s]."""


def bins_of_boxes(count, bins, moves=None):
    """Cubes of 0.2 m that fall into bins, at one step of 1/60 s per frame; known miss of the angular speed.

    The bins differ in friction by 0.001, which leads to different heaps. In one of sixteen heaps of 64 cubes, a cube is
    held at two opposite corners and rotates for up to ten seconds. In a quarter of the heaps of 1000 cubes, some still
    fall after five seconds. So the median bin is judged. The largest speeds of heaps scatter: of 36 after six seconds,
    the median is 7e-4, a quarter exceed 1e-2 and a tenth 5e-2, so that the known miss is reported from 5e-2 on.
    """
    friction = BIN_FRICTION + 0.001 * np.arange(bins)

    def cubes(scene):
        piles.add_pile_bin(scene, count, friction=BIN_FRICTION)
        add_bodies(scene, stacks.CUBE, *piles.starts(count, 1000), friction=BIN_FRICTION)

    def median(quantity, unit, measure, limit, miss=None):
        values = each(measure)
        return Check(quantity, unit, lambda s: np.median(values(s)), at_most(limit), labels=label, miss=miss)

    label, names = (f"median of {bins} bins",), tuple(f"mu {mu:.3f}" for mu in friction)
    scene, starts = on_ground(cubes, friction=BIN_FRICTION), (per_env("friction", friction),)
    return case(
        f"V76 {count} boxes in a bin at one step of 1/60 s per frame",
        "a heap of inelastic boxes comes to rest without overlap",
        median("largest speed after 6 s", "m/s or rad/s", lambda t: t.speed[-1], BIN_RESTING, moves),
        median("deepest overlap after 6 s", "m", lambda t: t.overlap[-1], 2.5e-4),
        of=Experiment(scene, 6.0, names, starts, dt=1 / 60, every=30),
        curve=Curve("largest speed", "m/s or rad/s", lambda t: t.speed),
    )
