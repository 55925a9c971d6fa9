"""Section A: mass properties of solids, and signed distances of meshes."""

import numpy as np
import trimesh
import warp as wp
from trimesh.sample import sample_surface

from warp_rigid.engine.layout import layout_of
from warp_rigid.engine.model import build_model
from warp_rigid.kernels.collide.probe import probe_distances
from warp_rigid.scene.scene import Scene
from warp_rigid.scene.shapes import Box, SampleKind, distance_grid, tessellation
from warp_rigid.scene.shapes.base import Grid, frozen_array
from warp_rigid.scene.shapes.mesh import Mesh
from warp_rigid.scenes.builders import meshes
from warp_rigid.validation import solids
from warp_rigid.validation.case import AT_LEAST, Cases, Check, absolute, at_most, case, relative

BAND = 3.0
"""Half the width of the band around a surface where distances are compared [cells]."""
FINE = 64
"""Cells of the longest side of the ball whose normals are compared."""


def cases(quick: bool) -> Cases:
    """All cases of the section; coarser if quick."""
    cells = (32, 64) if quick else (32, 64, 128)
    return [
        polyhedra(),
        torus(),
        sphere_distance(cells, 20_000 if quick else 100_000, 48 if quick else 96),
        box_distance(cells, 20_000 if quick else 100_000),
        eikonal(20_000 if quick else 100_000),
        signs(5_000 if quick else 20_000),
        coverage(800 if quick else 20_000),
    ]


def box_moments(sides, mass=1.0) -> np.ndarray:
    """Inertia tensor of a box about its centre."""
    square = np.square(np.asarray(sides, np.float64))
    return np.diag(mass * (square.sum() - square) / 12.0)


def two_boxes(first, second) -> tuple[float, np.ndarray, np.ndarray]:
    """Volume, centre and inertia of two disjoint boxes, each given by two corners, by Steiner's rule."""
    corners = np.array([first, second], np.float64)
    sides, middles = corners[:, 1] - corners[:, 0], corners.mean(axis=1)
    volumes = sides.prod(axis=1)
    center = np.average(middles, axis=0, weights=volumes)
    inertia = np.zeros((3, 3))
    for side, middle, volume in zip(sides, middles, volumes, strict=True):
        arm = middle - center
        inertia += box_moments(side, volume) + volume * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    return volumes.sum(), center, inertia


def exact_solids() -> dict[str, tuple[tuple, float, np.ndarray, np.ndarray]]:
    """Vertices and faces, volume, centre of mass and inertia at unit density of solids with closed forms."""
    corner = np.full((3, 3), 1 / 480) + np.diag([1 / 80 - 1 / 480] * 3)
    high = np.array([[1, 1, 1], [-1, 1, -1], [1, -1, -1], [-1, -1, 1]]) / 8**0.5
    regular = 1 / (6 * 2**0.5)
    hollow = box_moments((1, 1, 1)) - box_moments((0.8,) * 3, 0.8**3)
    vertices, faces = solids.cube()
    shift = np.array([0.5, 1.0, 1.5])
    return {
        "corner tetrahedron": (solids.tetrahedron([(0, 0, 0), *np.eye(3)]), 1 / 6, np.full(3, 0.25), corner),
        "regular tetrahedron": (solids.tetrahedron(high), regular, np.zeros(3), regular / 20 * np.eye(3)),
        "box 1 x 2 x 3": ((vertices * [1, 2, 3] + shift, faces), 6.0, shift, box_moments((1, 2, 3), 6.0)),
        "hollow cube": (solids.hollow_cube(), 1 - 0.8**3, np.zeros(3), hollow),
        "L prism": (solids.l_prism(), *two_boxes([(0, 0, 0), (3, 1, 1)], [(0, 1, 0), (1, 3, 1)])),
    }


def polyhedra():
    """Solids whose integrals are known."""
    table = exact_solids()
    names = tuple(table)

    def center_error(shapes):
        return [np.abs(mesh.center_of_mass - table[name][2]).max() for mesh, name in zip(shapes, names, strict=True)]

    def inertia_error(shapes):
        exact = [table[name][3] for name in names]
        return [np.abs(mesh.inertia - e).max() / np.abs(e).max() for mesh, e in zip(shapes, exact, strict=True)]

    return case(
        "V01 mass properties of polyhedra",
        "closed forms and Steiner's rule; Mirtich 1996",
        Check("volume", "m^3", lambda s: [m.volume for m in s], relative(1e-6), [table[n][1] for n in names]),
        Check("error of the centre of mass", "m", center_error, at_most(1e-6)),
        Check("inertia error relative to the largest entry", "", inertia_error, at_most(1e-6)),
        compute=lambda _: [Mesh(*table[name][0]) for name in names],
        labels=names,
        on_device=False,
    )


