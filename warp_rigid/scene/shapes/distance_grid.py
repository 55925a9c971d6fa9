"""Signed distance grids of meshes: computed by Warp kernels, cached on disk, interpolated here.

Grids are kept in the folder named by the environment variable WARP_RIGID_CACHE, or in the
platform's user cache folder under `warp_rigid`. A file is named by the hash of all that its grid
depends on. If a file is damaged, this is reported and the grid is computed again. If the folder cannot be
written to, nothing is cached.
"""

import contextlib
import logging
import os
import sys
from pathlib import Path

import numpy as np
import warp as wp

from warp_rigid.engine.cores import spread, usable_cores
from warp_rigid.files import archive
from warp_rigid.files.atomic import atomic_file
from warp_rigid.kernels.collide import bake as kernels
from warp_rigid.scene.shapes import topology
from warp_rigid.scene.shapes.base import Grid, content_hash, frozen_array
from warp_rigid.threads import exclusive

log = logging.getLogger("warp_rigid")

PADDING_CELLS = 3
FORMAT = 1  # raise whenever the same mesh would give another grid or file


def grid_of_mesh(vertices, faces, resolution: int, simple: bool) -> Grid:
    """Signed distances to a closed mesh, from the cache or computed.

    Args:
        vertices: (n, 3) [m].
        faces: (m, 3), closed and facing outward.
        resolution: cells along the longest side; 3 cells of padding are added on each side.
        simple: whether two faces meet at every edge, and no cap of a hole crosses the surface. If so, the sign is taken
            from angle-weighted pseudonormals, otherwise from the winding number.
    """
    file = cache_folder() / (content_hash(FORMAT, vertices, faces, resolution, simple) + ".npz")
    origin, spacing, shape = grid_layout(vertices, resolution)
    values = _read(file, shape)
    if values is None:
        values = bake(vertices, faces, origin, spacing, shape, simple, _device())
        if not np.isfinite(values).all():
            raise ValueError("mesh: must have a triangle that is no sliver, got slivers only")
        _write(file, values)
    return Grid(tuple(origin.tolist()), spacing, frozen_array(values, np.float32))


def grid_layout(vertices, resolution: int) -> tuple[np.ndarray, float, tuple[int, int, int]]:
    """Origin (3,), spacing and node counts of the grid around a mesh, centred on its bounds."""
    lower, upper = vertices.min(axis=0), vertices.max(axis=0)
    extent = upper - lower
    spacing = float(extent.max()) / resolution
    cells = np.ceil(extent / spacing - 1e-6).astype(int) + 2 * PADDING_CELLS
    origin = 0.5 * (lower + upper) - 0.5 * spacing * cells
    return origin, spacing, tuple((cells + 1).tolist())


@exclusive()
def bake(vertices, faces, origin, spacing: float, shape, simple: bool, device) -> np.ndarray:
    """Signed distances on the nodes of a grid, computed on a Warp device.

    Args:
        vertices: (n, 3) [m].
        faces: (m, 3), closed and facing outward.
        origin: (3,) first node [m].
        spacing: between nodes [m].
        shape: (nx, ny, nz) nodes.
        simple: as in `grid_of_mesh`.
        device: a Warp device; on the CPU all cores are used.

    Returns:
        (nx, ny, nz) float32 [m].
    """
    center = 0.5 * (vertices.min(axis=0) + vertices.max(axis=0))
    tables, held = _mesh_tables(vertices - center, faces, simple, device)
    values = wp.zeros(shape, dtype=float, device=device)
    inputs = [tables, wp.vec3(*(origin - center)), float(spacing)]
    _launch_slabs(kernels.distance_columns, shape[0] * shape[1], inputs, [values], device)
    result = values.numpy()
    del held
    return result


