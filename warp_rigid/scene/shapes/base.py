"""Parts, grids, and the base class of all shapes."""

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any, ClassVar, Self

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from warp_rigid.checks import number_array
from warp_rigid.kernel_cache import load_module
from warp_rigid.kernels.collide import host_distance
from warp_rigid.kernels.enums import PartKind
from warp_rigid.scene.shapes import inner_balls
from warp_rigid.scene.shapes.mass_properties import MassProperties, diagonal
from warp_rigid.scene.shapes.sampling import SampleList, Samples
from warp_rigid.scene.shapes.triangle_tree import TriangleTree
from warp_rigid.threads import exclusive

IDENTITY_ROTATION = (0.0, 0.0, 0.0, 1.0)

ReadArray = Callable[[str, Any, tuple[int | None, ...]], np.ndarray]


@dataclass(frozen=True, eq=False)
class Grid:
    """Distances on the nodes of a regular grid.

    Node (i, j, k) lies at `origin + spacing * (i, j, k)`; `values` is float32, shaped (nx, ny, nz),
    in C order, negative inside the solid [m]. A height field has shape (nx, ny, 1) and holds
    heights [m]; its nodes span the rectangle of its part's size, evenly but not always squarely.
    """

    origin: tuple[float, float, float]
    spacing: float
    values: np.ndarray


@dataclass(frozen=True, eq=False)
class Part:
    """One signed distance function of a shape, and its pose in the shape's frame.

    `size` by kind: SPHERE (radius, 0, 0, 0), BOX (half x, half y, half z, 0), CAPSULE and CYLINDER
    (radius, half height, 0, 0) about local z, PLANE (unit normal, offset), GRID (0, 0, 0, 0),
    HEIGHTFIELD (extent x, extent y, steepest slope, 0); all but the slope [m]. A GRID has a `tree` of its triangles,
    and exact distances to them near its surface if the tree is signed.
    """

    kind: PartKind
    size: tuple[float, float, float, float]
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    orientation: tuple[float, float, float, float] = IDENTITY_ROTATION
    grid: Grid | None = None
    tree: TriangleTree | None = None


