"""Bunnies fall into an open box."""

import math

import numpy as np

from warp_rigid import meshes
from warp_rigid.checks import whole_in
from warp_rigid.scene import Scene
from warp_rigid.scenes.demo import (
    ONE_PASS_2003,
    Demo,
    Verdict,
    indices,
    overlap_verdict,
    rest_verdict,
    turn,
)
from warp_rigid.shapes import Box, Plane

PITCH = 0.38
JITTER = 0.02
LOWEST = 0.25
WALL_HALF = 0.05
MOST_SEEDS = 2**32 - 1


def build(bodies: int = 8, seed: int = 1000) -> Scene:
    """Bunnies of 0.2 m at jittered lattice points above the floor of an open box, turned at random.

    Args:
        bodies: bunnies, 1 to 4096.
        seed: of jitter and rotations.
    """
    position, orientation = starts(bodies, seed)
    scene = Scene()
    scene.add_static(Plane(normal=(0, 0, 1), offset=0.0), friction=0.5, name="floor")
    for i, (center, half_extents) in enumerate(_walls(bodies)):
        scene.add_static(Box(half_extents), position=center, friction=0.5, name=f"wall_{i}")
    bunny = meshes.bunny()
    place = position - turn(orientation, np.tile(bunny.center_of_mass, (bodies, 1)))
    for i in range(bodies):
        scene.add_body(
            bunny,
            position=place[i],
            orientation=orientation[i],
            density=1000.0,
            friction=0.5,
            name=f"bunny_{i}",
        )
    return scene


def starts(bodies: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Where the bunnies of an environment start.

    Args:
        bodies: how many, 1 to 4096.
        seed: of jitter and rotations, 0 to 2^32 - 1; give every environment of a batch its own.

    Returns:
        Centres of mass (bodies, 3) [m] and unit quaternions (bodies, 4), (x, y, z, w).

    Raises:
        ValueError: A number is out of its range.
    """
    bodies = whole_in("bodies", bodies, 1, 4096)
    rng = np.random.default_rng(whole_in("seed", seed, 0, MOST_SEEDS))
    side, _ = _lattice(bodies)
    i = np.arange(bodies)
    cell = np.stack([i % side, i // side % side, i // side**2], axis=1)
    corner = np.array([-0.5 * (side - 1) * PITCH, -0.5 * (side - 1) * PITCH, LOWEST])
    position = corner + PITCH * cell + rng.uniform(-JITTER, JITTER, (bodies, 3))
    real_first = rng.normal(size=(bodies, 4))
    real_first /= np.linalg.norm(real_first, axis=1, keepdims=True)
    return position, real_first[:, [1, 2, 3, 0]]


def _lattice(bodies):
    """Cells along each side of the floor, and layers: about twice as high as wide."""
    side = max(2, math.ceil((bodies / 2.0) ** (1.0 / 3.0)))
    return side, math.ceil(bodies / side**2)


def _inner_half(bodies):
    """Half of the box's inner width [m]."""
    return 0.5 * _lattice(bodies)[0] * PITCH + 0.02


def _walls(bodies):
    """Centre and half extents of the four walls."""
    inner, thickness = _inner_half(bodies), WALL_HALF
    half_height = 0.5 * max(0.8, 0.6 * _lattice(bodies)[1] * PITCH + 0.5)
    away, length = inner + thickness, inner + 2.0 * thickness
    along_y = (thickness, length, half_height)
    along_x = (length, thickness, half_height)
    return [((sign * away, 0, half_height), along_y) for sign in (-1, 1)] + [
        ((0, sign * away, half_height), along_x) for sign in (-1, 1)
    ]


class PileOutcome:
    """Whether all bunnies came to rest in the box, none inside another."""

    def __init__(self, scene):
        """Find the bunnies."""
        self.bunnies = indices(scene, "bunny_")
        self.inner = _inner_half(len(self.bunnies))

    def observe(self, sim):
        """Nothing: the end tells."""

    def verdicts(self, sim):
        """Bunnies that left the box, overlap and speed at the end."""
        position = sim.get("center_of_mass")[:, self.bunnies]
        # A body that is not a number has left too: the comparison must be true for it.
        inside = (np.abs(position[..., :2]).max(axis=-1) < self.inner) & (position[..., 2] > 0.0)
        left = (~inside).sum(axis=1)
        sound = {"default": True}
        return [
            Verdict("escaped", left, "none outside the box", left == 0, sound),
            overlap_verdict(sim, 2e-3, sound),
            rest_verdict(sim, self.bunnies, sound),
        ]


def vary(sim, bodies, seed, **_):
    """Start environment e as the scene of seed + e does."""
    bunnies = indices(sim.scene, "bunny_")
    position, orientation = zip(*(starts(bodies, seed + env) for env in range(sim.num_envs)), strict=True)
    sim.set("position", np.array(position), bodies=bunnies)
    sim.set("orientation", np.array(orientation), bodies=bunnies)


DEMO = Demo(
    name="bunny_pile",
    summary="bunnies fall into an open box and settle",
    build=build,
    outcome=PileOutcome,
    duration=4.0,
    variants={"default": {}, "one_pass": ONE_PASS_2003},
    vary=vary,
)
