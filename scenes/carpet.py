"""A travelling wave of the ground throws and transports bodies."""

from typing import Any

import numpy as np

from warp_rigid import rotations
from warp_rigid.checks import number_in, whole_in
from warp_rigid.scene.camera import Camera
from warp_rigid.scene.scene import Scene
from warp_rigid.scene.shapes import HarmonicMotion, Heightfield
from warp_rigid.scenes.builders import assortment, piles
from warp_rigid.scenes.builders.bodies import add_bodies
from warp_rigid.scenes.demo import SOUND, OverlapOutcome, Verdict, above_heightfield, vary_starts

EXTENT = 30.0
VERTICES = 61
FREQUENCY = 5.0
WAVE_LENGTH = 10.0
RADIUS = 0.5
PITCH = 1.6
SURFACE: dict[str, Any] = {"friction": 0.5, "restitution": 0.3}
THROW = 0.1


def build(bodies: int = 16, amplitude: float = 0.5, seed: int = 0) -> Scene:
    """Convex bodies of about 0.8 m above 30 x 30 m of ground with a diagonal wave of 5 rad/s.

    Args:
        bodies: number of bodies, 1 to 400.
        amplitude: of the wave, 0 to 1 m; from 0.39 m the ground's acceleration exceeds
            gravity, and it throws bodies.
        seed: of kinds, sizes and starts.
    """
    bodies = whole_in("bodies", bodies, 1, 400)
    position, orientation = starts(bodies, seed, amplitude)
    x, y = np.meshgrid(*2 * [np.linspace(-0.5, 0.5, VERTICES) * EXTENT], indexing="ij")
    phase = -2.0 * np.pi / WAVE_LENGTH * (x + y) / 2.0**0.5
    wave = Heightfield(np.zeros_like(x), (EXTENT, EXTENT), HarmonicMotion(amplitude, FREQUENCY, phase))
    scene = Scene(camera=Camera.orbit(-67.0, 30.0))
    scene.add_kinematic(wave, name="carpet", **SURFACE)
    shapes = assortment.convex_solids(bodies, seed, RADIUS)
    add_bodies(scene, shapes, position, orientation, names="body", **SURFACE)
    return scene


def starts(bodies: int, seed: int, amplitude: float) -> tuple[np.ndarray, np.ndarray]:
    """Starts of the bodies in a square: positions (bodies, 3) [m] and unit quaternions (bodies, 4)."""
    amplitude = number_in("amplitude", amplitude, 0.0, 1.0)
    rng = np.random.default_rng((whole_in("seed", seed, 0, assortment.MOST_SEEDS), 8))
    side = min(int(np.ceil(bodies**0.5)), 10)
    position = piles.lattice(bodies, side, PITCH, amplitude + 1.25 * RADIUS + 0.2)
    return position + rng.uniform(-0.1, 0.1, (bodies, 3)), rotations.random(rng, bodies)


class CarpetOutcome(OverlapOutcome):
    """Height of the throws, mean speed, and whether a body passes through the ground."""

    def __init__(self, scene):
        """Find the bodies."""
        super().__init__(scene)
        self.reach = np.array([np.linalg.norm(scene.bodies[i].shape.surface()[0], axis=1).max() for i in self.bodies])
        self.throws = bool(scene.bodies[0].shape.amplitude.max() * FREQUENCY**2 > 1.1 * 9.81)
        self.speed = self.frames = 0

    def observe(self, sim):
        """Record overlap, the largest clearance above the ground, the mean speed, and the bodies below the ground."""
        super().observe(sim)
        height, here = above_heightfield(sim, self.bodies, 0.5 * EXTENT, sim.time)
        self.keep_largest(sunk=(~here).sum(axis=1))
        if sim.time > 1.0:
            self.keep_largest(flight=np.maximum((height - self.reach).max(axis=1), 0.0))
            speed = np.linalg.norm(sim.get("linear_velocity")[:, self.bodies], axis=-1).mean(axis=1)
            self.speed, self.frames = self.speed + speed, self.frames + 1

    def judge(self, sim):
        """Bodies below the ground, height of the throws, mean speed, overlap."""
        if self.frames == 0:
            return []
        moved = SOUND if self.throws else {}
        sunk, flight, speed = self.largest["sunk"], self.largest["flight"], self.speed / self.frames
        thrown = f"a body thrown > {THROW:g} m clear of the ground"
        return [
            Verdict("sunk", sunk, "no body below the ground or beyond its edge at any time", sunk == 0),
            Verdict("flight", flight, thrown, flight > THROW, moved, "m"),
            Verdict("speed", speed, "mean speed > 0.5 m/s", speed > 0.5, moved, "m/s"),
            *self.overlap_verdicts(sim, 3e-3, 0.013),
        ]


outcome = CarpetOutcome
DURATION = 4.0
vary = vary_starts("body_", starts)