class Shape:
    """Base of all shapes: immutable, compared by content.

    A subclass of analytic shape lists its `parameters` with the `part_kind` that has these numbers, and defines
    `mass_properties`, `support`, `sample_list` and `surface`. A subclass with other data also overrides `parts`,
    `signed_distance`, `_content`, `to_data` and `from_data`. The distance itself is a device function in
    `warp_rigid.kernels.collide.distance`.

    Attributes:
        classes: all subclasses by their name in saved scenes, which is the class name in lower case.
        parameters: the constructor's parameters, each a number or a vector kept in the attribute of that name.
        part_kind: kind of the part of an analytic shape.
        static_only: whether dynamic bodies cannot have this shape.
        image: path of the image that its bodies show by default; None without.
    """

    classes: ClassVar[dict[str, type["Shape"]]] = {}
    parameters: ClassVar[tuple[str, ...]] = ()
    part_kind: ClassVar[PartKind]
    static_only = False
    image: str | None = None

    def __init_subclass__(cls, **options):
        """Register a shape for saved scenes.

        Raises:
            TypeError: another shape has this name.
        """
        super().__init_subclass__(**options)
        known = Shape.classes.setdefault(cls.kind(), cls)
        if (known.__module__, known.__qualname__) != (cls.__module__, cls.__qualname__):
            raise TypeError(f"{cls.__name__}: {known.__module__}.{known.__qualname__} already has this name")
        Shape.classes[cls.kind()] = cls

    @classmethod
    def kind(cls) -> str:
        """Name of the shape in saved scenes."""
        return cls.__name__.lower()

    def __setattr__(self, name, value):
        """Set an attribute; an attribute that is already set cannot be changed."""
        if name in self.__dict__:
            raise AttributeError(f"{type(self).__name__}.{name} cannot be changed")
        super().__setattr__(name, value)

    def __repr__(self) -> str:
        """The constructor call of an analytic shape; other shapes list their sizes."""
        values = {name: np.asarray(getattr(self, name)).tolist() for name in self.parameters}
        listed = (f"{name}={tuple(v) if isinstance(v, list) else v}" for name, v in values.items())
        return f"{type(self).__name__}({', '.join(listed)})"

    @property
    def volume(self) -> float:
        """Volume [m^3]."""
        return self.mass_properties.volume

    @property
    def center_of_mass(self) -> np.ndarray:
        """Centre of mass at uniform density, (3,) [m]."""
        return self.mass_properties.center_of_mass

    @property
    def inertia(self) -> np.ndarray:
        """Inertia at unit density about the centre of mass, in the shape's frame, (3, 3) [m^5]."""
        return self.mass_properties.inertia

    @cached_property
    def moments(self) -> tuple[float, ...]:
        """Principal moments of inertia of a body of 1 kg, ascending, (3,) [m^2]."""
        return tuple((np.linalg.eigvalsh(np.asarray(self.inertia, dtype=np.float64)) / self.volume).tolist())

    @property
    def mass_properties(self) -> MassProperties:
        """Volume, centre of mass and inertia at unit density; zero for a shape that dynamic bodies cannot have."""
        if self.static_only:
            return diagonal(0.0, np.zeros(3))
        raise NotImplementedError

    def support(self, directions: np.ndarray) -> np.ndarray:
        """Largest `direction . x` over the shape, for (n, 3) directions -> (n,)."""
        raise NotImplementedError

    @property
    def hull(self) -> np.ndarray:
        """Vertices of the solid if it is a convex mesh, (n, 3) [m], else (0, 3)."""
        return np.zeros((0, 3))

    @cached_property
    def inner_balls(self) -> np.ndarray:
        """Centres and radii of large balls inside the shape, (k, 4) [m], the largest first; radius 0 without an inside.

        By default balls in a row through the centre of mass, as in boxes, balls, capsules and cylinders.
        """
        if self.static_only:
            return np.zeros((1, 4))
        center = self.center_of_mass
        axes = np.concatenate([np.eye(3), -np.eye(3)])
        extents = (self.support(axes) - axes @ center).reshape(2, 3).min(axis=0)
        return inner_balls.in_a_row(center, extents)

    def signed_distance(self, points: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
        """Distance to the surface and its gradient, in float64.

        For an analytic shape this is the kernels' own distance. Where the gradient does not exist (the centre of a
        sphere), it is an arbitrary unit vector.

        Args:
            points: (n, 3) in the shape's frame [m].

        Returns:
            Distance (n,) [m], negative inside, and gradient (n, 3).

        Raises:
            ValueError: the points have another shape.
        """
        (part,) = self.parts()
        return analytic_distance(part, point_array(points))

    def parts(self) -> list[Part]:
        """Parts whose union is the shape; by default one, whose numbers are the parameters."""
        numbers = np.hstack([getattr(self, name) for name in self.parameters]).tolist()
        return [Part(self.part_kind, (*numbers, *(0.0,) * (4 - len(numbers))))]

    def sample_list(self) -> SampleList:
        """Points, edges and rims of the surface that are tested against other shapes, ungrouped."""
        raise NotImplementedError

    def samples(self) -> Samples:
        """Surface samples, grouped into clusters."""
        return self._samples

    @cached_property
    def _samples(self) -> Samples:
        return self.sample_list().cluster()

    def surface(self) -> tuple[np.ndarray, np.ndarray]:
        """Triangles that face outward: vertices (n, 3) float64 [m], faces (m, 3) int32."""
        raise NotImplementedError

    def surface_uv(self) -> np.ndarray | None:
        """Texture coordinates of the corners of `surface()`, (m, 3, 2) float32, NaN where a part has none; or None."""
        return None

    @property
    def grid_nodes(self) -> int:
        """Number of grid values among the parts, without computing them."""
        return 0

    @property
    def tree_triangles(self) -> int:
        """Number of triangles of the meshes among the parts."""
        return 0

    def to_data(self, place: Callable[["Shape"], int]) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
        """Plain data for JSON and arrays by name, from which `from_data` restores the shape.

        Args:
            place: saves another shape, which this one contains, and returns its index.
        """
        return {name: np.asarray(getattr(self, name)).tolist() for name in self.parameters}, {}

    @classmethod
    def from_data(cls, data: dict[str, Any], array: ReadArray, earlier: list["Shape"]) -> Self:
        """The shape that `to_data` described.

        Args:
            data: its plain data.
            array: function(name, dtype, shape) that returns one of its arrays; a length may be None for any.
            earlier: the shapes saved before this one, by index.

        Raises:
            ValueError, TypeError, KeyError: the data are damaged.
        """
        return cls(**{name: data[name] for name in cls.parameters})

    def _content(self) -> list:
        """Numbers and arrays that determine the shape, for its key."""
        return [getattr(self, name) for name in self.parameters]

    @cached_property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper corner of the axis-aligned box around the shape, (3,) each [m]."""
        return -self.support(-np.eye(3)), self.support(np.eye(3))

    @cached_property
    def size(self) -> float:
        """Smallest extent of the bounds [m]."""
        lower, upper = self.bounds
        return float(np.min(upper - lower))

    @property
    def wall(self) -> float:
        """Thickness of the walls [m]; the size, if the shape is convex."""
        return self.size

    @cached_property
    def key(self) -> str:
        """Content hash: equal shapes have equal keys."""
        return content_hash(type(self).__name__, *self._content())

    def __eq__(self, other) -> bool:
        """Shapes are equal if their content is."""
        return isinstance(other, Shape) and self.key == other.key

    def __hash__(self) -> int:
        """Hash by content."""
        return hash(self.key)


@exclusive()
def analytic_distance(part: Part, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distance (n,) [m] and its gradient (n, 3) of an analytic part, in its own frame.

    Evaluates the device function of the collision kernels on the CPU, in float64. Warp compiles it at the first call.

    Args:
        part: of an analytic kind, neither GRID nor HEIGHTFIELD.
        points: (n, 3) float64 in the part's frame [m].
    """
    _load_host_distance()
    places = wp.array(np.ascontiguousarray(points), dtype=wp.vec3d, device="cpu", copy=False)
    found = wp.empty(len(points), dtype=wp.vec4d, device="cpu")
    inputs = [int(part.kind), wp.vec4d(*part.size), places]
    wp.launch(host_distance.part_distances, len(points), inputs=inputs, outputs=[found], device="cpu")
    columns = found.numpy()
    return columns[:, 3].copy(), columns[:, :3].copy()


@cache
def _load_host_distance() -> None:
    load_module(wp.get_device("cpu"), host_distance.__name__, 1)


def content_hash(*items) -> str:
    """SHA-256 over strings, numbers and arrays (their type, shape and bytes)."""
    digest = hashlib.sha256()
    for item in items:
        array = np.ascontiguousarray(item)
        digest.update(f"{array.dtype.str}{array.shape}".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()


def point_array(points) -> np.ndarray:
    """Points as a float64 (n, 3) array, or a ValueError."""
    array = number_array("points", points)
    if array.ndim == 1 and array.shape == (3,):
        array = array[None]
    if array.ndim != 2 or array.shape[1] != 3:
        raise ValueError(f"points: must be shaped (n, 3), got {array.shape}")
    return array


def frozen_array(values, dtype=np.float64) -> np.ndarray:
    """A private read-only copy."""
    array = np.array(values, dtype=dtype, order="C")
    array.flags.writeable = False
    return array
