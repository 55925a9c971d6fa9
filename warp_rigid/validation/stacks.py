"""Section E: stacks, towers, pyramids and what their weight does, with and without shock propagation."""

from typing import Any

import numpy as np

from warp_rigid import rotations
from warp_rigid.scene.shapes import Box, Plane, Sphere
from warp_rigid.validation.case import AT_LEAST, OUTCOME, Case, Check, Curve, Miss, absolute, at_most, each, relative
from warp_rigid.validation.common import G, largest_rise, level_ground, turn_about
from warp_rigid.validation.experiment import Experiment, Start, Trace

STATICS = "statics, closed form"
MODES = ("two_pass", "one_pass", "off")
HALF = 0.1
"""Half the width of most boxes [m]; they weigh 8 kg."""
OWN = 1e-4
"""What a stack may move [m]."""


def cases(quick: bool) -> list[Case]:
    """All cases of the section; lower and shorter if quick."""
    listed = [
        heavy_on_light(1.0 if quick else 10.0),
        heavy_dropped_on_light(3.0 if quick else 10.0),
        column((10,) if quick else (10, 20, 40), 2.0 if quick else 10.0),
        tall_stack(20 if quick else 50, 1.0 if quick else 10.0),
        spheres(1.0 if quick else 10.0),
        leaning_towers(2.0 if quick else 5.0),
        pyramid(8 if quick else 20, 1.0 if quick else 10.0),
        falling_towers(2.0 if quick else 6.0),
        piles(6.0 if quick else 12.0, 20 if quick else 40),
        card_house(2, 1.0 if quick else 2.0),
    ]
    return listed if quick else [*listed, beams(10.0), balls_that_spread(10.0)]


def stack_scene(count, half=HALF, friction=0.5, **options):
    """A straight stack of equal cubes, which are bodies 1 to `count`."""
    scene = level_ground(friction=friction)
    for k in range(count):
        scene.add_body(Box((half,) * 3), position=(0, 0, half * (2 * k + 1)), friction=friction, **options)
    return scene


def drift(trace: Trace) -> np.ndarray:
    """Largest way of a body across, at any time, (envs,) [m]."""
    moved = (trace.position - trace.position[0])[:, :, trace.dynamic, :2]
    return np.linalg.norm(moved, axis=-1).max(axis=(0, 2))


def sink(trace: Trace) -> np.ndarray:
    """Largest way of a body down, at any time, (envs,) [m]."""
    return (trace.position[0] - trace.position)[:, :, trace.dynamic, 2].max(axis=(0, 2))


def rise(trace: Trace) -> np.ndarray:
    """Largest way of a body up, at any time, (envs,) [m]."""
    return (trace.position - trace.position[0])[:, :, trace.dynamic, 2].max(axis=(0, 2))


def tilt(trace: Trace) -> np.ndarray:
    """Largest angle of a body's upright axis to the vertical at the end, (envs,) [deg]."""
    return np.degrees(np.arccos(np.clip(trace.turns[-1][:, trace.dynamic, 2, 2], -1, 1))).max(axis=1)


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
    experiment = Experiment(
        lambda: stack_scene(2, 0.5),
        duration,
        tuple(f"{ratio:g} : 1, {mode}" for ratio, mode in cells),
        (Start("mass", mass, bodies=[1, 2]), Start("shock_propagation", [mode for _, mode in cells])),
        dt=1 / 60,
        every=6,
    )
    names, names_cold = ([experiment.variants[row] for row in rows] for rows in (kept, cold))

    def top(t):
        return t.position[0, :, 2, 2] - t.position[-1, :, 2, 2]

    return Case(
        "V35",
        "heavy cube on a light one, 1 m, dt 1/60",
        f"{STATICS}; other engines: 2 to 98 mm at 1000 : 1",
        (
            Check("height lost by the top", "m", lambda s: top(s[0])[kept], 0.0, at_most(5e-4), names),
            Check("speed at the end", "m/s", lambda s: s[0].speed[-1, kept], 0.0, at_most(1e-3), names),
            Check("height lost without shock propagation", "m", lambda s: top(s[0])[cold], 5e-3, AT_LEAST, names_cold),
        ),
        (experiment,),
        curve=Curve("height lost", "m", lambda t: t.position[0, :, 2, 2] - t.position[:, :, 2, 2]),
    )


