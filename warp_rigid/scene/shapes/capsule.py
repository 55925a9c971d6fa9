"""Capsule: a cylinder about z with round ends."""

from functools import cached_property

import numpy as np

from warp_rigid.checks import number_in
from warp_rigid.scene.shapes import mass_properties, tessellation
from warp_rigid.scene.shapes.base import PartKind, Shape
from warp_rigid.scene.shapes.sampling import VERTEX, SampleList

SURFACE_SECTIONS = 32


class Capsule(Shape):
    """Cylinder about z with round ends: all points within `radius` of a segment."""

    parameters = ("radius", "half_height")
    part_kind = PartKind.CAPSULE

    def __init__(self, radius: float, half_height: float):
        """Make a capsule.

        Args:
            radius: [m], greater than 0.
            half_height: half of the segment, that is without the round ends [m], greater than 0.
        """
        self.radius = number_in("radius", radius, above=0)
        self.half_height = number_in("half_height", half_height, above=0)

    @cached_property
    def mass_properties(self):
        """Closed form."""
        return mass_properties.capsule(self.radius, self.half_height)

    def support(self, directions: np.ndarray) -> np.ndarray:
        """Largest `direction . x` over the capsule."""
        along = np.abs(directions[:, 2]) * self.half_height
        return along + self.radius * np.linalg.norm(directions, axis=1)

    def sample_list(self) -> SampleList:
        """Two balls at the ends and EDGE segments along the axis, all with the capsule's radius."""
        ends = np.array([[0.0, 0.0, -self.half_height], [0.0, 0.0, self.half_height]])
        collected = SampleList()
        collected.add_balls(ends, self.radius, rank=VERTEX)
        collected.add_axis(self.half_height, self.radius)
        return collected

    def surface(self) -> tuple[np.ndarray, np.ndarray]:
        """Half balls of 8 rings each, and the tube between them."""
        angles = np.linspace(0.0, 0.5 * np.pi, 9)
        radii = self.radius * np.concatenate([np.sin(angles[1:]), np.sin(angles[:0:-1])])
        rise = self.half_height + self.radius * np.cos(angles)
        return tessellation.revolve(radii, [*-rise, *rise[::-1]], SURFACE_SECTIONS)