def torus_of_triangles(major, minor, around, across) -> tuple[float, float, float]:
    """Volume, Ix and Iz of a torus whose section is a regular polygon and whose rings are polygons.

    Each sector between two sections is cut by lines parallel to their chord, and its moments are those of the
    isosceles triangles that a strip of the section sweeps.
    """
    section = 0.5 * across * minor**2 * np.sin(2 * np.pi / across)
    spread = minor**2 * (2 + np.cos(2 * np.pi / across)) / 12  # mean square distance from the section's axes
    step = 2 * np.pi / around
    sine, cosine = np.sin(0.5 * step), np.cos(0.5 * step)
    volume = around * np.sin(step) * section * major
    axial = 2 * around * sine * cosine * (cosine**2 + sine**2 / 3) * section * (major**3 + 3 * major * spread)
    return volume, 0.5 * axial + volume * spread, axial


def torus():
    """A mesh has the values of its polyhedron, which converge to those of the smooth solid at second order."""
    major, minor = 1.0, 0.3
    volume = 2 * np.pi**2 * major * minor**2
    smooth = np.array([volume, volume * (4 * major**2 + 5 * minor**2) / 8, volume * (major**2 + 0.75 * minor**2)])
    fine = (32, 64, 128)

    def values(shape):
        return np.array([shape.volume, shape.inertia[0, 0], shape.inertia[2, 2]])

    def order(shapes):
        errors = np.array([np.abs(values(shape) - smooth) for shape in shapes])
        return np.log2(errors[:-1] / errors[1:]).ravel()

    names = "volume", "Ix", "Iz"
    exact = torus_of_triangles(major, minor, 64, 32)
    steps = tuple(f"{name}, {a} to {b} segments" for a, b in zip(fine[:-1], fine[1:], strict=True) for name in names)
    return case(
        "V02 mass properties of a torus of triangles, R 1, r 0.3",
        "closed forms of the polyhedron and of the torus",
        Check("64 x 32 mesh", "m^3 or m^5", lambda s: values(s[1]), relative(1e-6), exact, labels=names),
        Check("order of convergence", "", order, absolute(0.05), 2.0, labels=steps),
        compute=lambda _: [meshes.torus(major, minor, segments=segments) for segments in fine],
        on_device=False,
    )


def grid_on(device, mesh: Mesh, cells: int) -> Grid:
    """A mesh's distance grid, computed on a device without the cache."""
    origin, spacing, shape = distance_grid.grid_layout(mesh.vertices, cells)
    values = distance_grid.bake(mesh.vertices, mesh.faces, origin, spacing, shape, True, wp.get_device(device))
    return Grid(tuple(origin.tolist()), spacing, frozen_array(values, np.float32))


def distances_of_contacts(device, mesh: Mesh, points) -> tuple[np.ndarray, np.ndarray]:
    """Distances (n,) and directions (n, 3) of points to a mesh in the narrow phase, for contacts within a cell."""
    scene = Scene()
    scene.add_static(mesh)
    model = build_model(layout_of(scene, 1), wp.get_device(device))
    at = wp.array(np.asarray(points, np.float32), dtype=wp.vec3, device=device)
    found = wp.zeros(len(points), dtype=wp.vec4, device=device)
    inputs = [0, mesh.grid.spacing, model.shapes, at]
    wp.launch(probe_distances, len(points), inputs=inputs, outputs=[found], device=device)
    values = found.numpy().astype(np.float64)
    return values[:, 3], values[:, :3]


def points_near(distance, half, width, count) -> np.ndarray:
    """Random points within `width` of a surface inside a box with the given half extents, (count, 3)."""
    draw = np.random.default_rng(4)
    found = np.zeros((0, 3))
    while len(found) < count:
        points = draw.uniform(-1, 1, (4 * count, 3)) * (np.asarray(half) + width)
        found = np.concatenate([found, points[np.abs(distance(points)) < width]])
    return found[:count]


