"""Turns a raw triangle list into the surface of a solid, and reports every change.

Closed shells that overlap or touch are united by the manifold3d package.
"""

from dataclasses import dataclass

import numpy as np

from warp_rigid.checks import array_of, number_array, shown
from warp_rigid.scene.shapes import mass_properties, topology
from warp_rigid.scene.shapes.distance_grid import mesh_distance

COINCIDENT, NEARLY_COINCIDENT = 1e-9, 1e-5
"""Differences of coordinates up to which vertices are one, everywhere and at open edges, relative to the extent."""
UNCHANGED = 1e-7
"""Relative change of volume and area below which shells neither overlap nor touch: rounding in the package."""

Joined = tuple[np.ndarray, np.ndarray, np.ndarray | None, str | None]
"""Vertices (n, 3), faces (m, 3), texture coordinates (m, 3, 2) or None, and a description of the change or None."""


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


def join_shells(vertices: np.ndarray, faces: np.ndarray, uv: np.ndarray | None = None) -> Joined:
    """Replace shells that overlap or touch by the surface of their union, the points with a winding number > 1/2.

    A cavity, whose faces point into the hollow of a shell, is cut out of the smallest shell around it before. A mesh
    with holes, or whose shells are apart, is not changed.

    Args:
        vertices: (n, 3) [m].
        faces: (m, 3), facing outward.
        uv: (m, 3, 2) texture coordinates of the corners, which the package interpolates where it cuts a face.

    Raises:
        ValueError: the union has no volume, or the package refuses a shell.
    """
    edges = topology.find_edges(faces)
    label = topology.face_components(edges)
    if not edges.closed or (edges.manifold and (label == label[0]).all()):
        return vertices, faces, uv, None
    split, faces_split, label = separate_shells(vertices, faces)
    shells = [np.flatnonzero(label == part) for part in np.unique(label)]
    volume = np.array([mass_properties.polyhedron(split, faces_split[shell]).volume for shell in shells])
    solid = [shell for shell, size in zip(shells, volume, strict=True) if size > 0.0]
    if not solid or (edges.manifold and not _bounds_meet(split, [faces_split[shell] for shell in solid])):
        return vertices, faces, uv, None
    cavities = [shell for shell, size in zip(shells, volume, strict=True) if size < 0.0]
    parts = [
        _manifold(split, faces_split[rows], None if uv is None else uv[rows])
        for rows in _with_cavities(split, faces_split, solid, cavities)
    ]
    joined, same = _union(parts)
    return (vertices, faces, uv, None) if same and edges.manifold else joined


