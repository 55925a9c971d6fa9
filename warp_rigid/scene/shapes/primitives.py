"""Shapes with closed-form distances: sphere, box, capsule, cylinder and plane."""

import math
from functools import cached_property

import numpy as np

from warp_rigid.checks import finite_number, finite_vector, number_in, shown
from warp_rigid.scene.shapes import mass_properties, tessellation
from warp_rigid.scene.shapes.base import (
    Part,
    PartKind,
    Shape,
    frozen_array,
    point_array,
)
from warp_rigid.scene.shapes.sampling import VERTEX, SampleKind, SampleList, split_segments

FEWEST_EDGE_PIECES, MOST_EDGE_PIECES = 4, 16
"""Of a box's edge. A segment touches in one place; where a long beam crosses one of its own width it must in two."""
RIM_POINTS = 16
CLEAR_OF_CAP = 1.02
"""Radii from a cap to the nearest ball in a cylinder: on the ground, the ball must not touch before the cap does."""
SURFACE_SECTIONS = 32


class Sphere(Shape):
    """Ball around the origin."""

    def __init__(self, radius: float):
        """Make a sphere.

        Args:
            radius: [m], greater than 0.
        """
        self.radius = number_in("radius", radius, above=0)

    def _content(self):
        return [self.radius]

    @cached_property
    def mass_properties(self):
        """Closed form."""
        return mass_properties.sphere(self.radius)

    def support(self, directions):
        """Largest `direction . x` over the ball."""
        return self.radius * np.linalg.norm(directions, axis=1)

    def signed_distance(self, points):
        """Exact; the gradient at the centre is +z."""
        points = point_array(points)
        distance = np.linalg.norm(points, axis=1)
        return distance - self.radius, _directions(points, distance, (0.0, 0.0, 1.0))

    def parts(self):
        """One SPHERE."""
        return [Part(PartKind.SPHERE, (self.radius, 0.0, 0.0, 0.0))]

    def sample_list(self):
        """One POINT at the centre, with the sphere's radius."""
        collected = SampleList()
        collected.add(SampleKind.POINT, np.zeros((1, 3)), radius=self.radius)
        return collected

    def surface(self):
        """1280 nearly equal triangles."""
        vertices, faces = tessellation.geodesic(8)
        return self.radius * vertices, faces


class Box(Shape):
    """Cuboid around the origin, its sides along the axes."""

    def __init__(self, half_extents):
        """Make a box.

        Args:
            half_extents: half of each side, (3,) [m], all greater than 0.
        """
        self.half_extents = frozen_array(_positive_vector("half_extents", half_extents, 3))

    def _content(self):
        return [self.half_extents]

    @cached_property
    def mass_properties(self):
        """Closed form."""
        return mass_properties.box(self.half_extents)

    def support(self, directions):
        """Largest `direction . x` over the box."""
        return np.abs(directions) @ self.half_extents

    def signed_distance(self, points):
        """Exact; inside, the gradient is the nearest face's normal (ties: x before y before z)."""
        points = point_array(points)
        excess = np.abs(points) - self.half_extents
        signs = np.where(points < 0.0, -1.0, 1.0)
        return _corner_distance(excess, signs)

    def parts(self):
        """One BOX."""
        return [Part(PartKind.BOX, (*self.half_extents.tolist(), 0.0))]

    def sample_list(self):
        """8 vertices, 9 FACE points a face, and 4 to 16 EDGE segments an edge, half as long as the box is wide."""
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

    def surface(self):
        """12 triangles."""
        return tessellation.box(self.half_extents)


