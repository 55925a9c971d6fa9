"""Closed rooms of random size, with random bodies in fast motion."""

from typing import Any

import numpy as np

from warp_rigid.scene.scene import Scene
from warp_rigid.scene.shapes import Box, Capsule, Cylinder, Sphere

WALLS = 6
"""Number of walls, which are the first bodies of a room."""


def random_room(seed: int, most: int) -> tuple[Scene, np.ndarray, float]:
    """A room with walls of 1 to 50 cm and up to `most` bodies of up to 40 m/s.

    Returns:
        The scene, the half widths of the room [m], (3,), and the thickness of its walls [m].
    """
    draw = np.random.default_rng(seed)
    half, wall = draw.uniform(0.6, 2.0, 3), np.exp(draw.uniform(np.log(0.01), np.log(0.5)))
    restitution = draw.choice([0, 0.5, 1.0]) if draw.random() < 0.6 else draw.uniform(0, 1)
    material: dict[str, Any] = {"restitution": restitution, "friction": draw.choice([0, 0.3, 0.8])}
    scene = Scene()
    for axis in range(3):
        for sign in (-1, 1):
            extents, place = half + 2 * wall, np.zeros(3)
            extents[axis], place[axis] = wall / 2, sign * (half[axis] + wall / 2)
            scene.add_static(Box(extents), position=place, **material)
    count = int(draw.integers(1, most + 1))
    across = int(np.ceil(count ** (1 / 3)))
    cells = [(i, j, k) for i in range(across) for j in range(across) for k in range(across)]
    draw.shuffle(cells)
    spacing = 2 * half / across
    room = float(np.prod(half) * 0.96 / count) ** (1 / 3)
    largest = min(0.25 * min(0.7, room), 0.3 * float(spacing.min()))
    fastest = draw.uniform(1, 40)
    for cell in cells[:count]:
        size = largest * draw.uniform(0.4, 1)
        extents = tuple(size * draw.uniform(0.2, 0.6, 3))
        kinds = [Box(extents), Sphere(size * 0.6), Capsule(size * 0.3, size * 0.5), Cylinder(size * 0.5, size * 0.4)]
        shape, velocity = kinds[draw.integers(4)], draw.normal(size=3)
        velocity *= fastest * draw.uniform(0.2, 1) / np.linalg.norm(velocity)
        turned = np.random.RandomState(draw.integers(1 << 30)).normal(size=4)
        spin = 5 * draw.normal(size=3)
        place = spacing * (np.array(cell) + 0.5) - half
        motion: dict[str, Any] = {"linear_velocity": velocity, "angular_velocity": spin}
        scene.add_body(shape, position=place, orientation=turned / np.linalg.norm(turned), **motion, **material)
    return scene, half, wall
