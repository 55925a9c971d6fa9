"""Makes a raw triangle list into a solid's surface, and says what it had to change."""

from dataclasses import dataclass

import numpy as np

from warp_rigid.checks import number_array, shown
from warp_rigid.scene.shapes import mass_properties, topology


@dataclass(frozen=True, eq=False)
class Surface:
    """A clean triangle surface.

    Attributes:
        vertices: (n, 3) float64 [m].
        faces: (m, 3) int32, facing outward.
        repairs: what was changed, in words.
    """

    vertices: np.ndarray
    faces: np.ndarray
    repairs: list[str]


def repair(vertices, faces) -> Surface:
    """Check a mesh and repair what can be.

    Merges duplicate vertices, drops faces without area and repeated faces, drops vertices that no
    face uses, makes neighbouring faces agree on their winding, and turns inverted surfaces outward
    (a cavity, a surface that faces into a hollow of another, stays as it is).

    Args:
        vertices: (n, 3) [m].
        faces: (m, 3) vertex indices.

    Raises:
        ValueError: The mesh is empty, not finite, of the wrong shape, or its faces name vertices
            that do not exist.
    """
    vertices, faces = checked(vertices, faces)
    repairs = []
    vertices, faces = _merge_duplicates(vertices, faces, repairs)
    faces = _drop_degenerate(vertices, faces, repairs)
    if not len(faces):
        raise ValueError("faces: must hold a triangle with an area > 0, got none")
    vertices, faces = _drop_unused(vertices, faces, repairs)
    faces = _agree_winding(faces, repairs)
    faces = _face_outward(vertices, faces, repairs)
    return Surface(vertices, faces.astype(np.int32), repairs)


def checked(vertices, faces) -> tuple[np.ndarray, np.ndarray]:
    """Vertices as float64 and faces as int64; a ValueError where they are no triangles."""
    vertices = number_array("vertices", vertices).copy()
    try:
        faces = np.asarray(faces)
    except ValueError:
        raise ValueError(f"faces: must be shaped (m, 3), got {shown(faces)}") from None
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
    extent = float(np.ptp(vertices, axis=0).max())
    rounded = np.round(vertices / (1e-9 * extent)) if extent > 0.0 else np.zeros_like(vertices)
    _, kept, merged = np.unique(rounded, axis=0, return_index=True, return_inverse=True)
    if len(kept) == len(vertices):
        return vertices, faces
    # keep the order in which vertices first appear
    order = np.argsort(kept)
    place = np.empty_like(order)
    place[order] = np.arange(len(order))
    repairs.append(f"merged {len(vertices) - len(kept)} duplicate vertices")
    return vertices[kept[order]], place[merged.reshape(-1)][faces]


def _drop_degenerate(vertices, faces, repairs):
    a, b, c = faces.T
    _, area = topology.face_normals(vertices, faces)
    sides = vertices[faces] - vertices[np.roll(faces, 1, axis=1)]
    longest = np.linalg.norm(sides, axis=2).max(axis=1)
    flat = (a == b) | (b == c) | (c == a) | (area <= 1e-12 * longest**2)
    if flat.any():
        repairs.append(f"dropped {int(flat.sum())} faces without area")
        faces = faces[~flat]
    # the same corners in the same cyclic order
    turn = np.argmin(faces, axis=1)[:, None] + np.arange(3)
    cyclic = np.take_along_axis(faces, turn % 3, axis=1)
    _, kept = np.unique(cyclic, axis=0, return_index=True)
    if len(kept) < len(faces):
        repairs.append(f"dropped {len(faces) - len(kept)} repeated faces")
        faces = faces[np.sort(kept)]
    return faces


def _drop_unused(vertices, faces, repairs):
    used = np.unique(faces)
    if len(used) == len(vertices):
        return vertices, faces
    repairs.append(f"dropped {len(vertices) - len(used)} vertices that no face uses")
    place = np.zeros(len(vertices), dtype=np.int64)
    place[used] = np.arange(len(used))
    return vertices[used], place[faces]


def _agree_winding(faces, repairs):
    """Flip faces until neighbours run along their common edge in opposite directions.

    Works outward from the first face of each component; where that cannot be done (a Moebius strip)
    the faces met last stay as they are.
    """
    edges = topology.find_edges(faces)
    pairs, shared = topology.face_pairs(edges)
    disagree = edges.net[shared] != 0
    if not disagree.any():
        return faces
    both = np.concatenate([pairs, pairs[:, ::-1]])
    differs = np.concatenate([disagree, disagree])
    flip = np.zeros(len(faces), dtype=bool)
    _, seeds = np.unique(topology.components(pairs, len(faces)), return_index=True)
    known = np.zeros(len(faces), dtype=bool)
    known[seeds] = True
    while True:
        step = np.flatnonzero(known[both[:, 0]] & ~known[both[:, 1]])
        if not len(step):
            break
        target, first = np.unique(both[step, 1], return_index=True)
        source = step[first]
        flip[target] = flip[both[source, 0]] ^ differs[source]
        known[target] = True
    # of the two consistent choices, keep the one that changes fewer faces
    label = topology.components(pairs, len(faces))
    mostly = np.bincount(label, flip, minlength=len(faces)) > 0.5 * np.bincount(label, minlength=len(faces))
    flip ^= mostly[label]
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
        corner = vertices[faces[own][:1, 0]]
        if topology.winding_number(corner, solid)[0] < 0.5:
            flip ^= own
    if flip.any():
        repairs.append(f"turned {int(flip.sum())} faces of an inverted surface outward")
    return _turned(faces, flip)


def _turned(faces, flip):
    """Faces, the chosen ones with their winding reversed."""
    return np.where(flip[:, None], faces[:, ::-1], faces)


def signed_volume(vertices, faces) -> float:
    """Volume inside a mesh whose boundary loops are closed by fans [m^3]; negative if inverted."""
    apexes, fans = topology.cap_boundaries(vertices, faces)
    closed = np.concatenate([faces, fans])
    return mass_properties.polyhedron(np.concatenate([vertices, apexes]), closed).volume
