"""Union of the closed shells of a mesh that overlap or touch, by the manifold3d package."""

import numpy as np

from warp_rigid.scene.shapes import mass_properties, topology
from warp_rigid.scene.shapes.distance_grid import mesh_distance

UNCHANGED = 1e-7
"""Relative change of volume and area below which shells neither overlap nor touch: rounding in the package."""


Joined = tuple[np.ndarray, np.ndarray, np.ndarray | None, str | None]
"""Vertices (n, 3), faces (m, 3), texture coordinates (m, 3, 2) or None, and a description of the change or None."""


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
