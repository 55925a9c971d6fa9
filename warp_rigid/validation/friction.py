"""Section D, first part: blocks that slide and stick."""

from dataclasses import replace

import numpy as np

from warp_rigid.scene.shapes import Box, Capsule, Mesh
from warp_rigid.scenes.builders.scene_parts import body, in_space, on_ground
from warp_rigid.validation.case import OUTCOME, Cases, Curve, Miss, absolute, at_most, case, measured, relative
from warp_rigid.validation.common import COULOMB, G, downhill, gain_of_energy, orientation_about, stop_checks
from warp_rigid.validation.experiment import Experiment, Start, of_body, per_env
from warp_rigid.validation.solids import cube

CUBE, SLAB, SMALL = Box((0.5, 0.5, 0.5)), Box((0.2, 0.2, 0.05)), Box((0.05, 0.05, 0.05))


def cases(quick: bool) -> Cases:
    """Cases of sliding; shorter if quick."""
    return [
        sticks(5.0),
        creeps_not(2.0 if quick else 10.0),
        slides(),
        stops(),
        authors_incline(),
        incline_grid(),
        stopping_distance(),
        painleve(),
        trays(),
    ]


def block_on_incline(block, degrees, friction, start=0.0, restitution=0.0, gravity=G, mesh=False, **options):
    """Experiment: a block on inclines that descend along x, one environment for each entry of the lists.

    Args:
        block: its shape.
        degrees: slopes.
        friction: coefficients.
        start: speeds downhill [m/s].
        restitution: of block and incline.
        gravity: [m/s^2].
        mesh: tilt a mesh under vertical gravity instead of gravity over level ground.
        options: of the Experiment.
    """
    degrees, friction, start = np.broadcast_arrays(np.atleast_1d(degrees), friction, start)
    half = block.half_extents[2]
    tilt = degrees if mesh else 0.0 * degrees
    down, up = directions(tilt)
    orientation = orientation_about((0, 1, 0), tilt)
    placed = body(block, position=(0, 0, half), restitution=restitution)

    def plate(scene):
        vertices, faces = cube()
        scene.add_static(Mesh(2.0 * vertices * [4, 2, 0.5], faces, sdf_resolution=32), restitution=restitution)

    starts = [
        per_env("friction", friction),
        *of_body(position=half * up - down, orientation=orientation, linear_velocity=start[:, None] * down),
    ]
    if mesh:
        scene = in_space(plate, placed, gravity=(0, 0, -gravity))
        starts += of_body(0, position=-0.5 * up, orientation=orientation)
    else:
        scene = on_ground(placed, restitution=restitution)
        starts.append(Start("gravity", [downhill(angle, gravity) for angle in degrees]))
    name = f"{'cube' if block is CUBE else 'slab'}{' on a mesh' if mesh else ''}"
    variants = tuple(f"{angle:.4g} deg, mu {mu:g}" for angle, mu in zip(degrees, friction, strict=True))
    return Experiment(scene, variants=variants, starts=tuple(starts), **{"label": name, **options})


def directions(degrees) -> np.ndarray:
    """Unit vectors (2, n, 3) down along an incline and up from it."""
    slope = np.radians(np.asarray(degrees, np.float64))
    cosine, zero, sine = np.cos(slope), np.zeros_like(slope), np.sin(slope)
    return np.array([[cosine, zero, -sine], [sine, zero, cosine]]).swapaxes(1, 2)


def along(trace, which=0):
    """Displacement downhill (0) or away from the incline (1), (records, envs) [m]."""
    moved = trace.position[:, :, 1] - trace.position[0, :, 1]
    rotation = trace.rotation[0, :, 0]
    # The incline is body 0: a tilted mesh, or level ground under tilted gravity.
    axis = rotation[:, :, 0] if which == 0 else rotation[:, :, 2]
    return np.einsum("nei,ei->ne", moved, axis)