def interpolate(grid: Grid, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Trilinear distance (n,) and its gradient (n, 3) at (n, 3) points.

    Outside the grid, with q the nearest place on its border, the distance is
    `sqrt(distance(q)^2 + |point - q|^2)`. As the grid is convex and holds the whole surface, this
    never exceeds the true distance; far away both agree.
    """
    last = np.array(grid.values.shape) - 1
    place = (points - np.array(grid.origin)) / grid.spacing
    clamped = np.clip(place, 0.0, last)
    cell = np.minimum(clamped.astype(np.int64), last - 1)
    fraction = clamped - cell
    values = grid.values.astype(np.float64)
    distance = np.zeros(len(points))
    gradient = np.zeros_like(points)
    for corner in np.ndindex(2, 2, 2):
        value = values[tuple((cell + corner).T)]
        weight = np.where(np.array(corner) == 1, fraction, 1.0 - fraction)
        distance += value * weight.prod(axis=1)
        for axis in range(3):
            others = weight[:, (axis + 1) % 3] * weight[:, (axis + 2) % 3]
            gradient[:, axis] += (2 * corner[axis] - 1) / grid.spacing * value * others
    outside = (place != clamped).any(axis=1)
    away = grid.spacing * (place - clamped)[outside]
    reach = np.hypot(distance[outside], np.linalg.norm(away, axis=1))
    along = np.where(away != 0.0, away, distance[outside, None] * gradient[outside])
    distance[outside], gradient[outside] = reach, along / reach[:, None]
    return distance, gradient


@exclusive()
def mesh_distance(vertices, faces, points, simple: bool, device=None):
    """Signed distance to the triangles of a closed mesh.

    Args:
        vertices: (n, 3) [m].
        faces: (m, 3), closed and facing outward.
        points: (k, 3) float64 [m].
        simple: as in `grid_of_mesh`.
        device: a Warp device; the first CUDA device, or else the CPU, if not given.

    Returns:
        Distance (k,) [m], and unit direction (k, 3), zero on the surface.
    """
    device = device or _device()
    center = 0.5 * (vertices.min(axis=0) + vertices.max(axis=0))
    tables, held = _mesh_tables(vertices - center, faces, simple, device)
    positions = wp.array((points - center).astype(np.float32), dtype=wp.vec3, device=device)
    found = wp.zeros(len(points), dtype=wp.vec4, device=device)
    _launch_slabs(kernels.distance_points, len(points), [tables, positions], [found], device)
    arms = found.numpy().astype(np.float64)
    del held
    length = np.linalg.norm(arms[:, :3], axis=1)
    direction = arms[:, :3] / np.where(length > 0.0, length, 1.0)[:, None]
    return arms[:, 3] * length, arms[:, 3:] * direction


def cache_folder() -> Path:
    """Folder in which grids are cached."""
    named = os.environ.get("WARP_RIGID_CACHE")
    if named:
        return Path(named)
    if sys.platform == "win32":
        base = os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local"
    elif sys.platform == "darwin":
        base = Path.home() / "Library" / "Caches"
    else:
        base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "warp_rigid"


def _read(file: Path, shape) -> np.ndarray | None:
    """The cached values in a file; None if the file cannot be read or is damaged."""
    try:
        values = archive.shaped(archive.Members(file), "values", np.float32, shape)
        if not np.isfinite(values).all():
            raise ValueError("values must be finite")
    except archive.UNREADABLE as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        log.warning("distance grid cache: %s is damaged (%s); the grid is computed again", file, reason)
        return None
    except OSError:
        return None
    return values


def _write(file: Path, values: np.ndarray) -> None:
    """Write the values atomically, so that readers never see an incomplete file."""
    with contextlib.suppress(OSError), atomic_file(file) as temporary, temporary.open("wb") as stream:
        np.savez(stream, values=values)


def _device():
    """The first CUDA device, or the CPU."""
    return wp.get_device("cuda:0" if wp.is_cuda_available() else "cpu")


def _mesh_tables(vertices, faces, simple: bool, device):
    """Mesh and pseudonormals on the device: the kernels' struct, and what must be kept alive."""
    edges = topology.find_edges(faces)
    normals, _ = topology.face_normals(vertices, faces)
    side_normal = topology.edge_normals(edges, normals)[edges.face_edge]

    def upload(values, dtype):
        kind = np.int32 if dtype is int else np.float32
        return wp.array(np.ascontiguousarray(values, dtype=kind), dtype=dtype, device=device)

    mesh = wp.Mesh(
        points=upload(vertices, wp.vec3),
        indices=upload(faces.ravel(), int),
        support_winding_number=not simple,
    )
    tables = kernels.MeshTables()
    tables.mesh = mesh.id
    tables.faces = upload(faces, int)
    tables.face_normal = upload(normals, wp.vec3)
    tables.side_normal = upload(side_normal, wp.vec3)
    tables.vertex_normal = upload(topology.vertex_normals(vertices, faces), wp.vec3)
    tables.by_winding = 0 if simple else 1
    return tables, mesh


def _launch_slabs(kernel, count: int, inputs, outputs, device) -> None:
    """Launch over `count` items; on the CPU in slabs on all cores.

    A CPU launch runs on one thread but releases the interpreter's lock, so slabs run side by side.
    """
    cores = usable_cores()
    slabs = 1 if device.is_cuda else min(count, 8 * cores)
    cuts = np.linspace(0, count, slabs + 1).astype(int)

    def launch(slab: int) -> None:
        first, last = int(cuts[slab]), int(cuts[slab + 1])
        arguments = [*inputs, first]
        wp.launch(kernel, dim=last - first, inputs=arguments, outputs=outputs, device=device)

    launch(0)  # loads the module before threads share it
    spread(launch, range(1, slabs), cores)
