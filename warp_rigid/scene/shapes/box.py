"""Box: a cuboid around the origin."""

from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from warp_rigid.checks import finite_vector, shown
from warp_rigid.scene.shapes import mass_properties, tessellation
from warp_rigid.scene.shapes.base import PartKind, Shape, frozen_array
from warp_rigid.scene.shapes.sampling import VERTEX, SampleKind, SampleList

FEWEST_EDGE_PIECES, MOST_EDGE_PIECES = 4, 16
"""EDGE segments per edge. A segment has one contact point; a long beam that crosses a beam of equal width needs two."""


class Box(Shape):
    """Cuboid around the origin, its sides along the axes."""

    parameters = ("half_extents",)
    part_kind = PartKind.BOX

    def __init__(self, half_extents: ArrayLike):
        """Make a box.

        Args:
            half_extents: half of each side, (3,) [m], all greater than 0.
        """
        halves = finite_vector("half_extents", half_extents)
        if min(halves) <= 0.0:
            raise ValueError(f"half_extents: must be 3 finite numbers > 0, got {shown(half_extents)}")
        self.half_extents = frozen_array(halves)

    @cached_property
    def mass_properties(self):
        """Closed form."""
        x, y, z = self.half_extents.tolist()
        volume = 8.0 * x * y * z
        return mass_properties.diagonal(volume, np.array([y * y + z * z, x * x + z * z, x * x + y * y]) * volume / 3.0)

    def support(self, directions: np.ndarray) -> np.ndarray:
        """Largest `direction . x` over the box."""
        return np.abs(directions) @ self.half_extents

    def sample_list(self) -> SampleList:
        """8 vertices, 9 FACE points per face, and 4 to 16 EDGE segments per edge, half as long as the box is wide."""
        half = self.half_extents
        width = np.sort(half)[1]
        collected = SampleList()
        corners = tessellation.box(half)[0]
        collected.add(SampleKind.POINT, corners, np.sign(corners) / 3.0**0.5, rank=VERTEX)
        inner = np.array([-0.5, 0.0, 0.5])
        for axis in range(3):
            others = [(axis + 1) % 3, (axis + 2) % 3]
            pieces = int(np.clip(np.ceil(2.0 * half[axis] / width), FEWEST_EDGE_PIECES, MOST_EDGE_PIECES))
            steps = (2.0 * np.arange(pieces) + 1.0) / pieces - 1.0
            slide = np.zeros(3)
            slide[axis] = half[axis] / pieces
            for signs in ((-1, -1), (-1, 1), (1, -1), (1, 1)):
                normal = np.zeros(3)
                normal[others] = np.array(signs) / 2.0**0.5
                point = np.zeros((pieces, 3))
                point[:, others] = signs * half[others]
                point[:, axis] = steps * half[axis]
                collected.add(SampleKind.EDGE, point, normal, slide)
            for sign in (-1.0, 1.0):
                point = np.zeros((9, 3))
                point[:, axis] = sign * half[axis]
                point[:, others[0]] = np.repeat(inner, 3) * half[others[0]]
                point[:, others[1]] = np.tile(inner, 3) * half[others[1]]
                collected.add(SampleKind.FACE, point, sign * np.eye(3)[axis])
        return collected

    def surface(self) -> tuple[np.ndarray, np.ndarray]:
        """12 triangles."""
        return tessellation.box(self.half_extents)
