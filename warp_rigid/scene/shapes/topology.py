"""Connectivity of triangle meshes: edges, components, boundaries; and their pseudonormals.

trimesh is imported only where a mesh is processed, so that importing the package stays quick. Its own component search
needs SciPy or NetworkX, and its normals and hole filling use absolute tolerances; these are written here instead.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

THIN = 1e-5
"""Height below which a triangle of a cap is too thin, as a fraction of the size of the mesh."""
TOUCHING = 1e-9
"""Overlap of two triangles that only touch, as a fraction of the size of the mesh: rounding errors."""
PARALLEL = 1e-9
"""Sine of the angle between two edges below which they have no common normal."""
SORTED_AT_ONCE = 2000
"""Triangles whose neighbours are looked for at the same time."""


@dataclass(frozen=True, eq=False)
class Edges:
    """Undirected edges of a triangle mesh.

    Attributes:
        ends: (e, 2) vertex indices, the smaller first.
        face_edge: (m, 3) edge of each face's sides (0-1, 1-2, 2-0).
        count: (e,) number of sides that use the edge.
        net: (e,) number of sides from the smaller index to the larger less that of opposite sides; 0 wherever the
            surface is closed.
    """

    ends: np.ndarray
    face_edge: np.ndarray
    count: np.ndarray
    net: np.ndarray

    @property
    def closed(self) -> bool:
        """Whether the surface has no boundary."""
        return not self.net.any()

    @property
    def manifold(self) -> bool:
        """Whether exactly two faces meet at each edge."""
        return bool((self.count == 2).all())


def find_edges(faces: np.ndarray) -> Edges:
    """Edges of (m, 3) triangles, sorted by their ends."""
    from trimesh.geometry import faces_to_edges

    sides = faces_to_edges(faces.astype(np.int64))
    ends = np.sort(sides, axis=1)
    keys = ends[:, 0] * (sides.max(initial=0) + 1) + ends[:, 1]
    _, first, edge, count = np.unique(keys, return_index=True, return_inverse=True, return_counts=True)
    forward = sides[:, 0] < sides[:, 1]
    return Edges(
        ends=ends[first],
        face_edge=edge.reshape(faces.shape),
        count=count,
        net=2 * np.bincount(edge[forward], minlength=len(count)) - count,
    )


def face_pairs(edges: Edges) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of faces at the edges that exactly two faces share: (p, 2) faces and (p,) edges."""
    from trimesh.grouping import group_rows

    sides = group_rows(edges.face_edge.ravel(), require_count=2)
    return np.sort(sides // 3, axis=1), edges.face_edge.ravel()[sides[:, 0]]


def components(pairs: np.ndarray, count: int) -> np.ndarray:
    """Smallest index in the connected component of each of `count` items linked by (p, 2) pairs."""
    label = np.arange(count)
    while True:
        ends = label[pairs]
        ends = ends[ends[:, 0] != ends[:, 1]]
        if not len(ends):
            return label
        # Whole trees are joined, at their roots, so that long chains take few rounds.
        np.minimum.at(label, ends, ends.min(axis=1, keepdims=True))
        while not np.array_equal(label, label[label]):
            label = label[label]


def face_components(edges: Edges) -> np.ndarray:
    """Component label of each face; faces that share an edge are in the same component."""
    count = len(edges.face_edge)
    face = np.repeat(np.arange(count), 3)
    return components(np.stack([face, count + edges.face_edge.ravel()], axis=1), count + len(edges.ends))[:count]


def is_convex(vertices: np.ndarray, faces: np.ndarray) -> bool:
    """Whether a closed manifold mesh is convex, to 1e-6 of its size.

    A closed connected surface that is convex at each of its edges is convex (H. Tietze 1928, S. Nakajima 1928).
    """
    edges = find_edges(faces)
    pairs, _ = face_pairs(edges)
    if face_components(edges).any():
        return False
    normals, _ = face_normals(vertices, faces)
    across = vertices[faces].mean(axis=1)[pairs[:, 1]] - vertices[faces[pairs[:, 0], 0]]
    height = np.einsum("ij,ij->i", across, normals[pairs[:, 0]])
    return bool(height.max() < 1e-6 * np.ptp(vertices, axis=0).max())


def close_boundaries(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Close a mesh by a fan of triangles over each boundary loop, from the loop's mean point.

    Returns:
        The vertices (n + k, 3), with the mean points of the k loops after the given ones, and the faces (m + f, 3).
    """
    edges = find_edges(faces)
    open_edges = np.flatnonzero(edges.net)
    if not len(open_edges):
        return vertices, faces
    # A fan side runs against the boundary, once for each side without a counterpart.
    net = edges.net[open_edges]
    sides = np.where(net[:, None] > 0, edges.ends[open_edges, ::-1], edges.ends[open_edges])
    sides = np.repeat(sides, np.abs(net), axis=0)
    used, local = np.unique(sides, return_inverse=True)
    local = local.reshape(sides.shape)
    _, loop, size = np.unique(components(local, len(used)), return_inverse=True, return_counts=True)
    apexes = np.stack([np.bincount(loop, vertices[used, axis]) / size for axis in range(3)], axis=1)
    fans = np.column_stack([sides, len(vertices) + loop[local[:, 0]]])
    return np.concatenate([vertices, apexes]), np.concatenate([faces, fans])


def crosses_itself(vertices: np.ndarray, faces: np.ndarray, given: int) -> bool:
    """Whether triangles of a closed surface cross or overlap each other, or caps of holes are too thin for a normal.

    Of the first `given` faces, which are no caps, pairs with a common vertex are not tested.
    """
    corners = vertices[faces]
    size = np.ptp(vertices, axis=0).max()
    sides = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    if (2.0 * face_normals(vertices, faces)[1][given:] < THIN * size * sides[given:]).any():
        return True
    for first, second in _near_pairs(corners):
        shared = (faces[first][:, :, None] == faces[second][:, None]).any(axis=(1, 2))
        tested = ~shared | (np.maximum(first, second) >= given)
        if not _are_apart(corners[first[tested]], corners[second[tested]], TOUCHING * size).all():
            return True
    return False


def _near_pairs(corners: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Pairs of triangles whose boxes meet, some at a time: they are sorted along the first axis."""
    lower, upper = corners.min(axis=1), corners.max(axis=1)
    order = np.argsort(lower[:, 0])
    end = np.searchsorted(lower[order, 0], upper[order, 0], side="right")
    for start in range(0, len(order), SORTED_AT_ONCE):
        own = np.arange(start, min(start + SORTED_AT_ONCE, len(order)))
        count = end[own] - own - 1
        first = np.repeat(own, count)
        second = first + 1 + np.arange(len(first)) - np.repeat(np.cumsum(count) - count, count)
        first, second = order[first], order[second]
        near = ((lower[first] <= upper[second]) & (lower[second] <= upper[first])).all(axis=1)
        yield first[near], second[near]


def _are_apart(first: np.ndarray, second: np.ndarray, touch: float) -> np.ndarray:
    """Whether pairs of triangles (n, 3, 3) overlap by no more than `touch` along one of their separating axes [m].

    These are both normals, the products of their edges, and the normals of the edges in each plane.
    """
    edges = [triangle - np.roll(triangle, 1, axis=1) for triangle in (first, second)]
    normals = [np.cross(edge[:, 0], edge[:, 1])[:, None] for edge in edges]
    products = np.cross(edges[0][:, :, None], edges[1][:, None]).reshape(len(first), 9, 3)
    axes = np.concatenate([*normals, products, *(np.cross(edges[k], normals[k]) for k in range(2))], axis=1)
    length = np.linalg.norm(axes, axis=2)
    longest = np.maximum(*(np.linalg.norm(edge, axis=2).max(axis=1) for edge in edges))
    usable = length > PARALLEL * longest[:, None] ** np.array([2] * 11 + [3] * 6)
    axes = axes / np.where(usable, length, 1.0)[:, :, None]
    spans = [np.einsum("nai,nci->nac", axes, triangle) for triangle in (first, second)]
    (low, high), (other_low, other_high) = ((span.min(axis=2), span.max(axis=2)) for span in spans)
    # Along their common normal, triangles in one plane have no extent.
    usable &= np.maximum(high - low, other_high - other_low) > touch
    return (usable & (np.minimum(high - other_low, other_high - low) <= touch)).any(axis=1)


def face_normals(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit normals (m, 3) (zero for a face without area) and areas (m,)."""
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    cross = np.cross(b - a, c - a)
    double_area = np.linalg.norm(cross, axis=1)
    return cross / np.where(double_area > 0.0, double_area, 1.0)[:, None], 0.5 * double_area


def vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Angle-weighted unit normals (n, 3); zero where none is defined.

    With these, the sign of a distance is right at every vertex: J. A. Baerentzen and H. Aanaes,
    "Signed distance computation using the angle weighted pseudonormal", IEEE TVCG 11(3), 2005.
    """
    normals, _ = face_normals(vertices, faces)
    total = np.zeros_like(vertices)
    for corner in range(3):
        here = vertices[faces[:, corner]]
        to_next = vertices[faces[:, (corner + 1) % 3]] - here
        to_last = vertices[faces[:, (corner + 2) % 3]] - here
        sine = np.linalg.norm(np.cross(to_next, to_last), axis=1)
        angle = np.arctan2(sine, np.einsum("ij,ij->i", to_next, to_last))
        for axis in range(3):
            total[:, axis] += np.bincount(faces[:, corner], angle * normals[:, axis], minlength=len(vertices))
    return _unit_or_zero(total)


def edge_normals(edges: Edges, normals: np.ndarray) -> np.ndarray:
    """Unit mean of the normals of the faces at each edge, (e, 3); zero where they cancel."""
    side = edges.face_edge.ravel()
    return _unit_or_zero(np.stack([np.bincount(side, np.repeat(normals[:, axis], 3)) for axis in range(3)], axis=1))


def _unit_or_zero(vectors: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return vectors / np.where(length > 1e-12, length, np.inf)
