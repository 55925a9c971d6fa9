"""A belt carries parcels, and an arm on a path sends the large ones into another bin."""

import math

import numpy as np

from warp_rigid.checks import number_in, whole_in
from warp_rigid.scene.camera import Camera
from warp_rigid.scene.look import Look
from warp_rigid.scene.pose_path import PosePath
from warp_rigid.scene.scene import Scene
from warp_rigid.scene.shapes import Box
from warp_rigid.scenes.builders import grounds
from warp_rigid.scenes.demo import ONE_PASS_2003, SceneOutcome, Verdict

GRAVITY = 9.81
SIZES = {"small": 0.07, "medium": 0.1, "large": 0.13}
"""Half of the edges of the parcels, in the order in which they come [m]."""
PITCH, FIRST = 1.3, -1.0
"""Distance of the parcels at the start, and place of the first one along the belt; the arm turns at x = 0 [m]."""
HALF_WIDTH, END, TOP = 0.35, 1.5, 0.6
PIVOT = -0.4
"""Place of the arm's hinge across the belt [m]."""
ARM_HALF = (0.5, 0.02, 0.1)
ANGLE = 45.0
"""Angle of the arm across the belt [degree]."""
BEFORE, SWING = 0.2, 0.24
"""Way of a parcel to the hinge when the arm starts to swing, and its way while the arm swings [m]."""
LEAST_WAY = 0.5
"""Way on the belt from which it is compared with the closed form [m]."""
BINS = {"straight": (END + 0.65, 0.0), "side": (0.8, 0.95)}
BIN_HALF, WALL_HALF, BIN_HEIGHT = 0.55, 0.02, 0.3
RUBBER = (0.03, 0.045, 0.06)
"""Colour of the belt, in linear light."""


def build(parcels: int = 6, speed: float = 1.5, friction: float = 0.5) -> Scene:
    """Parcels of three sizes on a belt 0.7 m wide, an arm without friction, and a bin for each lane.

    Args:
        parcels: number of parcels, 1 to 30; every third one is large. They start at rest.
        speed: of the belt [m/s], 0.3 to 1.5. The arm swings at the times that follow from it.
        friction: of belt and parcels, 0.3 to 0.9.
    """
    parcels = whole_in("parcels", parcels, 1, 30)
    speed = number_in("speed", speed, 0.3, 1.5)
    friction = number_in("friction", friction, 0.3, 0.9)
    scene = grounds.level_scene((0, 0, -GRAVITY), name="ground", camera=Camera.orbit(50.0, 30.0))
    begin = FIRST - PITCH * (parcels - 1) - 0.3
    half, middle = (0.5 * (END - begin), HALF_WIDTH, 0.5 * TOP), (0.5 * (begin + END), 0.0, 0.5 * TOP)
    belt = scene.add_static(Box(half), position=middle, surface_velocity=(speed, 0, 0), friction=friction, name="belt")
    scene.looks[belt] = Look(RUBBER)
    scene.add_kinematic(Box(ARM_HALF), path=arm_path(parcels, speed, friction), friction=0.0, name="arm")
    for name, center in BINS.items():
        grounds.add_bin(scene, BIN_HALF, BIN_HEIGHT, 2.0 * WALL_HALF, center=center, names=f"{name}_bin")
    for k in range(parcels):
        size, edge = list(SIZES.items())[k % len(SIZES)]
        place = (FIRST - PITCH * k, 0.0, TOP + edge)
        scene.add_body(Box((edge,) * 3), position=place, density=200.0, friction=friction, name=f"parcel_{k}_{size}")
    return scene


def way_of_parcel(time: float, speed: float, friction: float) -> float:
    """Way of a parcel at a time after it was put on the belt: first mu g t^2 / 2, then with the belt [m]."""
    pull = friction * GRAVITY
    return 0.5 * pull * time**2 if time < speed / pull else speed * time - 0.5 * speed**2 / pull


