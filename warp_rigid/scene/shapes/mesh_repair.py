"""Turns a raw triangle list into the surface of a solid, and reports every change."""

from dataclasses import dataclass

import numpy as np

from warp_rigid.checks import array_of, number_array, shown
from warp_rigid.scene.shapes import mass_properties, topology
from warp_rigid.scene.shapes.mesh_union import join_shells


@dataclass(frozen=True, eq=False)
class Surface:
    """A clean triangle surface.

    Attributes:
        vertices: (n, 3) float64 [m].
        faces: (m, 3) int32, facing outward.
        repairs: descriptions of the changes.
    """

    vertices: np.ndarray
    faces: np.ndarray
    repairs: list[str]


def repair(vertices, faces) -> Surface:
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

    Raises:
        ValueError: The mesh is empty, not finite, of the wrong shape, or its faces refer to vertices
            that do not exist.
    """
    vertices, faces = checked(vertices, faces)
    repairs: list[str] = []
    vertices, faces = _merge_duplicates(vertices, faces, repairs)
    faces = _drop_degenerate(vertices, faces, repairs)
    if not len(faces):
        raise ValueError("faces: must hold a triangle with an area > 0, got none")
    vertices, faces = _drop_unused(vertices, faces, repairs)
    faces = _agree_winding(faces, repairs)
    faces = _face_outward(vertices, faces, repairs)
    vertices, faces, change = join_shells(vertices, faces)
    repairs += [change] if change else []
    return Surface(vertices, faces.astype(np.int32), repairs)


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


def _merge_duplicates(vertices, faces, repairs):
    """Merge vertices that coincide to 1e-9 of the mesh's extent; the first of each stays, in the given order."""
    from trimesh.grouping import unique_rows

    extent = float(np.ptp(vertices, axis=0).max())
    places = (vertices - vertices.min(axis=0)) / (1e-9 * extent) if extent > 0.0 else np.zeros_like(vertices)
    kept, merged = unique_rows(np.round(places).astype(np.int64), keep_order=True)
    if len(kept) == len(vertices):
        return vertices, faces
    repairs.append(f"merged {len(vertices) - len(kept)} duplicate vertices")
    return vertices[kept], merged[faces]


def _drop_degenerate(vertices, faces, repairs):
    from trimesh.grouping import unique_rows

    a, b, c = faces.T
    _, area = topology.face_normals(vertices, faces)
    sides = vertices[faces] - vertices[np.roll(faces, 1, axis=1)]
    longest = np.linalg.norm(sides, axis=2).max(axis=1)
    flat = (a == b) | (b == c) | (c == a) | (area <= 1e-12 * longest**2)
    if flat.any():
        repairs.append(f"dropped {int(flat.sum())} faces without area")
        faces = faces[~flat]
    # Repeated faces have the same corners in the same cyclic order; a face and its reverse both stay.
    turn = np.argmin(faces, axis=1)[:, None] + np.arange(3)
    kept, _ = unique_rows(np.take_along_axis(faces, turn % 3, axis=1), keep_order=True)
    if len(kept) < len(faces):
        repairs.append(f"dropped {len(faces) - len(kept)} repeated faces")
        faces = faces[kept]
    return faces


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
    return _turned(faces, flip)


def _face_outward(vertices, faces, repairs):
    """Make the volume positive, then turn each inverted component unless it is a cavity."""
    flip = np.full(len(faces), signed_volume(vertices, faces) < 0.0)
    label = topology.face_components(topology.find_edges(faces))
    labels = np.unique(label)
    volume = np.array([signed_volume(vertices, faces[label == part]) for part in labels])
    volume = -volume if flip.all() else volume
    upright = np.isin(label, labels[volume > 0.0])
    solid = vertices[_turned(faces, flip)[upright]]
    for part in labels[volume < 0.0]:
        own = label == part
        if topology.winding_number(vertices[faces[own][0, 0]], solid) < 0.5:
            flip ^= own
    if flip.any():
        repairs.append(f"turned {int(flip.sum())} faces of an inverted surface outward")
    return _turned(faces, flip)


def _turned(faces, flip):
    """Faces, the chosen ones with their winding reversed."""
    return np.where(flip[:, None], faces[:, ::-1], faces)


def signed_volume(vertices, faces) -> float:
    """Volume inside a mesh whose boundary loops are closed by fans [m^3]; negative if inverted."""
    return mass_properties.polyhedron(*topology.close_boundaries(vertices, faces)).volume
