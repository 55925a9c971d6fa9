"""Section E: stacks, towers, pyramids and piles, with and without shock propagation."""

from collections.abc import Callable
from typing import Any

import numpy as np

from warp_rigid import rotations
from warp_rigid.scene.scene import Scene
from warp_rigid.scene.shapes import Box, Cylinder, Mesh, Shape, Sphere
from warp_rigid.scenes.builders import grounds, stacks
from warp_rigid.scenes.builders.grounds import level_scene
from warp_rigid.scenes.builders.scene_parts import bodies, body, on_ground
from warp_rigid.validation.case import (
    AT_LEAST,
    OUTCOME,
    Cases,
    Check,
    Curve,
    absolute,
    at_most,
    case,
    measured,
    relative,
)
from warp_rigid.validation.common import G, largest_rise
from warp_rigid.validation.experiment import Experiment, Start, Trace, per_env
from warp_rigid.validation.solids import extrude

STATICS = "statics, closed form"
MODES = ("two_pass", "one_pass", "off")
HALF = 0.1
"""Half the width of most boxes [m], whose mass is 8 kg."""
UNIT = Box((0.5,) * 3)
"""Cube of 1 m."""
OWN = 1e-4
"""Permitted displacement of a stack [m]."""


def cases(quick: bool) -> Cases:
    """All cases of the section; lower and shorter if quick."""
    listed = [
        heavy_on_light(1.0 if quick else 10.0),
        heavy_dropped_on_light(3.0 if quick else 10.0),
        column((10,) if quick else (10, 20, 40), 2.0 if quick else 10.0),
        tall_stack(20 if quick else 50, 1.0 if quick else 10.0),
        spheres(1.0 if quick else 10.0),
        leaning_towers(5.0),
        toppling(4 if quick else 16),
        pyramid(8 if quick else 20, 1.0 if quick else 10.0),
        falling_towers(2.0 if quick else 6.0),
        falling_piles(4.0 if quick else 8.0, 20 if quick else 40),
        card_house(2, 1.0 if quick else 2.0),
    ]
    return listed if quick else [*listed, beams(10.0), balls_that_spread(10.0)]


def stack_scene(count: int, shape: Shape = stacks.CUBE) -> Callable[[], Scene]:
    """A function that builds a straight stack of equal bodies on level ground, which are bodies 1 to `count`."""
    return on_ground(bodies(shape, stacks.column(count, shape)))


def pyramid_scene(rows: int) -> Callable[[], Scene]:
    """A function that builds a pyramid of cubes of 0.2 m on level ground."""
    return on_ground(bodies(stacks.CUBE, stacks.pyramid(rows)))


def farthest(trace: Trace) -> np.ndarray:
    """Largest displacement of a body at any time, (envs,) [m]."""
    return trace.displacement.max(axis=0)


def drift(trace: Trace) -> np.ndarray:
    """Largest horizontal displacement of a body at any time, (envs,) [m]."""
    return np.linalg.norm(trace.moved[..., :2], axis=-1).max(axis=(0, 2))


def sink(trace: Trace) -> np.ndarray:
    """Largest downward displacement of a body at any time, (envs,) [m]."""
    return -trace.moved[..., 2].min(axis=(0, 2))


def tilt(trace: Trace) -> np.ndarray:
    """Largest angle of a body's upright axis to the vertical at the end, (envs,) [deg]."""
    return np.degrees(np.arccos(np.clip(trace.rotation[-1][:, trace.dynamic, 2, 2], -1, 1))).max(axis=1)


def load_on_ground(trace: Trace) -> np.ndarray:
    """Upward force of body 0 on the others in the last step, (envs,) [N]."""
    found = trace.contacts
    sign = np.where(found["body_b"] == 0, 1.0, -1.0) * ((found["body_a"] == 0) | (found["body_b"] == 0))
    lift = sign * found["impulse"][:, 2].astype(np.float64) / trace.experiment.dt
    return np.bincount(found["env"], lift, len(trace.labels))


