"""Compound: several shapes rigidly joined into one."""

import math
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from warp_rigid import rotations
from warp_rigid.checks import finite_vector, numbers_of, shown, unit_quaternion, whole_in
from warp_rigid.scene.shapes import mass_properties
from warp_rigid.scene.shapes.analytic import Sphere
from warp_rigid.scene.shapes.base import (
    IDENTITY_ROTATION,
    Part,
    ReadArray,
    Shape,
    frozen_array,
    point_array,
)
from warp_rigid.scene.shapes.inner_balls import spread_out
from warp_rigid.scene.shapes.mass_properties import MassProperties
from warp_rigid.scene.shapes.sampling import SampleKind, SampleList


class Compound(Shape):
    """Union of shapes, each at its own pose.

    Masses add, so that an overlap of two children counts twice. Where the mass matters, place children in contact
    without overlap, or give the distribution of the mass. `size` is the smallest of the children's sizes.
    """

    def __init__(
        self,
        children: Iterable[tuple[Shape, ArrayLike, ArrayLike]],
        center_of_mass: ArrayLike | None = None,
        inertia_per_mass: ArrayLike | None = None,
    ):
        """Join shapes.

        Args:
            children: (shape, position (3,) [m], orientation (x, y, z, w)) of each. Planes and height fields cannot be
                joined; compounds can. There may be none if the distribution of the mass is given: such a body touches
                nothing.
            center_of_mass: (3,) [m], where the mass is not distributed uniformly over the children.
            inertia_per_mass: (3, 3) moments of inertia about the centre of mass, divided by the mass [m^2]; given
                together with the centre of mass.

        Raises:
            ValueError: There are no children and no distribution of the mass, or a value is not what is stated above.
        """
        children = list(children)
        if not children and inertia_per_mass is None:
            raise ValueError("children: must hold at least one (shape, position, orientation)")
        self.children = tuple(_checked_child(index, child) for index, child in enumerate(children))
        self._placed = [(shape, position, rotations.matrix(turned)) for shape, position, turned in self.children]
        self.distribution = _checked_distribution(center_of_mass, inertia_per_mass)

    def __repr__(self) -> str:
        """Show the shapes of the children."""
        return f"Compound({', '.join(repr(shape) for shape, _, _ in self.children)})"

    def _content(self):
        children = [item for child in self.children for item in (child[0].key, child[1], child[2])]
        return [*children, *(self.distribution or ())]

    @cached_property
    def mass_properties(self):
        """As given, else the sum over the children, by the parallel axis theorem."""
        if self.distribution is None:
            return self._sum_of_children()
        center, per_mass = self.distribution
        volume = self._sum_of_children().volume if self.children else Sphere(self._reach).volume
        return MassProperties(volume, center, volume * per_mass)

    def _sum_of_children(self) -> MassProperties:
        return mass_properties.combine((shape.mass_properties, *pose) for shape, *pose in self._placed)

    @property
    def _reach(self) -> float:
        """Radius of the ball that has the mean moment of inertia of a compound without children [m]."""
        assert self.distribution is not None
        return math.sqrt(2.5 * float(np.trace(self.distribution[1])) / 3.0)

    @cached_property
    def size(self):
        """Smallest size among the children [m]: contact tolerances must fit the thinnest."""
        return min((shape.size for shape, _, _ in self.children), default=0.0) or 2.0 * self._reach

    def support(self, directions: np.ndarray) -> np.ndarray:
        """Largest `direction . x` over all children."""
        if not self.children:
            return directions @ self.center_of_mass + self._reach * np.linalg.norm(directions, axis=1)
        return np.max(
            [
                directions @ position + shape.support(directions @ rotation)
                for shape, position, rotation in self._placed
            ],
            axis=0,
        )

    @property
    def wall(self) -> float:
        """Thinnest walls among the children [m]."""
        return min((shape.wall for shape, _, _ in self.children), default=0.0) or self.size

    @cached_property
    def inner_balls(self):
        """Some of the children's."""
        if not self.children:
            return np.array([[*self.center_of_mass, 0.0]])
        candidates = [
            np.column_stack([shape.inner_balls[:, :3] @ rotation.T + position, shape.inner_balls[:, 3]])
            for shape, position, rotation in self._placed
        ]
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
        shape, position, rotation = self._placed[index]
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
        """The children by index, each with its pose, and the distribution of the mass where it is given."""
        data: dict[str, Any] = {
            "children": [
                [place(child), position.tolist(), orientation] for child, position, orientation in self.children
            ]
        }
        if self.distribution is not None:
            center, per_mass = self.distribution
            data |= {"center_of_mass": center.tolist(), "inertia_per_mass": per_mass.tolist()}
        return data, {}

    @classmethod
    def from_data(cls, data: dict[str, Any], array: ReadArray, earlier: list[Shape]) -> Self:
        """Join shapes that were saved earlier."""
        last = len(earlier) - 1
        children = [
            (earlier[whole_in("child", child, 0, last)], position, orientation)
            for child, position, orientation in data["children"]
        ]
        return cls(children, data.get("center_of_mass"), data.get("inertia_per_mass"))

    def parts(self) -> list[Part]:
        """The children's parts, in order, at their poses."""
        flat = []
        for (shape, position, rotation), (*_, orientation) in zip(self._placed, self.children, strict=True):
            for part in shape.parts():
                place = rotation @ np.array(part.position) + position
                composed = tuple(rotations.multiply(orientation, part.orientation).tolist())
                flat.append(replace(part, position=tuple(place.tolist()), orientation=composed))
        return flat

    def sample_list(self) -> SampleList:
        """The children's samples, without those inside another child."""
        collected = SampleList()
        for index, (shape, position, turned) in enumerate(self._placed):
            rotation = turned.T
            samples = shape.sample_list()
            columns = samples.columns()
            columns["point"] = columns["point"] @ rotation + position
            columns["normal"] = columns["normal"] @ rotation
            columns["slide"] = columns["slide"] @ rotation
            hidden = np.zeros(len(columns["point"]), dtype=bool)
            for other in range(len(self.children)):
                if other != index:
                    hidden |= self._hidden(other, columns)
            kept = {name: column[~hidden] for name, column in columns.items()}
            collected.add(**kept, unsampled_edges=samples.unsampled_edges @ rotation)
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
        """The children's surfaces together, inner walls included; without children a triangle that is a point."""
        if not self.children:
            return np.tile(self.center_of_mass, (3, 1)), np.array([[0, 1, 2]], np.int32)
        vertices, faces, count = [], [], 0
        for shape, position, rotation in self._placed:
            child_vertices, child_faces = shape.surface()
            vertices.append(child_vertices @ rotation.T + position)
            faces.append(child_faces + count)
            count += len(child_vertices)
        return np.concatenate(vertices), np.concatenate(faces).astype(np.int32)

    def surface_uv(self) -> np.ndarray | None:
        """Those of the children, in order."""
        found = [shape.surface_uv() for shape, _, _ in self.children]
        if all(uv is None for uv in found):
            return None
        return np.concatenate(
            [
                np.full((len(shape.surface()[1]), 3, 2), np.nan, np.float32) if uv is None else uv
                for (shape, _, _), uv in zip(self.children, found, strict=True)
            ]
        )


