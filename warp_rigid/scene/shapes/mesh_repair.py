"""Turns a raw triangle list into the surface of a solid, and reports every change."""

from dataclasses import dataclass

import numpy as np

from warp_rigid.checks import array_of, number_array, shown
from warp_rigid.scene.shapes import mass_properties, topology
from warp_rigid.scene.shapes.distance_grid import mesh_distance
from warp_rigid.scene.shapes.mesh_union import join_shells, separate_shells

COINCIDENT, NEARLY_COINCIDENT = 1e-9, 1e-5
"""Differences of coordinates up to which vertices are one, everywhere and at open edges, relative to the extent."""


@dataclass(frozen=True, eq=False)
class Surface:
    """A clean triangle surface.

    Attributes:
        vertices: (n, 3) float64 [m].
        faces: (m, 3) int32, facing outward.
        repairs: descriptions of the changes.
        uv: (m, 3, 2) texture coordinates of the corners of the faces; None without.
    """

    vertices: np.ndarray
    faces: np.ndarray
    repairs: list[str]
    uv: np.ndarray | None = None


def repair(vertices, faces, uv=None) -> Surface:
    """Check a mesh and repair it where possible.

    Merges duplicate vertices, removes faces without area and repeated faces, removes unused
    vertices, makes the winding of neighbouring faces consistent, and turns inverted surfaces outward
    (the surface of a cavity, which faces into the hollow of another, is not changed). Shells that overlap or touch are
    replaced by their union.

    trimesh's own repairs are not used: they invert cavities, merge within absolute distances and do
    not report the number of faces that they change.

    Args:
        vertices: (n, 3) [m].
        faces: (m, 3) vertex indices.
        uv: texture coordinates of the vertices (n, 2) or of the corners (m, 3, 2), which they follow; None without.

    Raises:
        ValueError: The mesh is empty, not finite, of the wrong shape, or its faces refer to vertices
            that do not exist.
    """
    vertices, faces = checked(vertices, faces)
    uv = None if uv is None else checked_uv(uv, vertices, faces)
    repairs: list[str] = []
    vertices, faces = _merge_duplicates(vertices, faces, repairs)
    given = faces
    faces = _drop_degenerate(vertices, faces, repairs)
    faces = _drop_repeated(vertices, faces, repairs)
    if not len(faces):
        raise ValueError("faces: must hold a triangle with an area > 0, got none")
    uv = None if uv is None else _followed(uv, given, faces)
    vertices, faces = _drop_unused(vertices, faces, repairs)
    given = faces
    faces = _agree_winding(faces, repairs)
    faces = _face_outward(vertices, faces, repairs)
    uv = None if uv is None else _followed(uv, given, faces)
    vertices, faces, uv, change = join_shells(vertices, faces, uv)
    repairs += [change] if change else []
    return Surface(vertices, faces.astype(np.int32), repairs, uv)


def checked(vertices, faces) -> tuple[np.ndarray, np.ndarray]:
    """Vertices as float64 and faces as int64; a ValueError if they do not describe triangles."""
    vertices = number_array("vertices", vertices).copy()
    given, faces = faces, array_of(faces)
    if faces is None:
        raise ValueError(f"faces: must be shaped (m, 3), got {shown(given)}")
    if vertices.ndim != 2 or vertices.shape[1] != 3 or not len(vertices):
        raise ValueError(f"vertices: must be shaped (n, 3) with n > 0, got {vertices.shape}")
    if faces.ndim != 2 or faces.shape[1] != 3 or not len(faces):
        raise ValueError(f"faces: must be shaped (m, 3) with m > 0, got {faces.shape}")
    if faces.dtype.kind not in "iu":
        raise ValueError(f"faces: must be whole numbers, got {faces.dtype}")
    faces = faces.astype(np.int64)
    if not np.isfinite(vertices).all():
        wrong = int((~np.isfinite(vertices).all(axis=1)).sum())
        raise ValueError(f"vertices: must be finite numbers, got {wrong} with NaN or infinity")
    if faces.min() < 0 or faces.max() >= len(vertices):
        named = f"{faces.min()} to {faces.max()}"
        raise ValueError(f"faces: must name vertices 0 to {len(vertices) - 1}, got {named}")
    return vertices, faces