def heavy_on_light(duration):
    """Mass ratios and modes as environments; dt 1/60."""
    cells = [(ratio, mode) for mode in MODES for ratio in (1.0, 10.0, 100.0, 1000.0)]
    mass = np.array([(1000.0, 1000.0 * ratio) for ratio, _ in cells])
    kept = [row for row, (_, mode) in enumerate(cells) if mode != "off"]
    cold = [len(cells) - 1]
    names = tuple(f"{ratio:g} : 1, {mode}" for ratio, mode in cells)
    starts = Start("mass", mass, bodies=[1, 2]), Start("shock_propagation", [mode for _, mode in cells])

    def top(t):
        return t.position[0, :, 2, 2] - t.position[-1, :, 2, 2]

    return case(
        "V35 heavy cube on a light one, 1 m, dt 1/60",
        f"{STATICS}; other engines: 2 to 98 mm at 1000 : 1",
        measured("height lost by the top", "m", top, at_most(5e-4), rows=kept),
        measured("speed at the end", "m/s", lambda t: t.speed[-1], at_most(1e-3), rows=kept),
        measured("height lost without shock propagation", "m", top, AT_LEAST, 5e-3, rows=cold),
        of=Experiment(stack_scene(2, UNIT), duration, names, starts, dt=1 / 60, every=6),
        curve=Curve("height lost", "m", lambda t: t.position[0, :, 2, 2] - t.position[:, :, 2, 2]),
    )


def heavy_dropped_on_light(duration):
    """A cube of 1 m falls by 0.1 m, and a cube of 10 m with 1000 times its mass falls on it."""
    scene = on_ground(body(Box((0.5,) * 3), position=(0, 0, 0.6)), body(Box((5.0,) * 3), position=(0, 0, 6.5)))
    return case(
        "V35 cube of 10 m dropped on one of 1 m, 1000 : 1, dt 1/100",
        "statics; rigid-ipc large-mass-ratio",
        measured("height of the top cube", "m", lambda t: t.position[-1, :, 2, 2], absolute(5e-4), 6.0),
        measured("speed at the end", "m/s", lambda t: t.speed[-1], at_most(1e-3)),
        of=Experiment(scene, duration, dt=0.01, every=5),
        curve=Curve("height of the top cube", "m", lambda t: t.position[:, :, 2, 2]),
    )


def column(counts, duration):
    """Unit cubes with two restitutions: the ground supports their weight, and nothing moves."""

    def experiment(count):
        name = f"{count} cubes"
        return Experiment(stack_scene(count, UNIT), duration, ("e 0", "e 0.5"), starts, every=24, label=name)

    starts = (per_env("restitution", [0.0, 0.5]),)
    weight = np.repeat([count * 1000.0 * G for count in counts], 2)
    return case(
        "V37 column of unit cubes",
        f"{STATICS}; other engines sink by 0.5 to 58 mm",
        measured("force on the ground", "N", load_on_ground, relative(1e-3), weight),
        measured("sink", "m", sink, at_most(OWN)),
        measured("drift", "m", drift, at_most(OWN)),
        measured("tilt", "deg", tilt, at_most(0.1)),
        of=tuple(experiment(count) for count in counts),
    )


def tall_stack(count, duration):
    """Fifty cubes of 0.2 m."""
    return case(
        f"V37 straight stack of {count} cubes of 0.2 m, {duration:g} s",
        STATICS,
        measured("drift", "m", drift, at_most(OWN)),
        measured("sink", "m", sink, at_most(OWN)),
        measured("rise", "m", lambda t: t.moved[..., 2].max(axis=(0, 2)), at_most(OWN)),
        measured("speed at the end", "m/s", lambda t: t.speed[-1], at_most(1e-3)),
        of=Experiment(stack_scene(count), duration, every=24),
        curve=Curve("largest displacement", "m", lambda t: t.displacement),
    )


def spheres(duration):
    """Five spheres of radius 1 m on top of one another: an unstable equilibrium that symmetry preserves."""
    return case(
        "V37 column of five spheres, R 1",
        "Chrono's SMC stacking",
        measured("drift from the axis", "m", drift, at_most(1e-6)),
        measured("sink", "m", sink, at_most(OWN)),
        of=Experiment(stack_scene(5, Sphere(1.0)), duration, every=24),
    )


WAYS: dict[str, dict[str, Any]] = {
    "default": {},
    "two_pass, cold": {"warm_starting": False},
    "off": {"shock_propagation": "off"},
    "one_pass, cold": {"shock_propagation": "one_pass", "warm_starting": False},
}
"""Settings under which towers are compared: the default, and those of the 2003 method."""


def way_starts(names) -> tuple[Start, ...]:
    """Settings of a list of keys of WAYS, by environment."""
    ways = [WAYS[name] for name in names]
    return (
        Start("shock_propagation", [way.get("shock_propagation", "two_pass") for way in ways]),
        Start("warm_starting", [way.get("warm_starting", True) for way in ways]),
    )


