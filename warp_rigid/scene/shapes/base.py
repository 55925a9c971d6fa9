"""What every shape is made of: parts, grids, and the base class that holds the common rules."""

import hashlib
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from warp_rigid.kernels.enums import PartKind
from warp_rigid.scene.shapes.mass_properties import MassProperties
from warp_rigid.scene.shapes.sampling import SampleList, Samples

IDENTITY_ROTATION = (0.0, 0.0, 0.0, 1.0)


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
    HEIGHTFIELD (extent x, extent y, steepest slope, 0); all but the slope [m].
    """

    kind: PartKind
    size: tuple[float, float, float, float]
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    orientation: tuple[float, float, float, float] = IDENTITY_ROTATION
    grid: Grid | None = None


class Shape:
    """Base of all shapes: immutable, compared by content.

    A subclass gives `mass_properties`, `support`, `signed_distance`, `parts`, `surface`,
    `sample_list` and `_content` (what its key is made from).
    """

    static_only = False

    def __setattr__(self, name, value):
        """Set an attribute once, and never again."""
        if name in self.__dict__:
            raise AttributeError(f"{type(self).__name__}.{name} cannot be changed")
        super().__setattr__(name, value)

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

    @property
    def mass_properties(self) -> MassProperties:
        """Volume, centre of mass and inertia at unit density."""
        raise NotImplementedError

    def support(self, directions: np.ndarray) -> np.ndarray:
        """Largest `direction . x` over the shape, for (n, 3) directions -> (n,)."""
        raise NotImplementedError

    def signed_distance(self, points) -> tuple[np.ndarray, np.ndarray]:
        """Distance to the surface (n,) [m], negative inside, and its gradient (n, 3)."""
        raise NotImplementedError

    def parts(self) -> list[Part]:
        """The signed distance functions whose union is the shape."""
        raise NotImplementedError

    def sample_list(self) -> SampleList:
        """Points, edges and rims of the surface that are tested against other shapes, ungrouped."""
        raise NotImplementedError

    def samples(self) -> Samples:
        """The same, grouped into clusters."""
        return self._samples

    @cached_property
    def _samples(self) -> Samples:
        return self.sample_list().cluster()

    def surface(self) -> tuple[np.ndarray, np.ndarray]:
        """Triangles that face outward: vertices (n, 3) float64 [m], faces (m, 3) int32."""
        raise NotImplementedError

    def _content(self) -> list:
        raise NotImplementedError

    @cached_property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper corner of the axis-aligned box around the shape, (3,) each [m]."""
        return -self.support(-np.eye(3)), self.support(np.eye(3))

    @cached_property
    def size(self) -> float:
        """Smallest extent of the bounds [m]."""
        lower, upper = self.bounds
        return float(np.min(upper - lower))

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
    array = np.asarray(points, dtype=np.float64)
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
