"""Bodies fall from all sides on a small planet and settle all around it."""

import numpy as np

from warp_rigid import rotations
from warp_rigid.checks import whole_in
from warp_rigid.scene.camera import Camera
from warp_rigid.scene.fields import PointField
from warp_rigid.scene.scene import Scene
from warp_rigid.scene.shapes import Mesh, tessellation
from warp_rigid.scenes.builders import assortment
from warp_rigid.scenes.builders.bodies import add_bodies
from warp_rigid.scenes.demo import SOUND, OverlapOutcome, Verdict, vary_starts

PLANET_RADIUS = 5.0
FACETS = 4
"""The planet has 20 FACETS^2 flat triangles; on a smooth ball a cube would rock for a minute."""
RESOLUTION = 96
STRENGTH = 100.0
RADIUS = 0.5
NEAREST, SPREAD = 6.5, 1.5
KICK = 0.3
SURFACE = assortment.rough_surface(RADIUS)


def build(bodies: int = 40, seed: int = 0) -> Scene:
    """Convex bodies of about 0.8 m on shells around a faceted ball of radius 5 m; gravity at its surface is 4 m/s^2.

    Args:
        bodies: number of bodies, 1 to 5000; a shell holds 60.
        seed: of kinds, sizes, starts and initial velocities.
    """
    bodies = whole_in("bodies", bodies, 1, 5000)
    position, orientation, velocity = starts(bodies, seed)
    scene = Scene(gravity=(0, 0, 0), camera=Camera.orbit(-67.0, 20.0))
    scene.add_force_field(PointField(center=(0, 0, 0), strength=STRENGTH))
    corners, faces = tessellation.geodesic(FACETS)
    scene.add_static(Mesh(PLANET_RADIUS * corners, faces, RESOLUTION), name="planet", **SURFACE)
    shapes = assortment.convex_solids(bodies, seed, RADIUS)
    add_bodies(scene, shapes, position, orientation, linear_velocities=velocity, names="body", **SURFACE)
    return scene


def starts(bodies: int, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Starts of the bodies: positions [m], unit quaternions and velocities [m/s].

    A shell holds up to 60 bodies on a spiral of equal areas, rotated at random.
    """
    rng = np.random.default_rng((whole_in("seed", seed, 0, assortment.MOST_SEEDS), 2))
    shells = -(-bodies // 60)
    position = np.concatenate([_shell(min(60, bodies - 60 * k), NEAREST + SPREAD * k, rng) for k in range(shells)])
    return position, rotations.random(rng, bodies), rng.normal(scale=KICK, size=(bodies, 3))


def _shell(count, radius, rng):
    """Points of a Fibonacci spiral on a sphere, rotated at random."""
    k = np.arange(count)
    z = 1.0 - (2.0 * k + 1.0) / count
    angle = np.pi * (3.0 - 5.0**0.5) * k
    flat = np.sqrt(1.0 - z * z)
    points = radius * np.stack([flat * np.cos(angle), flat * np.sin(angle), z], axis=1)
    rotation, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    return points @ rotation


class PlanetOutcome(OverlapOutcome):
    """Whether the bodies settled on all sides of the planet."""

    def verdicts(self, sim):
        """Octants with bodies, bodies lost, bodies at rest, contacts at the end, overlap."""
        position = sim.get("center_of_mass")[:, self.bodies]
        distance = np.linalg.norm(position, axis=-1)
        lost = (~((distance > PLANET_RADIUS) & (distance < NEAREST + SPREAD))).sum(axis=1)
        octant = ((position > 0.0) * [1, 2, 4]).sum(axis=-1)
        sides = np.array([len(np.unique(row)) for row in octant])
        around = SOUND if len(self.bodies) > 30 else {}
        return [
            Verdict("lost", lost, "no body inside the planet or far from it", lost == 0),
            Verdict("octants", sides, "bodies in all 8 octants around the planet", sides == 8, around),
            *self.settled_verdicts(sim, 5e-3, 0.015),
        ]


outcome = PlanetOutcome
DURATION = 8.0
vary = vary_starts("body_", starts)
