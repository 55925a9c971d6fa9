"""Compound: several shapes rigidly joined into one."""

from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from warp_rigid import rotations
from warp_rigid.checks import finite_vector, shown, unit_quaternion, whole_in
from warp_rigid.scene.shapes import mass_properties
from warp_rigid.scene.shapes.base import (
    Part,
    ReadArray,
    Shape,
    frozen_array,
    point_array,
)
from warp_rigid.scene.shapes.inner_balls import spread_out
from warp_rigid.scene.shapes.sampling import SampleKind, SampleList


class Compound(Shape):
    """Union of shapes, each at its own pose.

    Masses add, so that an overlap of two children counts twice. Where the mass matters, place children in contact
    without overlap. `size` is the smallest of the children's sizes.
    """

    def __init__(self, children: Iterable[tuple[Shape, ArrayLike, ArrayLike]]):
        """Join shapes.

        Args:
            children: at least one (shape, position (3,) [m], orientation (x, y, z, w)). Planes and
                height fields cannot be joined; compounds can.
        """
        children = list(children)
        if not children:
            raise ValueError("children: must hold at least one (shape, position, orientation)")
        self.children = tuple(_checked_child(index, child) for index, child in enumerate(children))
        self._rotations = [rotations.matrix(orientation) for _, _, orientation in self.children]

    def __repr__(self) -> str:
        """Show the shapes of the children."""
        return f"Compound({', '.join(repr(shape) for shape, _, _ in self.children)})"

    def _content(self):
        return [item for child in self.children for item in (child[0].key, child[1], child[2])]

    @cached_property
    def mass_properties(self):
        """Sum over the children, by the parallel axis theorem."""
        return mass_properties.combine(
            (shape.mass_properties, position, rotation)
            for (shape, position, _), rotation in zip(self.children, self._rotations, strict=True)
        )

    @cached_property
    def size(self):
        """Smallest size among the children [m]: contact tolerances must fit the thinnest."""
        return min(shape.size for shape, _, _ in self.children)

    def support(self, directions: np.ndarray) -> np.ndarray:
        """Largest `direction . x` over all children."""
        return np.max(
            [
                directions @ position + shape.support(directions @ rotation)
                for (shape, position, _), rotation in zip(self.children, self._rotations, strict=True)
            ],
            axis=0,
        )

    @property
    def wall(self) -> float:
        """Thinnest walls among the children [m]."""
        return min(shape.wall for shape, _, _ in self.children)

    @cached_property
    def inner_balls(self):
        """Some of the children's."""
        candidates = [shape.inner_balls.copy() for shape, _, _ in self.children]
        for balls, (_, position, _), rotation in zip(candidates, self.children, self._rotations, strict=True):
            balls[:, :3] = balls[:, :3] @ rotation.T + position
        return spread_out(np.concatenate(candidates))

    def signed_distance(self, points: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
        """Distance to the nearest child.

        Exact outside. Inside, the depth is that in the deepest child, which is at most the true depth.
        """
        points = point_array(points)
        distance = np.full(len(points), np.inf)
        gradient = np.zeros_like(points)
        for index in range(len(self.children)):
            child_distance, child_gradient = self._child_distance(index, points)
            nearer = child_distance < distance
            distance[nearer] = child_distance[nearer]
            gradient[nearer] = child_gradient[nearer]
        return distance, gradient

    def _child_distance(self, index: int, points: np.ndarray):
        shape, position, _ = self.children[index]
        rotation = self._rotations[index]
        distance, gradient = shape.signed_distance((points - position) @ rotation)
        return distance, gradient @ rotation.T

    @property
    def grid_nodes(self) -> int:
        """Sum over all children."""
        return sum(shape.grid_nodes for shape, _, _ in self.children)

    @property
    def tree_triangles(self) -> int:
        """Sum over all children."""
        return sum(shape.tree_triangles for shape, _, _ in self.children)

    def to_data(self, place: Callable[[Shape], int]) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
        """The children by index, each with its pose."""
        return {
            "children": [
                [place(child), position.tolist(), orientation] for child, position, orientation in self.children
            ]
        }, {}

    @classmethod
    def from_data(cls, data: dict[str, Any], array: ReadArray, earlier: list[Shape]) -> Self:
        """Join shapes that were saved earlier."""
        last = len(earlier) - 1
        return cls(
            (earlier[whole_in("child", child, 0, last)], position, orientation)
            for child, position, orientation in data["children"]
        )

    def parts(self) -> list[Part]:
        """The children's parts, in order, at their poses."""
        flat = []
        for (shape, position, orientation), rotation in zip(self.children, self._rotations, strict=True):
            for part in shape.parts():
                place = rotation @ np.array(part.position) + position
                turned = tuple(rotations.multiply(orientation, part.orientation).tolist())
                flat.append(replace(part, position=tuple(place.tolist()), orientation=turned))
        return flat

    def sample_list(self) -> SampleList:
        """The children's samples, without those inside another child."""
        collected = SampleList()
        for index, (shape, position, _) in enumerate(self.children):
            rotation = self._rotations[index].T
            columns = shape.sample_list().columns()
            columns["point"] = columns["point"] @ rotation + position
            columns["normal"] = columns["normal"] @ rotation
            columns["slide"] = columns["slide"] @ rotation
            hidden = np.zeros(len(columns["point"]), dtype=bool)
            for other in range(len(self.children)):
                if other != index:
                    hidden |= self._hidden(other, columns)
            collected.add(**{name: column[~hidden] for name, column in columns.items()})
        return collected

    def _hidden(self, other: int, columns) -> np.ndarray:
        """Mask of the samples that lie inside another child, or on a face that the two share."""
        point, normal, slide = columns["point"], columns["normal"], columns["slide"]
        tolerance = 1e-6 * self.size
        ball = np.where(columns["kind"] == SampleKind.RIM, 0.0, columns["radius"])
        reach = np.full(len(point), -np.inf)
        for probe in (point, point - slide, point + slide, *_rim_probes(columns)):
            distance, gradient = self._child_distance(other, probe)
            facing = np.einsum("ij,ij->i", normal, gradient) < -0.5
            allowed = np.where(facing, tolerance, -tolerance)
            reach = np.maximum(reach, distance + ball - allowed)
        return reach < 0.0

    def surface(self) -> tuple[np.ndarray, np.ndarray]:
        """The children's surfaces together, inner walls included."""
        vertices, faces, count = [], [], 0
        for (shape, position, _), rotation in zip(self.children, self._rotations, strict=True):
            child_vertices, child_faces = shape.surface()
            vertices.append(child_vertices @ rotation.T + position)
            faces.append(child_faces + count)
            count += len(child_vertices)
        return np.concatenate(vertices), np.concatenate(faces).astype(np.int32)


def _checked_child(index: int, child):
    name = f"children[{index}]"
    try:
        shape, position, orientation = child
    except (TypeError, ValueError):
        raise ValueError(f"{name}: must be (shape, position, orientation)") from None
    if not isinstance(shape, Shape):
        raise ValueError(f"{name}: must begin with a shape, got {shown(shape)}")
    if shape.static_only:
        raise ValueError(f"{name}: must be a solid, got a {type(shape).__name__}")
    position = frozen_array(finite_vector(f"{name} position", position))
    return shape, position, unit_quaternion(f"{name} orientation", orientation)


def _rim_probes(columns) -> list[np.ndarray]:
    """Eight points on the circle of each RIM (for other samples the point itself)."""
    rim = (columns["kind"] == SampleKind.RIM)[:, None]
    if not rim.any():
        return []
    normal = columns["normal"]
    helper = np.eye(3)[np.argmin(np.abs(normal), axis=1)]
    first = np.cross(helper, normal)
    first /= np.maximum(np.linalg.norm(first, axis=1, keepdims=True), 1e-12)
    second = np.cross(normal, first)
    radius = columns["radius"][:, None] * rim
    angles = 2.0 * np.pi * np.arange(8) / 8
    return [columns["point"] + radius * (np.cos(angle) * first + np.sin(angle) * second) for angle in angles]
