"""Bodies slide without friction over a concave terrain."""

from typing import Any

import numpy as np

from warp_rigid import rotations
from warp_rigid.checks import whole_in
from warp_rigid.scene.camera import Camera
from warp_rigid.scene.scene import Scene
from warp_rigid.scene.shapes import Heightfield
from warp_rigid.scenes.builders import assortment
from warp_rigid.scenes.builders.bodies import add_bodies
from warp_rigid.scenes.demo import OverlapOutcome, Verdict, above_heightfield, below, vary_starts

EXTENT = 20.0
VERTICES = 81
STEEPNESS = 0.04
HILLS = 0.12
RADIUS = 0.4
PITCH = 1.4
SURFACE: dict[str, Any] = {"friction": 0.0, "restitution": 0.3}


def build(bodies: int = 16, seed: int = 0) -> Scene:
    """Convex bodies of about 0.6 m above a bowl of 20 x 20 m with low hills, 8 m deep.

    Args:
        bodies: number of bodies, 1 to 1000.
        seed: of hills, kinds, sizes and starts.
    """
    bodies = whole_in("bodies", bodies, 1, 1000)
    position, orientation = starts(bodies, seed)
    scene = Scene(camera=Camera.orbit(-67.0, 34.0))
    scene.add_static(Heightfield(_heights(seed), (EXTENT, EXTENT)), name="terrain", **SURFACE)
    shapes = assortment.convex_solids(bodies, seed, RADIUS)
    add_bodies(scene, shapes, position, orientation, names="body", **SURFACE)
    return scene


def _heights(seed):
    """A paraboloid with a few long waves."""
    rng = np.random.default_rng((whole_in("seed", seed, 0, assortment.MOST_SEEDS), 6))
    x, y = np.meshgrid(*2 * [np.linspace(-0.5, 0.5, VERTICES) * EXTENT], indexing="ij")
    heights = STEEPNESS * (x**2 + y**2)
    for angle, phase in zip(rng.uniform(0, np.pi, 5), rng.uniform(0, 2 * np.pi, 5), strict=True):
        heights += HILLS * np.sin(1.2 * (np.cos(angle) * x + np.sin(angle) * y) + phase)
    return heights


def starts(bodies: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Starts of the bodies: positions (bodies, 3) [m] and unit quaternions (bodies, 4).

    The bodies start on a spiral around the middle of the bowl, in layers of 60.
    """
    rng = np.random.default_rng((whole_in("seed", seed, 0, assortment.MOST_SEEDS), 7))
    i = np.arange(bodies)
    distance, angle = 0.6 * PITCH * np.sqrt(i % 60 + 4.0), np.pi * (3.0 - 5.0**0.5) * i + rng.uniform(0.0, 2.0 * np.pi)
    height = STEEPNESS * distance**2 + 5 * HILLS + RADIUS + 0.6 + PITCH * (i // 60)
    position = np.stack([distance * np.cos(angle), distance * np.sin(angle), height], axis=1)
    return position, rotations.random(rng, bodies)


class SlideOutcome(OverlapOutcome):
    """Whether all bodies stay above the terrain and their energy never increases."""

    first = last = None
    """Energy of the first frame and of the last one, (envs,) [J]."""

    def observe(self, sim):
        """Record overlap, bodies below the surface, and the largest increase of energy from frame to frame."""
        super().observe(sim)
        _, above = above_heightfield(sim, self.bodies, 0.5 * EXTENT)
        energy = (sim.get("kinetic_energy") + sim.get("potential_energy"))[:, self.bodies].sum(axis=1)
        if self.last is None:
            self.first, self.last = np.maximum(np.abs(energy), 1e-9), energy
        gain = np.maximum((energy - self.last) / self.first, 0.0)
        self.keep_largest(sunk=(~above).sum(axis=1), gain=gain)
        self.last = energy

    def judge(self, sim):
        """Bodies below the surface, energy gained, overlap."""
        sunk, gain = self.largest["sunk"], self.largest["gain"]
        return [
            Verdict("sunk", sunk, "no body below the surface or beyond its edge at any time", sunk == 0),
            below("gain", gain, 1e-3, "energy increase < 0.1 % in every frame", unit="%"),
            *self.overlap_verdicts(sim, 5e-3, 0.025),
        ]


outcome = SlideOutcome
DURATION = 5.0
vary = vary_starts("body_", starts)
