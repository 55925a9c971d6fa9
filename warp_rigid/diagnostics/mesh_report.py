"""Report on the collision representation of a mesh: solid, surface samples and signed distance grid."""

import time
from typing import Any

import numpy as np

from warp_rigid.files.atomic import atomic_file
from warp_rigid.scene.shapes import Mesh
from warp_rigid.scene.shapes.distance_grid import interpolate
from warp_rigid.scene.shapes.mesh import CELLS_OF_A_WALL
from warp_rigid.scene.shapes.sampling import SampleKind

PROBES = 4096
"""Number of random points that compare the grid with the exact distance."""
SLICE_POINTS = 240
"""Number of points along the longer side of a slice."""
ARROWS = 24


def inspect_mesh(mesh: Mesh) -> dict[str, Any]:
    """Report on a mesh as plain data in SI units.

    The distance error compares the grid with the exact signed distance at random points within two cells of the
    surface, where contacts occur. A wrong sign counts if the exact distance exceeds half a cell.
    """
    start = time.perf_counter()
    grid = mesh.grid
    seconds = time.perf_counter() - start
    lower, upper = np.asarray(mesh.bounds)
    kind = mesh.samples().kind
    approximate, exact = _distances_near_surface(mesh)
    error = np.abs(approximate - exact)
    clear = np.abs(exact) > 0.5 * grid.spacing
    return {
        "vertices": len(mesh.vertices),
        "triangles": len(mesh.faces),
        "watertight": bool(mesh.watertight),
        "repairs": list(mesh.repairs),
        "fault": mesh.fault,
        "thinnest_wall": CELLS_OF_A_WALL * grid.spacing if mesh.fault else 0.0,
        "lower": [float(x) for x in lower],
        "upper": [float(x) for x in upper],
        "volume": float(mesh.volume),
        "center_of_mass": [float(x) for x in mesh.center_of_mass],
        "principal_inertia": [float(x) for x in np.linalg.eigvalsh(mesh.inertia)],
        "samples": {k.name.lower(): int((kind == k).sum()) for k in SampleKind if k != SampleKind.CORNER},
        "grid": list(grid.values.shape),
        "cell": float(grid.spacing),
        "grid_seconds": seconds,
        "distance_error_mean": float(error.mean()),
        "distance_error_largest": float(error.max()),
        "wrong_signs": int((clear & (np.sign(approximate) != np.sign(exact))).sum()),
    }


def parse_slice(text: str) -> tuple[int, float]:
    """Parse a plane such as "z=0.05" to the axis index and the coordinate [m].

    Raises:
        ValueError: The text has another form.
    """
    axis, equals, coordinate = text.partition("=")
    try:
        if not equals or axis.strip() not in "xyz" or len(axis.strip()) != 1:
            raise ValueError
        return "xyz".index(axis.strip()), float(coordinate)
    except ValueError:
        raise ValueError(f"--slice: must be x=, y= or z= and a number, got {text!r}") from None


def save_slice(mesh: Mesh, path, axis: int, coordinate: float) -> None:
    """Plot the signed distance in a plane, with its zero contour and its gradient.

    Args:
        mesh: the mesh.
        path: output file, .png; missing folders are created.
        axis: 0, 1 or 2: the axis normal to the plane.
        coordinate: coordinate of the plane on that axis [m].

    Raises:
        ValueError: The plane is outside the grid.
        ModuleNotFoundError: Matplotlib is not installed.
    """
    from matplotlib.figure import Figure

    lower = np.asarray(mesh.grid.origin)
    upper = lower + mesh.grid.spacing * (np.array(mesh.grid.values.shape) - 1)
    if not lower[axis] <= coordinate <= upper[axis]:
        raise ValueError(
            f"--slice: {'xyz'[axis]} must be from {lower[axis]:.4g} to {upper[axis]:.4g}, got {coordinate:g}"
        )
    across, up = [k for k in range(3) if k != axis]
    figure = Figure(figsize=(8.0, 6.4), dpi=110, layout="constrained")
    axes = figure.add_subplot(
        aspect="equal",
        xlabel=f"{'xyz'[across]} [m]",
        ylabel=f"{'xyz'[up]} [m]",
        title=f"signed distance at {'xyz'[axis]} = {coordinate:g} m",
    )

    def plane(points):
        """Coordinates, distances and gradients on a regular grid of the plane."""
        step = max(upper[across] - lower[across], upper[up] - lower[up]) / points
        u = np.arange(lower[across] + step / 2.0, upper[across], step)
        v = np.arange(lower[up] + step / 2.0, upper[up], step)
        where = np.full((len(v), len(u), 3), coordinate)
        where[..., across], where[..., up] = u[None, :], v[:, None]
        distance, gradient = mesh.signed_distance(where.reshape(-1, 3))
        return u, v, distance.reshape(len(v), len(u)), gradient.reshape(len(v), len(u), 3)

    u, v, distance, _ = plane(SLICE_POINTS)
    most = np.abs(distance).max()
    colors = axes.pcolormesh(u, v, distance, cmap="RdBu", vmin=-most, vmax=most, shading="nearest")
    axes.contour(u, v, distance, levels=12, colors="#40404080", linewidths=0.5)
    axes.contour(u, v, distance, levels=[0.0], colors="black", linewidths=2.0)
    u, v, _, gradient = plane(ARROWS)
    axes.quiver(u, v, gradient[..., across], gradient[..., up], color="#303030", width=0.0022)
    figure.colorbar(colors, ax=axes, shrink=0.8, label="signed distance [m], negative inside")
    with atomic_file(path) as temporary:
        figure.savefig(temporary, format="png")


def _distances_near_surface(mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """Signed distances at random points near the surface, from the grid and exact."""
    rng = np.random.default_rng(0)
    corners = mesh.vertices[mesh.faces[rng.integers(len(mesh.faces), size=PROBES)]]
    weights = rng.dirichlet((1.0, 1.0, 1.0), size=PROBES)
    reach = 2.0 * mesh.grid.spacing / np.sqrt(3.0)
    points = np.einsum("ni,nij->nj", weights, corners) + rng.uniform(-reach, reach, (PROBES, 3))
    return interpolate(mesh.grid, points)[0], mesh.signed_distance(points)[0]
