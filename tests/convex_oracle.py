"""Depth of penetration of two convex solids in float64, from their support functions alone.

The depth is the smallest translation that separates two solids: the minimum over all unit directions n of
h_A(n) + h_B(-n), where h is the largest n . x over a solid. It is negative, and no longer a distance, if the solids are
apart. Between polyhedra the minimum is at a face normal of either or at a cross product of an edge of each (the
separating axis theorem), which is exact. For round solids it is searched for from many directions.
"""

from dataclasses import dataclass

import numpy as np

from tests.oracles import random_quaternion, rotation_matrix
from warp_rigid.scene.shapes import Box, Capsule, Cylinder, Mesh, topology
from warp_rigid.scenes.builders import assortment

STARTS, ROUNDS, TRIALS = 4, 80, 12
"""Directions from which the search for round solids goes on, its rounds, and the directions tried in each."""


@dataclass(frozen=True)
class Solid:
    """A convex solid: a shape, and what the oracle knows about it.

    Attributes:
        shape: the shape itself.
        normals: (f, 3) unit normals of the faces, one of each opposite pair; empty if the solid is round.
        edges: (e, 3) unit directions of the edges, likewise.
    """

    shape: object
    normals: np.ndarray
    edges: np.ndarray

    @property
    def flat(self) -> bool:
        """Whether the solid is a polyhedron."""
        return len(self.normals) > 0


def solid(shape) -> Solid:
    """The faces and edges of a convex shape."""
    if not isinstance(shape, (Box, Mesh)):
        return Solid(shape, np.zeros((0, 3)), np.zeros((0, 3)))
    vertices, faces = shape.surface()
    normals, _ = topology.face_normals(vertices, faces)
    edges = topology.find_edges(faces)
    pairs, shared = topology.face_pairs(edges)
    bent = np.einsum("ij,ij->i", normals[pairs[:, 0]], normals[pairs[:, 1]]) < 1.0 - 1e-6
    ends = edges.ends[shared[bent]]
    along = vertices[ends[:, 1]] - vertices[ends[:, 0]]
    return Solid(shape, _lines(normals), _lines(along / np.linalg.norm(along, axis=1, keepdims=True)))


def _lines(directions):
    """Directions without those that are parallel to an earlier one."""
    kept = []
    for direction in directions:
        if all(abs(direction @ other) < 1.0 - 1e-6 for other in kept):
            kept.append(direction)
    return np.array(kept)


SOLIDS = {
    **{kind: lambda kind=kind: assortment.convex_solid(kind, 0.2) for kind in assortment.CONVEX_KINDS},
    "slab": lambda: Box((0.2, 0.15, 0.04)),
    "bar": lambda: Box((0.05, 0.06, 0.3)),
    "capsule": lambda: Capsule(0.08, 0.15),
    "rod": lambda: Cylinder(0.08, 0.2),
    "disc": lambda: Cylinder(0.2, 0.05),
}
"""Every kind of convex solid: the assortment's (its cylinder is a prism of twelve sides), and round and slim ones."""


def overlaps(a: Solid, b: Solid, position, orientation) -> np.ndarray:
    """Depth of n pairs of solids in the world: positions (n, 2, 3), unit quaternions (n, 2, 4). Returns (n,) [m]."""
    rotation = rotation_matrix(orientation)
    back = np.swapaxes(rotation[:, 0], 1, 2)
    shift = np.einsum("nij,nj->ni", back, np.diff(position, axis=1)[:, 0])
    return penetration_depth(a, b, shift, back @ rotation[:, 1])


def random_poses(a: Solid, b: Solid, count: int, generator) -> tuple[np.ndarray, np.ndarray]:
    """Poses in which most pairs overlap, from concentric to just apart: positions (n, 2, 3), orientations (n, 2, 4)."""
    orientation = random_quaternion(generator, 2 * count).reshape(count, 2, 4)
    back = np.swapaxes(rotation_matrix(orientation), 2, 3)
    toward = generator.normal(size=(count, 3))
    toward /= np.linalg.norm(toward, axis=1, keepdims=True)
    reach = a.shape.support(np.einsum("nij,nj->ni", back[:, 0], toward))
    reach += b.shape.support(-np.einsum("nij,nj->ni", back[:, 1], toward))
    position = np.zeros((count, 2, 3))
    position[:, 1] = toward * (reach * np.sqrt(generator.random(count)))[:, None]
    return position, orientation