def speed(trace):
    """Speed of the block, (records, envs) [m/s]."""
    return np.linalg.norm(trace.linear_velocity[:, :, 1], axis=-1)


def pull(degrees, friction, gravity=G):
    """Acceleration down an incline, g (sin - mu cos) [m/s^2]."""
    slope = np.radians(degrees)
    return gravity * (np.sin(slope) - friction * np.cos(slope))


def inclines(degrees, friction, **options):
    """The same experiment with a cube and a slab, under tilted gravity and on a tilted mesh."""
    kinds = [(block, mesh) for block in (CUBE, SLAB) for mesh in (False, True)]
    return tuple(block_on_incline(block, degrees, friction, mesh=mesh, **options) for block, mesh in kinds)


def sticks(duration):
    """A block at rest with e = 0 and e = 1; the order of the stages must not cause bounces by gravity."""
    experiments = tuple(
        replace(one, label=f"{one.label}, e {e:g}")
        for e in (0.0, 1.0)
        for one in inclines(20.0, 0.5, restitution=e, duration=duration, every=24)
    )
    return case(
        "V22 block that sticks on an incline, 20 degrees, mu 0.5",
        COULOMB,
        measured("slip", "m", lambda t: np.abs(along(t)).max(axis=0), at_most(1e-4)),
        measured("lift", "m", lambda t: np.abs(along(t, 1)).max(axis=0), at_most(1e-4)),
        measured("speed", "m/s", lambda t: speed(t).max(axis=0), at_most(1e-3)),
        of=experiments,
        curve=Curve("slip", "m", along),
    )


def creeps_not(duration):
    """Static friction holds without drift."""
    return case(
        f"V22 creep on an incline, 25 degrees, mu 0.6, {duration:g} s",
        COULOMB,
        measured("creep", "m", lambda t: np.abs(along(t)).max(axis=0), at_most(1e-4)),
        of=inclines(25.0, 0.6, duration=duration, every=24),
        curve=Curve("slip", "m", along),
    )


def slides():
    """Uniform acceleration."""
    distance = 0.5 * pull(30.0, 0.3)
    return case(
        "V22 block that slides down an incline from rest, 30 degrees, mu 0.3",
        COULOMB,
        measured("distance after 1 s", "m", lambda t: along(t)[-1], relative(5e-3), distance),
        of=inclines(30.0, 0.3, duration=1.0, every=4),
        curve=Curve("way", "m", along, lambda t: distance * t.time[:, None] ** 2),
    )


def way(trace):
    """Displacement of the block at the end, (envs,) [m]."""
    return along(trace)[-1]


def stops():
    """A block with an initial speed downhill stops and stays at rest."""
    degrees, friction, start = np.array([20.0, 10.0]), np.array([0.5, 0.3]), np.array([2.0, 1.0])
    time = start / -pull(degrees, friction)
    every = np.tile(time, 3)
    return case(
        "V22 block that slides downhill and stops",
        COULOMB,
        *stop_checks(speed, along, every, 0.5 * every * np.tile(start, 3), 0.01, 1e-4),
        of=(
            block_on_incline(CUBE, degrees, friction, start, duration=3.0),
            block_on_incline(SLAB, degrees, friction, start, duration=3.0),
            block_on_incline(SLAB, degrees, friction, start, mesh=True, duration=3.0),
        ),
        curve=Curve("way", "m", along),
    )


def authors_incline():
    """The two blocks of the accuracy test by the authors of the 2003 method, g = 9.8, e = 1."""
    slowing = -pull(20.0, 0.5, 9.8)
    options = {"restitution": 1.0, "gravity": 9.8}
    first = block_on_incline(SMALL, 20.0, 0.5, 1.25, duration=3.0, label="block 1", **options)
    second = block_on_incline(SMALL, 20.0, 0.25, duration=2.0, label="block 2", **options)
    slid = 0.5 * pull(20.0, 0.25, 9.8) * 2.0**2
    first_block = {"rows": [0], "labels": ("block 1",)}
    return case(
        "V22 the 2003 authors' two blocks on an incline, 20 degrees, e 1",
        "PhysBAM Sliding_Test, and Coulomb's law",
        *stop_checks(speed, along, 1.25 / slowing, 1.25**2 / (2 * slowing), 0.01, 1e-4, **first_block),
        measured("distance after 2 s", "m", way, relative(0.01), slid, rows=[1], labels=("block 2",)),
        of=(first, second),
        curve=Curve("way", "m", along),
    )