def separate_shells(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cut a closed surface where it touches itself along edges or at vertices, so that two faces meet at every edge.

    Where more than two faces meet, faces of one shell stay together, and else those that bound the same wedge of solid.
    Of faces that coincide, the one is taken that other edges have joined already.

    Returns:
        Vertices (k, 3), faces (m, 3), and the component of each face (m,).
    """
    sides = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    partner = _partners(vertices, faces, sides)
    # The corner at the start of a side is that at the end of its partner.
    corner = np.arange(len(sides))
    after = corner - corner % 3 + (corner + 1) % 3
    pairs = np.stack([corner, after[partner]], axis=1)
    _, first, renumbered = np.unique(topology.components(pairs, len(sides)), return_index=True, return_inverse=True)
    split = renumbered.reshape(faces.shape)
    return vertices[faces.reshape(-1)[first]], split, topology.face_components(topology.find_edges(split))


def _partners(vertices, faces, sides):
    """For each side of a face (3 m,) the side in the opposite direction on the other border of the same solid wedge."""
    ends = np.sort(sides, axis=1)
    forward = sides[:, 0] < sides[:, 1]
    key = ends[:, 0] * (sides.max() + 1) + ends[:, 1]
    order = np.lexsort((forward, key))
    starts = np.flatnonzero(np.r_[True, np.diff(key[order]) != 0])
    counts = np.diff(np.r_[starts, len(order)])
    partner = np.empty(len(sides), dtype=np.int64)
    simple = starts[counts == 2]
    partner[order[simple]], partner[order[simple + 1]] = order[simple + 1], order[simple]
    pairs = np.stack([order[simple], order[simple + 1]], axis=1) // 3
    _, shell = np.unique(topology.components(pairs, len(faces)), return_inverse=True)
    shell = np.repeat(shell, 3)
    joined = np.arange(shell.max(initial=0) + 1)
    for start, count in zip(starts[counts > 2], counts[counts > 2], strict=True):
        group = order[start : start + count]
        backward, onward = group[~forward[group]], group[forward[group]]
        angle = _angles(vertices, faces, ends[group[0]], np.concatenate([onward, backward]))
        # The normal of a face that runs along the edge points to larger angles, and so the solid lies at smaller ones.
        opening = (angle[: len(onward)][:, None] - angle[len(onward) :][None]) % (2.0 * np.pi)
        opening[opening < 1e-9] = 2.0 * np.pi
        opening[shell[onward][:, None] != shell[backward][None]] += 2.0 * np.pi
        opening[joined[shell[onward]][:, None] != joined[shell[backward]][None]] += 1e-6
        for _ in range(len(onward)):
            i, j = np.unravel_index(np.argmin(opening), opening.shape)
            partner[onward[i]], partner[backward[j]] = backward[j], onward[i]
            opening[i], opening[:, j] = np.inf, np.inf
            one, other = joined[shell[[onward[i], backward[j]]]]
            joined[joined == max(one, other)] = min(one, other)
    return partner


def _angles(vertices, faces, ends, sides):
    """Angles about an edge at which the faces of some of its sides lie (s,) [rad]."""
    start, end = vertices[ends]
    axis = (end - start) / np.linalg.norm(end - start)
    first = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    first /= np.linalg.norm(first)
    opposite = vertices[faces[sides // 3, (sides % 3 + 2) % 3]] - start
    return np.arctan2(opposite @ np.cross(axis, first), opposite @ first)


def _bounds_meet(vertices, shells) -> bool:
    """Whether the boxes around any two shells overlap or touch."""
    lower = np.array([vertices[shell].min(axis=(0, 1)) for shell in shells])
    upper = np.array([vertices[shell].max(axis=(0, 1)) for shell in shells])
    margin = 1e-9 * np.ptp(vertices, axis=0).max()
    for i in range(len(shells) - 1):
        if ((lower[i + 1 :] <= upper[i] + margin) & (upper[i + 1 :] >= lower[i] - margin)).all(axis=1).any():
            return True
    return False


def _with_cavities(vertices, faces, solid, cavities):
    """The rows of the faces of each shell, with those of the cavities of which it is the smallest shell around."""
    groups = [[shell] for shell in solid]
    volume = [mass_properties.polyhedron(vertices, faces[shell]).volume for shell in solid]
    for cavity in cavities:
        point = vertices[faces[cavity[:1], 0]]
        around = [
            k for k, shell in enumerate(solid) if mesh_distance(vertices, faces[shell], point, simple=False)[0] < 0.0
        ]
        groups[min(around, key=lambda k: volume[k]) if around else int(np.argmax(volume))].append(cavity)
    return [np.concatenate(group) for group in groups]


def _manifold(vertices, faces, uv):
    """A shell as an object of the package, in float64; with texture coordinates, each corner is a vertex of its own."""
    import manifold3d

    used, first, renumbered = np.unique(faces, return_index=True, return_inverse=True)
    renumbered = renumbered.reshape(faces.shape)
    if uv is None:
        return manifold3d.Manifold(manifold3d.Mesh64(vertices[used], renumbered.astype(np.uint64)))
    corners = np.arange(faces.size)
    places = np.column_stack([vertices[faces.reshape(-1)], uv.reshape(-1, 2)])
    same = first[renumbered].reshape(-1)
    merged = (corners[corners != same].astype(np.uint64), same[corners != same].astype(np.uint64))
    return manifold3d.Manifold(manifold3d.Mesh64(places, corners.reshape(-1, 3).astype(np.uint64), *merged))


def _union(parts):
    """The union as join_shells returns it; and whether its volume and area are the sums over the parts."""
    import manifold3d

    joined = manifold3d.Manifold.batch_boolean(parts, manifold3d.OpType.Add)
    if joined.status() != manifold3d.Error.NoError:
        raise ValueError(f"mesh: must have shells that can be united, got {joined.status().name}")
    volume, area = (sum(values) for values in zip(*((p.volume(), p.surface_area()) for p in parts), strict=True))
    same = abs(joined.volume() - volume) <= UNCHANGED * volume and abs(joined.surface_area() - area) <= UNCHANGED * area
    mesh = joined.to_mesh64()
    change = f"joined {len(parts)} shells that overlap or touch into their union"
    places, triangles = np.array(mesh.vert_properties), np.array(mesh.tri_verts).astype(np.int64)
    if places.shape[1] == 3:
        return (places, triangles, None, change), same
    vertex = np.arange(len(places))
    vertex[np.array(mesh.merge_from_vert, np.int64)] = np.array(mesh.merge_to_vert, np.int64)
    used, faces = np.unique(vertex[triangles], return_inverse=True)
    return (places[used, :3], faces.reshape(-1, 3), places[triangles, 3:], change), same
