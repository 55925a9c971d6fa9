"""How the triangles of a mesh hang together: edges, components, boundaries, normals."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class Edges:
    """Undirected edges of a triangle mesh.

    Attributes:
        ends: (e, 2) vertex indices, the smaller first.
        face_edge: (m, 3) edge of each face's sides (0-1, 1-2, 2-0).
        forward: (m, 3) bool, whether the side runs from the smaller index to the larger.
        count: (e,) how many sides use the edge.
        net: (e,) forward sides less backward ones; 0 wherever the surface is closed.
    """

    ends: np.ndarray
    face_edge: np.ndarray
    forward: np.ndarray
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
    start = faces.astype(np.int64)
    end = np.roll(start, -1, axis=1)
    low, high = np.minimum(start, end), np.maximum(start, end)
    stride = int(high.max()) + 1 if high.size else 1
    keys, face_edge = np.unique(low * stride + high, return_inverse=True)
    face_edge = face_edge.reshape(faces.shape)
    forward = start < end
    count = np.bincount(face_edge.ravel(), minlength=len(keys))
    ahead = np.bincount(face_edge[forward], minlength=len(keys))
    return Edges(
        ends=np.stack([keys // stride, keys % stride], axis=1),
        face_edge=face_edge,
        forward=forward,
        count=count,
        net=2 * ahead - count,
    )


def face_pairs(edges: Edges) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of faces at the edges that exactly two faces share: (p, 2) faces and (p,) edges."""
    order = np.argsort(edges.face_edge.ravel(), kind="stable")
    first = np.concatenate([[0], np.cumsum(edges.count)[:-1]])
    shared = np.flatnonzero(edges.count == 2)
    sides = np.stack([order[first[shared]], order[first[shared] + 1]], axis=1)
    return sides // 3, shared


def components(pairs: np.ndarray, count: int) -> np.ndarray:
    """Label of the connected component of each of `count` items linked by (p, 2) pairs."""
    label = np.arange(count)
    while True:
        low = np.minimum(label[pairs[:, 0]], label[pairs[:, 1]])
        lower = label.copy()
        np.minimum.at(lower, label[pairs[:, 0]], low)
        np.minimum.at(lower, label[pairs[:, 1]], low)
        lower = lower[lower]
        if np.array_equal(lower, label):
            return label
        label = lower


def face_components(edges: Edges) -> np.ndarray:
    """Component label of each face; faces that share an edge belong together."""
    sides = np.argsort(edges.face_edge.ravel(), kind="stable")
    same = edges.face_edge.ravel()[sides[1:]] == edges.face_edge.ravel()[sides[:-1]]
    pairs = np.stack([sides[:-1][same], sides[1:][same]], axis=1) // 3
    return components(pairs, len(edges.face_edge))


def cap_boundaries(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Triangles that close an open mesh: a fan over each boundary loop from the loop's mean point.

    Returns:
        Extra vertices (k, 3), to be appended to the mesh's, and extra faces (f, 3).
    """
    edges = find_edges(faces)
    open_edges = np.flatnonzero(edges.net)
    if not len(open_edges):
        return np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int32)
    # a fan side runs against the boundary, once for each side without a counterpart
    repeat = np.abs(edges.net[open_edges])
    start, end = edges.ends[open_edges].T
    start, end = np.where(edges.net[open_edges] > 0, (end, start), (start, end))
    start, end = np.repeat(start, repeat), np.repeat(end, repeat)
    used, local = np.unique(np.concatenate([start, end]), return_inverse=True)
    label = components(local.reshape(2, -1).T, len(used))
    loops, loop = np.unique(label, return_inverse=True)
    apexes = np.stack([np.bincount(loop, vertices[used, axis]) / np.bincount(loop) for axis in range(3)], axis=1)
    apex = len(vertices) + loop[local.reshape(2, -1)[0]]
    return apexes, np.stack([start, end, apex], axis=1).astype(np.int32)


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
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return total / np.where(length > 1e-12, length, np.inf)


def edge_normals(edges: Edges, normals: np.ndarray) -> np.ndarray:
    """Unit mean of the normals of the faces at each edge, (e, 3); zero where they cancel."""
    total = np.stack(
        [np.bincount(edges.face_edge.ravel(), np.repeat(normals[:, axis], 3)) for axis in range(3)],
        axis=1,
    )
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return total / np.where(length > 1e-12, length, np.inf)


def winding_number(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Exact winding number of (n, 3) points in (m, 3, 3) triangles, (n,).

    The solid angle formula of A. Van Oosterom and J. Strackee, IEEE TBME 30(2), 1983; memory grows
    with n m, so points are taken in portions.
    """
    result = np.empty(len(points))
    portion = max(1, 2_000_000 // max(1, len(triangles)))
    for first in range(0, len(points), portion):
        corner = triangles[None] - points[first : first + portion, None, None]
        a, b, c = corner[:, :, 0], corner[:, :, 1], corner[:, :, 2]
        la, lb, lc = (np.linalg.norm(side, axis=-1) for side in (a, b, c))
        volume = np.einsum("nmi,nmi->nm", a, np.cross(b, c))
        below = (
            la * lb * lc
            + np.einsum("nmi,nmi->nm", a, b) * lc
            + np.einsum("nmi,nmi->nm", b, c) * la
            + np.einsum("nmi,nmi->nm", c, a) * lb
        )
        angle = np.arctan2(volume, below).sum(axis=1)
        result[first : first + portion] = angle / (2.0 * np.pi)
    return result
