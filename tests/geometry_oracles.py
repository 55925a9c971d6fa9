"""Slow, plain float64 answers to geometric questions, independent of the code under test."""

import numpy as np

from warp_rigid.scene.shapes import Box, Capsule, Compound, Cylinder, Plane, Sphere
from warp_rigid.validation.solids import (  # noqa: F401
    cube,
    extrude,
    hollow_cube,
    in_portions,
    l_prism,
    star_prism,
    winding,
)


def distance_to_triangles(points, triangles):
    """Unsigned distance of (n, 3) points to the nearest of (m, 3, 3) triangles."""
    return in_portions(_distance_to_triangles, points, triangles)


def _distance_to_triangles(points, triangles):
    a, b, c = triangles[:, 0], triangles[:, 1], triangles[:, 2]
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    height = np.abs(_along(points, a, normal))
    inside = np.ones(height.shape, dtype=bool)
    nearest = np.full(height.shape, np.inf)
    for start, end in ((a, b), (b, c), (c, a)):
        side = end - start
        # the side's outward normal in the triangle's plane decides inside or not
        inside &= _along(points, start, np.cross(normal, side)) >= 0.0
        along = np.clip(_along(points, start, side) / (side * side).sum(axis=1), 0.0, 1.0)
        square = np.zeros(height.shape)
        for i in range(3):
            square += (points[:, i, None] - start[:, i] - along * side[:, i]) ** 2
        nearest = np.minimum(nearest, square)
    return np.where(inside, height, np.sqrt(nearest)).min(axis=1)


def _along(points, start, direction):
    """Products of each point, as seen from `start`, and a direction, (p, m)."""
    return sum((points[:, i, None] - start[:, i]) * direction[:, i] for i in range(3))


def random_surface_points(vertices, faces, count, generator):
    """Uniformly distributed points of a triangle surface."""
    triangles = vertices[faces]
    side = triangles[:, 1:] - triangles[:, :1]
    area = np.linalg.norm(np.cross(side[:, 0], side[:, 1]), axis=1)
    chosen = generator.choice(len(faces), count, p=area / area.sum())
    u, v = generator.random((2, count, 1))
    folded = u + v > 1.0
    u, v = np.where(folded, 1.0 - u, u), np.where(folded, 1.0 - v, v)
    return triangles[chosen, 0] + u * side[chosen, 0] + v * side[chosen, 1]


def points_around(lower, upper, factor, count, generator):
    """Uniform points in a box `factor` times as large as the one between two corners."""
    middle, extent = 0.5 * (lower + upper), upper - lower
    return middle + (generator.random((count, 3)) - 0.5) * factor * extent


def random_rotation(generator):
    """Uniform random (x, y, z, w) unit quaternion and its matrix, by Rodrigues' formula."""
    quaternion = generator.normal(size=4)
    quaternion /= np.linalg.norm(quaternion)
    axis, w = quaternion[:3], quaternion[3]
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return quaternion, np.eye(3) + 2.0 * w * cross + 2.0 * cross @ cross


def numeric_gradient(distance, points, step):
    """Central differences of a distance function, (n, 3)."""
    return np.stack(
        [(distance(points + step * axis) - distance(points - step * axis)) / (2.0 * step) for axis in np.eye(3)], axis=1
    )


def exact_distance(shape, points):
    """Signed distance (n,) and gradient (n, 3) of a shape; closed forms in NumPy where the shape is analytic.

    Meshes and height fields have a distance on the host that is independent of the kernels already.
    """
    points = np.asarray(points, dtype=np.float64)
    if isinstance(shape, Compound):
        return _nearest_child(shape, points)
    for kind, closed_form in CLOSED_FORMS.items():
        if isinstance(shape, kind):
            return closed_form(shape, points)
    return shape.signed_distance(points)


def _nearest_child(shape, points):
    found = []
    for child, position, (x, y, z, w) in shape.children:
        cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        rotation = np.eye(3) + 2.0 * w * cross + 2.0 * cross @ cross
        distance, gradient = exact_distance(child, (points - position) @ rotation)
        found.append((distance, gradient @ rotation.T))
    distances = np.array([distance for distance, _ in found])
    nearest = distances.argmin(axis=0)
    at = np.arange(len(points))
    return distances[nearest, at], np.array([gradient for _, gradient in found])[nearest, at]


def _sphere(shape, points):
    distance = np.linalg.norm(points, axis=1)
    return distance - shape.radius, _directions(points, distance, (0.0, 0.0, 1.0))


def _box(shape, points):
    signs = np.where(points < 0.0, -1.0, 1.0)
    return _corner_distance(np.abs(points) - shape.half_extents, signs)


def _capsule(shape, points):
    arm = points.copy()
    arm[:, 2] -= np.clip(points[:, 2], -shape.half_height, shape.half_height)
    distance = np.linalg.norm(arm, axis=1)
    return distance - shape.radius, _directions(arm, distance, (0.0, 0.0, 1.0))


def _cylinder(shape, points):
    from_axis = np.linalg.norm(points[:, :2], axis=1)
    excess = np.stack([from_axis - shape.radius, np.abs(points[:, 2]) - shape.half_height], axis=1)
    upward = np.where(points[:, 2] < 0.0, -1.0, 1.0)
    distance, slope = _corner_distance(excess, np.ones_like(excess))
    radial = _directions(points[:, :2], from_axis, (1.0, 0.0))
    return distance, np.column_stack([slope[:, :1] * radial, slope[:, 1] * upward])


def _plane(shape, points):
    return points @ shape.normal - shape.offset, np.tile(shape.normal, (len(points), 1))


CLOSED_FORMS = {Sphere: _sphere, Box: _box, Capsule: _capsule, Cylinder: _cylinder, Plane: _plane}


def _directions(arm, length, fallback):
    """Unit vectors along `arm`; the fallback where its length is zero."""
    safe = np.where(length > 0.0, length, 1.0)
    return np.where((length > 0.0)[:, None], arm / safe[:, None], np.asarray(fallback))


def _corner_distance(excess, signs):
    """Distance and gradient from how far a point lies beyond each of several orthogonal faces."""
    beyond = np.maximum(excess, 0.0)
    outside = np.linalg.norm(beyond, axis=1)
    inside = np.eye(excess.shape[1])[np.argmax(excess, axis=1)]
    distance = np.where(outside > 0.0, outside, excess.max(axis=1))
    safe = np.where(outside > 0.0, outside, 1.0)[:, None]
    return distance, signs * np.where((outside > 0.0)[:, None], beyond / safe, inside)
