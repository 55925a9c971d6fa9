"""Shapes whose distance is a closed form: Sphere, Box, Capsule, Cylinder and Plane."""

import math
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from warp_rigid.checks import finite_vector, number_in, shown
from warp_rigid.kernels.schema import RIM_ARCS
from warp_rigid.scene.shapes import tessellation
from warp_rigid.scene.shapes.base import PartKind, Shape, frozen_array
from warp_rigid.scene.shapes.mass_properties import diagonal
from warp_rigid.scene.shapes.sampling import VERTEX, SampleKind, SampleList

FEWEST_EDGE_PIECES, MOST_EDGE_PIECES = 4, 16
"""EDGE segments per edge. A segment has one contact point; a long beam that crosses a beam of equal width needs two."""
CLEAR_OF_CAP = 1.02
"""Radii from a cap to the nearest ball on the axis: on the ground, the cap must touch before the ball does."""
CAPSULE_SECTIONS, CYLINDER_SECTIONS = 32, 64
DRAWN_HALF_WIDTH = 10.0
"""Half of the side of the square that is drawn for a plane [m]."""


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
        volume = 4.0 / 3.0 * math.pi * self.radius**3
        return diagonal(volume, np.full(3, 0.4 * volume * self.radius**2))

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
        return diagonal(volume, np.array([y * y + z * z, x * x + z * z, x * x + y * y]) * volume / 3.0)

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
        """Closed form: a cylinder between two half balls.

        The centre of mass of a half ball is 3/8 of the radius from its flat side, which gives the term
        3/4 radius half_height below.
        """
        tube = Cylinder(self.radius, self.half_height).mass_properties
        balls = Sphere(self.radius).mass_properties
        shifted = self.half_height**2 + 0.75 * self.half_height * self.radius
        moments = np.diag(tube.inertia) + np.diag(balls.inertia)
        moments = moments + balls.volume * shifted * np.array([1.0, 1.0, 0.0])
        return diagonal(tube.volume + balls.volume, moments)

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
        return tessellation.revolve(radii, [*-rise, *rise[::-1]], CAPSULE_SECTIONS)


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
        volume = 2.0 * math.pi * self.radius**2 * self.half_height
        across = volume * (self.radius**2 / 4.0 + self.half_height**2 / 3.0)
        return diagonal(volume, (across, across, 0.5 * volume * self.radius**2))

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
        collected.add(SampleKind.SIDE, (height - half) * caps, caps, half * caps, radius=radius)
        return collected

    def surface(self) -> tuple[np.ndarray, np.ndarray]:
        """64-sided prism."""
        radii = [self.radius, self.radius]
        heights = [-self.half_height, -self.half_height, self.half_height, self.half_height]
        return tessellation.revolve(radii, heights, CYLINDER_SECTIONS)


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