def leaning(offsets, ways, duration, **options) -> Experiment:
    """Experiment: towers of ten cubes of 0.2 m; environments differ in relative offset and settings."""
    place = np.array([stacks.column(10, lean=2 * HALF * offset) for offset in offsets])
    names = tuple(f"{offset:g} w, {way}" for offset, way in zip(offsets, ways, strict=True))
    starts = Start("position", place, bodies=list(range(1, 11))), *way_starts(ways)
    return Experiment(stack_scene(10), duration, names, starts, **options)


OFFSETS = (0.0, 0.05, 0.08, 0.12, 0.15, 0.2)
"""Offsets from cube to cube of the leaning towers, relative to their width; statics demands a fall above 0.1."""
EVERY_OFFSET = tuple(range(len(OFFSETS)))
AGAINST_STATICS: dict[str, tuple[str, Callable[[float], bool]]] = {
    "off": ("falls from 0.12 w on", lambda offset: offset >= 0.12),
    "one_pass, cold": ("never falls", lambda offset: False),
}
"""What towers do under settings of WAYS with which they do not follow statics, in words and by offset."""


def leaning_towers(duration):
    """The first flaw of the 2003 method: one pass keeps towers standing that must topple.

    Every tower is judged: with the default settings, and with two passes from zero, it must do what statics demands;
    with the others, what is documented of them.
    """
    cells = [(offset, way) for way in WAYS for offset in OFFSETS]
    offsets, ways = zip(*cells, strict=True)
    experiment = leaning(offsets, ways, duration, every=24)
    statics = [stacks.leaning_tower_falls(offset * np.arange(10), 0.5) for offset in OFFSETS]
    decided = [k for k, offset in enumerate(OFFSETS) if offset == 0.0 or offset > 0.1]

    def fell(t):
        return t.position[-1, :, 10, 2] < 10 * HALF

    def rows_of(way, chosen):
        return [cells.index((OFFSETS[k], way)) for k in chosen]

    def falls(way, chosen=EVERY_OFFSET):
        words, known = AGAINST_STATICS.get(way, ("as statics demands", None))
        labels = [f"{OFFSETS[k]:g} w; statics: {'falls' if statics[k] else 'stands'}" for k in chosen]
        reference = [known(OFFSETS[k]) if known else statics[k] for k in chosen]
        rows = rows_of(way, chosen)
        return measured(f"falls, {way}: {words}", "", fell, OUTCOME, reference, rows, labels=labels, itemized=True)

    def leans(way, chosen):
        labels = [f"{OFFSETS[k]:g} w; statics: stands" for k in chosen]
        name, rows, all_do = f"leans by 3 cm or falls, {way}: does", rows_of(way, chosen), [True] * len(chosen)
        return measured(name, "", lambda t: farthest(t) > 0.03, OUTCOME, all_do, rows, labels=labels, itemized=True)

    def moves(way, limit):
        rows = rows_of(way, [k for k, due in enumerate(statics) if not due])
        return measured("displacement of standing towers", "m", farthest, at_most(limit), rows=rows)

    return case(
        "V61 leaning towers of ten cubes",
        "statics: whether the centre of mass above each joint lies over the joint",
        *(falls(way) for way in WAYS if way != "off"),
        # Without shock propagation, whether a tower that leans so far falls hangs on rounding.
        falls("off", decided),
        leans("off", [k for k in range(len(OFFSETS)) if k not in decided]),
        moves("default", 3e-6),
        moves("two_pass, cold", 3e-5),
        of=experiment,
        curve=Curve("height of the top cube", "m", lambda t: t.position[:, :, 10, 2]),
    )


def round_and_prisms() -> dict[str, tuple[Any, float, int]]:
    """Solids of radius 0.1 m: height over radius, and number of sides, 0 if round, by their names."""

    def prism(sides, height):
        angle = 2.0 * np.pi * np.arange(sides) / sides
        base = 0.1 * np.column_stack([np.cos(angle), np.sin(angle)])
        fan = [(0, k, k + 1) for k in range(1, sides - 1)]
        return Mesh(*extrude(base, fan, 0.1 * height))

    cylinders = {f"cylinder, h/r {h}": (Cylinder(0.1, 0.05 * h), h, 0) for h in (2, 4, 10)}
    sides = (3, 4, 5, 6, 8, 12, 16, 24, 32, 48, 64)
    return cylinders | {f"prism of {count} sides": (prism(count, 4), 4, count) for count in sides}


