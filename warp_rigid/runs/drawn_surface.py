"""Surfaces that represent shapes in drawings and exports."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from warp_rigid.scene.body_columns import shapes_of
from warp_rigid.scene.scene import Body
from warp_rigid.scene.shapes import Shape
from warp_rigid.scene.shapes.heightfield import moves


@dataclass(frozen=True, eq=False)
class DrawnSurface:
    """Triangles of a shape, in the shape's frame.

    Attributes:
        vertices: (n, 3) float32 [m].
        faces: (m, 3) int32, counter-clockwise seen from outside.
        endless: True for a plane, of which the triangles cover a finite part.
        swing: (2, n) float32, sine and cosine amplitudes of the vertical vertex displacement about `vertices` [m];
            empty for a surface of constant shape.
        angular_frequency: of that displacement [rad/s].
        uv: (m, 3, 2) float32, texture coordinates of the corners, NaN where a part has none; None without.
    """

    vertices: np.ndarray
    faces: np.ndarray
    endless: bool = False
    swing: np.ndarray = field(default_factory=lambda: np.zeros((2, 0), np.float32))
    angular_frequency: float = 0.0
    uv: np.ndarray | None = None

    @property
    def moves(self) -> bool:
        """Whether the surface changes its shape over time."""
        return self.swing.size > 0

    def vertices_at(self, time: float) -> np.ndarray:
        """Vertices at a time [s], (n, 3) float32 [m]."""
        if not self.moves:
            return self.vertices
        rise = self.weights_at(time) @ self.swing
        return (self.vertices + rise[:, None] * [0.0, 0.0, 1.0]).astype(np.float32)

    def weights_at(self, time: float | np.ndarray) -> np.ndarray:
        """Weights (..., 2) of the two rows of `swing` at times (...) [s]."""
        angle = self.angular_frequency * np.asarray(time)
        return np.stack([np.sin(angle), np.cos(angle)], axis=-1)


def surfaces_of(bodies: Sequence[Body]) -> tuple[tuple[DrawnSurface, ...], np.ndarray]:
    """The distinct surfaces of some bodies, and the index (bodies,) of the surface of each."""
    shapes, shape_of = shapes_of(bodies)
    return tuple(map(drawn_surface, shapes)), shape_of


def drawn_surface(shape: Shape) -> DrawnSurface:
    """The surface that represents a shape in drawings and exports."""
    vertices, faces = shape.surface()
    motion: dict[str, Any] = {}
    if moves(shape):
        vertices = vertices.copy()
        vertices[:, 2] = shape.heights.reshape(-1)
        parts = shape.amplitude * np.array([np.cos(shape.phase), np.sin(shape.phase)])
        motion = {"swing": parts.reshape(2, -1).astype(np.float32), "angular_frequency": shape.angular_frequency}
    return DrawnSurface(
        np.asarray(vertices, dtype=np.float32),
        np.asarray(faces, dtype=np.int32),
        not np.isfinite(np.asarray(shape.bounds)).all(),
        uv=shape.surface_uv(),
        **motion,
    )
