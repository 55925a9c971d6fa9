"""Mesh: a solid bounded by triangles, with a signed distance grid."""

import contextlib
import warnings
from collections.abc import Callable
from functools import cached_property
from os import PathLike
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from warp_rigid.checks import shown, whole_in
from warp_rigid.files import mesh_files
from warp_rigid.files.atomic import atomic_file
from warp_rigid.scene.shapes import distance_grid, inner_balls, mass_properties, topology
from warp_rigid.scene.shapes.base import Grid, Part, PartKind, ReadArray, Shape, content_hash, frozen_array, point_array
from warp_rigid.scene.shapes.mesh_repair import Surface, checked, checked_uv, repair
from warp_rigid.scene.shapes.sampling import SampleList, sample_mesh
from warp_rigid.scene.shapes.triangle_tree import TriangleTree, triangle_tree

SAMPLES_PER_SIDE = 16
LARGE = 10.0
"""Extent from which the unit of a file is doubted that does not state one [m]."""
CELLS_OF_A_WALL = 1.3
"""Thickness from which a wall holds by the grid alone, in cells: measured 1.28."""


class Mesh(Shape):
    """Solid inside a triangle mesh, convex or not.

    Collisions use a grid of signed distances, which is computed at first use and stored in a cache
    folder (see `warp_rigid.scene.shapes.distance_grid`), and near the surface the triangles themselves, so
    that walls may be thinner than a cell of the grid. The triangles take at most 200 bytes each. The grid alone is used
    if more than two faces meet at an edge, or if a mesh with holes crosses itself or their caps (see `fault`).

    A mesh with holes represents the solid that results when each boundary loop is closed by a fan
    of triangles from the loop's mean point. Mass, signed distance and sign (by winding number
    > 1/2) all refer to that solid: an open skull is a solid skull with its eye sockets capped at
    their rims, and other bodies cannot enter it. A hollow body needs a mesh with two walls, an outer
    and an inner one.

    Attributes:
        vertices: (n, 3) float64 [m].
        faces: (m, 3) int32, facing outward.
        sdf_resolution: grid cells along the longest side.
        watertight: whether the given mesh has no holes.
        uv: (m, 3, 2) float32, texture coordinates of the corners of `faces`; None without.
        image: path of the image that its file has for it; None without. Not part of comparisons and saved shapes.
        repairs: descriptions of the repairs, empty if none was needed.
    """

    def __init__(self, vertices: ArrayLike, faces: ArrayLike, sdf_resolution: int = 64, *, uv: ArrayLike | None = None):
        """Make a mesh.

        Args:
            vertices: (n, 3) [m], finite.
            faces: (m, 3) vertex indices; either winding.
            sdf_resolution: grid cells along the longest side, 8 to 512.
            uv: texture coordinates of the vertices (n, 2), or of the corners of the faces (m, 3, 2), for a body whose
                look has an image: (0, 0) is its lower left corner, (1, 1) the upper right one, beyond which it repeats.

        Raises:
            ValueError: The mesh is empty, not finite or encloses no volume, or it has a `fault` and walls too thin for
                the grid.
        """
        self._setup(repair(vertices, faces, uv), sdf_resolution)
        if self.repairs:
            warnings.warn(f"mesh repaired: {'; '.join(self.repairs)}", stacklevel=2)

    def _setup(self, surface, sdf_resolution):
        self.sdf_resolution = whole_in("sdf_resolution", sdf_resolution, 8, 512)
        self.vertices = frozen_array(surface.vertices)
        self.faces = frozen_array(surface.faces, np.int32)
        self.uv = None if surface.uv is None else frozen_array(surface.uv, np.float32)
        self.repairs = surface.repairs
        edges = topology.find_edges(self.faces)
        self.watertight = edges.closed
        self._closed = edges.closed and edges.manifold
        solid_vertices, solid_faces = topology.close_boundaries(self.vertices, self.faces)
        self._solid_vertices = frozen_array(solid_vertices)
        self._solid_faces = frozen_array(solid_faces, np.int32)
        _refuse_flat(self.vertices, self.faces, self.mass_properties)
        if not self._closed:
            self._refuse_thin()

    def _refuse_thin(self) -> None:
        """Reject walls that the grid does not resolve, where it alone decides between inside and outside."""
        extent = float(np.ptp(self.vertices, axis=0).max())
        least = int(np.ceil(CELLS_OF_A_WALL * extent / self.wall))
        if self.sdf_resolution < least and self.fault:
            raise ValueError(
                f"sdf_resolution: must be at least {least} for walls about {1e3 * self.wall:.3g} mm thick, got "
                f"{self.sdf_resolution}; as {self.fault}, only the grid separates inside from outside"
            )

    @cached_property
    def fault(self) -> str:
        """Why contacts cannot use the triangles; empty if they can.

        They can if the nearest triangle shows on which side of the surface a point is: on a closed surface with two
        faces at each edge. Where holes were closed, it must not cross itself, too: a cap may cross the surface, and
        only surfaces without holes are united where they cross.
        """
        if self._closed:
            return ""
        if not topology.find_edges(self._solid_faces).manifold:
            return "more than two faces meet at an edge"
        crosses = topology.crosses_itself(self._solid_vertices, self._solid_faces, len(self.faces))
        return "the mesh has holes, and with their caps it crosses itself" if crosses else ""

    def __repr__(self) -> str:
        """Show the numbers of vertices and triangles."""
        sizes = f"{len(self.vertices)} vertices, {len(self.faces)} triangles"
        return f"Mesh({sizes}, sdf_resolution={self.sdf_resolution})"

    @classmethod
    def from_file(cls, path: str | PathLike[str], scale: float = 1.0, sdf_resolution: int = 64) -> "Mesh":
        """Read a mesh file.

        Vertices that a file format repeats for each face (STL) or texture seam (glTF) are merged
        without a warning; other repairs warn. So does a mesh of 10 m or more from a file that does not state its
        unit and is not scaled.

        Texture coordinates are kept; corners without any have (0, 0). The image of the first material that has one
        (OBJ, PLY, glTF) becomes `image`, which bodies show that `Scene.add_body` makes of the mesh. Images inside
        of a file are copied to the cache folder. `import_usd` reads the materials of USD files.

        Args:
            path: OBJ, STL, PLY, GLB, GLTF or OFF, or USD (.usd, .usda, .usdc, .usdz; all its meshes
                at their poses). glTF and USD state their up axis, and USD its unit: such
                files are rotated to z up and scaled to metres. Other files are read unchanged.
            scale: factor on all coordinates, greater than 0.
            sdf_resolution: as in `Mesh`.

        Raises:
            ValueError: The file cannot be read or holds no usable mesh; the message names it.
            FileNotFoundError: The file does not exist; the message names it.
        """
        found = mesh_files.load(path, scale)
        uv = None if found.uv is None else np.where(np.isfinite(found.uv), found.uv, 0.0)
        mesh = cls.__new__(cls)
        try:
            mesh._setup(repair(found.vertices, found.faces, uv), sdf_resolution)
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from None
        notable = [text for text in mesh.repairs if "duplicate" not in text]
        if notable:
            warnings.warn(f"{path}: mesh repaired: {'; '.join(notable)}", stacklevel=2)
        if scale == 1.0 and not mesh_files.states_its_unit(path):
            mesh._doubt_unit(f"{path}: ", "scale=0.001")
        mesh.image = _image_path(path, found.image)
        return mesh

    @classmethod
    def from_trimesh(cls, mesh: Any, sdf_resolution: int = 64) -> "Mesh":
        """Make a mesh from a `trimesh.Trimesh`, with its texture coordinates and image if it has any.

        Args:
            mesh: any object with `vertices` (n, 3) [m] and `faces` (m, 3).
            sdf_resolution: as in `Mesh`.

        Raises:
            ValueError: The object has none, such as a `trimesh.Scene`, or `Mesh` refuses them.
        """
        if not (hasattr(mesh, "vertices") and hasattr(mesh, "faces")):
            raise ValueError(f"mesh: must have vertices and faces, as a trimesh.Trimesh, got {shown(mesh)}")
        visual = getattr(mesh, "visual", None)
        made = cls(mesh.vertices, mesh.faces, sdf_resolution, uv=getattr(visual, "uv", None))
        made.image = None if made.uv is None else _image_path("mesh", mesh_files.image_of(visual))
        if getattr(mesh, "units", None) is None:
            made._doubt_unit("mesh: ", "mesh.apply_scale(0.001)")
        return made

    def _doubt_unit(self, where: str, remedy: str) -> None:
        """Warn about a large mesh whose unit is not stated."""
        extent = float(np.ptp(self.vertices, axis=0).max())
        if extent >= LARGE:
            warnings.warn(f"{where}the mesh is {extent:.3g} m long; if it is in mm, use {remedy}", stacklevel=3)

    @property
    def grid_nodes(self) -> int:
        """From the bounds and the resolution."""
        nx, ny, nz = distance_grid.grid_layout(self.vertices, self.sdf_resolution)[2]
        return nx * ny * nz

    @property
    def tree_triangles(self) -> int:
        """All, with those that close holes."""
        return len(self._solid_faces)

    def to_data(self, place: Callable[[Shape], int]) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
        """Triangles and distances as arrays."""
        arrays = {"vertices": self.vertices, "faces": self.faces, "distances": self.grid.values}
        data: dict[str, Any] = {"sdf_resolution": self.sdf_resolution, "repairs": self.repairs}
        if self.uv is not None:
            data["uv"], arrays["uv"] = True, self.uv
        return data, arrays

    @classmethod
    def from_data(cls, data: dict[str, Any], array: ReadArray, earlier: list[Shape]) -> Self:
        """The mesh as it was, bit for bit: without repairs, warnings or a new distance grid."""
        mesh = cls.__new__(cls)
        vertices, faces = checked(array("vertices", np.float64, (None, 3)), array("faces", np.int32, (None, 3)))
        uv = array("uv", np.float32, (None, 3, 2)) if data.get("uv") else None  # older files have none
        uv = None if uv is None else checked_uv(uv, vertices, faces)
        repairs = [str(text) for text in data["repairs"]]
        mesh._setup(Surface(vertices, faces.astype(np.int32), repairs, uv), data["sdf_resolution"])
        origin, spacing, shape = distance_grid.grid_layout(mesh._solid_vertices, mesh.sdf_resolution)
        distances = array("distances", np.float32, shape)
        if not np.isfinite(distances).all():
            raise ValueError("distances: must be finite numbers")
        mesh.__dict__["grid"] = Grid(tuple(origin.tolist()), spacing, frozen_array(distances, np.float32))
        return mesh

    def _content(self):
        return [self.vertices, self.faces, self.sdf_resolution, *([] if self.uv is None else [self.uv])]

    @cached_property
    def mass_properties(self):
        """Exact integrals over the triangles, with holes closed by fans."""
        return mass_properties.polyhedron(self._solid_vertices, self._solid_faces)

    def support(self, directions: np.ndarray) -> np.ndarray:
        """Largest `direction . x` over the vertices."""
        return (directions @ self.vertices.T).max(axis=1)

    @cached_property
    def hull(self):
        """All vertices, if the mesh is convex."""
        convex = self._closed and topology.is_convex(self.vertices, self.faces)
        return self.vertices if convex else np.zeros((0, 3))

    @cached_property
    def grid(self) -> Grid:
        """Signed distances: `sdf_resolution` cells along the longest side, and 3 more on every side."""
        return distance_grid.grid_of_mesh(self._solid_vertices, self._solid_faces, self.sdf_resolution, not self.fault)

    def signed_distance(self, points: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
        """Signed distance to the triangles (n,) [m] and unit direction (n, 3), which is zero on the surface itself.

        Computed in float32 about the middle of the mesh. The simulation takes it from the grid where no contact can be,
        and more than a cell inside.
        """
        return distance_grid.mesh_distance(self._solid_vertices, self._solid_faces, point_array(points), not self.fault)

    @cached_property
    def wall(self):
        """Thickness of a large plate with the same volume and area [m]."""
        area = topology.face_normals(self._solid_vertices, self._solid_faces)[1].sum()
        return float(2.0 * self.volume / area)

    @cached_property
    def inner_balls(self):
        """About nodes of the grid."""
        depth = -self.grid.values
        deepest = depth.max()  # negative if the shape is thinner than a cell of the grid
        nodes = np.argwhere(depth >= min(inner_balls.THINNEST * deepest, deepest))
        centers = np.array(self.grid.origin) + self.grid.spacing * nodes
        return inner_balls.spread_out(np.column_stack([centers, np.maximum(depth[tuple(nodes.T)], 0.0)]))

    def parts(self) -> list[Part]:
        """One GRID, with its tree of triangles."""
        return [Part(PartKind.GRID, (0.0, 0.0, 0.0, 0.0), grid=self.grid, tree=self.tree)]

    @cached_property
    def tree(self) -> TriangleTree:
        """All triangles; without a sign if the mesh has a `fault`."""
        return triangle_tree(self._solid_vertices, self._solid_faces, not self.fault)

    @property
    def sample_spacing(self) -> float:
        """Largest distance of a surface point from the nearest sample: longest side / 16 [m]."""
        return float(np.ptp(self.vertices, axis=0).max()) / SAMPLES_PER_SIDE

    def sample_list(self) -> SampleList:
        """Vertices, EDGE segments on sharp convex edges, and points on large triangles, with those of closed holes."""
        return sample_mesh(self._solid_vertices, self._solid_faces, self.sample_spacing)

    def surface(self) -> tuple[np.ndarray, np.ndarray]:
        """The repaired mesh itself, with its holes open."""
        return self.vertices, self.faces

    def surface_uv(self) -> np.ndarray | None:
        """As given, those of the faces that are left after repairs."""
        return self.uv


def _refuse_flat(vertices, faces, properties) -> None:
    """Reject a mesh that encloses no volume or whose inertia is not that of a solid."""
    area = topology.face_normals(vertices, faces)[1].sum()
    diagonal = float(np.linalg.norm(np.ptp(vertices, axis=0)))
    if not properties.volume > 1e-7 * area * diagonal:
        raise ValueError(f"mesh: must enclose a volume > 0, got {properties.volume:.3g} m^3")
    if not np.linalg.eigvalsh(properties.inertia)[0] > 0.0:
        raise ValueError("mesh: must bound a solid, got a surface whose inertia is not positive")


def _image_path(path: Any, image: Any) -> str | None:
    """Absolute path of an image of a mesh file; an image inside of the file is written to the cache folder.

    Args:
        path: of the mesh file.
        image: path of the image, or an image of Pillow; None without.

    Returns:
        None without an image, with a warning if its file does not exist or cannot be written.
    """
    if image is None:
        return None
    if not isinstance(image, Path):
        pixels = image.convert("RGB")
        image = distance_grid.cache_folder() / "images" / f"{content_hash(np.asarray(pixels))}.png"
        with contextlib.suppress(OSError):
            if not image.is_file():
                with atomic_file(image) as temporary:
                    pixels.save(temporary, "PNG")
    if not image.is_file():
        warnings.warn(f"{path}: image {image} does not exist; bodies are shown in their plain colour", stacklevel=4)
        return None
    return str(image.absolute())
