"""Bodies fall from all sides on a small planet and settle all around it: nothing knows an "up"."""

from typing import Any

import numpy as np

from warp_rigid import rotations
from warp_rigid.checks import whole_in
from warp_rigid.scene.fields import PointField
from warp_rigid.scene.scene import Scene
from warp_rigid.scene.shapes import Mesh, tessellation
from warp_rigid.scenes.builders import assortment
from warp_rigid.scenes.demo import (
    Demo,
    Verdict,
    contacts_verdict,
    indices,
    overlap_verdict,
    resting_verdict,
    start_apart,
)

PLANET_RADIUS = 5.0
FACETS = 4
"""The planet is a ball of 20 FACETS^2 flat triangles: on a perfect ball a cube rocks for a minute."""
RESOLUTION = 96
STRENGTH = 100.0
RADIUS = 0.5
NEAREST, SPREAD = 6.5, 1.5
KICK = 0.3
SURFACE: dict[str, Any] = {"friction": 0.9, "restitution": 0.1, "rolling_friction": 0.15 * RADIUS}


def build(bodies: int = 40, seed: int = 0) -> Scene:
    """Convex bodies of about 0.8 m on shells around a faceted ball of radius 5 m that pulls with 4 m/s^2 there.

    Args:
        bodies: how many, 1 to 5000; every 60 fill one more shell.
        seed: of kinds, sizes, starts and first velocities.
    """
    bodies = whole_in("bodies", bodies, 1, 5000)
    position, orientation, velocity = starts(bodies, seed)
    scene = Scene(gravity=(0, 0, 0))
    scene.add_force_field(PointField(center=(0, 0, 0), strength=STRENGTH))
    corners, faces = tessellation.geodesic(FACETS)
    scene.add_static(Mesh(PLANET_RADIUS * corners, faces, RESOLUTION), name="planet", **SURFACE)
    for i, shape in enumerate(assortment.convex_solids(bodies, seed, RADIUS)):
        scene.add_body(
            shape,
            position=position[i],
            orientation=orientation[i],
            linear_velocity=velocity[i],
            name=f"body_{i}",
            **SURFACE,
        )
    return scene


def starts(bodies: int, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where the bodies of an environment start: positions [m], unit quaternions and velocities [m/s].

    A shell holds up to 60 bodies on a spiral of equal areas, turned at random.
    """
    rng = np.random.default_rng((whole_in("seed", seed, 0, assortment.MOST_SEEDS), 2))
    shells = -(-bodies // 60)
    position = np.concatenate([_shell(min(60, bodies - 60 * k), NEAREST + SPREAD * k, rng) for k in range(shells)])
    return position, rotations.random(rng, bodies), rng.normal(scale=KICK, size=(bodies, 3))


def _shell(count, radius, rng):
    """Points of a Fibonacci spiral on a sphere, turned by a random rotation."""
    k = np.arange(count)
    z = 1.0 - (2.0 * k + 1.0) / count
    angle = np.pi * (3.0 - 5.0**0.5) * k
    flat = np.sqrt(1.0 - z * z)
    points = radius * np.stack([flat * np.cos(angle), flat * np.sin(angle), z], axis=1)
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    return points @ turn


class PlanetOutcome:
    """Whether the bodies settled on the planet, on all sides of it."""

    def __init__(self, scene):
        """Find the bodies."""
        self.bodies = indices(scene, "body_")

    def observe(self, sim):
        """Nothing: the end tells."""

    def verdicts(self, sim):
        """Octants with bodies, bodies lost, bodies at rest, contacts and overlap at the end."""
        position = sim.get("center_of_mass")[:, self.bodies]
        distance = np.linalg.norm(position, axis=-1)
        lost = (~((distance > PLANET_RADIUS) & (distance < NEAREST + SPREAD))).sum(axis=1)
        octant = ((position > 0.0) * [1, 2, 4]).sum(axis=-1)
        sides = np.array([len(np.unique(row)) for row in octant])
        sound = {"default": True}
        around = sound if len(self.bodies) > 30 else {}
        return [
            Verdict("lost", lost, "none inside the planet or away from it", lost == 0, sound),
            Verdict("octants", sides, "bodies in all 8 octants around the planet", sides == 8, around),
            resting_verdict(sim, self.bodies, sound),
            contacts_verdict(sim, self.bodies, sound),
            overlap_verdict(sim, 5e-3, sound),
        ]


def vary(sim, bodies, seed, **_):
    """Start environment e where the scene of seed + e does; the shapes stay those of the first."""
    start_apart(sim, "body_", lambda env: starts(bodies, seed + env))


DEMO = Demo(
    name="planet",
    summary="bodies fall from all sides on a small planet and settle all around it",
    build=build,
    outcome=PlanetOutcome,
    duration=8.0,
    variants={"default": {}},
    vary=vary,
)