def with_distribution(shape: Shape, center_of_mass: ArrayLike, inertia_per_mass: ArrayLike) -> Compound:
    """The same solid with another distribution of its mass; see Compound."""
    if isinstance(shape, Compound):
        return Compound(shape.children, center_of_mass, inertia_per_mass)
    return Compound([(shape, np.zeros(3), np.array(IDENTITY_ROTATION))], center_of_mass, inertia_per_mass)


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


def _checked_distribution(center: ArrayLike | None, per_mass: ArrayLike | None) -> tuple[np.ndarray, np.ndarray] | None:
    """The centre of mass (3,) and the inertia per mass (3, 3); None if neither is given."""
    if center is None and per_mass is None:
        return None
    if center is None or per_mass is None:
        raise ValueError("center_of_mass: must be given together with inertia_per_mass")
    tensor = numbers_of(per_mass)
    if (
        tensor is None
        or tensor.shape != (3, 3)
        or not np.isfinite(tensor).all()
        or not np.allclose(tensor, tensor.T, rtol=1e-6)
    ):
        raise ValueError("inertia_per_mass: must be a symmetric matrix of 3 x 3 finite numbers")
    if np.linalg.eigvalsh(tensor)[0] <= 0.0:
        raise ValueError("inertia_per_mass: must have principal moments > 0")
    return frozen_array(finite_vector("center_of_mass", center)), frozen_array(0.5 * (tensor + tensor.T))


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