def heavy_dropped_on_light(duration):
    """A cube of 1 m falls by 0.1 m, one of 10 m and a thousand times its mass onto it."""

    def scene():
        made = level_ground()
        made.add_body(Box((0.5,) * 3), position=(0, 0, 0.6))
        made.add_body(Box((5.0,) * 3), position=(0, 0, 6.5))
        return made

    return Case(
        "V35",
        "cube of 10 m dropped on one of 1 m, 1000 : 1, dt 1/100",
        "statics; rigid-ipc large-mass-ratio",
        (
            Check("height of the top cube", "m", each(lambda t: t.position[-1, :, 2, 2]), 6.0, absolute(5e-4)),
            Check("speed at the end", "m/s", each(lambda t: t.speed[-1]), 0.0, at_most(1e-3)),
        ),
        (Experiment(scene, duration, dt=0.01, every=5),),
        curve=Curve("height of the top cube", "m", lambda t: t.position[:, :, 2, 2]),
    )


def column(counts, duration):
    """Unit cubes at two restitutions: the ground carries their weight, and nothing moves."""

    def experiment(count):
        return Experiment(
            lambda: stack_scene(count, 0.5),
            duration,
            ("e 0", "e 0.5"),
            (Start("restitution", np.array([[0.0], [0.5]])),),
            every=24,
            label=f"{count} cubes",
        )

    weight = np.repeat([count * 1000.0 * G for count in counts], 2)
    return Case(
        "V37",
        "column of unit cubes",
        f"{STATICS}; other engines sink by 0.5 to 58 mm",
        (
            Check("force on the ground", "N", each(load_on_ground), weight, relative(1e-3)),
            Check("sink", "m", each(sink), 0.0, at_most(OWN)),
            Check("drift", "m", each(drift), 0.0, at_most(OWN)),
            Check("tilt", "deg", each(tilt), 0.0, at_most(0.1)),
        ),
        tuple(experiment(count) for count in counts),
    )


def tall_stack(count, duration):
    """Fifty cubes of 0.2 m."""
    return Case(
        "V37",
        f"straight stack of {count} cubes of 0.2 m, {duration:g} s",
        STATICS,
        (
            Check("drift", "m", each(drift), 0.0, at_most(OWN)),
            Check("sink", "m", each(sink), 0.0, at_most(OWN)),
            Check("rise", "m", each(rise), 0.0, at_most(OWN)),
            Check("speed at the end", "m/s", each(lambda t: t.speed[-1]), 0.0, at_most(1e-3)),
        ),
        (Experiment(lambda: stack_scene(count), duration, every=24),),
        curve=Curve("largest displacement", "m", lambda t: t.displacement),
    )


def spheres(duration):
    """Five spheres of 1 m on top of one another: an unstable balance, kept by symmetry."""

    def scene():
        made = level_ground()
        for k in range(5):
            made.add_body(Sphere(1.0), position=(0, 0, 2 * k + 1))
        return made

    return Case(
        "V37",
        "column of five spheres, R 1",
        "Chrono's SMC stacking",
        (
            Check("drift from the axis", "m", each(drift), 0.0, at_most(1e-6)),
            Check("sink", "m", each(sink), 0.0, at_most(OWN)),
        ),
        (Experiment(scene, duration, every=24),),
    )


def tower_falls(count, offset) -> bool:
    """Whether some upper part of a leaning tower has its centre of mass beyond the edge of what it stands on.

    `offset` is each cube's step over its width; the lowest cube stands on the ground with all of its face.
    """
    place = offset * np.arange(count)
    edges = np.concatenate([[0.5], place[:-1] + 0.5])
    return any(place[k:].mean() > edges[k] + 1e-9 for k in range(count))


WAYS: dict[str, dict[str, Any]] = {
    "default": {},
    "two_pass, cold": {"warm_starting": False},
    "off": {"shock_propagation": "off"},
    "one_pass, cold": {"shock_propagation": "one_pass", "warm_starting": False},
}
"""Settings under which towers are compared: the default, and those of 2003."""


