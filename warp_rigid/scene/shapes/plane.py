"""Plane: a half space, for static bodies only."""

import math

import numpy as np
from numpy.typing import ArrayLike

from warp_rigid.checks import finite_vector, number_in, shown
from warp_rigid.scene.shapes import tessellation
from warp_rigid.scene.shapes.base import PartKind, Shape, frozen_array
from warp_rigid.scene.shapes.sampling import SampleList

DRAWN_HALF_WIDTH = 10.0
"""Half of the side of the square that is drawn for a plane [m]."""


class Plane(Shape):
    """Half space `normal . x <= offset`; for static bodies only."""

    parameters = ("normal", "offset")
    part_kind = PartKind.PLANE
    static_only = True
    size = math.inf

    def __init__(self, normal: ArrayLike = (0.0, 0.0, 1.0), offset: float = 0.0):
        """Make a plane.

        Args:
            normal: outward direction, (3,), scaled to unit length.
            offset: distance of the plane from the origin along the unit normal [m].
        """
        direction = np.array(finite_vector("normal", normal))
        length = float(np.linalg.norm(direction))
        if length < 1e-6:
            raise ValueError(f"normal: must have a length > 0, got {shown(normal)}")
        # A unit normal is not scaled again, so that it keeps its bits.
        self.normal = frozen_array(direction if abs(length - 1.0) <= 1e-15 else direction / length)
        self.offset = number_in("offset", offset)

    def support(self, directions: np.ndarray) -> np.ndarray:
        """Infinite in all directions except the normal's."""
        along = directions @ self.normal
        norm = np.linalg.norm(directions, axis=1)
        return np.where(along > norm * (1.0 - 1e-12), norm * self.offset, math.inf)

    def sample_list(self) -> SampleList:
        """None: contacts with a plane come from the other body's samples."""
        return SampleList()

    def surface(self) -> tuple[np.ndarray, np.ndarray]:
        """A square of 20 m."""
        helper = np.eye(3)[np.argmin(np.abs(self.normal))]
        first = np.cross(helper, self.normal)
        first /= np.linalg.norm(first)
        second = np.cross(self.normal, first)
        corners = [a * first + b * second for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
        vertices = DRAWN_HALF_WIDTH * np.array(corners) + self.offset * self.normal
        return vertices, tessellation.triangulate_quads(np.array([[0, 1, 2, 3]]))
