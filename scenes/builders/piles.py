"""Bodies that start apart and fall into a pile: their lattices, random starts and bins."""

import math
from typing import Any

import numpy as np

from warp_rigid.checks import whole_in
from warp_rigid.scene.scene import Scene
from warp_rigid.scenes.builders import grounds
from warp_rigid.scenes.builders.assortment import MOST_SEEDS

PITCH = 0.38
JITTER = 0.02
LOWEST = 0.25
WALL_THICKNESS = 0.1
MOST_BODIES = 1_000_000


def lattice(count: int, side: int, pitch: float, lowest: float, rise: float | None = None) -> np.ndarray:
    """The first `count` points of a lattice centred on the z axis, (count, 3) [m]; x varies fastest, then y.

    Args:
        count: number of points.
        side: points along x and along y.
        pitch: distance of neighbours along x and y [m].
        lowest: height of the lowest layer [m].
        rise: distance of layers [m]; `pitch` if None.
    """
    i = np.arange(count)
    cell = np.stack([i % side, i // side % side, i // side**2], axis=1)
    corner = -0.5 * (side - 1) * pitch
    return np.array([corner, corner, lowest]) + np.array([pitch, pitch, pitch if rise is None else rise]) * cell


def starts(bodies: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Random starts above the floor of the bin of `add_pile_bin`: jittered lattice points and random orientations.

    Args:
        bodies: number of bodies, 1 to 1e6.
        seed: of jitter and orientations, 0 to 2^32 - 1; use a different one for each environment of a batch.

    Returns:
        Centres of mass (bodies, 3) [m] and unit quaternions (bodies, 4), (x, y, z, w).

    Raises:
        ValueError: A number is out of its range.
    """
    bodies = whole_in("bodies", bodies, 1, MOST_BODIES)
    rng = np.random.default_rng(whole_in("seed", seed, 0, MOST_SEEDS))
    position = lattice(bodies, _layout(bodies)[0], PITCH, LOWEST) + rng.uniform(-JITTER, JITTER, (bodies, 3))
    real_first = rng.normal(size=(bodies, 4))
    real_first /= np.linalg.norm(real_first, axis=1, keepdims=True)
    return position, real_first[:, [1, 2, 3, 0]]


def inner_half(bodies: int) -> float:
    """Half of the inner width of the bin of `add_pile_bin` [m]."""
    return 0.5 * _layout(bodies)[0] * PITCH + 0.02


def add_pile_bin(scene: Scene, bodies: int, *, names: str | None = None, **surface: Any) -> None:
    """Add four walls around the starts of a pile of bodies of about 0.2 m.

    Args:
        scene: the scene.
        bodies: number of bodies in the pile, 1 to 1e6.
        names: prefix of the walls' names, followed by their numbers.
        **surface: coefficients, as in `Scene.add_static`.
    """
    height = max(0.8, 0.6 * _layout(bodies)[1] * PITCH + 0.5)
    grounds.add_bin(scene, inner_half(bodies), height, WALL_THICKNESS, names=names, **surface)


def _layout(bodies):
    """Lattice points along each side of the floor, and layers: about twice as high as wide."""
    side = max(2, math.ceil((bodies / 2.0) ** (1.0 / 3.0)))
    return side, math.ceil(bodies / side**2)