def penetration_depth(a: Solid, b: Solid, shift, rotation) -> np.ndarray:
    """Depth of n poses of b in the frame of a: positions (n, 3), rotation matrices (n, 3, 3). Returns (n,) [m]."""
    if a.flat and b.flat:
        return _reach(a, b, shift, rotation, _axes(a, b, rotation)).min(axis=1)
    return _search(a, b, shift, rotation)


def _reach(a, b, shift, rotation, directions):
    """h_A(n) + h_B(-n) for directions (n, k, 3) of n poses, (n, k)."""
    count, each, _ = directions.shape
    of_a = a.shape.support(directions.reshape(-1, 3)).reshape(count, each)
    of_b = b.shape.support(-(directions @ rotation).reshape(-1, 3)).reshape(count, each)
    return of_a + of_b - np.einsum("nki,ni->nk", directions, shift)


def _axes(a, b, rotation):
    """The separating axes of n poses of two polyhedra, with both signs, (n, k, 3)."""
    count = len(rotation)
    edges_of_b = np.einsum("nij,ej->nei", rotation, b.edges)
    crossed = np.cross(a.edges[None, :, None], edges_of_b[:, None]).reshape(count, -1, 3)
    length = np.linalg.norm(crossed, axis=2, keepdims=True)
    # parallel edges have no axis of their own; a face normal stands in
    crossed = np.where(length > 1e-6, crossed / np.maximum(length, 1e-6), a.normals[0])
    of_a = np.broadcast_to(a.normals, (count, *a.normals.shape))
    axes = np.concatenate([of_a, np.einsum("nij,fj->nfi", rotation, b.normals), crossed], axis=1)
    return np.concatenate([axes, -axes], axis=1)


def _sphere_points(count):
    """Points spread evenly over the unit sphere (a Fibonacci spiral)."""
    k = np.arange(count) + 0.5
    z, angle = 1.0 - 2.0 * k / count, np.pi * (1.0 + 5.0**0.5) * k
    r = np.sqrt(1.0 - z * z)
    return np.stack([r * np.cos(angle), r * np.sin(angle), z], axis=1)


def _search(a, b, shift, rotation):
    """The least reach found: the best of many directions, each improved by random steps.

    A step grows where it has succeeded and shrinks where it has not, so that narrow valleys are followed.
    """
    count = len(shift)
    known = np.einsum("nij,fj->nfi", rotation, b.normals)
    fixed = np.concatenate([_sphere_points(300), a.normals, -a.normals])
    start = np.concatenate([np.broadcast_to(fixed, (count, *fixed.shape)), known, -known], axis=1)
    reach = _reach(a, b, shift, rotation, start)
    best = np.argsort(reach, axis=1)[:, :STARTS]
    at = np.take_along_axis(start, best[:, :, None], axis=1)
    value = np.take_along_axis(reach, best, axis=1)
    generator, step = np.random.default_rng(0), np.full((count, STARTS, 1, 1), 0.1)
    for _ in range(ROUNDS):
        trial = at[:, :, None] + step * generator.normal(size=(1, 1, TRIALS, 3))
        trial /= np.linalg.norm(trial, axis=3, keepdims=True)
        reach = _reach(a, b, shift, rotation, trial.reshape(count, -1, 3)).reshape(count, STARTS, TRIALS)
        lowest = reach.argmin(axis=2)
        found = np.take_along_axis(reach, lowest[:, :, None], axis=2)[:, :, 0]
        better = found < value
        chosen = np.take_along_axis(trial, lowest[:, :, None, None], axis=2)[:, :, 0]
        at, value = np.where(better[:, :, None], chosen, at), np.where(better, found, value)
        step *= np.where(better, 1.5, 0.7)[:, :, None, None]
    return value.min(axis=1)
