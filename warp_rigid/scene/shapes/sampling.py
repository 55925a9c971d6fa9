"""Surface samples of shapes, and their grouping into tight clusters."""

import math
from dataclasses import dataclass

import numpy as np

from warp_rigid.kernels.enums import SampleKind
from warp_rigid.kernels.schema import BALL_PLACES
from warp_rigid.scene.shapes import topology

CLUSTER_LIMIT = 32
FEATURE_DEGREES = 30.0
COLUMNS: dict[str, tuple[int, ...]] = {
    "point": (3,), "normal": (3,), "slide": (3,), "radius": (), "kind": (), "choice": (), "rank": (), "edges": (2,),
    "dip": (),
}  # fmt: skip
"""Columns of a SampleList, and the shape of the value of a sample in each."""
WHOLE = ("kind", "choice", "edges")
"""Columns of whole numbers."""
FLAT_DEGREES = 0.5
"""Edges that bend by less are flat."""
VERTEX, OTHER = 0, 1  # ranks: inside a cluster, vertices come first


@dataclass(frozen=True, eq=False)
class Samples:
    """Surface samples in the shape's frame [m], grouped into clusters.

    Attributes:
        point: (n, 3) float32, a surface point, the middle of a segment, or a circle's centre.
        normal: (n, 3) float32, unit outward, of a SIDE to its cap; zero where a sample has no direction.
        slide: (n, 3) float32, half of the segment of an EDGE, half of the length of an ARC along it, else zero.
        radius: (n,) float32, of the ball around a POINT or EDGE, or of the circle of a RIM.
        kind: (n,) int32, a `SampleKind`.
        choice: (n,) int32, of balls: the place on a mesh that each stands for, from 1; else 0.
        edges: (n, 2) int32, the first of the unsampled edges of each sample, and the one after the last.
        unsampled_edges: (m, 3) float32, from a point of a mesh to the next one on such an edge [m].
        dip: how much nearer than the points the unsampled edges may come to others like them [m].
        cluster_start: (c + 1,) int32, where each cluster begins and the last ends.
        cluster_center: (c, 3) float32, centre of the bounding sphere of the samples.
        cluster_radius: (c,) float32, its radius.
    """

    point: np.ndarray
    normal: np.ndarray
    slide: np.ndarray
    radius: np.ndarray
    kind: np.ndarray
    choice: np.ndarray
    edges: np.ndarray
    unsampled_edges: np.ndarray
    dip: float
    cluster_start: np.ndarray
    cluster_center: np.ndarray
    cluster_radius: np.ndarray

    def __len__(self) -> int:
        """Number of samples."""
        return len(self.point)


class SampleList:
    """Collects samples of mixed kinds; `cluster` turns them into `Samples`."""

    def __init__(self):
        """An empty list."""
        self._columns = {name: [] for name in COLUMNS}
        self._unsampled_edges, self._edge_count = [np.zeros((0, 3))], 0

    def add(self, kind, point, normal=(0, 0, 0), slide=(0, 0, 0), rank=OTHER, unsampled_edges=(), **more):
        """Append n samples; each argument is one value for all, or one per sample.

        `more` has other columns, which are 0 by default. `edges` (n, 2) are ranges of rows of `unsampled_edges` (m, 3),
        both as in `Samples`.
        """
        point = np.asarray(point, dtype=np.float64).reshape(-1, 3)
        given = {"kind": kind, "point": point, "normal": normal, "slide": slide, "rank": rank, **more}
        given["edges"] = np.asarray(given.get("edges", 0)) + self._edge_count
        self._unsampled_edges.append(np.reshape(unsampled_edges, (-1, 3)))
        self._edge_count += len(self._unsampled_edges[-1])
        for name, shape in COLUMNS.items():
            self._columns[name].append(np.broadcast_to(np.asarray(given.get(name, 0)), (len(point), *shape)))

    def add_balls(self, center, radius: float, rank=OTHER) -> None:
        """Append balls about points (n, 3), each once for every place on a mesh."""
        for choice in range(1, BALL_PLACES + 1):
            self.add(SampleKind.POINT, center, radius=radius, rank=rank, choice=choice)

    def add_axis(self, half_length: float, radius: float) -> None:
        """Append EDGE segments with a radius along z, each about one radius long, 8 at most."""
        pieces = int(np.clip(math.ceil(half_length / radius), 1, 8))
        end = np.array([[0.0, 0.0, half_length]])
        middle, half, _ = split_segments(-end, end, np.array([pieces]))
        self.add(SampleKind.EDGE, middle, slide=half, radius=radius)

    @property
    def unsampled_edges(self) -> np.ndarray:
        """The unsampled edges of all samples, (m, 3) [m]."""
        return np.concatenate(self._unsampled_edges)

    def columns(self) -> dict[str, np.ndarray]:
        """All samples, a column for each of `COLUMNS`."""
        self.add(SampleKind.POINT, np.zeros((0, 3)))
        return {name: np.concatenate(column) for name, column in self._columns.items()}

    def cluster(self) -> Samples:
        """All samples, in tight clusters of at most 32. Edges, faces, arcs, sides, further places are apart."""
        given = self.columns()
        kind, choice, dip = given["kind"], given["choice"], given["dip"]
        points = np.isin(kind, (SampleKind.POINT, SampleKind.RIM, SampleKind.CAP))
        families = [points & (choice <= 1)]
        families += [kind == one for one in (SampleKind.EDGE, SampleKind.FACE, SampleKind.ARC, SampleKind.SIDE)]
        groups = []
        for members in map(np.flatnonzero, (*families, choice > 1)):
            if len(members):
                groups += [members[group] for group in _bisect(given["point"][members])]
        groups = [group[np.lexsort((group, given["rank"][group]))] for group in groups]
        order = np.concatenate(groups) if groups else np.zeros(0, dtype=np.int64)
        start = np.concatenate([[0], np.cumsum([len(group) for group in groups])])
        columns = {name: column[order] for name, column in given.items() if name not in ("rank", "dip")}
        columns["radius"] = columns["radius"].astype(np.float64)
        center, reach = _bounding_spheres(columns["point"], columns["slide"], columns["radius"], start)
        return Samples(
            **{name: _frozen(own, np.int32 if name in WHOLE else np.float32) for name, own in columns.items()},
            unsampled_edges=_frozen(self.unsampled_edges, np.float32),
            dip=float(dip[dip > 0.0].mean()) if dip.any() else 0.0,
            cluster_start=_frozen(start, np.int32),
            cluster_center=_frozen(center, np.float32),
            cluster_radius=_frozen(reach, np.float32),
        )


