"""Deepest overlap of two solids in float64: the largest depth of a point of one surface inside the other solid.

A surface is a set of triangles and a map of these onto it, which lengthens no way.
"""

import numpy as np

from tests.geometry_oracles import distance_to_triangles, winding
from tests.oracles import rotation_matrix
from warp_rigid.scene.shapes import Box, Capsule, Compound, Cylinder, Heightfield, Mesh, Plane, Sphere, tessellation
from warp_rigid.validation.resting_meshes import deepest_point


class Solid:
    """A solid in the world.

    Args:
        shape: its shape.
        position: (3,) [m].
        orientation: (4,) unit quaternion.
    """

    def __init__(self, shape, position, orientation):
        self.pieces = list(_pieces(shape, np.asarray(position, float), rotation_matrix(np.asarray(orientation, float))))

    def depth(self, points):
        """Depth of (n, 3) points, negative outside; in the deepest piece of a compound."""
        return np.max([_depth(piece, (points - at) @ turn) for piece, at, turn in self.pieces], axis=0)


def deepest_overlap(first: Solid, second: Solid, accuracy: float = 3e-7) -> float:
    """The deepest overlap of two solids [m], 0 if they are apart."""
    best = 0.0
    for own, other in ((first, second), (second, first)):
        for number, (piece, at, turn) in enumerate(own.pieces):
            hidden = [own.pieces[k] for k in range(len(own.pieces)) if k != number]
            best = _deepest(piece, at, turn, hidden, other, best, accuracy)
    return best


def _pieces(shape, position, turn):
    if isinstance(shape, Compound):
        for child, place, orientation in shape.children:
            yield from _pieces(child, position + turn @ place, turn @ rotation_matrix(np.asarray(orientation)))
    else:
        yield shape, position, turn


def _deepest(piece, at, turn, hidden, other, best, accuracy):
    """The deepest point of a piece's surface that no other piece hides."""

    def depth_at(points):
        world = _onto(piece, points) @ turn.T + at
        seen = np.ones(len(world), bool)
        for shape, place, rotation in hidden:
            seen &= _depth(shape, (world - place) @ rotation) < 1e-9
        return other.depth(world), seen

    return deepest_point(_triangles(piece), depth_at, best, accuracy)[0]


def _triangles(shape):
    """Triangles of the surface, or of a box around it."""
    if isinstance(shape, Plane):
        return np.zeros((0, 3, 3))
    if isinstance(shape, (Mesh, Heightfield)):
        vertices, faces = shape.surface()
        return vertices[faces]
    lower, upper = shape.bounds
    vertices, faces = tessellation.box(0.5 * (upper - lower) * 1.01)
    return vertices[faces]


def _onto(shape, points):
    """The nearest point of a round solid's surface, for points outside it."""
    if isinstance(shape, Sphere):
        return shape.radius * points / np.linalg.norm(points, axis=1, keepdims=True)
    if isinstance(shape, Capsule):
        core = np.clip(points[:, 2], -shape.half_height, shape.half_height)[:, None] * [0, 0, 1]
        arm = points - core
        return core + shape.radius * arm / np.linalg.norm(arm, axis=1, keepdims=True)
    if isinstance(shape, Cylinder):
        away = np.linalg.norm(points[:, :2], axis=1, keepdims=True)
        ring = points[:, :2] * np.minimum(1.0, shape.radius / np.maximum(away, 1e-12))
        return np.column_stack([ring, np.clip(points[:, 2], -shape.half_height, shape.half_height)])
    if isinstance(shape, Box):
        return np.clip(points, -shape.half_extents, shape.half_extents)
    return points


def _depth(shape, points):
    """Depth of points in a solid, in its frame; negative outside."""
    if isinstance(shape, Sphere):
        return shape.radius - np.linalg.norm(points, axis=1)
    if isinstance(shape, Plane):
        return shape.offset - points @ shape.normal
    if isinstance(shape, Capsule):
        core = np.clip(points[:, 2], -shape.half_height, shape.half_height)[:, None] * [0, 0, 1]
        return shape.radius - np.linalg.norm(points - core, axis=1)
    if isinstance(shape, Box):
        return _depth_of_slabs(np.abs(points) - shape.half_extents)
    if isinstance(shape, Cylinder):
        beyond = [np.linalg.norm(points[:, :2], axis=1) - shape.radius, np.abs(points[:, 2]) - shape.half_height]
        return _depth_of_slabs(np.stack(beyond, axis=1))
    if isinstance(shape, Heightfield):
        return _depth_in_field(shape, points)
    vertices, faces = shape.surface()
    triangles = vertices[faces]
    lower, upper = shape.bounds
    near = ((points > lower - 0.02) & (points < upper + 0.02)).all(axis=1)
    depth = np.full(len(points), -1.0)
    if near.any():
        inside = winding(points[near], triangles) > 0.5
        depth[near] = np.where(inside, 1.0, -1.0) * distance_to_triangles(points[near], triangles)
    gap = np.maximum(np.maximum(lower - points, points - upper), 0.0)
    depth[~near] = -np.linalg.norm(gap[~near], axis=1)
    return depth


def _depth_in_field(shape, points):
    """By the triangles that are no farther from all points than the surface straight above or below the farthest."""
    below = shape.height_at(points[:, :2], 0.0) - points[:, 2]
    reach = np.abs(below).max()
    if (np.abs(points[:, :2]) + reach > 0.5 * shape.extent).any():  # the sides may be nearer
        return -shape.signed_distance(points)[0]
    triangles = _triangles(shape)
    near = (triangles.max(axis=1) >= points.min(axis=0) - reach) & (triangles.min(axis=1) <= points.max(axis=0) + reach)
    return np.sign(below) * distance_to_triangles(points, triangles[near.all(axis=1)])


def _depth_of_slabs(beyond):
    outside = np.linalg.norm(np.maximum(beyond, 0.0), axis=1)
    return np.where(outside > 0.0, -outside, -beyond.max(axis=1))
