"""Rings fall on a field of poles, thread, lean and interlock.

Mass, friction, restitution, tilt and the cylinder of starts are those of Guendelman, Bridson and Fedkiw 2003 (500 or
1000 rings of 10 kg over 25 poles 7 m apart); the sizes of rings and poles are not from the paper.
"""

import math
from typing import Any

import numpy as np

from warp_rigid.checks import whole_in
from warp_rigid.rotations import rotate
from warp_rigid.scene.camera import Camera
from warp_rigid.scene.scene import Scene
from warp_rigid.scene.shapes import Cylinder
from warp_rigid.scenes.builders import assortment, grounds, meshes
from warp_rigid.scenes.builders.bodies import add_bodies
from warp_rigid.scenes.demo import ONE_PASS_2003, SOUND, OverlapOutcome, Verdict, indices, vary_starts

MASS = 10.0
SURFACE: dict[str, Any] = {"friction": 0.6, "restitution": 0.3}
TILT = 0.2
POLE_PITCH = 7.0
POLE_RADIUS, POLE_HALF_HEIGHT = 0.5, 6.0
RING_MAJOR, RING_MINOR = 2.4, 0.45
REACH = RING_MAJOR + RING_MINOR
CYLINDER_A_SIDE = 4.0
"""Radius of the cylinder of starts per pole along a side of the field [m]; 20 m for 5 x 5 poles."""
LOWEST_A_SIDE = 6.0
"""Lowest height of that cylinder per pole along a side [m]; 30 m for 5 x 5 poles."""
VOLUME_A_RING = math.pi * 20.0**2 * 0.6
"""Volume of that cylinder per ring [m^3]; 500 rings over 25 poles start between 30 and 330 m."""
DEEPEST = 0.055
"""Overlap that a ring may have at any time [m]: it lands on a pole at 15 m/s, 60 mm a step."""
LOST = 10.0
"""A ring further from the z axis than this many radii of the cylinder is lost."""


def build(rings: int = 12, poles: int = 4, seed: int = 0) -> Scene:
    """Tori of 10 kg at random positions in a cylinder above a square field of poles.

    Args:
        rings: number of rings, 1 to 2000; 500 and 1000 in the paper.
        poles: number of poles, a square number from 1 to 49; 25 in the paper.
        seed: of positions and tilts.
    """
    rings = whole_in("rings", rings, 1, 2000)
    side = _side(poles)
    position, orientation = starts(rings, poles, seed)
    scene = grounds.level_scene(name="ground", **SURFACE, camera=Camera.orbit(-67.0, 20.0))
    pole = Cylinder(POLE_RADIUS, POLE_HALF_HEIGHT)
    line = POLE_PITCH * (np.arange(side) - 0.5 * (side - 1))
    for i, (row, column) in enumerate(np.ndindex(side, side)):
        place = (line[row], line[column], POLE_HALF_HEIGHT)
        scene.add_static(pole, position=place, name=f"pole_{i}", **SURFACE)
    ring = meshes.torus(RING_MAJOR, RING_MINOR)
    add_bodies(scene, ring, position, orientation, names="ring", mass=MASS, **SURFACE)
    return scene


def starts(rings: int, poles: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Starts of the rings: positions (rings, 3) [m] and unit quaternions (rings, 4), without overlap.

    A position is drawn again until it is a ring's width away from all earlier ones (random sequential packing).
    """
    rng = np.random.default_rng((whole_in("seed", seed, 0, assortment.MOST_SEEDS), 3))
    radius, lowest = CYLINDER_A_SIDE * _side(poles), LOWEST_A_SIDE * _side(poles)
    height = rings * VOLUME_A_RING / (math.pi * radius**2)
    places = np.zeros((0, 3))
    while len(places) < rings:
        distance, angle = radius * math.sqrt(rng.random()), 2.0 * math.pi * rng.random()
        place = [distance * math.cos(angle), distance * math.sin(angle), lowest + height * rng.random()]
        if len(places) == 0 or np.linalg.norm(places - place, axis=1).min() > 2.0 * REACH:
            places = np.concatenate([places, [place]])
    half, about = 0.5 * TILT * rng.random(rings), 2.0 * math.pi * rng.random(rings)
    flat = np.zeros(rings)
    tilt = np.stack([np.sin(half) * np.cos(about), np.sin(half) * np.sin(about), flat, np.cos(half)], axis=1)
    return places, tilt


def _side(poles):
    """Poles along a side of the field."""
    side = math.isqrt(whole_in("poles", poles, 1, 49))
    if side * side != poles:
        raise ValueError(f"poles: must be a square number from 1 to 49, got {poles}")
    return side


def threaded(position, orientation, feet) -> np.ndarray:
    """Number of rings with a pole in their hole, (envs,).

    A ring counts if the pole's axis crosses the ring's plane within the hole, below the pole's top.

    Args:
        position: (envs, rings, 3) centres [m].
        orientation: (envs, rings, 4).
        feet: (poles, 2) positions of the poles [m].
    """
    axis = rotate(orientation, np.broadcast_to([0.0, 0.0, 1.0], position.shape))
    slant = np.where(np.abs(axis[..., 2]) > 1e-6, axis[..., 2], 1e-6)
    side = position[:, :, None, :2] - feet
    rise = np.einsum("erpk,erk->erp", side, axis[..., :2]) / slant[..., None]
    height = position[:, :, None, 2] + rise
    away = np.sqrt((side**2).sum(axis=-1) + rise**2)
    inside = (away < RING_MAJOR - RING_MINOR) & (height > 0.0) & (height < 2.0 * POLE_HALF_HEIGHT)
    return inside.any(axis=-1).sum(axis=1)


class RingsOutcome(OverlapOutcome):
    """Number of rings on poles, and whether none is lost and none overlaps another."""

    prefix = "ring_"

    def verdicts(self, sim):
        """Rings lost, rings on poles, and overlap."""
        position = sim.get("position")[:, self.bodies].astype(np.float64)
        orientation = sim.get("orientation")[:, self.bodies].astype(np.float64)
        feet = np.array([sim.scene.bodies[i].position[:2] for i in indices(sim.scene, "pole_")])
        bound = LOST * CYLINDER_A_SIDE * math.isqrt(len(feet))
        # A ring whose position is NaN counts as lost.
        there = (np.linalg.norm(position[..., :2], axis=-1) < bound) & (position[..., 2] > 0.0)
        lost = (~there).sum(axis=1)
        on_poles = threaded(position, orientation, feet)
        some = SOUND if len(self.bodies) >= 3 * len(feet) else {}
        return [
            Verdict("lost", lost, "no ring lost", lost == 0),
            Verdict("threaded", on_poles, "at least one ring on a pole", on_poles > 0, some),
            *self.overlap_verdicts(sim, 0.02, DEEPEST),
        ]


outcome = RingsOutcome
DURATION = 8.0
VARIANTS = {"one_pass": ONE_PASS_2003}
vary = vary_starts("ring_", starts)