def sphere_distance(cells, count, frequency):
    """Distances and normals of a triangulated ball, compared with those of the sphere."""
    radius = 0.5

    def distance(points):
        return np.linalg.norm(points, axis=1) - radius

    def largest_turn(mesh, points, device):
        """Largest angle between a direction of contacts and the radius [degrees]."""
        _, normal = distances_of_contacts(device, mesh, points)
        radial = points / np.linalg.norm(points, axis=1, keepdims=True)
        return np.degrees(np.arcsin(np.clip(np.linalg.norm(np.cross(normal, radial), axis=1), 0, 1))).max()

    def compute(device):
        corners, faces = tessellation.geodesic(frequency)
        ball = Mesh(radius * corners, faces)
        rows = []
        for n in cells:
            grid = grid_on(device, ball, n)
            points = points_near(distance, 3 * [radius], BAND * grid.spacing, count)
            value, _ = distance_grid.interpolate(grid, points)
            near = points[np.abs(distance(points)) < grid.spacing]
            angle = largest_turn(Mesh(ball.vertices, faces, sdf_resolution=n), near, device) if n == FINE else np.nan
            sag = radius - np.linalg.norm(ball.vertices[ball.faces].mean(axis=1), axis=1).min()
            bound = grid.spacing**2 / (4 * (radius - BAND * grid.spacing)) + sag
            rows.append((np.abs(value - distance(points)).max(), bound, angle))
        return np.array(rows)

    def turn(rows):
        return rows[[fine], 2]

    names, fine = [f"{n} cells" for n in cells], cells.index(FINE)
    return case(
        "V05 distance grid of a sphere, R 0.5",
        "bound of trilinear interpolation, h^2 / (4 r), and the mesh's sag",
        Check("largest error within 3 cells", "m", lambda s: s[:, 0], at_most(0.0), lambda s: s[:, 1]),
        Check("largest error of the normals of contacts, h = R / 32", "deg", turn, at_most(1.0), labels=[names[fine]]),
        compute=compute,
        labels=names,
    )


def box_distance(cells, count):
    """Distances of a box: exact over its faces, first order at its edges."""
    box = Box((0.5, 0.3, 0.2))

    def compute(device):
        vertices, faces = solids.cube()
        mesh = Mesh(2 * vertices * box.half_extents, faces)
        rows = []
        for n in cells:
            grid = grid_on(device, mesh, n)
            points = points_near(lambda at: box.signed_distance(at)[0], box.half_extents, BAND * grid.spacing, count)
            exact, _ = box.signed_distance(points)
            error = np.abs(distance_grid.interpolate(grid, points)[0] - exact)
            over = np.sort(np.abs(points) - box.half_extents, axis=1)
            flat = (over[:, 2] - over[:, 1] > 2 * grid.spacing) & (over[:, 1] < -2 * grid.spacing)
            center = distance_grid.interpolate(grid, np.zeros((1, 3)))[0][0] / grid.spacing
            edge = [error[side].max() / grid.spacing for side in (exact > 0, exact < 0)]
            rows.append((error[flat].max(), *edge, center + 0.2 / grid.spacing))
        return np.array(rows)

    names = tuple(f"{n} cells" for n in cells)
    return case(
        "V05 distance grid of a box, half extents 0.5, 0.3, 0.2",
        "closed form; first order at edges",
        Check("largest error where one face is nearest", "m", lambda s: s[:, 0], at_most(2e-6)),
        Check("largest error outside", "cells", lambda s: s[:, 1], at_most(0.3)),
        Check("largest error inside", "cells", lambda s: s[:, 2], at_most(0.4)),
        Check("error of the depth at the centre (V06)", "cells", lambda s: s[:, 3], absolute(1.0)),
        compute=compute,
        labels=names,
    )


