"""Section I: blocks that rock, closed rooms at large time steps, and the same results again."""

import tempfile
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from warp_rigid import scenes
from warp_rigid.engine.settings import Settings
from warp_rigid.engine.simulator import Simulator
from warp_rigid.scene.scene import Scene
from warp_rigid.scene.shapes import Box, Capsule, Cylinder, Plane, Sphere
from warp_rigid.scenes.builders.grounds import EARTH
from warp_rigid.scenes.builders.scene_parts import body, in_space, static
from warp_rigid.validation.case import Cases, Check, Curve, Miss, ValidationCase, at_most, case, measured, relative
from warp_rigid.validation.common import G
from warp_rigid.validation.experiment import STATES, Experiment, Trace

BLOCKS = ((0.1, 0.4, 0.1), (0.05, 0.4, 0.06), (0.2, 0.4, 0.2))
"""Half width and half height [m] of the blocks, and the angle from which they are released [rad]."""
FIRST_ORDER = "an impact acts on the velocities at the end of its step, not at the time of contact"
ROOM_TIME, MOST_IN_ROOM = 2.0, 40
"""Time for which rooms are watched [s], and largest number of bodies in one."""
WALLS = 6
"""Number of walls, which are the first bodies of a room."""
STEPS = 60
"""Steps of a scene before and after it is saved."""


def cases(quick: bool) -> Cases:
    """All cases of the section; few rooms and scenes if quick."""
    chosen = scenes.names()[:3] if quick else scenes.names()
    return [rocking(), closed_rooms(20 if quick else 200, (1 / 60, 1 / 30, 0.1)), same_again(chosen)]


def angles(trace: Trace) -> np.ndarray:
    """Angle of the block about y at each record [rad]."""
    turn = trace.orientation[:, 0, 1]
    return 2.0 * np.arctan2(turn[:, 1], turn[:, 3])


def rocking() -> ValidationCase:
    """A block that is released on one edge falls, hits the ground with the other edge, and rises again."""

    def experiment(b: float, h: float, start: float) -> Experiment:
        c, s = np.cos(start), np.sin(start)
        place, turn = (h * s - b * c, 0, b * s + h * c), (0, np.sin(0.5 * start), 0, np.cos(0.5 * start))
        block = body(Box((b, 3 * b, h)), position=place, orientation=turn, friction=1.0)
        ground = static(Plane(), friction=1.0)
        return Experiment(in_space(ground, block, gravity=EARTH), 2.0, label=f"{b} x {h} m, {start} rad")

    def quarter(trace: Trace) -> float:
        """Time at which the block is upright for the first time [s]."""
        angle = angles(trace)
        k = np.flatnonzero(np.diff(np.sign(angle)))[0]
        return trace.time[k] + trace.experiment.dt * angle[k] / (angle[k] - angle[k + 1])

    def kept(trace: Trace) -> float:
        """Energy at the largest angle after the first impact, relative to that at the start."""
        angle, changes = np.abs(angles(trace)), np.flatnonzero(np.diff(np.sign(angles(trace))))
        rise = angle[changes[0] + 1 : changes[1]].max()
        shape: Any = trace.scene.bodies[1].shape
        alpha = np.arctan2(shape.half_extents[0], shape.half_extents[2])
        return (np.cos(alpha - rise) - np.cos(alpha)) / (np.cos(alpha - angle[0]) - np.cos(alpha))

    b, h, _ = np.array(BLOCKS).T
    exact, miss = (1.0 - 1.5 * np.sin(np.arctan2(b, h)) ** 2) ** 2, Miss(FIRST_ORDER, 0.2)
    return case(
        "V106 rocking block",
        "integral of the equation of motion; Housner 1963, The behavior of inverted pendulum structures",
        measured("quarter of the period", "s", quarter, relative(0.01), [fall_time(*block) for block in BLOCKS]),
        measured("energy kept by the first impact", "", kept, relative(0.03), exact, miss=miss),
        of=tuple(experiment(*block) for block in BLOCKS),
        curve=Curve("angle", "rad", lambda t: angles(t)[:, None]),
    )


def fall_time(b: float, h: float, start: float) -> float:
    """Time in which a block on one edge falls from an angle until it is upright [s].

    The midpoint rule for u, with the angle start - u^2, in which the integrand is finite.
    """
    alpha, count = np.arctan2(b, h), 10_000
    u = np.sqrt(start) * (np.arange(count) + 0.5) / count
    speed = np.sqrt(1.5 * G / np.hypot(b, h) * (np.cos(alpha - start) - np.cos(alpha - start + u**2)))
    return float((2.0 * u / speed).mean() * np.sqrt(start))