def checked_uv(uv, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Texture coordinates of the corners of faces, (m, 3, 2) float64; a ValueError if they do not match the mesh."""
    found = number_array("uv", uv)
    if found.shape == (len(vertices), 2):
        found = found[faces]
    if found.shape != (len(faces), 3, 2):
        raise ValueError(f"uv: must be shaped ({len(vertices)}, 2) or ({len(faces)}, 3, 2), got {found.shape}")
    if not np.isfinite(found).all():
        raise ValueError("uv: must be finite numbers, got NaN or infinity")
    return found


def _followed(uv: np.ndarray, before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Texture coordinates (k, 3, 2) of faces (k, 3), each with the vertices of one before, in any order."""
    from trimesh.grouping import unique_rows

    kept, which = unique_rows(np.sort(np.concatenate([before, after]), axis=1), keep_order=True)
    source = kept[which[len(before) :]]
    corner = np.argmax(before[source][:, None, :] == after[:, :, None], axis=2)
    return uv[source[:, None], corner]


def _merge_duplicates(vertices, faces, repairs):
    """Merge vertices that coincide, and those of open edges that nearly do; the first of each stays, in its order.

    Coordinates in files are float32 numbers or have six digits, and their last digits can differ from face to face.
    """
    from trimesh.grouping import unique_rows

    extent = float(np.ptp(vertices, axis=0).max())
    places = (vertices - vertices.min(axis=0)) / extent if extent > 0.0 else np.zeros_like(vertices)
    kept, merged = unique_rows(np.round(places / COINCIDENT).astype(np.int64), keep_order=True)
    count, faces = len(vertices), merged[faces]
    vertices, places = vertices[kept], places[kept]
    edges = topology.find_edges(faces)
    border = np.unique(edges.ends[edges.count % 2 == 1])
    if len(border):
        kept, merged = np.unique(topology.components(_near(places, border), len(vertices)), return_inverse=True)
        vertices, faces = vertices[kept], merged[faces]
    if len(vertices) < count:
        repairs.append(f"merged {count - len(vertices)} duplicate vertices")
    return vertices, faces


def _near(places, border):
    """Pairs of some vertices (p, 2), which link all those that differ by at most NEARLY_COINCIDENT in each coordinate.

    Of eight grids with cells of twice that size, shifted by half a cell along some of the axes, at least one has both
    vertices in one cell.
    """
    from trimesh.grouping import unique_rows

    pairs = []
    for shift in np.ndindex(2, 2, 2):
        cell = np.floor(0.5 * (places[border] / NEARLY_COINCIDENT + shift))
        first, which = unique_rows(cell.astype(np.int64))
        pairs.append(np.stack([border, border[first[which]]], axis=1))
    return np.concatenate(pairs)


def _drop_degenerate(vertices, faces, repairs):
    a, b, c = faces.T
    _, area = topology.face_normals(vertices, faces)
    sides = vertices[faces] - vertices[np.roll(faces, 1, axis=1)]
    longest = np.linalg.norm(sides, axis=2).max(axis=1)
    flat = (a == b) | (b == c) | (c == a) | (area <= 1e-12 * longest**2)
    if flat.any():
        repairs.append(f"dropped {int(flat.sum())} faces without area")
        faces = faces[~flat]
    return faces


def _drop_repeated(vertices, faces, repairs):
    """Keep one of the faces that have the same corners, in any order, or none where they are a wall inside a solid.

    Repeated faces form patches, which end where other faces meet them. A patch is such a wall, as where two solids
    touch, if an even number of other faces meets at more of its sides than an odd number. Other patches fill a gap, or
    are surfaces of their own. Of these, one that is there in both directions bounds a solid, not a cavity.
    """
    from trimesh.grouping import unique_rows

    kept, which = unique_rows(np.sort(faces, axis=1), keep_order=True)
    count = np.bincount(which)
    repeated = count > 1
    if not repeated.any():
        return faces
    once = faces[kept]
    edges = topology.find_edges(once)
    others = np.bincount(edges.face_edge[~repeated].ravel(), minlength=len(edges.ends))
    pairs, shared = topology.face_pairs(edges)
    patch = topology.components(pairs[others[shared] == 0], len(once))
    met = others[edges.face_edge]
    odd, even = (
        np.bincount(patch, n.sum(axis=1), minlength=len(once)) for n in (met % 2 == 1, (met > 0) & (met % 2 == 0))
    )
    ordered = np.take_along_axis(faces, (np.argmin(faces, axis=1)[:, None] + np.arange(3)) % 3, axis=1)
    forward = np.bincount(which, ordered[:, 1] < ordered[:, 2])
    both = (forward > 0) & (forward < count)
    for alone in np.unique(patch[both & (odd[patch] + even[patch] == 0)]):
        own = patch == alone
        agreed = _agree_winding(once[own], [])
        once[own] = _flipped(agreed, np.full(len(agreed), signed_volume(vertices, agreed) < 0.0))
    once = once[~repeated | (odd[patch] >= even[patch])]
    repairs.append(f"dropped {len(faces) - len(once)} repeated faces")
    return once


def _drop_unused(vertices, faces, repairs):
    used, renumbered = np.unique(faces, return_inverse=True)
    if len(used) == len(vertices):
        return vertices, faces
    repairs.append(f"dropped {len(vertices) - len(used)} vertices that no face uses")
    return vertices[used], renumbered.reshape(faces.shape)


def _agree_winding(faces, repairs):
    """Flip faces so that neighbours traverse their common edge in opposite directions.

    Every face is two nodes of a graph, as given and flipped, and an edge of the mesh links the nodes that agree across
    it. The components then are the consistent windings; of the two of each connected surface, the one that flips fewer
    faces is taken. A surface that has none (a Moebius strip) is not changed.
    """
    edges = topology.find_edges(faces)
    pairs, shared = topology.face_pairs(edges)
    disagree = edges.net[shared] != 0
    if not disagree.any():
        return faces
    count = len(faces)
    given, flipped = pairs + np.outer(disagree, [0, count]), pairs + np.outer(~disagree, [0, count]) + [count, 0]
    winding = topology.components(np.concatenate([given, flipped]), 2 * count).reshape(2, count)
    flip = winding[0] > winding[1]
    part = winding.min(axis=0)
    mostly = np.bincount(part, flip, minlength=count) > 0.5 * np.bincount(part, minlength=count)
    flip ^= mostly[part]
    if not flip.any():
        return faces
    repairs.append(f"turned {int(flip.sum())} faces that disagreed with their neighbours")
    return _flipped(faces, flip)


def _face_outward(vertices, faces, repairs):
    """Turn each inverted surface outward unless it is a cavity: inside the larger surfaces, as these face then.

    If the largest surface is inverted, all are turned first, so that its cavities stay cavities.
    """
    label = _surfaces(vertices, faces)
    parts = np.unique(label)
    volume = np.array([signed_volume(vertices, faces[label == part]) for part in parts])
    largest, *others = np.argsort(-np.abs(volume), kind="stable").tolist()
    flip = np.full(len(faces), volume[largest] < 0.0)
    settled = label == parts[largest]
    for k in others:
        own = label == parts[k]
        inverted = (volume[k] < 0.0) != (volume[largest] < 0.0)
        if inverted and not _is_inside(vertices, faces[own], _flipped(faces, flip)[settled]):
            flip ^= own
        settled |= own
    if flip.any():
        repairs.append(f"turned {int(flip.sum())} faces of an inverted surface outward")
    return _flipped(faces, flip)


def _surfaces(vertices, faces):
    """Label of the surface of each face: of all that meet at edges, or of each closed one where several meet."""
    edges = topology.find_edges(faces)
    label = topology.face_components(edges)
    crowded, uneven = (np.unique(label[odd[edges.face_edge].any(axis=1)]) for odd in (edges.count > 2, edges.net != 0))
    several = np.flatnonzero(np.isin(label, np.setdiff1d(crowded, uneven)))
    if len(several):
        label[several] = several[separate_shells(vertices, faces[several])[2]]
    return label


def _is_inside(vertices, faces, around) -> bool:
    """Whether the corners and the middles of some faces lie inside a surface, or on it."""
    points = np.concatenate([vertices[np.unique(faces)], vertices[faces].mean(axis=1)])
    corners = vertices[around].reshape(-1, 3)
    margin = NEARLY_COINCIDENT * float(np.ptp(corners, axis=0).max())
    lower, upper = corners.min(axis=0) - margin, corners.max(axis=0) + margin
    if not ((points >= lower) & (points <= upper)).all():
        return False
    distance, _ = mesh_distance(*topology.close_boundaries(vertices, around), points, simple=False)
    return bool((distance <= margin).all())


def _flipped(faces, flip):
    """Faces, the chosen ones with their winding reversed."""
    return np.where(flip[:, None], faces[:, ::-1], faces)


def signed_volume(vertices, faces) -> float:
    """Volume inside a mesh whose boundary loops are closed by fans [m^3]; negative if inverted."""
    return mass_properties.polyhedron(*topology.close_boundaries(vertices, faces)).volume
