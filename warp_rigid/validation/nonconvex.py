"""Section F: sharp and nonconvex contacts."""

import numpy as np
import trimesh

from warp_rigid import rotations
from warp_rigid.scene.shapes import Box, Capsule, Mesh, Sphere
from warp_rigid.scenes.builders import meshes
from warp_rigid.scenes.builders.grounds import EARTH
from warp_rigid.scenes.builders.scene_parts import body, in_space, on_ground, static
from warp_rigid.validation import solids
from warp_rigid.validation.case import (
    AT_LEAST,
    OUTCOME,
    Cases,
    Check,
    Curve,
    Miss,
    absolute,
    at_most,
    case,
    measured,
    relative,
)
from warp_rigid.validation.common import NO_GRAVITY, orientation_about
from warp_rigid.validation.experiment import Experiment, Start, of_body
from warp_rigid.validation.towers import tilt

ERLEBEN = "Erleben 2018; rigid-ipc unit-tests/erleben"
PARTED = 1e-4
"""Overlap below which two bodies count as separated [m]."""
OVER = 1e-4
"""Initial gap below a dropped tip [m]."""


def cases(quick: bool) -> Cases:
    """All cases of the section; only the fast ones if quick."""
    listed = [sliding_tips(), tips_on_tips(), internal_edges(0.5 if quick else 2.0), push_out()]
    if quick:
        return [*listed, random_overlaps(256)]
    return [*listed, random_overlaps(2048), bypass(1 / 240), bypass(0.05)]


def tip_down(solid, **motion):
    """A part of a scene: a spike or a wedge without friction, its tip just above the origin."""
    orientation = orientation_about((0, 1, 0), 180.0)
    return body(Mesh(*solid), position=(0, 0, 3.0 + OVER), orientation=orientation, friction=0.0, **motion)


def sliding_tips():
    """A tip that slides over a plane must not snag."""

    def experiment(name, solid):
        tip = tip_down(solid, linear_velocity=(10, 0, 0))
        return Experiment(on_ground(tip, gravity=NO_GRAVITY, friction=0.0), 1.0, dt=0.01, label=name)

    return case(
        "V49 spike and wedge that slide on their tip, 10 m/s, no gravity",
        ERLEBEN,
        measured("distance in 1 s", "m", lambda t: t.position[-1, :, 1, 0], absolute(1e-4), 10.0),
        measured("turn", "rad/s", lambda t: np.abs(t.angular_velocity[-1, :, 1]).max(axis=1), at_most(1e-4)),
        of=(experiment("spike", solids.spike()), experiment("wedge", solids.wedge())),
    )


def tips_on_tips():
    """A tip dropped on a tip slides off it without penetration."""
    spike, wedge = solids.spike(), solids.wedge()

    def experiment(name, below, above):
        lower = static(Mesh(*below), position=(0, 0, -3.0), friction=0.0)
        scene = in_space(lower, tip_down(above), gravity=EARTH)
        return Experiment(scene, 1.25, dt=0.01, label=name, watch_overlap=True)

    return case(
        "V49 spikes and wedges dropped tip on tip, 1.25 s",
        ERLEBEN,
        measured("deepest overlap, 1 % of the width allowed", "m", lambda t: t.overlap.max(axis=0), at_most(0.01)),
        measured("speed at the end", "m/s", lambda t: t.speed[-1], at_most(0.0), 20.0),
        of=(
            experiment("spike on spike", spike, spike),
            experiment("wedge on wedge", wedge, wedge),
            experiment("spike on wedge", wedge, spike),
        ),
    )


def internal_edges(duration):
    """A cube rests flat on a slab of many triangles, also where its faces are flush with those of the slab."""

    def experiment(name, half, divisions):
        corners, faces = solids.cube()
        slab = trimesh.Trimesh(corners * [2, 2, 1], faces)
        for _ in range(divisions):
            slab = slab.subdivide()
        cube = body(Box(half), position=(0, 0, half[2] + 0.05))
        scene = in_space(static(Mesh.from_trimesh(slab), position=(0, 0, -0.5)), cube, gravity=EARTH)
        return Experiment(scene, duration, label=name, every=2)

    return case(
        "V49 cube dropped on a slab with interior edges, and flush with its rim",
        ERLEBEN,
        measured("height error at the end", "m", lambda t: t.position[-1, :, 1, 2] - 0.5, absolute(1e-3)),
        measured("drift", "m", lambda t: np.abs(t.position[-1, :, 1, :2]).max(axis=1), at_most(1e-3)),
        measured("tilt", "deg", tilt, at_most(0.1)),
        measured("speed at the end", "m/s", lambda t: t.speed[-1], at_most(1e-3)),
        of=(
            experiment("12 triangles", (0.5, 0.5, 0.5), 0),
            experiment("192 triangles", (0.5, 0.5, 0.5), 2),
            experiment("flush with the rim", (1.0, 1.0, 0.5), 2),
        ),
    )


