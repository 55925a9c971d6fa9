"""Height fields: terrain over a rectangle, which can move up and down in waves."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Self, TypeGuard

import numpy as np
from numpy.typing import ArrayLike

from warp_rigid.checks import finite_vector, instance_of, number_array, number_in, shown
from warp_rigid.scene.shapes import tessellation, topology
from warp_rigid.scene.shapes.base import Grid, Part, PartKind, ReadArray, Shape, frozen_array, point_array
from warp_rigid.scene.shapes.sampling import VERTEX, SampleKind, SampleList

ON_SURFACE = 1e-9
"""Distance from the surface, relative to the size, within which the direction is that of the triangle."""


@dataclass(frozen=True, eq=False)
class HarmonicMotion:
    """Vertical motion of a height field: each vertex by `amplitude * sin(angular_frequency * t + phase)`.

    One amplitude and phase for all vertices give a vibrating table. Phases that decrease along a direction give a wave
    that travels in that direction. Amplitudes of both signs give a standing wave.

    Attributes:
        amplitude: [m], a number or one for each vertex.
        angular_frequency: [rad/s], >= 0.
        phase: [rad], a number or one for each vertex.
    """

    amplitude: float | np.ndarray
    angular_frequency: float
    phase: float | np.ndarray = 0.0


class Heightfield(Shape):
    """Terrain over a rectangle around the origin, solid below; for static and kinematic bodies.

    Each cell has two triangles, divided from corner (i, j) to (i + 1, j + 1). The solid has vertical sides at the
    border; a body that lies entirely below its lowest height does not touch it. With a motion the vertices move up and
    down, and contacts include the surface's velocity.
    """

    static_only = True
    size = math.inf

    def __init__(self, heights: ArrayLike, size: ArrayLike, motion: HarmonicMotion | None = None):
        """Make a height field.

        Args:
            heights: (nx, ny), at least 2 x 2, finite [m]; heights[i, j] belongs to
                x = size_x (i / (nx - 1) - 1/2), y = size_y (j / (ny - 1) - 1/2).
            size: (size_x, size_y) of the rectangle [m], both greater than 0.
            motion: of the heights in time, for kinematic bodies; None for a field that does not move.
        """
        given = number_array("heights", heights)
        if given.ndim != 2 or min(given.shape) < 2:
            raise ValueError(f"heights: must be at least 2 x 2 numbers, got {given.shape}")
        if not np.isfinite(given).all():
            raise ValueError("heights: must be finite numbers, got NaN or infinity")
        self.heights = frozen_array(given)
        extent = finite_vector("size", size, 2)
        if min(extent) <= 0.0:
            raise ValueError(f"size: must be 2 finite numbers > 0, got {shown(size)}")
        self.extent = frozen_array(extent)
        instance_of("motion", motion, HarmonicMotion | None, "a HarmonicMotion or None")
        self.moving = motion is not None
        motion = motion or HarmonicMotion(0.0, 0.0)
        self.amplitude = self._at_vertices("amplitude", motion.amplitude)
        self.phase = self._at_vertices("phase", motion.phase)
        self.angular_frequency = number_in("angular_frequency", motion.angular_frequency, 0.0)

    def __repr__(self) -> str:
        """Show the numbers of heights and the size."""
        rows, columns = self.heights.shape
        return f"Heightfield({rows} x {columns} heights, size={tuple(self.extent.tolist())})"

    def _at_vertices(self, name, value):
        """A finite number for each vertex."""
        try:
            values = np.broadcast_to(number_array(name, value), self.heights.shape)
        except ValueError:
            raise ValueError(
                f"{name}: must be a number or shaped {self.heights.shape}, got shape {np.shape(value)}"
            ) from None
        if not np.isfinite(values).all():
            raise ValueError(f"{name}: must be finite numbers, got NaN or infinity")
        return frozen_array(values)

    def _content(self):
        return [self.heights, self.extent, self.moving, self.amplitude, self.phase, self.angular_frequency]

    @property
    def grid_nodes(self) -> int:
        """One per vertex."""
        return self.heights.size

    def to_data(self, place: Callable[[Shape], int]) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
        """Heights and motion as arrays."""
        data, arrays = {"size": self.extent.tolist()}, {"heights": self.heights}
        if self.moving:
            data["angular_frequency"] = self.angular_frequency
            arrays |= {"amplitude": self.amplitude, "phase": self.phase}
        return data, arrays

    @classmethod
    def from_data(cls, data: dict[str, Any], array: ReadArray, earlier: list[Shape]) -> Self:
        """The field with its motion, if it has one."""
        heights = array("heights", np.float64, (None, None))
        motion = None
        if "angular_frequency" in data:
            amplitude, phase = (array(name, np.float64, heights.shape) for name in ("amplitude", "phase"))
            motion = HarmonicMotion(amplitude, data["angular_frequency"], phase)
        return cls(heights, data["size"], motion)

    def heights_at(self, time: float) -> np.ndarray:
        """Heights at a time [s], (nx, ny) [m]."""
        return self.heights + self.amplitude * np.sin(self.angular_frequency * time + self.phase)

    @property
    def top_speed(self) -> float:
        """Largest speed of any vertex [m/s]."""
        return float(np.abs(self.amplitude).max() * self.angular_frequency)

    @cached_property
    def steepest_slope(self) -> float:
        """Bound of the slope of any triangle at any time."""
        swing = self.amplitude * np.exp(1j * self.phase)
        slopes = []
        for axis, length in enumerate(self.extent):
            step = length / (self.heights.shape[axis] - 1)
            rise = np.abs(np.diff(self.heights, axis=axis)) + np.abs(np.diff(swing, axis=axis))
            slopes.append(rise.max() / step)
        return float(np.hypot(*slopes))

    @cached_property
    def bounds(self):
        """The rectangle, from the lowest to the highest height at any time; the solid extends further below."""
        half, swing = 0.5 * self.extent, np.abs(self.amplitude)
        return (np.array([*-half, (self.heights - swing).min()]), np.array([*half, (self.heights + swing).max()]))

    def signed_distance(self, points: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
        """Distance at time 0 to the solid below the triangles, and its direction.

        Exact above, below and beside the solid. Beyond the rectangle and above the height of its border it is a lower
        bound, `sqrt(d^2 + a^2)` with the distance d at the border's nearest point and the length a to it. Computed in
        float64 on the host: the kernels' distance is exact only within the reach of contacts, from float32 heights.
        """
        points = point_array(points)
        half = 0.5 * self.extent
        inside = np.column_stack([np.clip(points[:, :2], -half, half), points[:, 2]])
        distance, normal = self._distance_within(inside)
        side = np.abs(points[:, :2]) - half
        nearest = np.argmax(side, axis=1)
        beside = side.max(axis=1)
        through_side = (beside > distance) & (distance < 0.0)
        normal[through_side] = (np.sign(points[:, :2]) * np.eye(2)[nearest] @ np.eye(2, 3))[through_side]
        distance = np.where(through_side, beside, distance)
        away = points - inside
        beyond = (away != 0.0).any(axis=1)
        above = np.maximum(distance[beyond], 0.0)
        above[through_side[beyond]] = 0.0
        reach = np.hypot(above, np.linalg.norm(away[beyond], axis=1))
        toward = away[beyond] + above[:, None] * normal[beyond]
        normal[beyond] = toward / np.linalg.norm(toward, axis=1, keepdims=True)
        distance[beyond] = reach
        return distance, normal

    def _distance_within(self, points):
        """Distance within the rectangle, to the upper surface only."""
        vertices, faces = self.surface()
        portion = max(1, 20_000 // len(faces))
        found = [_to_triangles(points[k : k + portion], vertices[faces]) for k in range(0, len(points), portion)]
        arm, nearest = (np.concatenate(column) for column in zip(*found, strict=True))
        normal = topology.face_normals(vertices, faces)[0][nearest]
        length = np.linalg.norm(arm, axis=1)
        under = points[:, 2] < self.height_at(points[:, :2], 0.0)
        flat = length < ON_SURFACE * float(np.ptp(vertices, axis=0).max())
        distance = np.where(flat, np.einsum("ij,ij->i", arm, normal), np.where(under, -length, length))
        direction = np.where(flat[:, None], normal, arm / np.where(flat, 1.0, distance)[:, None])
        return distance, direction

    def height_at(self, places: ArrayLike, time: float) -> np.ndarray:
        """Height of the surface at points (n, 2) of its rectangle and a time [s], (n,) [m]."""
        heights, last = self.heights_at(time), np.array(self.heights.shape) - 1
        place = np.clip((np.asarray(places) / self.extent + 0.5) * last, 0.0, last)
        cell = np.minimum(place.astype(np.int64), last - 1)
        i, j = cell.T
        u, v = (place - cell).T
        corner, h10, h01, far = heights[i, j], heights[i + 1, j], heights[i, j + 1], heights[i + 1, j + 1]
        along_x = np.where(u > v, h10 - corner, far - h01)
        along_y = np.where(u > v, far - h10, h01 - corner)
        return corner + u * along_x + v * along_y

    def parts(self) -> list[Part]:
        """One HEIGHTFIELD; its grid's spacing is that along x."""
        values = frozen_array(self.heights_at(0.0)[:, :, None], np.float32)
        origin = (-0.5 * float(self.extent[0]), -0.5 * float(self.extent[1]), 0.0)
        spacing = float(self.extent[0] / (self.heights.shape[0] - 1))
        grid = Grid(origin, spacing, values)
        return [Part(PartKind.HEIGHTFIELD, (*self.extent.tolist(), self.steepest_slope, 0.0), grid=grid)]

    def sample_list(self) -> SampleList:
        """The grid's vertices, as FACE points: a body that slides over a vertex must not be stopped by it."""
        vertices, _ = self.surface()
        spacing = self.extent / (np.array(self.heights.shape) - 1)
        slope_x, slope_y = np.gradient(self.heights_at(0.0), *spacing)
        normal = np.stack([-slope_x, -slope_y, np.ones_like(self.heights)], axis=-1).reshape(-1, 3)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        collected = SampleList()
        collected.add(SampleKind.FACE, vertices, normal, rank=VERTEX)
        return collected

    @cached_property
    def _samples(self):
        """Clusters of a moving field contain their vertices at any time."""
        samples = self.sample_list().cluster()
        swing = np.float32(2.0 * np.abs(self.amplitude).max())
        return replace(samples, cluster_radius=samples.cluster_radius + swing)

    def surface(self) -> tuple[np.ndarray, np.ndarray]:
        """Two triangles per cell, at time 0."""
        rows, columns = self.heights.shape
        x = np.linspace(-0.5, 0.5, rows) * self.extent[0]
        y = np.linspace(-0.5, 0.5, columns) * self.extent[1]
        x, y = np.meshgrid(x, y, indexing="ij")
        vertices = np.stack([x, y, self.heights_at(0.0)], axis=-1).reshape(-1, 3)
        return vertices, tessellation.lattice(rows, columns)


def moves(shape: Shape) -> TypeGuard[Heightfield]:
    """Whether a shape is a height field that moves."""
    return isinstance(shape, Heightfield) and shape.moving


def _to_triangles(points, corners):
    """For each point the vector from the nearest of some triangles (m, 3, 3), and the index of that one."""
    from trimesh.triangles import closest_point

    place = closest_point(np.tile(corners, (len(points), 1, 1)), np.repeat(points, len(corners), axis=0))
    arm = points[:, None] - place.reshape(len(points), -1, 3)
    nearest = np.einsum("pmk,pmk->pm", arm, arm).argmin(axis=1)
    return arm[np.arange(len(points)), nearest], nearest
