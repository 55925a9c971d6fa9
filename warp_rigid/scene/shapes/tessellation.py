"""Triangles for drawing: closed, outward-facing surfaces of the simple solids."""

from itertools import combinations

import numpy as np


def box(half_extents) -> tuple[np.ndarray, np.ndarray]:
    """Cuboid of 8 vertices and 12 triangles; vertex 4 i + 2 j + k has the signs of (i, j, k)."""
    signs = 2.0 * np.array(list(np.ndindex(2, 2, 2))) - 1.0
    quads = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
    return signs * np.asarray(half_extents, dtype=np.float64), triangulate_quads(quads)


def triangulate_quads(quads: np.ndarray) -> np.ndarray:
    """(n, 4) corners in order -> (2 n, 3) triangles."""
    return quads[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3).astype(np.int32)


def icosahedron() -> tuple[np.ndarray, np.ndarray]:
    """Regular icosahedron inscribed in the unit sphere."""
    golden = (1.0 + 5.0**0.5) / 2.0
    rectangle = [[s, t * golden, 0.0] for s in (-1, 1) for t in (-1, 1)]
    vertices = np.array([np.roll(corner, shift) for shift in range(3) for corner in rectangle])
    return vertices / np.linalg.norm(vertices[0]), hull_triangles(vertices)


def hull_triangles(vertices: np.ndarray) -> np.ndarray:
    """Outward triangles of a convex polyhedron with triangular faces, from its shortest edges."""
    gaps = np.linalg.norm(vertices[:, None] - vertices[None], axis=-1)
    shortest = gaps[gaps > 1e-9].min()
    near = (gaps > 1e-9) & (gaps < 1.001 * shortest)
    corners = combinations(range(len(vertices)), 3)
    triangles = [(i, j, k) for i, j, k in corners if near[i, j] and near[j, k] and near[i, k]]
    faces = np.array(triangles, dtype=np.int32)
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    inward = np.einsum("ij,ij->i", np.cross(b - a, c - a), a + b + c) < 0.0
    faces[inward] = faces[inward][:, ::-1]
    return faces


def dodecahedron() -> tuple[np.ndarray, np.ndarray]:
    """Regular dodecahedron, the dual of the icosahedron: each pentagon a fan of three triangles."""
    centers, triangles = icosahedron()
    corners = centers[triangles].mean(axis=1)
    faces = []
    for index, center in enumerate(centers):
        around = np.flatnonzero((triangles == index).any(axis=1))
        first = corners[around[0]] - (corners[around[0]] @ center) * center
        second = np.cross(center, first)
        order = np.argsort(np.arctan2(corners[around] @ second, corners[around] @ first))
        pentagon = around[order]
        faces += [[pentagon[0], pentagon[k], pentagon[k + 1]] for k in range(1, 4)]
    return corners, np.array(faces, dtype=np.int32)


def geodesic(frequency: int) -> tuple[np.ndarray, np.ndarray]:
    """Unit sphere of 20 frequency^2 nearly equal triangles, vertices on the sphere."""
    corners, faces = icosahedron()
    i, j = np.meshgrid(np.arange(frequency + 1), np.arange(frequency + 1), indexing="ij")
    inside = i + j <= frequency
    place = np.full(i.shape, -1)
    place[inside] = np.arange(inside.sum())
    weight = np.stack([frequency - i - j, i, j], axis=-1)[inside] / frequency
    points = np.einsum("wk,fkx->fwx", weight, corners[faces])
    low_i, low_j = np.nonzero(i + j < frequency)
    upward = np.stack([place[low_i, low_j], place[low_i + 1, low_j], place[low_i, low_j + 1]], 1)
    two = low_i + low_j < frequency - 1
    low_i, low_j = low_i[two], low_j[two]
    downward = np.stack([place[low_i + 1, low_j], place[low_i + 1, low_j + 1], place[low_i, low_j + 1]], 1)
    pattern = np.concatenate([upward, downward])
    triangles = pattern[None] + len(weight) * np.arange(len(faces))[:, None, None]
    points = points.reshape(-1, 3)
    _, first, merged = np.unique(np.round(points * 1e9), axis=0, return_index=True, return_inverse=True)
    vertices = points[first]
    vertices /= np.linalg.norm(vertices, axis=1, keepdims=True)
    return vertices, merged.reshape(-1)[triangles.reshape(-1, 3)].astype(np.int32)


def revolve(radii, heights, sections: int) -> tuple[np.ndarray, np.ndarray]:
    """Closed surface of revolution about z.

    Args:
        radii: profile radii between the two poles, from the lowest up [m].
        heights: profile heights, the two poles' included [m].
        sections: segments around the axis.
    """
    angles = 2.0 * np.pi * np.arange(sections) / sections
    circle = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    rings = [
        np.column_stack([radius * circle, np.full(sections, height)])
        for radius, height in zip(radii, heights[1:-1], strict=True)
    ]
    poles = np.array([[0.0, 0.0, heights[0]], [0.0, 0.0, heights[-1]]])
    return np.concatenate([*rings, poles]), np.concatenate(capped_tube(len(rings), sections)).astype(np.int32)


def capped_tube(rings: int, sections: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Triangles of a tube from the lowest ring up: the fan below it, its sides, and the fan above it.

    Args:
        rings: number of rings of vertices, which two more vertices follow, the middles of the fans.
        sections: vertices of a ring.
    """
    around = np.arange(sections)
    after = (around + 1) % sections
    low = sections * np.arange(rings - 1)[:, None]
    high, last, south = low + sections, sections * (rings - 1), sections * rings
    quads = np.stack([low + around, low + after, high + after, high + around], axis=-1).reshape(-1, 4)
    below = np.stack([np.full(sections, south), after, around], axis=1)
    above = np.stack([np.full(sections, south + 1), last + around, last + after], axis=1)
    return below, triangulate_quads(quads), above


def wheel(section: np.ndarray, sections: int) -> tuple[np.ndarray, np.ndarray]:
    """Closed surface that a closed polygon sweeps about z without touching the axis.

    Args:
        section: (n, 2) corners (distance from the axis, height) [m], counter-clockwise.
        sections: segments around the axis.
    """
    count = len(section)
    angle = 2.0 * np.pi * np.arange(sections) / sections
    radius, height = section.T
    vertices = np.stack(
        [np.outer(np.cos(angle), radius), np.outer(np.sin(angle), radius), np.broadcast_to(height, (sections, count))],
        axis=-1,
    )
    return vertices.reshape(-1, 3), ring_of_rings(sections, count)


def ring_of_rings(sections: int, corners: int) -> np.ndarray:
    """Outward triangles of a torus of vertices: a number of corners in each of some sections."""
    section, corner = (index.reshape(-1) for index in np.indices((sections, corners)))
    next_section, next_corner = (section + 1) % sections, (corner + 1) % corners
    places = [(section, corner), (next_section, corner), (next_section, next_corner), (section, next_corner)]
    return triangulate_quads(np.stack([at_turn * corners + at_corner for at_turn, at_corner in places], axis=1))


def lattice(rows: int, columns: int) -> np.ndarray:
    """Triangles of a (rows, columns) grid of vertices in C order; +z if x grows with the row."""
    row, column = np.meshgrid(np.arange(rows - 1), np.arange(columns - 1), indexing="ij")
    corner = (row * columns + column).reshape(-1)
    return triangulate_quads(np.stack([corner, corner + columns, corner + columns + 1, corner + 1], axis=1))