def push_out():
    """Two overlapping bodies separate within half a second without gaining velocity."""
    cube = Box((0.1, 0.1, 0.1))
    rows = {
        "spheres": (Sphere(0.1), ((0.3, 0), (0.9, 0))),
        "capsules": (Capsule(0.1, 0.2), ((0.3, 0), (0.9, 0))),
        "cubes": (cube, ((0.1, 0), (0.3, 0), (0.2, 35), (0.5, 0))),
        "bunnies": (meshes.bunny(sdf_resolution=32), ((0.3, 0), (0.5, 60))),
    }

    def experiment(name, shape, cells):
        overlap, degrees = np.array(cells, np.float64).T
        place = np.stack([0.2 * (1 - overlap), 0 * overlap + 0.01, 0 * overlap + 0.02], axis=1)
        starts = of_body(position=place, orientation=orientation_about((1, 2, 3), degrees))
        names = tuple(f"{100 * fraction:g} % of the width, turned by {angle:g} deg" for fraction, angle in cells)
        return Experiment(in_space(body(shape), body(shape)), 0.5, names, starts, label=name, watch_overlap=True)

    experiments = tuple(experiment(name, *row) for name, row in rows.items())
    stuck = experiment("cubes", cube, ((0.8, 35),))
    boxes = in_space(*(body(Box(half), position=place, orientation=turn) for half, place, turn in CROSSING))
    crossing = Experiment(boxes, 0.5, ("two boxes whose edges cross",), watch_overlap=True)
    count = sum(len(one.variants) for one in experiments)

    def check(first, end):
        rows = slice(first, end)
        return measured("overlap after 0.5 s", "m", lambda t: t.overlap[-1], at_most(4e-5), rows=rows)

    return case(
        "V63 bodies that start with overlap",
        "they separate within 0.5 s and are at rest",
        measured("overlap at the start", "m", lambda t: t.overlap[0], AT_LEAST, 0.005, rows=slice(count)),
        check(0, count),
        check(count, count + 1),
        check(count + 1, count + 2),
        measured("speed after 0.5 s", "m/s or rad/s", lambda t: t.speed[-1], at_most(1e-6)),
        of=(*experiments, stuck, crossing),
    )


CROSSING = (
    ((0.084392, 0.06487, 0.066778), (0.241749, -0.229452, 0.064856), (-0.70698, -0.013248, -0.013241, -0.706985)),
    ((0.035003, 0.040402, 0.040368), (0.103323, -0.199384, 0.130609), (-0.533362, 0.327473, 0.757487, -0.185743)),
)
"""Half extents, positions and orientations of two boxes of a pile whose edges cross with an overlap of 2 mm."""


def random_overlaps(count):
    """Pairs of boxes that start with a small overlap in random positions."""
    draw = np.random.default_rng(11)
    away = draw.normal(size=(count, 3))
    away *= (draw.uniform(0.09, 0.16, count) / np.linalg.norm(away, axis=1))[:, None]
    scene = in_space(body(Box((0.084, 0.065, 0.067))), body(Box((0.035, 0.04, 0.04))))
    starts = (*of_body(position=away), Start("orientation", rotations.random(draw, count, 2)))

    def parted(s):
        """Share of the pairs with an initial overlap of 1 to 20 mm that no longer overlap."""
        begun = (s[0].overlap[0] > 1e-3) & (s[0].overlap[0] < 0.02)
        return [(s[0].overlap[-1, begun] < PARTED).mean()]

    return case(
        f"V63 {count} random pairs of boxes, those that start with an overlap of 1 to 20 mm",
        "they separate within 0.5 s",
        Check("share of separated pairs", "", parted, AT_LEAST, 1.0, labels=("all",)),
        measured("speed after 0.5 s", "m/s or rad/s", lambda t: t.speed[-1], at_most(1e-5)),
        of=Experiment(scene, 0.5, tuple(f"pair {k}" for k in range(count)), starts, every=60, watch_overlap=True),
    )


def bypass(dt):
    """A fast square approaches a thin bar and must hit it within the bar's width, at every phase of the step.

    The bar is 20 m long and 0.1 m thick, the square 2 m wide, its depth is 0.2 m, and it crosses many times the bar's
    thickness in a step. If its centre is above the bar, the square comes to rest on it. If only its border is, it
    continues past the end with rotation, as a plate that is struck at an arm r without restitution: it keeps the
    fraction 1 - 1 / (1 + r^2 / k^2) of its speed, where k is its radius of gyration.
    """
    speed, phases = 75.0, 32
    sides = {
        "in the middle": 0.0,
        "centre 0.2 m within the end": 9.8,
        "border 0.2 m within it": 10.8,
        "past the end": 11.2,
    }
    cells = [(name, phase) for name in sides for phase in range(phases)]
    place = np.array([(sides[name], 0, 5.0 + phase / phases * speed * dt) for name, phase in cells])
    arm, gyration = 0.8, (2.0**2 + 0.2**2) / 12.0
    kept = 1.0 - 1.0 / (1.0 + arm**2 / gyration)
    square = body(Box((1.0, 1.0, 0.1)), linear_velocity=(0, 0, -speed), friction=0.0)

    def passed(trace):
        return trace.position[:, :, 1, 2].min(axis=0) < -1.0

    speculative = (
        "two phases begin a step less than 25 mm above the bar: a speculative contact leaves up to a fourteenth of the "
        "approach to the next step, at whose start the square has turned by 15 deg"
    )
    miss = Miss(speculative, 0.013) if dt < 0.01 else None
    after = "speed past the end after it was struck 0.8 m off its centre"
    scene = in_space(static(Box((10.0, 1.0, 0.05)), friction=0.0), square)
    names = tuple(f"{name}, phase {phase}/{phases}" for name, phase in cells)
    above, struck, beside = slice(2 * phases), slice(2 * phases, 3 * phases), slice(3 * phases, None)
    return case(
        f"V56 square 0.2 m deep at 75 m/s against a bar 0.1 m thick, dt 1/{1 / dt:.3g}",
        "rigid-ipc bypass, extruded; eccentric impact of a plate",
        measured("goes through the bar", "", passed, OUTCOME, rows=above),
        measured(
            after, "m/s", lambda t: -t.linear_velocity[-1, :, 1, 2], relative(0.01), kept * speed, struck, miss=miss
        ),
        measured("goes past the bar's end", "", passed, OUTCOME, 1, rows=beside),
        of=Experiment(scene, 0.3, names, of_body(position=place), dt=dt),
        curve=Curve("height", "m", lambda t: t.position[:, :, 1, 2]),
    )
