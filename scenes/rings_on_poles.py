"""Rings rain on a field of poles: nonconvex bodies that thread, lean and interlock.

Mass, friction, restitution, tilt and the cylinder of starts are those of Guendelman, Bridson and Fedkiw 2003 (500 or
1000 rings of 10 kg over 25 poles 7 m apart); the sizes of rings and poles are our own.
"""

import math
from typing import Any

import numpy as np

from warp_rigid.checks import whole_in
from warp_rigid.rotations import rotate
from warp_rigid.scene.scene import Scene
from warp_rigid.scene.shapes import Cylinder, Plane
from warp_rigid.scenes.builders import assortment, meshes
from warp_rigid.scenes.demo import (
    ONE_PASS_2003,
    Demo,
    Verdict,
    indices,
    overlap_verdict,
    start_apart,
)

MASS = 10.0
SURFACE: dict[str, Any] = {"friction": 0.6, "restitution": 0.3}
TILT = 0.2
POLE_PITCH = 7.0
POLE_RADIUS, POLE_HALF_HEIGHT = 0.5, 6.0
RING_MAJOR, RING_MINOR = 2.4, 0.45
REACH = RING_MAJOR + RING_MINOR
CYLINDER_A_SIDE = 4.0
"""Radius of the cylinder of starts for each pole along a side of the field [m]: 20 m for 5 x 5 poles."""
LOWEST_A_SIDE = 6.0
"""Its lowest height for each pole along a side [m]: 30 m for 5 x 5 poles."""
VOLUME_A_RING = math.pi * 20.0**2 * 0.6
"""Of the cylinder [m^3]: 500 rings over 25 poles start between 30 and 330 m."""
LOST = 10.0
"""A ring that rolls further than this many radii of the cylinder is lost."""


def build(rings: int = 12, poles: int = 4, seed: int = 0) -> Scene:
    """Tori of 10 kg at random places of a cylinder above a square field of poles.

    Args:
        rings: how many, 1 to 2000; the paper has 500 and 1000.
        poles: a square number from 1 to 49; the paper has 25.
        seed: of places and tilts.
    """
    rings = whole_in("rings", rings, 1, 2000)
    side = _side(poles)
    position, orientation = starts(rings, side, seed)
    scene = Scene()
    scene.add_static(Plane(normal=(0, 0, 1), offset=0.0), name="ground", **SURFACE)
    pole = Cylinder(POLE_RADIUS, POLE_HALF_HEIGHT)
    for i, place in enumerate(_pole_places(side)):
        scene.add_static(pole, position=(*place, POLE_HALF_HEIGHT), name=f"pole_{i}", **SURFACE)
    ring = meshes.torus(RING_MAJOR, RING_MINOR)
    for i in range(rings):
        scene.add_body(ring, position=position[i], orientation=orientation[i], mass=MASS, name=f"ring_{i}", **SURFACE)
    return scene


def starts(rings: int, side: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Where the rings start: positions (rings, 3) [m] and unit quaternions (rings, 4), none near another.

    Places are drawn until one is a ring's width away from all before, as in a random sequential packing.
    """
    rng = np.random.default_rng((whole_in("seed", seed, 0, assortment.MOST_SEEDS), 3))
    radius, lowest = CYLINDER_A_SIDE * side, LOWEST_A_SIDE * side
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


def _pole_places(side):
    """Feet of the poles, (side^2, 2) [m]."""
    line = POLE_PITCH * (np.arange(side) - 0.5 * (side - 1))
    return np.stack(np.meshgrid(line, line, indexing="ij"), axis=-1).reshape(-1, 2)


def threaded(position, orientation, feet) -> np.ndarray:
    """How many rings have a pole in their hole, (envs,).

    A ring has one if the pole's axis crosses the ring's plane within the hole, below the pole's top.

    Args:
        position: (envs, rings, 3) centres [m].
        orientation: (envs, rings, 4).
        feet: (poles, 2) where the poles stand [m].
    """
    axis = rotate(orientation, np.broadcast_to([0.0, 0.0, 1.0], position.shape))
    slant = np.where(np.abs(axis[..., 2]) > 1e-6, axis[..., 2], 1e-6)
    side = position[:, :, None, :2] - feet
    rise = np.einsum("erpk,erk->erp", side, axis[..., :2]) / slant[..., None]
    height = position[:, :, None, 2] + rise
    away = np.sqrt((side**2).sum(axis=-1) + rise**2)
    inside = (away < RING_MAJOR - RING_MINOR) & (height > 0.0) & (height < 2.0 * POLE_HALF_HEIGHT)
    return inside.any(axis=-1).sum(axis=1)


class RingsOutcome:
    """How many rings hang on poles, and whether all are there and none inside another."""

    def __init__(self, scene):
        """Find rings and poles."""
        self.rings = indices(scene, "ring_")
        self.feet = np.array([scene.bodies[i].position[:2] for i in indices(scene, "pole_")])
        self.bound = LOST * CYLINDER_A_SIDE * math.isqrt(len(self.feet))

    def observe(self, sim):
        """Nothing: the end tells."""

    def verdicts(self, sim):
        """Rings lost, rings on poles, and overlap at the end."""
        position = sim.get("position")[:, self.rings].astype(np.float64)
        orientation = sim.get("orientation")[:, self.rings].astype(np.float64)
        # A ring that is not a number is lost: the comparison must be true for it.
        there = (np.linalg.norm(position[..., :2], axis=-1) < self.bound) & (position[..., 2] > 0.0)
        lost = (~there).sum(axis=1)
        on_poles = threaded(position, orientation, self.feet)
        sound = {"default": True}
        some = sound if len(self.rings) >= 3 * len(self.feet) else {}
        return [
            Verdict("lost", lost, "no ring lost", lost == 0, sound),
            Verdict("threaded", on_poles, "at least one ring on a pole", on_poles > 0, some),
            overlap_verdict(sim, 0.02, sound),
        ]


def vary(sim, rings, poles, seed, **_):
    """Start environment e as the scene of seed + e does."""
    start_apart(sim, "ring_", lambda env: starts(rings, _side(poles), seed + env))


DEMO = Demo(
    name="rings_on_poles",
    summary="rings rain on a field of poles, thread, lean and interlock",
    build=build,
    outcome=RingsOutcome,
    duration=8.0,
    variants={"default": {}, "one_pass": ONE_PASS_2003},
    vary=vary,
)
