"""Random convex bodies fall on a fixed slab and come to rest."""

import math

import numpy as np

from warp_rigid import rotations
from warp_rigid.checks import whole_in
from warp_rigid.scene.camera import Camera
from warp_rigid.scene.scene import Scene
from warp_rigid.scene.shapes import Box
from warp_rigid.scenes.builders import assortment, piles
from warp_rigid.scenes.builders.bodies import add_bodies
from warp_rigid.scenes.demo import OverlapOutcome, Verdict, outside, vary_starts

RADIUS = 0.2
PITCH = 0.6
JITTER = 0.04
LOWEST = 0.8
SLAB_HALF_HEIGHT = 0.25
SURFACE = assortment.rough_surface(RADIUS)


def build(bodies: int = 100, seed: int = 0) -> Scene:
    """Cubes, spheres, cylinders and polyhedra of 0.3 to 0.5 m at jittered lattice points above a slab.

    Args:
        bodies: number of bodies, 1 to 20 000.
        seed: of kinds, sizes and starts.
    """
    bodies = whole_in("bodies", bodies, 1, 20_000)
    position, orientation = starts(bodies, seed)
    scene = Scene(camera=Camera.orbit(-60.0, 28.0))
    half = slab_half(bodies)
    scene.add_static(Box((half, half, SLAB_HALF_HEIGHT)), position=(0, 0, -SLAB_HALF_HEIGHT), name="slab", **SURFACE)
    shapes = assortment.convex_solids(bodies, seed, RADIUS)
    add_bodies(scene, shapes, position, orientation, names="body", **SURFACE)
    return scene


def starts(bodies: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Starts of the bodies: positions (bodies, 3) [m] and unit quaternions (bodies, 4)."""
    rng = np.random.default_rng((whole_in("seed", seed, 0, assortment.MOST_SEEDS), 1))
    position = piles.lattice(bodies, _side(bodies), PITCH, LOWEST) + rng.uniform(-JITTER, JITTER, (bodies, 3))
    return position, rotations.random(rng, bodies)


def slab_half(bodies: int) -> float:
    """Half of the slab's width [m], with a margin for bodies that roll aside."""
    return 0.5 * _side(bodies) * PITCH + 2.0


def _side(bodies):
    """Lattice points along each side; the lattice is about half as high as wide."""
    return math.ceil((2.0 * bodies) ** (1.0 / 3.0))


class RainOutcome(OverlapOutcome):
    """Whether all bodies rest on the slab and none overlaps another."""

    def verdicts(self, sim):
        """Bodies off the slab, bodies at rest, contacts at the end, overlap."""
        off = outside(sim, self.bodies, slab_half(len(self.bodies))).sum(axis=1)
        return [
            Verdict("off_slab", off, "no body off the slab", off == 0),
            *self.settled_verdicts(sim, 7e-4, 0.03),
        ]


outcome = RainOutcome
DURATION = 4.0
vary = vary_starts("body_", starts)