def toppling(directions: int):
    """A solid on level ground under tilted gravity topples when its weight points beyond the edge of its base."""
    solids = round_and_prisms()
    angle = 2.0 * np.pi * (np.arange(directions) + 0.3) / directions
    ratios = np.array([0.97, 0.98, 0.99, 0.9955, 1.0045])

    def experiment(name):
        solid, height, sides = solids[name]
        within = np.remainder(angle, 2.0 * np.pi / sides) - np.pi / sides if sides else 0.0
        edge = np.cos(np.pi / sides) / np.cos(within) if sides else np.ones(directions)
        slope = np.outer(2.0 / height * edge, ratios)
        pull = G / np.sqrt(1.0 + slope**2)
        along = (pull * slope)[..., None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)[:, None]
        gravity = np.concatenate([along, -pull[..., None]], axis=2).reshape(-1, 3)
        low = 0.0 if sides else 0.05 * height
        scene = on_ground(body(solid, position=(0.0, 0.0, low), friction=3.0), friction=3.0)
        variants = tuple(f"{name}, {np.degrees(a):.1f} deg, {ratio:g}" for a in angle for ratio in ratios)
        return Experiment(scene, variants=variants, starts=(Start("gravity", gravity),), duration=2.0, every=24)

    def limits(traces):
        """Largest ratio at which each solid stands in each direction, as at all smaller ones."""
        upright = np.concatenate([trace.rotation[-1, :, 1, 2, 2] > 0.99 for trace in traces])
        standing = np.cumprod(upright.reshape(-1, len(ratios)), axis=1).sum(axis=1)
        return np.concatenate([[0.0], ratios])[standing]

    labels = [f"{name}, {np.degrees(a):.1f} deg" for name in solids for a in angle]
    return case(
        "V103 toppling of cylinders and prisms",
        "statics: the weight points to the edge of the base",
        Check("largest slope at which it stands, over that of statics", "", limits, relative(0.005), 1.0, labels),
        of=[experiment(name) for name in solids],
    )


def pyramid(rows, duration):
    """A pyramid stays in place, at rest, without a gain of energy."""
    count = rows * (rows + 1) // 2
    return case(
        f"V43 pyramid of {rows} rows, {count} cubes of 0.2 m, {duration:g} s",
        STATICS,
        measured("largest displacement", "m", farthest, at_most(OWN)),
        measured("speed at the end", "m/s", lambda t: t.speed[-1], at_most(1e-3)),
        measured("energy gained, relative to a fall", "", gained(lambda t: t.energy), at_most(1e-6)),
        measured("force on the ground", "N", load_on_ground, relative(1e-3), count * 8.0 * G),
        of=Experiment(pyramid_scene(rows), duration, every=24),
        curve=Curve("largest displacement", "m", lambda t: t.displacement),
    )


def gained(series):
    """Measure: largest increase of an energy above its running minimum, relative to the energy of a fall to z = 0."""

    def measure(trace):
        scale = (trace.mass * G * np.abs(trace.center[0, :, :, 2])).sum(axis=1)
        return largest_rise(series(trace)) / scale

    return measure


def energy_checks(warm, cold, by_impulses=1e-6, in_all=1e-6):
    """Energy gained by impulses without and with warm starting, and with push-out, relative to a fall.

    Args:
        warm: environments with the default settings.
        cold: environments without warm starting.
        by_impulses: largest gain by impulses with the default settings.
        in_all: largest gain by impulses and push-out with the default settings.
    """

    def check(quantity, series, rows, limit):
        return measured(f"energy gained {quantity}, relative to a fall", "", gained(series), at_most(limit), rows=rows)

    return (
        check("by impulses without warm starting", lambda t: t.work_free_energy, cold, 1e-6),
        check("by impulses", lambda t: t.work_free_energy, warm, by_impulses),
        check("by impulses and push-out", lambda t: t.energy, warm, in_all),
    )


def falling_towers(duration):
    """Shock propagation in falling structures: impulses must not add energy."""
    offsets = [offset for offset in (0.15, 0.25, 0.4) for _ in range(2)]
    experiment = leaning(offsets, ["default", "two_pass, cold"] * 3, duration)
    return case(
        "V62 energy of falling towers of ten cubes",
        "conservation",
        *energy_checks([0, 2, 4], [1, 3, 5]),
        of=experiment,
        curve=Curve("energy", "J", lambda t: t.energy),
    )