def incline_grid():
    """All combinations of slope and friction in one batch, and two degrees on either side of each friction angle."""
    frictions = (0.1, 0.3, 0.5, 0.7, 1.0)
    cells = [(mu, degrees) for mu in frictions for degrees in (3, 10, 20, 30, 40)]
    cells += [(mu, np.degrees(np.arctan(mu)) + side) for mu in frictions for side in (-2, 2)]
    friction, degrees = np.array(cells).T
    exact = 0.5 * np.maximum(pull(degrees, friction), 0.0)
    sliding = exact > 0.0
    experiment = block_on_incline(SLAB, degrees, friction, duration=1.0, every=24)
    moving, resting = (np.array(experiment.variants)[chosen].tolist() for chosen in (sliding, ~sliding))
    return case(
        "V22 grid of 25 slopes and frictions, and 2 degrees from each friction angle",
        COULOMB,
        measured("slides", "", lambda t: along(t)[-1] > 1e-4, OUTCOME, sliding),
        measured("distance after 1 s", "m", way, relative(5e-3), exact[sliding], sliding, labels=moving),
        measured("slip", "m", way, absolute(1e-5), rows=~sliding, labels=resting),
        of=experiment,
        curve=Curve("way", "m", along),
    )


def stopping_distance():
    """A box that slides on level ground.

    The velocities of a step include its friction before they move the body. The sum of these steps is v0 dt / 2 less
    than the integral: a first-order error, which is 1.4 % for the shortest way at dt 1/240, and halves with the step.
    """
    start, friction = np.array([(2.0, 0.2), (2.0, 0.4), (2.0, 0.7), (5.0, 0.5)]).T

    scene = on_ground(body(Box((0.25, 0.25, 0.25)), position=(0, 0, 0.25)))
    velocity = np.stack([start, 0 * start, 0 * start], axis=1)
    starts = per_env("friction", friction), *of_body(linear_velocity=velocity)

    def experiment(steps):
        names = tuple(f"v0 {v:g}, mu {mu:g}, dt 1/{steps}" for v, mu in zip(start, friction, strict=True))
        return Experiment(scene, 2.0, names, starts, dt=1 / steps, every=8)

    exact = np.tile(start**2 / (2 * friction * G), 2)
    by_steps = exact - 0.5 * np.outer([1 / 240, 1 / 480], start).ravel()

    def distance(trace):
        return trace.position[-1, :, 1, 0]

    # With the step 1/240 the error of the third way is more than 1 %.
    coarse, fine = [0, 1, 4, 5, 6], [3, 7]
    return case(
        "V23 stopping distance on level ground",
        COULOMB,
        measured("sum of the steps to stop", "m", distance, absolute(2e-4), by_steps),
        measured("distance to stop", "m", distance, relative(0.01), exact[coarse], coarse),
        measured("distance to stop", "m", distance, relative(0.005), exact[fine], fine),
        measured("speed at the end", "m/s", lambda t: t.speed[-1], at_most(1e-3)),
        of=(experiment(240), experiment(480)),
        curve=Curve("way", "m", lambda t: t.position[:, :, 1, 0]),
    )


