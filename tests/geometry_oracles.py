"""Slow, plain float64 answers to geometric questions, independent of the code under test."""

import numpy as np

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


def _distance_to_triangles(point, triangles):
    a, b, c = triangles[:, 0], triangles[:, 1], triangles[:, 2]
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    height = np.einsum("pmi,mi->pm", point - a, normal)
    inside = np.ones(height.shape, dtype=bool)
    nearest = np.full(height.shape, np.inf)
    for start, end in ((a, b), (b, c), (c, a)):
        side, arm = end - start, point - start
        # the side's outward normal in the triangle's plane decides inside or not
        inside &= np.einsum("pmi,mi->pm", arm, np.cross(normal, side)) >= 0.0
        along = np.einsum("pmi,mi->pm", arm, side) / np.einsum("mi,mi->m", side, side)
        gap = arm - np.clip(along, 0.0, 1.0)[:, :, None] * side
        nearest = np.minimum(nearest, np.sqrt(np.einsum("pmi,pmi->pm", gap, gap)))
    return np.where(inside, np.abs(height), nearest).min(axis=1)


def distance_to_polyline(points, corners):
    """Unsigned distance of (n, 2) points to an open polyline of (m, 2) corners."""
    start, side = corners[:-1], np.diff(corners, axis=0)
    arm = points[:, None] - start[None]
    along = np.einsum("nmi,mi->nm", arm, side) / np.einsum("mi,mi->m", side, side)
    arm = arm - np.clip(along, 0.0, 1.0)[:, :, None] * side[None]
    return np.linalg.norm(arm, axis=2).min(axis=1)


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
        [(distance(points + step * axis) - distance(points - step * axis)) / (2.0 * step) for axis in np.eye(3)],
        axis=1,
    )
