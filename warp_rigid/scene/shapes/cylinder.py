"""Cylinder about z with flat ends."""

from functools import cached_property

import numpy as np

from warp_rigid.checks import number_in
from warp_rigid.kernels.schema import RIM_ARCS
from warp_rigid.scene.shapes import mass_properties, tessellation
from warp_rigid.scene.shapes.base import PartKind, Shape
from warp_rigid.scene.shapes.sampling import VERTEX, SampleKind, SampleList

CLEAR_OF_CAP = 1.02
"""Radii from a cap to the nearest ball on the axis: on the ground, the cap must touch before the ball does."""
SURFACE_SECTIONS = 64


class Cylinder(Shape):
    """Cylinder about z with flat ends."""

    parameters = ("radius", "half_height")
    part_kind = PartKind.CYLINDER

    def __init__(self, radius: float, half_height: float):
        """Make a cylinder.

        Args:
            radius: [m], greater than 0.
            half_height: half of the length [m], greater than 0.
        """
        self.radius = number_in("radius", radius, above=0)
        self.half_height = number_in("half_height", half_height, above=0)

    @cached_property
    def mass_properties(self):
        """Closed form."""
        return mass_properties.cylinder(self.radius, self.half_height)

    def support(self, directions: np.ndarray) -> np.ndarray:
        """Largest `direction . x` over the cylinder."""
        along = np.abs(directions[:, 2]) * self.half_height
        return along + self.radius * np.linalg.norm(directions[:, :2], axis=1)

    def sample_list(self) -> SampleList:
        """For each cap a RIM, its 16 ARCs and their CAP points, and 9 FACE points; for the side, EDGE segments.

        The side of a cylinder longer than wide is sampled as a capsule inside it, whose end balls are clear of the
        caps; the side of a disc by 16 lines. The rest of the axis is a segment at each cap, whose normal points to it.
        """
        radius, height = self.radius, self.half_height
        angles = 2.0 * np.pi * np.arange(RIM_ARCS) / RIM_ARCS
        circle = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(RIM_ARCS)])
        collected = SampleList()
        for sign in (-1.0, 1.0):
            cap = np.array([0.0, 0.0, sign])
            rim = radius * circle + height * cap
            collected.add(SampleKind.CAP, rim, cap, rank=VERTEX)
            collected.add(SampleKind.RIM, height * cap, cap, radius=radius)
            slide = np.pi / RIM_ARCS * radius * np.cross(circle, cap)
            collected.add(SampleKind.ARC, rim, np.sqrt(0.5) * (circle + cap), slide)
            collected.add(SampleKind.FACE, height * cap, cap)
            collected.add(SampleKind.FACE, 0.5 * radius * circle[::2] + height * cap, cap)
        axis = height - CLEAR_OF_CAP * radius
        if axis > 0.0:
            collected.add_balls([[0.0, 0.0, -axis], [0.0, 0.0, axis]], radius)
            collected.add_axis(axis, radius)
        else:
            slide = (0.0, 0.0, height)
            collected.add(SampleKind.EDGE, radius * circle, circle, slide)
        half = 0.5 * (height - max(axis, 0.0))
        caps = np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]])
        collected.add(SampleKind.SIDE, (height - half) * caps, caps, half * caps, radius)
        return collected

    def surface(self) -> tuple[np.ndarray, np.ndarray]:
        """64-sided prism."""
        radii = [self.radius, self.radius]
        heights = [-self.half_height, -self.half_height, self.half_height, self.half_height]
        return tessellation.revolve(radii, heights, SURFACE_SECTIONS)