def eikonal(count):
    """The gradient has unit length: that of grids away from creases, and that of contacts everywhere.

    A cell that contains a crease of the distance has the mean gradient of both sides, which is shorter. Within a cell
    of the surface contacts take the distance from the triangles.
    """
    smooth = {
        "cube": lambda: Mesh(*solids.cube()),
        "torus": lambda: meshes.torus(segments=128),
        "L prism, 96 cells": lambda: Mesh(*solids.l_prism(), sdf_resolution=96),
    }
    creased = {
        "star": lambda: Mesh(*solids.star_prism()),
        "wedge": lambda: Mesh(*solids.wedge()),
        "spike": lambda: Mesh(*solids.spike()),
    }
    both = smooth | creased

    def shares(mesh, device):
        grid = grid_on(device, mesh, mesh.sdf_resolution)
        upper = np.array(grid.origin) + grid.spacing * (np.array(grid.values.shape) - 1)
        points = np.random.default_rng(6).uniform(grid.origin, upper, (5 * count, 3))
        distance, gradient = distance_grid.interpolate(grid, points)
        length = np.linalg.norm(gradient[np.abs(distance) < BAND * grid.spacing], axis=1)
        return near_one(length), near_one(slope_of_contacts(mesh, points[np.abs(distance) < grid.spacing], device))

    def slope_of_contacts(mesh, points, device):
        way = 0.01 * mesh.grid.spacing
        _, direction = distances_of_contacts(device, mesh, points)
        ahead, behind = (distances_of_contacts(device, mesh, points + k * way * direction)[0] for k in (1, -1))
        return (ahead - behind) / (2.0 * way)

    def near_one(length):
        return (np.abs(length - 1) < 0.05).mean()

    def check(quantity, names, which):
        return Check(quantity, "", lambda s: [s[name][which] for name in names], AT_LEAST, 0.95, labels=tuple(names))

    return case(
        "V06 gradient of distances to meshes",
        "eikonal equation",
        check("share of gradients of grids of length 1 +- 0.05 within 3 cells", smooth, 0),
        check("share of slopes of contacts of 1 +- 0.05 within a cell", both, 1),
        compute=lambda device: {name: shares(make(), device) for name, make in both.items()},
    )


def signs(count):
    """Sign of the distance of points in a box twice as large as the mesh, against the winding number in float64."""
    sharp = {
        "spike": solids.spike(),
        "wedge": solids.wedge(),
        "corner tetrahedron": solids.tetrahedron([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)]),
        "needle": solids.tetrahedron([(0, 0, 0), (0.1, 0, 0), (0, 0.1, 0), (0.03, 0.03, 2)]),
        "star": solids.star_prism(),
        "L prism": solids.l_prism(),
        "hollow cube": solids.hollow_cube(),
    }

    def wrong(vertices, faces, simple, device):
        lower, upper = vertices.min(axis=0), vertices.max(axis=0)
        draw = np.random.default_rng(3)
        points = 0.5 * (lower + upper) + draw.uniform(-1, 1, (count, 3)) * (upper - lower)
        distance, _ = distance_grid.mesh_distance(vertices, faces, points, simple, wp.get_device(device))
        inside = solids.winding(points, vertices[faces]) > 0.5
        return int(((distance < 0) != inside)[np.abs(distance) > 1e-6].sum())

    rules = tuple(f"{name}, {rule}" for name in sharp for rule in ("pseudonormals", "winding number"))
    return case(
        f"V07 sign at sharp features, {count} points around each mesh",
        "winding number in float64; Baerentzen and Aanaes 2005",
        Check("points with the wrong sign", "", np.asarray, absolute(0.0)),
        compute=lambda device: [wrong(*sharp[name], simple, device) for name in sharp for simple in (True, False)],
        labels=rules,
    )


def coverage(count):
    """No point of a surface is farther from a sample than the stated spacing."""
    made = {
        "cube": lambda: Mesh(*solids.cube()),
        "L prism": lambda: Mesh(*solids.l_prism()),
        "star": lambda: Mesh(*solids.star_prism()),
        "torus": lambda: meshes.torus(),
        "bunny": lambda: meshes.bunny(),
    }

    def farthest(mesh):
        points, _ = sample_surface(trimesh.Trimesh(mesh.vertices, mesh.faces, process=False), count, seed=5)
        return max(to_samples(mesh.samples(), part).max() for part in np.array_split(points, 40)) / mesh.sample_spacing

    def to_samples(samples, points):
        slide = np.where((samples.kind == SampleKind.EDGE)[:, None], samples.slide, 0.0).astype(np.float64)
        arm = points[:, None] - samples.point.astype(np.float64)
        length = np.maximum(np.einsum("si,si->s", slide, slide), 1e-30)
        along = np.clip(np.einsum("psi,si->ps", arm, slide) / length, -1, 1)
        return np.linalg.norm(arm - along[:, :, None] * slide, axis=2).min(axis=1)

    return case(
        "V09 samples of mesh surfaces",
        "the stated spacing, a sixteenth of the longest side",
        Check(
            "largest distance of a surface point from a sample, over the spacing", "", np.asarray, at_most(1e-6), 1.0
        ),
        compute=lambda _: [farthest(make()) for make in made.values()],
        labels=tuple(made),
        on_device=False,
    )