def way_starts(names) -> tuple[Start, ...]:
    """Settings of a list of ways, by environment."""
    ways = [WAYS[name] for name in names]
    return (
        Start("shock_propagation", [way.get("shock_propagation", "two_pass") for way in ways]),
        Start("warm_starting", [way.get("warm_starting", True) for way in ways]),
    )


def leaning(offsets, ways, duration, **options) -> Experiment:
    """Experiment: towers of ten cubes of 0.2 m, each environment with its offset over the width and its settings."""
    place = np.zeros((len(offsets), 10, 3))
    place[:, :, 0] = 2 * HALF * np.outer(offsets, np.arange(10))
    place[:, :, 2] = HALF * (2 * np.arange(10) + 1)
    return Experiment(
        lambda: stack_scene(10),
        duration,
        tuple(f"{offset:g} w, {way}" for offset, way in zip(offsets, ways, strict=True)),
        (Start("position", place, bodies=list(range(1, 11))), *way_starts(ways)),
        **options,
    )


def leaning_towers(duration):
    """The first flaw of the 2003 method: one pass holds up what must fall."""
    # One pass from cold starts holds everything up; the others must follow statics.
    ways = ("default", "two_pass, cold", "off")
    cells = [(offset, way) for offset in (0.05, 0.08, 0.15, 0.2) for way in ways] + [(0.15, "one_pass, cold")]
    offsets, names = zip(*cells, strict=True)
    due = [tower_falls(10, offset) for offset in offsets]

    def fell(t):
        return t.position[-1, :, 10, 2] < 10 * HALF

    sure = [
        row for row, (offset, way) in enumerate(cells) if way == "default" or (due[row] and way != "one_pass, cold")
    ]
    standing = [row for row in sure if not due[row]]
    experiment = leaning(offsets, names, duration, every=24)
    return Case(
        "V61",
        "leaning towers of ten cubes",
        "the centre of mass of all that is above a joint lies over it, or not",
        (
            Check(
                "falls",
                "",
                lambda s: fell(s[0])[sure],
                np.array(due)[sure],
                OUTCOME,
                [experiment.variants[k] for k in sure],
            ),
            Check(
                "falls with one pass (flaw of 2003: it must not, though statics says so)",
                "",
                lambda s: fell(s[0])[-1:],
                0,
                OUTCOME,
                (experiment.variants[-1],),
            ),
            Check(
                "displacement of those that stand",
                "m",
                lambda s: s[0].displacement[:, standing].max(axis=0),
                0.0,
                at_most(OWN),
                [experiment.variants[k] for k in standing],
            ),
        ),
        (experiment,),
        curve=Curve("height of the top cube", "m", lambda t: t.position[:, :, 10, 2]),
    )


def pyramid_scene(rows, half=HALF, gap=0.0):
    """Rows of cubes, each with one cube less than that below and half a cube aside."""
    scene = level_ground()
    width = 2 * half + gap
    for row in range(rows):
        for k in range(rows - row):
            x = width * (k - 0.5 * (rows - row - 1))
            scene.add_body(Box((half,) * 3), position=(x, 0, half * (2 * row + 1)))
    return scene


def pyramid(rows, duration):
    """It keeps its place, at rest, and no energy comes from nowhere."""
    count = rows * (rows + 1) // 2
    return Case(
        "V43",
        f"pyramid of {rows} rows, {count} cubes of 0.2 m, {duration:g} s",
        STATICS,
        (
            Check("largest displacement", "m", each(lambda t: t.displacement.max(axis=0)), 0.0, at_most(OWN)),
            Check("speed at the end", "m/s", each(lambda t: t.speed[-1]), 0.0, at_most(1e-3)),
            Check("energy gained, of that of a fall", "", each(gained(lambda t: t.energy)), 0.0, at_most(1e-6)),
            Check("force on the ground", "N", each(load_on_ground), count * 8.0 * G, relative(1e-3)),
        ),
        (Experiment(lambda: pyramid_scene(rows), duration, every=24),),
        curve=Curve("largest displacement", "m", lambda t: t.displacement),
    )