class Capsule(Shape):
    """Cylinder about z with round ends: all points within `radius` of a segment."""

    def __init__(self, radius: float, half_height: float):
        """Make a capsule.

        Args:
            radius: [m], greater than 0.
            half_height: half of the segment, that is without the round ends [m], greater than 0.
        """
        self.radius = number_in("radius", radius, above=0)
        self.half_height = number_in("half_height", half_height, above=0)

    def _content(self):
        return [self.radius, self.half_height]

    @cached_property
    def mass_properties(self):
        """Closed form."""
        return mass_properties.capsule(self.radius, self.half_height)

    def support(self, directions):
        """Largest `direction . x` over the capsule."""
        along = np.abs(directions[:, 2]) * self.half_height
        return along + self.radius * np.linalg.norm(directions, axis=1)

    def signed_distance(self, points):
        """Exact; the gradient on the axis is +x."""
        points = point_array(points)
        arm = points.copy()
        arm[:, 2] -= np.clip(points[:, 2], -self.half_height, self.half_height)
        distance = np.linalg.norm(arm, axis=1)
        return distance - self.radius, _directions(arm, distance, (1.0, 0.0, 0.0))

    def parts(self):
        """One CAPSULE."""
        return [Part(PartKind.CAPSULE, (self.radius, self.half_height, 0.0, 0.0))]

    def sample_list(self):
        """Two balls at the ends and EDGE segments along the axis, all with the capsule's radius."""
        ends = np.array([[0.0, 0.0, -self.half_height], [0.0, 0.0, self.half_height]])
        collected = SampleList()
        collected.add(SampleKind.POINT, ends, radius=self.radius, rank=VERTEX)
        _add_axis(collected, self.half_height, self.radius)
        return collected

    def surface(self):
        """Half balls of 8 rings each, and the tube between them."""
        angles = np.linspace(0.0, 0.5 * np.pi, 9)
        radii = self.radius * np.concatenate([np.sin(angles[1:]), np.sin(angles[:0:-1])])
        rise = self.half_height + self.radius * np.cos(angles)
        return tessellation.revolve(radii, [*-rise, *rise[::-1]], SURFACE_SECTIONS)


class Cylinder(Shape):
    """Cylinder about z with flat ends."""

    def __init__(self, radius: float, half_height: float):
        """Make a cylinder.

        Args:
            radius: [m], greater than 0.
            half_height: half of the length [m], greater than 0.
        """
        self.radius = number_in("radius", radius, above=0)
        self.half_height = number_in("half_height", half_height, above=0)

    def _content(self):
        return [self.radius, self.half_height]

    @cached_property
    def mass_properties(self):
        """Closed form."""
        return mass_properties.cylinder(self.radius, self.half_height)

    def support(self, directions):
        """Largest `direction . x` over the cylinder."""
        along = np.abs(directions[:, 2]) * self.half_height
        return along + self.radius * np.linalg.norm(directions[:, :2], axis=1)

    def signed_distance(self, points):
        """Exact; on the axis radial means +x, and where side and cap tie, the side wins."""
        points = point_array(points)
        from_axis = np.linalg.norm(points[:, :2], axis=1)
        excess = np.stack([from_axis - self.radius, np.abs(points[:, 2]) - self.half_height], axis=1)
        upward = np.where(points[:, 2] < 0.0, -1.0, 1.0)
        distance, slope = _corner_distance(excess, np.ones_like(excess))
        radial = _directions(points[:, :2], from_axis, (1.0, 0.0))
        return distance, np.column_stack([slope[:, :1] * radial, slope[:, 1] * upward])

    def parts(self):
        """One CYLINDER."""
        return [Part(PartKind.CYLINDER, (self.radius, self.half_height, 0.0, 0.0))]

    def sample_list(self):
        """For each cap a RIM, 16 CAP points on its circle and 9 FACE points; for the side, EDGE segments.

        The side of a cylinder longer than wide is sampled by the axis of a capsule that it holds, and by the balls at
        its ends, which stay clear of the caps; that of a disc by 16 lines.
        """
        radius, height = self.radius, self.half_height
        angles = 2.0 * np.pi * np.arange(RIM_POINTS) / RIM_POINTS
        circle = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(RIM_POINTS)])
        collected = SampleList()
        for sign in (-1.0, 1.0):
            cap = np.array([0.0, 0.0, sign])
            collected.add(SampleKind.CAP, radius * circle + height * cap, cap, rank=VERTEX)
            collected.add(SampleKind.RIM, height * cap, cap, radius=radius)
            collected.add(SampleKind.FACE, height * cap, cap)
            collected.add(SampleKind.FACE, 0.5 * radius * circle[::2] + height * cap, cap)
        axis = height - CLEAR_OF_CAP * radius
        if axis > 0.0:
            collected.add(SampleKind.POINT, [[0.0, 0.0, -axis], [0.0, 0.0, axis]], radius=radius)
            _add_axis(collected, axis, radius)
        else:
            slide = (0.0, 0.0, height)
            collected.add(SampleKind.EDGE, radius * circle, circle, slide)
        return collected

    def surface(self):
        """64-sided prism."""
        radii = [self.radius, self.radius]
        heights = [-self.half_height, -self.half_height, self.half_height, self.half_height]
        return tessellation.revolve(radii, heights, 2 * SURFACE_SECTIONS)


