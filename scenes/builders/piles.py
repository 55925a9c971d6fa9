"""Where the bodies of a pile start: a lattice above the floor of an open box, jittered and turned at random."""

import math

import numpy as np

from warp_rigid.checks import whole_in

PITCH = 0.38
JITTER = 0.02
LOWEST = 0.25
WALL_HALF = 0.05
MOST_SEEDS = 2**32 - 1
MOST_BODIES = 1_000_000


def starts(bodies: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Where the bodies of an environment start.

    Args:
        bodies: how many, 1 to 1e6.
        seed: of jitter and rotations, 0 to 2^32 - 1; give every environment of a batch its own.

    Returns:
        Centres of mass (bodies, 3) [m] and unit quaternions (bodies, 4), (x, y, z, w).

    Raises:
        ValueError: A number is out of its range.
    """
    bodies = whole_in("bodies", bodies, 1, MOST_BODIES)
    rng = np.random.default_rng(whole_in("seed", seed, 0, MOST_SEEDS))
    side, _ = _lattice(bodies)
    i = np.arange(bodies)
    cell = np.stack([i % side, i // side % side, i // side**2], axis=1)
    corner = np.array([-0.5 * (side - 1) * PITCH, -0.5 * (side - 1) * PITCH, LOWEST])
    position = corner + PITCH * cell + rng.uniform(-JITTER, JITTER, (bodies, 3))
    real_first = rng.normal(size=(bodies, 4))
    real_first /= np.linalg.norm(real_first, axis=1, keepdims=True)
    return position, real_first[:, [1, 2, 3, 0]]


def inner_half(bodies: int) -> float:
    """Half of the box's inner width [m]."""
    return 0.5 * _lattice(bodies)[0] * PITCH + 0.02


def walls(bodies: int) -> list[tuple[tuple, tuple]]:
    """Centre and half extents of the four walls [m]."""
    inner, thickness = inner_half(bodies), WALL_HALF
    half_height = 0.5 * max(0.8, 0.6 * _lattice(bodies)[1] * PITCH + 0.5)
    away, length = inner + thickness, inner + 2.0 * thickness
    along_y = (thickness, length, half_height)
    along_x = (length, thickness, half_height)
    return [((sign * away, 0, half_height), along_y) for sign in (-1, 1)] + [
        ((0, sign * away, half_height), along_x) for sign in (-1, 1)
    ]


def _lattice(bodies):
    """Cells along each side of the floor, and layers: about twice as high as wide."""
    side = max(2, math.ceil((bodies / 2.0) ** (1.0 / 3.0)))
    return side, math.ceil(bodies / side**2)