def _frozen(values, dtype) -> np.ndarray:
    array = np.ascontiguousarray(values, dtype=dtype)
    array.flags.writeable = False
    return array


def _bisect(point: np.ndarray) -> list[np.ndarray]:
    """Bisect along the longest side until no group exceeds the limit; groups have about equal size."""
    groups, waiting = [], [np.arange(len(point))]
    while waiting:
        members = waiting.pop()
        clusters = -(-len(members) // CLUSTER_LIMIT)
        if clusters == 1:
            groups.append(members)
            continue
        axis = int(np.argmax(np.ptp(point[members], axis=0)))
        ordered = members[np.argsort(point[members, axis], kind="stable")]
        cut = len(members) * ((clusters + 1) // 2) // clusters
        waiting += [ordered[cut:], ordered[:cut]]
    return groups


def _bounding_spheres(point, slide, radius, start) -> tuple[np.ndarray, np.ndarray]:
    """Spheres that contain every point +- slide with the ball (or circle) around it."""
    count = len(start) - 1
    if count == 0:
        return np.zeros((0, 3)), np.zeros(0)
    reach = np.abs(slide) + radius[:, None]
    lower = np.minimum.reduceat(point - reach, start[:-1])
    upper = np.maximum.reduceat(point + reach, start[:-1])
    center = (0.5 * (lower + upper)).astype(np.float32)
    offset = point - np.repeat(center, np.diff(start), axis=0)
    ends = [np.linalg.norm(offset + sign * slide, axis=1) for sign in (-1.0, 1.0)]
    distance = np.maximum.reduceat(np.maximum(*ends) + radius, start[:-1])
    # float32 rounding of points and centres must not let a sample stick out
    return center, distance * (1.0 + 1e-5) + 1e-6 * np.abs(center).max(axis=1)


def split_segments(start: np.ndarray, end: np.ndarray, pieces: np.ndarray):
    """Cut segments into equal pieces.

    Args:
        start: (n, 3) first ends.
        end: (n, 3) second ends.
        pieces: (n,) how many pieces each becomes.

    Returns:
        middle (m, 3) and half (m, 3) of each piece, and segment (m,), the index it came from.
    """
    segment = np.repeat(np.arange(len(start)), pieces)
    first = np.concatenate([[0], np.cumsum(pieces)[:-1]]) if len(pieces) else np.zeros(0, int)
    step = np.arange(len(segment)) - first[segment]
    fraction = (step + 0.5) / pieces[segment]
    along = (end - start)[segment]
    return (start[segment] + fraction[:, None] * along, 0.5 * along / pieces[segment][:, None], segment)


def sample_mesh(vertices: np.ndarray, faces: np.ndarray, spacing: float) -> SampleList:
    """Samples of a triangle mesh that leave no surface point farther away than the spacing.

    All vertices (angle-weighted normals); EDGE segments, no longer than the spacing, on boundary
    edges and convex edges of more than 30 degrees if longer than half of the spacing; FACE points
    on the other edges and inside triangles that are longer than the spacing. Concave edges need no
    EDGE: contact in a notch is with the other body's edge. The points at the ends of other convex
    edges know these unsampled edges.
    """
    edges = topology.find_edges(faces)
    normals, _ = topology.face_normals(vertices, faces)
    edge_normal = topology.edge_normals(edges, normals)
    start, end = vertices[edges.ends[:, 0]], vertices[edges.ends[:, 1]]
    length = np.linalg.norm(end - start, axis=1)
    sharp, bend = bends(vertices, faces, edges, normals)
    pieces = np.maximum(np.ceil(length / spacing - 1e-9).astype(np.int64), 1)
    sampled = sharp & (length > 0.5 * spacing)
    unsampled = ~sampled & (bend > np.radians(FLAT_DEGREES))
    along = (end - start) / pieces[:, None]
    dip = 0.5 * np.linalg.norm(along, axis=1) * np.tan(0.5 * np.minimum(bend, np.radians(FEATURE_DEGREES)))
    collected = SampleList()
    normal = topology.vertex_normals(vertices, faces)
    of_vertices = _edges_of_vertices(len(vertices), edges.ends[unsampled], along[unsampled], dip[unsampled])
    collected.add(SampleKind.POINT, vertices, normal, rank=VERTEX, **of_vertices)
    chosen = np.flatnonzero(sampled)
    middle, half, segment = split_segments(start[chosen], end[chosen], pieces[chosen])
    collected.add(SampleKind.EDGE, middle, edge_normal[chosen[segment]], half)
    plain = np.flatnonzero(~sharp & (length > spacing))
    edge, fraction = _inner_fractions(pieces[plain])
    chosen = plain[edge]
    point = start[chosen] + fraction[:, None] * (end - start)[chosen]
    of_points = _edges_of_points(unsampled[chosen], along[chosen], dip[chosen])
    collected.add(SampleKind.FACE, point, edge_normal[chosen], **of_points)
    point, face = _inner_points(vertices, faces, length[edges.face_edge].max(axis=1), spacing)
    collected.add(SampleKind.FACE, point, normals[face])
    return collected


def _edges_of_vertices(count: int, ends, along, dip) -> dict[str, np.ndarray]:
    """Unsampled edges at each vertex, and their largest dip, as columns of `SampleList`.

    Args:
        count: number of vertices.
        ends: (e, 2) vertices of each unsampled edge.
        along: (e, 3) from the first vertex to the next point on the edge [m].
        dip: (e,) of each edge [m].
    """
    vertex = ends.T.ravel()
    order = np.argsort(vertex, kind="stable")
    largest = np.zeros(count)
    np.maximum.at(largest, ends, dip[:, None])
    bounds = np.searchsorted(vertex[order], np.arange(count + 1))
    edges = np.stack([bounds[:-1], bounds[1:]], axis=1)
    return {"edges": edges, "dip": largest, "unsampled_edges": np.concatenate([along, -along])[order]}


def _edges_of_points(unsampled, along, dip) -> dict[str, np.ndarray]:
    """The same for points inside edges: both directions of each edge that is unsampled, (n,)."""
    end = 2 * np.cumsum(unsampled)
    both = np.stack([along, -along], axis=1)[unsampled]
    return {"edges": np.stack([end - 2 * unsampled, end], axis=1), "dip": dip * unsampled, "unsampled_edges": both}


def bends(vertices, faces, edges, normals) -> tuple[np.ndarray, np.ndarray]:
    """Which edges are boundaries, or convex with more than 30 degrees between the faces, (e,); and that angle [rad].

    The angle is that of a fold, pi, for boundaries, and negative for concave edges.
    """
    pairs, shared = topology.face_pairs(edges)
    first, second = normals[pairs[:, 0]], normals[pairs[:, 1]]
    cosine = np.einsum("ij,ij->i", first, second)
    centroid = vertices[faces].mean(axis=1)
    across = centroid[pairs[:, 1]] - centroid[pairs[:, 0]]
    convex = np.einsum("ij,ij->i", across, first - second) < 0.0
    sharp = edges.count != 2
    sharp[shared] = convex & (cosine < np.cos(np.radians(FEATURE_DEGREES)))
    bend = np.full(len(sharp), np.pi)
    bend[shared] = np.where(convex, 1.0, -1.0) * np.arccos(np.clip(cosine, -1.0, 1.0))
    return sharp, bend


def _inner_fractions(pieces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where edges cut into equal pieces are cut: (m,) edge and (m,) fraction along it."""
    edge = np.repeat(np.arange(len(pieces)), pieces - 1)
    first = np.cumsum(pieces - 1) - (pieces - 1)
    step = np.arange(len(edge)) - first[edge] + 1
    return edge, step / pieces[edge]


def _inner_points(vertices, faces, longest, spacing) -> tuple[np.ndarray, np.ndarray]:
    """Lattice points strictly inside triangles whose longest side exceeds the spacing."""
    pieces = np.ceil(longest / spacing - 1e-9).astype(np.int64)
    points, owners = [np.zeros((0, 3))], [np.zeros(0, dtype=np.int64)]
    for count in np.unique(pieces[pieces > 2]):
        chosen = np.flatnonzero(pieces == count)
        i, j = np.meshgrid(np.arange(1, count), np.arange(1, count), indexing="ij")
        inside = i + j < count
        weight = np.stack([i[inside], j[inside], count - i[inside] - j[inside]], axis=1) / count
        points.append(np.einsum("wk,fkx->fwx", weight, vertices[faces[chosen]]).reshape(-1, 3))
        owners.append(np.repeat(chosen, len(weight)))
    return np.concatenate(points), np.concatenate(owners)