def random_room(seed: int, most: int) -> tuple[Scene, np.ndarray, float]:
    """A closed room of random size with walls of 1 to 50 cm, and up to `most` random bodies of up to 40 m/s.

    Returns:
        The scene, the half widths of the room [m], (3,), and the thickness of its walls [m].
    """
    draw = np.random.default_rng(seed)
    half, wall = draw.uniform(0.6, 2.0, 3), np.exp(draw.uniform(np.log(0.01), np.log(0.5)))
    restitution = draw.choice([0, 0.5, 1.0]) if draw.random() < 0.6 else draw.uniform(0, 1)
    material: dict[str, Any] = {"restitution": restitution, "friction": draw.choice([0, 0.3, 0.8])}
    scene = Scene()
    for axis in range(3):
        for sign in (-1, 1):
            extents, place = half + 2 * wall, np.zeros(3)
            extents[axis], place[axis] = wall / 2, sign * (half[axis] + wall / 2)
            scene.add_static(Box(extents), position=place, **material)
    count = int(draw.integers(1, most + 1))
    across = int(np.ceil(count ** (1 / 3)))
    cells = list(np.ndindex(across, across, across))
    draw.shuffle(cells)
    spacing = 2 * half / across
    room = float(np.prod(half) * 0.96 / count) ** (1 / 3)
    largest = min(0.25 * min(0.7, room), 0.3 * float(spacing.min()))
    fastest = draw.uniform(1, 40)
    for cell in cells[:count]:
        size = largest * draw.uniform(0.4, 1)
        extents = tuple(size * draw.uniform(0.2, 0.6, 3))
        kinds = [Box(extents), Sphere(size * 0.6), Capsule(size * 0.3, size * 0.5), Cylinder(size * 0.5, size * 0.4)]
        shape, velocity = kinds[draw.integers(4)], draw.normal(size=3)
        velocity *= fastest * draw.uniform(0.2, 1) / np.linalg.norm(velocity)
        turned = np.random.RandomState(draw.integers(1 << 30)).normal(size=4)
        spin = 5 * draw.normal(size=3)
        place = spacing * (np.array(cell) + 0.5) - half
        motion: dict[str, Any] = {"linear_velocity": velocity, "angular_velocity": spin}
        scene.add_body(shape, position=place, orientation=turned / np.linalg.norm(turned), **motion, **material)
    return scene, half, wall


def escaped(seeds: Sequence[int], dt: float, device: str, most: int = MOST_IN_ROOM) -> int:
    """Number of random rooms of up to `most` bodies that a body leaves."""
    built, half, wall = zip(*(random_room(seed, most) for seed in seeds), strict=True)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "dt: body")  # the steps are meant to be large
        sim = Simulator(list(built), settings=Settings(dt=dt), device=device)
    bound = (np.array(half) + np.array(wall)[:, None])[:, None]
    left = np.zeros(len(built), bool)
    for _ in range(round(ROOM_TIME / dt)):
        sim.step(1)
        inside = (np.abs(sim.get("position")) <= bound).all(axis=2) | ~sim.exists
        left |= ~inside[:, WALLS:].all(axis=1)
    return int(left.sum())


def closed_rooms(count: int, steps: tuple[float, ...]) -> ValidationCase:
    """Random closed rooms: no body leaves one."""
    return case(
        f"V107 {count} random closed rooms with up to {MOST_IN_ROOM} fast bodies, {ROOM_TIME:g} s",
        "what is in a closed room stays inside",
        Check("rooms that a body leaves", "", lambda found: found, at_most(0.0)),
        compute=lambda device: [escaped(range(count), dt, device) for dt in steps],
        labels=tuple(f"dt 1/{1 / dt:.0f}" for dt in steps),
    )


def differences(name: str, device: str) -> int:
    """Number of quantities of a scene that differ after a reset, or after its state was stored and loaded."""

    def state(sim: Simulator) -> list[bytes]:
        return [sim.get(quantity).tobytes() for quantity in STATES]

    demo = scenes.get(name)
    sim = Simulator(demo.build(), settings=Settings(**demo.settings), device=device)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "state.npz"
        sim.step(STEPS)
        sim.save(file)
        sim.step(STEPS)
        end = state(sim)
        again = Simulator.load(file, device=device)
        again.step(STEPS)
    found = sum(one != other for one, other in zip(end, state(again), strict=True))
    sim.reset()
    sim.step(2 * STEPS)
    return found + sum(one != other for one, other in zip(end, state(sim), strict=True))


def same_again(names: list[str]) -> ValidationCase:
    """Every built-in scene ends with the same bits after a reset, and after it was stored and loaded."""
    return case(
        "V105 built-in scenes after a reset, and after save and load",
        "a fresh start, an uninterrupted run",
        Check("quantities whose bits differ", "", lambda found: found, at_most(0.0)),
        compute=lambda device: [differences(name, device) for name in names],
        labels=tuple(names),
    )