SWEEPS = (
    "ten warm-started sweeps stop short of their fixed point while a structure comes apart; "
    "a tower gains less than 1e-7 of its energy with 160, and nothing from cold starts"
)
LIFTED = "push-out lifts bodies that a step has driven into each other, which counts as energy here"


def gained(series):
    """Measure: how far an energy climbs above its least value so far, over what a fall to the ground sets free."""

    def measure(trace):
        scale = (trace.mass * G * np.abs(trace.center[0, :, :, 2])).sum(axis=1)
        return largest_rise(series(trace)) / scale

    return measure


def energy_checks(warm, cold, names):
    """Energy gained by impulses, from cold and warm starts, and with what push-out adds; all over that of a fall.

    Args:
        warm: environments with the default settings.
        cold: environments where every step starts from zero impulses.
        names: labels of all environments.
    """

    def check(quantity, series, rows, limit, miss=None):
        measure = gained(series)
        return Check(
            f"energy gained {quantity}, of that of a fall",
            "",
            lambda s: measure(s[0])[rows],
            0.0,
            at_most(limit),
            [names[row] for row in rows],
            miss,
        )

    return (
        check("by impulses from cold starts", lambda t: t.work_free_energy, cold, 1e-6),
        check("by impulses", lambda t: t.work_free_energy, warm, 1e-4, Miss(SWEEPS, 1e-3, always=False)),
        check("by impulses and push-out", lambda t: t.energy, warm, 1e-4, Miss(LIFTED, 1e-3, always=False)),
    )


def falling_towers(duration):
    """Shock propagation at work in structures that fall: impulses only ever take energy away."""
    offsets = [offset for offset in (0.15, 0.25, 0.4) for _ in range(2)]
    experiment = leaning(offsets, ["default", "two_pass, cold"] * 3, duration)
    return Case(
        "V62",
        "energy of falling towers of ten cubes",
        "conservation",
        energy_checks([0, 2, 4], [1, 3, 5], experiment.variants),
        (experiment,),
        curve=Curve("energy", "J", lambda t: t.energy),
    )