def pile_scene(count: int) -> Scene:
    """Boxes, and spheres as every fourth body, in layers of four above level ground between four walls."""
    surface: dict[str, Any] = {"friction": 0.6, "rolling_friction": 2e-3, "spinning_friction": 2e-3}
    scene = level_scene(**surface)
    grounds.add_plane_bin(scene, 0.35, **surface)
    draw = np.random.default_rng(8)
    for k in range(count):
        size = draw.uniform(0.05, 0.09)
        shape: Shape = Sphere(size) if k % 4 == 0 else Box(size * draw.uniform(0.6, 1.1, 3))
        corner = 0.17 * np.array([2 * (k % 2) - 1, 2 * (k // 2 % 2) - 1])
        place = (*(corner + draw.uniform(-0.01, 0.01, 2)), 0.2 + 0.36 * (k // 4))
        scene.add_body(shape, position=place, **surface)
    return scene


def falling_piles(duration, count):
    """Bodies that fall into a pile and come to rest; environments differ in orientations."""
    warm = list(range(12))
    starts = (
        Start("orientation", rotations.random(np.random.default_rng(7), 13, count), bodies=list(range(5, 5 + count))),
        *way_starts(["default"] * 12 + ["two_pass, cold"]),
    )
    names = (*(f"pile {k + 1}" for k in warm), "pile 13, cold")

    def late_motion(t):
        """A contact whose gap has grown by rounding errors closes in one step: a body moves by up to 3e-7 m."""
        return np.ptp(t.position[-120:], axis=0).max(axis=(1, 2))

    return case(
        f"V62 piles of {count} boxes and balls that fall into a box",
        "conservation; a pile comes to rest",
        # A body that is hit is stopped at its time of impact, but gravity acts for the whole step: 5e-5.
        *energy_checks(warm, [12], 4e-6, 1e-4),
        measured("largest motion in the last half second", "m", late_motion, at_most(5e-7), rows=warm),
        measured("deepest overlap at the end", "m", lambda t: t.overlap[-1], at_most(5e-5), rows=warm),
        of=Experiment(lambda: pile_scene(count), duration, names, starts),
        curve=Curve("energy", "J", lambda t: t.energy),
    )


def card_house_scene(storeys):
    """A function that builds a card house on level ground, with cards at 65 degrees."""
    return on_ground(bodies(*stacks.card_house(storeys, np.radians(25.0)), friction=0.7), friction=0.7)


def card_house(levels, duration):
    """Pairs of cards that lean on each other, with level cards between the storeys."""

    def dropped(t):
        return (1 - t.position[-1][:, t.dynamic, 2] / t.position[0][:, t.dynamic, 2]).max(axis=1)

    return case(
        f"V39 card house of {levels} storeys, 65 degrees, thickness 0.02 of the length",
        "rigid-ipc and box3d: no card drops by 5 % of its height in 2 s",
        measured("largest drop relative to the height", "", dropped, at_most(0.05)),
        of=Experiment(card_house_scene(levels), duration, every=4),
        curve=Curve("largest displacement", "m", lambda t: t.displacement),
    )


def beams(duration):
    """Thirty crossed layers of two beams."""
    layers = bodies(*stacks.crossed_layers(30), rolling_friction=0.05)
    return case(
        "V45 tower of thirty crossed layers of two beams, 10 s",
        "box3d: the tower stands",
        measured("largest displacement", "m", farthest, at_most(0.01)),
        of=Experiment(on_ground(layers, rolling_friction=0.05), duration, every=24),
    )


def balls_that_spread(duration):
    """A cube of 216 frictionless balls collapses; overlaps must stay small."""
    places = 0.21 * np.array(list(np.ndindex(6, 6, 6))) + [0, 0, 0.101]
    balls = bodies(Sphere(0.1), places, mass=10.0, friction=0.0)

    def squares(trace):
        sums = []
        for place in trace.position[:, 0, 1:]:
            gap = np.linalg.norm(place[:, None] - place[None], axis=-1) - 0.2
            inside = np.minimum(gap[np.triu_indices(len(place), 1)], 0.0)
            sums.append((inside**2).sum() + (np.minimum(place[:, 2] - 0.1, 0.0) ** 2).sum())
        return [np.mean(sums)]

    return case(
        "V44 216 frictionless balls that collapse, 10 s, dt 1/1000",
        "SimBenchmark 666; other engines: 1.35e-4 to 0.38 m^2",
        measured("sum of squared overlaps, mean over time", "m^2", squares, at_most(1e-3)),
        of=Experiment(on_ground(balls, friction=0.0), duration, dt=1e-3, every=20),
    )