def painleve():
    """A rod whose tip drags over the ground into Painleve's paradox, where Coulomb's law has no rigid solution.

    An engine must then stay finite and gain no energy. The paradox begins at
    mu = (1 + 3 cos^2) / (3 sin cos), which has its minimum 4/3 at a slope of 63.4 degrees.
    """
    angle, friction = np.radians(63.4), np.array([1.0, 1.5, 2.0])
    rod = Capsule(0.01, 0.49)
    place = (-0.49 * np.cos(angle), 0, 0.49 * np.sin(angle) + 0.01)
    # The rod leans forward over its dragging tip, as chalk pushed over a board.
    orientation = orientation_about((0, 1, 0), -(90 - np.degrees(angle)))
    scene = on_ground(body(rod, mass=1.0, position=place, orientation=orientation, linear_velocity=(1.0, 0, 0)))

    def tip_speed(trace):
        along_rod = trace.rotation[:, :, 1, :, 2]
        moving = trace.linear_velocity[:, :, 1] + np.cross(trace.angular_velocity[:, :, 1], -0.49 * along_rod)
        return moving[:, :, 0]

    return case(
        "V32 rod whose tip drags at 1 m/s, 63.4 degrees: Painleve's paradox from mu 4/3 on",
        "Coulomb's law: no gain of energy, no reversal of the slip within a step",
        gain_of_energy(lambda t: t.work_free_energy, 1e-3),
        measured("speed of the tip backwards", "m/s", lambda t: -tip_speed(t).min(axis=0), at_most(G / 240)),
        measured("largest speed", "m/s or rad/s", lambda t: t.speed.max(axis=0), at_most(0.0), 20.0),
        of=Experiment(scene, 0.1, tuple(f"mu {mu:g}" for mu in friction), (per_env("friction", friction),)),
        curve=Curve("speed of the tip", "m/s", tip_speed),
    )


LIGHT_TRAY = "load passes through the tray in more sweeps than an island in motion has"


def tray_of_boxes(side: int, mass: float, speed: float = 1.0):
    """Build a scene of boxes of 1 kg on a tray, side by side; tray and boxes start with a speed along x.

    Args:
        side: number of boxes along each edge of the tray.
        mass: of the tray [kg].
        speed: at the start [m/s].
    """
    half, pitch, thickness = 0.05, 0.12, 0.02
    edge = 0.5 * pitch * side + 0.02
    start = {"linear_velocity": (speed, 0, 0), "friction": 0.5}
    places = pitch * (np.mgrid[:side, :side].reshape(2, -1).T - 0.5 * (side - 1))
    return on_ground(
        body(Box((edge, edge, thickness)), position=(0, 0, thickness), mass=mass, **start),
        *(body(Box((half,) * 3), position=(x, y, 2 * thickness + half), mass=1.0, **start) for x, y in places),
        friction=0.5,
    )


def trays():
    """A tray and the boxes on it slide as one body: all decelerate by mu g."""
    speed, dt = 1.0, 1.0 / 240.0
    solved = {
        "9 boxes": (3, 1.0),
        "25 boxes": (5, 1.0),
        "25 boxes, 10 kg": (5, 10.0),
        "9 boxes, 0.1 kg": (3, 0.1),
        "25 boxes, 0.1 kg": (5, 0.1),
        "144 boxes": (12, 1.0),
        "400 boxes, 10 kg": (20, 10.0),
    }
    unsolved = {"400 boxes": (20, 1.0)}

    def shortest(trace):
        return (trace.position[-1, :, 1:, 0] - trace.position[0, :, 1:, 0]).min(1)

    def check(rows, miss=None):
        # Velocities change before positions do, so that the first step is shorter by mu g dt^2.
        way = speed**2 / (2 * 0.5 * G) - 0.5 * speed * dt
        return measured("shortest way of a body", "m", shortest, relative(0.01), way, rows=rows, miss=miss)

    return case(
        "V109 tray of boxes that slides, mu 0.5",
        COULOMB,
        check(slice(0, len(solved))),
        check(slice(len(solved), None), Miss(LIGHT_TRAY, 0.08)),
        of=tuple(
            Experiment(tray_of_boxes(*options), duration=0.4, dt=dt, label=label)
            for label, options in (solved | unsolved).items()
        ),
    )
