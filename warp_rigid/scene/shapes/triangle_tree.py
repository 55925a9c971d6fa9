"""Tree of bounding boxes over the triangles of a mesh, for exact distances near its surface."""

from dataclasses import dataclass

import numpy as np
import warp as wp

from warp_rigid.kernels import schema
from warp_rigid.kernels.shape_arrays import MOST_OF_LEAF
from warp_rigid.scene.shapes import topology

LEAF_TRIANGLES = 4


@dataclass(frozen=True, eq=False)
class TriangleTree:
    """Triangles with their normals, and the boxes around groups of them.

    Attributes:
        triangles: (m,) records `TriangleRecord`, in the order of the leaves.
        nodes: (k,) records `TreeRecord`, depth first; indices count from the first triangle and the first node.
        signed: whether the nearest triangle determines on which side of the surface a point is.
    """

    triangles: np.ndarray
    nodes: np.ndarray
    signed: bool


def triangle_tree(vertices: np.ndarray, faces: np.ndarray, signed: bool) -> TriangleTree:
    """Build the tree of a closed mesh that faces outward.

    The triangles are halved at the median of their centres along the longest side of these, level by level, until no
    leaf holds more than four. The tree is complete, so its nodes are placed by their level and rank alone.

    Args:
        vertices: (n, 3) [m].
        faces: (m, 3).
        signed: as in `TriangleTree`.
    """
    corners = vertices[faces]
    center = corners.mean(axis=1)
    order = np.arange(len(faces))
    levels = tree_levels(len(faces))
    for level in range(levels):
        order = _halved(order, center, _cuts(len(faces), level))
    return TriangleTree(_triangle_rows(vertices, faces)[order], _node_rows(corners[order], levels), signed)


def tree_levels(triangles: int) -> int:
    """Levels of a tree below its root."""
    return int(np.ceil(np.log2(max(triangles / LEAF_TRIANGLES, 1.0))))


def tree_bytes(triangles: int) -> int:
    """Memory of a tree [bytes]: its triangles and nodes, at most 200 for each triangle."""
    if triangles == 0:
        return 0
    nodes = 2 ** (tree_levels(triangles) + 1) - 1
    size = wp.types.type_size_in_bytes
    return triangles * size(schema.TriangleRecord) + nodes * size(schema.TreeRecord)


def _cuts(count: int, level: int) -> np.ndarray:
    """First triangle of each node of a level, and the end, (2**level + 1,)."""
    return np.arange(2**level + 1) * count // 2**level


def _halved(order, center, cuts):
    """Sort the triangles of each node along the longest side of their centres."""
    node = np.repeat(np.arange(len(cuts) - 1), np.diff(cuts))
    lower, upper = (ufunc.reduceat(center[order], cuts[:-1]) for ufunc in (np.minimum, np.maximum))
    axis = np.argmax(upper - lower, axis=1)
    return order[np.lexsort((center[order, axis[node]], node))]


def _node_rows(corners: np.ndarray, levels: int) -> np.ndarray:
    """All nodes, depth first; the boxes are widened by the rounding to float32."""
    rows = np.zeros(2 ** (levels + 1) - 1, schema.TreeRecord.numpy_dtype())
    lower, upper = corners.min(axis=1), corners.max(axis=1)
    margin = 1e-6 * np.abs(corners).max()
    place = np.zeros(1, dtype=np.int64)
    for level in range(levels + 1):
        cuts = _cuts(len(corners), level)
        subtree = 2 ** (levels - level + 1) - 1
        rows["lower"][place] = np.minimum.reduceat(lower, cuts[:-1]) - margin
        rows["upper"][place] = np.maximum.reduceat(upper, cuts[:-1]) + margin
        rows["skip"][place] = place + subtree
        if level == levels:
            rows["leaf"][place] = MOST_OF_LEAF * cuts[:-1] + np.diff(cuts)
        place = np.stack([place + 1, place + 1 + subtree // 2], axis=1).reshape(-1)
    return rows


def _triangle_rows(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Corners and pseudonormals of each triangle."""
    edges = topology.find_edges(faces)
    normals, _ = topology.face_normals(vertices, faces)
    side = topology.edge_normals(edges, normals)[edges.face_edge]
    vertex = topology.vertex_normals(vertices, faces)[faces]
    rows = np.zeros(len(faces), schema.TriangleRecord.numpy_dtype())
    for k, component in enumerate("xyz"):
        rows[f"normal_{component}"] = normals[:, k]
    for k in range(3):
        rows[f"corner_{k}"], rows[f"side_{k}"], rows[f"vertex_{k}"] = vertices[faces[:, k]], side[:, k], vertex[:, k]
    return rows