def pile_scene(count, draw):
    """Boxes and spheres in layers of four above level ground between four walls, clear of one another."""
    rough: dict[str, Any] = {"friction": 0.6, "rolling_friction": 2e-3, "spinning_friction": 2e-3}
    scene = level_ground(**rough)
    for normal in ((1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0)):
        scene.add_static(Plane(normal=normal, offset=-0.35), **rough)
    for k in range(count):
        size = draw.uniform(0.05, 0.09)
        shape = Sphere(size) if k % 4 == 0 else Box(size * draw.uniform(0.6, 1.1, 3))
        corner = 0.17 * np.array([2 * (k % 2) - 1, 2 * (k // 2 % 2) - 1])
        place = (*(corner + draw.uniform(-0.01, 0.01, 2)), 0.2 + 0.36 * (k // 4))
        scene.add_body(shape, position=place, **rough)
    return scene


def piles(duration, count):
    """Piles that fall together, and come to rest; each start from other orientations."""
    starts = (
        Start("orientation", rotations.random(np.random.default_rng(7), 4, count), bodies=list(range(5, 5 + count))),
        *way_starts(["default", "default", "default", "two_pass, cold"]),
    )
    names = ("pile 1", "pile 2", "pile 3", "pile 4, cold")
    warm = [0, 1, 2]
    return Case(
        "V62",
        f"piles of {count} boxes and balls that fall into a box",
        "conservation; a pile comes to rest",
        (
            *energy_checks(warm, [3], names),
            Check(
                "largest speed in the last half second",
                "m/s",
                lambda s: np.linalg.norm(s[0].linear_velocity[-120:, warm], axis=-1).max(axis=(0, 2)),
                0.0,
                at_most(0.01),
                names[:3],
                Miss("some piles creep for seconds, at millimetres a second, before they rest", 0.1, always=False),
            ),
            Check(
                "deepest overlap at the end",
                "m",
                lambda s: s[0].overlap[-1, warm],
                0.0,
                at_most(5e-4),
                names[:3],
                Miss(
                    "two boxes can slide into each other where their edges cross, unseen by any sample (V63)",
                    3e-3,
                    always=False,
                ),
            ),
        ),
        (Experiment(lambda: pile_scene(count, np.random.default_rng(8)), duration, names, starts),),
        curve=Curve("energy", "J", lambda t: t.energy),
    )


def card_house(levels, duration):
    """Pairs of cards that lean on each other, with level cards between the storeys."""
    length, thickness, angle = 0.2, 0.004, np.radians(25.0)
    card = Box((0.5 * thickness, 0.05, 0.5 * length))
    storey = length * np.cos(angle) + thickness * np.sin(angle)
    foot = length * np.sin(angle) + thickness * np.cos(angle)

    def scene():
        made = level_ground(friction=0.7)
        for level in range(levels):
            base = level * (storey + thickness)
            for pair in range(levels - level):
                middle = 2 * foot * (pair - 0.5 * (levels - level - 1))
                for side in (-1, 1):
                    place = (middle + side * 0.5 * foot, 0, base + 0.5 * storey)
                    turn = turn_about((0, 1, 0), -side * np.degrees(angle))
                    made.add_body(card, position=place, orientation=turn, friction=0.7)
            for gap in range(levels - level - 1):
                middle = 2 * foot * (gap - 0.5 * (levels - level - 2))
                flat = (middle, 0, base + storey + 0.5 * thickness)
                made.add_body(card, position=flat, orientation=turn_about((0, 1, 0), 90), friction=0.7)
        return made

    def dropped(t):
        return (1 - t.position[-1][:, t.dynamic, 2] / t.position[0][:, t.dynamic, 2]).max(axis=1)

    return Case(
        "V39",
        f"card house of {levels} storeys, 65 degrees, thickness 0.02 of the length",
        "rigid-ipc and box3d: no card drops by 5 % of its height in 2 s",
        (Check("largest drop, of the height", "", each(dropped), 0.0, at_most(0.05)),),
        (Experiment(scene, duration, every=4),),
        curve=Curve("largest displacement", "m", lambda t: t.displacement),
    )


def beams(duration):
    """Thirty crossed layers of two beams."""

    def scene():
        made = level_ground(rolling_friction=0.05)
        for layer in range(30):
            for side in (-0.9, 0.9):
                across = (side, 0, 0.1 + 0.2 * layer) if layer % 2 else (0, side, 0.1 + 0.2 * layer)
                half = (0.1, 1.0, 0.1) if layer % 2 else (1.0, 0.1, 0.1)
                made.add_body(Box(half), position=across, rolling_friction=0.05)
        return made

    return Case(
        "V45",
        "tower of thirty crossed layers of two beams, 10 s",
        "box3d: it stands",
        (Check("largest displacement", "m", each(lambda t: t.displacement.max(axis=0)), 0.0, at_most(0.01)),),
        (Experiment(scene, duration, every=24),),
    )


def balls_that_spread(duration):
    """A cube of 216 frictionless balls collapses: overlaps stay small."""

    def scene():
        made = level_ground(friction=0.0)
        for cell in np.ndindex(6, 6, 6):
            made.add_body(Sphere(0.1), mass=10.0, position=0.21 * np.array(cell) + [0, 0, 0.101], friction=0.0)
        return made

    def squares(trace):
        sums = []
        for place in trace.position[:, 0, 1:]:
            gap = np.linalg.norm(place[:, None] - place[None], axis=-1) - 0.2
            inside = np.minimum(gap[np.triu_indices(len(place), 1)], 0.0)
            sums.append((inside**2).sum() + (np.minimum(place[:, 2] - 0.1, 0.0) ** 2).sum())
        return [np.mean(sums)]

    return Case(
        "V44",
        "216 frictionless balls that collapse, 10 s, dt 1/1000",
        "SimBenchmark 666; other engines: 1.35e-4 to 0.38 m^2",
        (Check("sum of squared overlaps, mean over time", "m^2", each(squares), 0.0, at_most(1e-3)),),
        (Experiment(scene, duration, dt=1e-3, every=20),),
    )