class Plane(Shape):
    """Half space `normal . x <= offset`; for static bodies only."""

    static_only = True
    size = math.inf

    def __init__(self, normal=(0.0, 0.0, 1.0), offset: float = 0.0):
        """Make a plane.

        Args:
            normal: outward direction, (3,), scaled to unit length.
            offset: distance of the plane from the origin along the unit normal [m].
        """
        direction = np.array(finite_vector("normal", normal))
        length = float(np.linalg.norm(direction))
        if length < 1e-6:
            raise ValueError(f"normal: must have a length > 0, got {shown(normal)}")
        # A normal that is unit already stays the same to the last bit.
        self.normal = frozen_array(direction if abs(length - 1.0) <= 1e-15 else direction / length)
        self.offset = finite_number("offset", offset)

    def _content(self):
        return [self.normal, self.offset]

    @cached_property
    def mass_properties(self):
        """None: a plane has no mass."""
        return mass_properties.no_solid()

    def support(self, directions):
        """Infinite in all directions but the normal's."""
        along = directions @ self.normal
        norm = np.linalg.norm(directions, axis=1)
        return np.where(along > norm * (1.0 - 1e-12), norm * self.offset, math.inf)

    def signed_distance(self, points):
        """Exact."""
        points = point_array(points)
        return points @ self.normal - self.offset, np.tile(self.normal, (len(points), 1))

    def parts(self):
        """One PLANE."""
        return [Part(PartKind.PLANE, (*self.normal.tolist(), self.offset))]

    def sample_list(self):
        """None: the other body's samples find a plane."""
        return SampleList()

    def surface(self):
        """A square of 20 m."""
        helper = np.eye(3)[np.argmin(np.abs(self.normal))]
        first = np.cross(helper, self.normal)
        first /= np.linalg.norm(first)
        second = np.cross(self.normal, first)
        corners = [a * first + b * second for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
        vertices = 10.0 * np.array(corners) + self.offset * self.normal
        return vertices, tessellation.triangulate_quads(np.array([[0, 1, 2, 3]]))


def _positive_vector(name: str, value, length: int) -> tuple[float, ...]:
    vector = finite_vector(name, value, length)
    if min(vector) <= 0.0:
        raise ValueError(f"{name}: must be {length} finite numbers > 0, got {shown(value)}")
    return vector


def _directions(arm: np.ndarray, length: np.ndarray, fallback) -> np.ndarray:
    """Unit vectors along `arm`; where its length is zero, the fallback."""
    safe = np.where(length > 0.0, length, 1.0)
    return np.where((length > 0.0)[:, None], arm / safe[:, None], np.asarray(fallback))


def _corner_distance(excess: np.ndarray, signs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distance and gradient from how far a point lies beyond each of several square faces."""
    beyond = np.maximum(excess, 0.0)
    outside = np.linalg.norm(beyond, axis=1)
    nearest = np.argmax(excess, axis=1)
    inside = np.eye(excess.shape[1])[nearest]
    distance = np.where(outside > 0.0, outside, excess.max(axis=1))
    safe = np.where(outside > 0.0, outside, 1.0)[:, None]
    return distance, signs * np.where((outside > 0.0)[:, None], beyond / safe, inside)


def _add_axis(collected: SampleList, half_length: float, radius: float) -> None:
    """EDGE segments with a radius along z, each about as long as the radius is wide, 8 at most."""
    pieces = int(np.clip(math.ceil(half_length / radius), 1, 8))
    end = np.array([[0.0, 0.0, half_length]])
    middle, half, _ = split_segments(-end, end, np.array([pieces]))
    collected.add(SampleKind.EDGE, middle, slide=half, radius=radius)
