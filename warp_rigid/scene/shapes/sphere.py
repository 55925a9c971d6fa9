"""Sphere: a ball around the origin."""

from functools import cached_property

import numpy as np

from warp_rigid.checks import number_in
from warp_rigid.scene.shapes import mass_properties, tessellation
from warp_rigid.scene.shapes.base import PartKind, Shape
from warp_rigid.scene.shapes.sampling import SampleList


class Sphere(Shape):
    """Ball around the origin."""

    parameters = ("radius",)
    part_kind = PartKind.SPHERE

    def __init__(self, radius: float):
        """Make a sphere.

        Args:
            radius: [m], greater than 0.
        """
        self.radius = number_in("radius", radius, above=0)

    @cached_property
    def mass_properties(self):
        """Closed form."""
        return mass_properties.sphere(self.radius)

    def support(self, directions: np.ndarray) -> np.ndarray:
        """Largest `direction . x` over the ball."""
        return self.radius * np.linalg.norm(directions, axis=1)

    def sample_list(self) -> SampleList:
        """One ball at the centre."""
        collected = SampleList()
        collected.add_balls(np.zeros((1, 3)), self.radius)
        return collected

    def surface(self) -> tuple[np.ndarray, np.ndarray]:
        """1280 nearly equal triangles."""
        vertices, faces = tessellation.geodesic(8)
        return self.radius * vertices, faces