def arm_path(parcels: int, speed: float, friction: float) -> PosePath:
    """The arm is closed from each large parcel to the next one, and else beside the belt."""
    times, angles = [0.0], [0.0]
    for k in range(2, parcels, len(SIZES)):
        way = PITCH * k - FIRST - BEFORE
        for start, change in ((way, ANGLE), (way + PITCH, -ANGLE)):
            time = start / speed + 0.5 * speed / (friction * GRAVITY)
            times += [time, time + SWING / speed]
            angles += [angles[-1], angles[-1] + change]
    times.append(times[-1] + 1.0)
    angle = np.radians([*angles, angles[-1]])
    zero = np.zeros_like(angle)
    direction = np.stack([np.cos(angle), np.sin(angle), zero], axis=1)
    hinge = (0.0, PIVOT, TOP + ARM_HALF[2] + 0.01)
    return PosePath(
        times,
        hinge + ARM_HALF[0] * direction,
        np.stack([zero, zero, np.sin(0.5 * angle), np.cos(0.5 * angle)], axis=1),
    )


class SortingOutcome(SceneOutcome):
    """Parcels in their bins, their way on the belt, and their speed along the arm."""

    prefix = "parcel_"

    def __init__(self, scene):
        """Note which parcels are large."""
        super().__init__(scene)
        self.large = np.array([scene.bodies[i].name.endswith("large") for i in self.bodies])
        belt = scene.bodies[scene.index("belt")]
        self.speed, self.friction = belt.surface_velocity[0], belt.friction
        self.along = None

    def observe(self, sim):
        """Compare the ways of parcels before the arm with the closed form; record speeds along the closed arm."""
        x, y, _ = np.moveaxis(sim.get("position")[:, self.bodies].astype(np.float64), -1, 0)
        expected = way_of_parcel(float(sim.time), self.speed, self.friction)
        start = self.start[:, 0]
        before = start + expected < -BEFORE
        # Steps of dt add speed dt / 2 to a way.
        if expected > LEAST_WAY and before.any():
            self.keep_largest(error=np.abs((x - start)[:, before] / expected - 1.0).max(axis=1))
        speed = np.linalg.norm(sim.get("linear_velocity")[:, self.bodies], axis=-1)
        slides = self.large & (np.abs(y - 0.5 * HALF_WIDTH) < 0.25 * HALF_WIDTH)
        now = np.where(slides.any(axis=1), (speed * slides).max(axis=1), np.nan)
        self.along = now if self.along is None else np.where(np.isnan(now), self.along, now)

    def verdicts(self, sim):
        """Sorted parcels, once all have arrived; the worst relative error of a way; the last speed along the arm."""
        if self.along is None:
            return []
        sound = {"default": True, "one_pass": True}
        x, y, z = np.moveaxis(sim.get("position")[:, self.bodies].astype(np.float64), -1, 0)
        place = np.where(self.large[:, None], BINS["side"], BINS["straight"])
        inside = (np.abs(x - place[:, 0]) < BIN_HALF) & (np.abs(y - place[:, 1]) < BIN_HALF) & (z < TOP)
        count = inside.sum(axis=1)
        found = []
        if "error" in self.largest:
            error = self.largest["error"]
            found.append(Verdict("way_error", error, "way on the belt within 1 %", error < 0.01, sound, "%"))
        if not np.isnan(self.along).any():
            expected = self.speed * math.cos(math.radians(ANGLE))
            passed = np.abs(self.along / expected - 1.0) < 0.05
            text = f"slides along the arm within 5 % of {expected:.3f} m/s"
            found.append(Verdict("slide", self.along, text, passed, sound, "m/s"))
        if way_of_parcel(float(sim.time), self.speed, self.friction) > END + 0.5 - self.start[:, 0].min():
            text = f"all {len(self.bodies)} parcels in their bins"
            found.insert(0, Verdict("sorted", count, text, count == len(self.bodies), sound))
        return found


outcome = SortingOutcome
DURATION = 8.0
VARIANTS = {"one_pass": ONE_PASS_2003}
