"""Columns: an attribute of many bodies as an array, and the distinct shapes among them, without work per body."""

from collections.abc import Sequence
from itertools import chain
from operator import attrgetter
from typing import Any

import numpy as np

from warp_rigid.scene.scene import Body, Motion
from warp_rigid.scene.shapes import Shape


def column(bodies: Sequence[Body], name: str, dtype: Any = np.float64) -> np.ndarray:
    """An attribute of bodies: (bodies,), or (bodies, n) for vectors of length n.

    Args:
        bodies: the bodies.
        name: an attribute that is a number or a tuple of numbers.
        dtype: type of the array.
    """
    values: Any = map(attrgetter(name), bodies)
    if bodies and isinstance(getattr(bodies[0], name), tuple):
        flat = np.fromiter(chain.from_iterable(values), dtype)
        return flat.reshape(len(bodies), -1)
    return np.fromiter(values, dtype, len(bodies))


def is_dynamic(bodies: Sequence[Body]) -> np.ndarray:
    """Which bodies are dynamic, (bodies,) bool."""
    return column(bodies, "motion", np.int32) == Motion.DYNAMIC


def shapes_of(bodies: Sequence[Body]) -> tuple[list[Shape], np.ndarray]:
    """The shapes of different content in the order in which they first appear, and the index of that of each body."""
    place: dict[str, int] = {}
    shapes: list[Shape] = []
    index = np.empty(len(bodies), np.int64)
    for row, body in enumerate(bodies):
        key = body.shape.key
        if key not in place:
            place[key] = len(shapes)
            shapes.append(body.shape)
        index[row] = place[key]
    return shapes, index


def extents(shapes: Sequence[Shape]) -> np.ndarray:
    """Side lengths of the bounding boxes of shapes, (shapes, 3) [m]; infinite for planes."""
    return np.array([np.subtract(shape.bounds[1], shape.bounds[0]) for shape in shapes]).reshape(-1, 3)
