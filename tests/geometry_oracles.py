"""Slow, plain float64 answers to geometric questions, independent of the code under test."""

import numpy as np

TETRAHEDRON_FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])


def in_portions(function, points, triangles):
    """Apply a function of (p, 1, 3) points and (m, 3, 3) triangles to points, a portion at a time."""
    portion = max(1, 400_000 // len(triangles))
    parts = [points[i : i + portion, None] for i in range(0, len(points), portion)]
    return np.concatenate([function(part, triangles) for part in parts])


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


def winding(points, triangles):
    """Winding number of each point: the sum of the triangles' solid angles over 4 pi."""
    return in_portions(_winding, points, triangles)


def _winding(point, triangles):
    a, b, c = (triangles[:, corner] - point for corner in range(3))
    la, lb, lc = (np.sqrt(np.einsum("pmi,pmi->pm", v, v)) for v in (a, b, c))
    ab, bc, ca = (np.einsum("pmi,pmi->pm", v, w) for v, w in ((a, b), (b, c), (c, a)))
    top = np.einsum("pmi,pmi->pm", a, np.cross(b, c))
    bottom = la * lb * lc + ab * lc + bc * la + ca * lb
    return 2.0 * np.arctan2(top, bottom).sum(axis=1) / (4.0 * np.pi)


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


def star_prism(points=5, outer=1.0, inner=0.3, thickness=0.2):
    """A star with fanned caps: vertices, faces."""
    count = 2 * points
    angle = np.pi * np.arange(count) / points
    radius = np.where(np.arange(count) % 2 == 0, outer, inner)
    flat = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    half = 0.5 * thickness
    vertices = np.concatenate(
        [
            np.column_stack([flat, np.full(count, -half)]),
            np.column_stack([flat, np.full(count, half)]),
            [[0.0, 0.0, -half], [0.0, 0.0, half]],
        ]
    )
    faces = []
    for i in range(count):
        j = (i + 1) % count
        faces += [[i, j, j + count], [i, j + count, i + count]]
        faces += [[2 * count, j, i], [2 * count + 1, i + count, j + count]]
    return vertices, np.array(faces)


def extrude(polygon, triangles, height):
    """Prism over a counter-clockwise polygon in the plane z = 0, cut into the given triangles."""
    polygon, triangles = np.asarray(polygon, dtype=np.float64), np.asarray(triangles)
    count = len(polygon)
    vertices = np.concatenate([np.column_stack([polygon, np.full(count, z)]) for z in (0.0, height)])
    walls = []
    for i in range(count):
        j = (i + 1) % count
        walls += [[i, j, j + count], [i, j + count, i + count]]
    return vertices, np.concatenate([triangles[:, ::-1], triangles + count, walls])


def cube(half=0.5, inward=False):
    """Cube around the origin: vertices, faces; facing inward if asked."""
    corners = half * (2.0 * np.array(list(np.ndindex(2, 2, 2))) - 1.0)
    quads = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    faces = np.array(quads)[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)
    return corners, faces[:, ::-1] if inward else faces


def hollow_cube(outer=0.5, inner=0.4):
    """Cube with a cubic cavity, whose faces point into the hollow."""
    wall, hollow = cube(outer), cube(inner, inward=True)
    return np.concatenate([wall[0], hollow[0]]), np.concatenate([wall[1], hollow[1] + 8])


L_POLYGON = [(0, 0), (3, 0), (3, 1), (1, 1), (1, 3), (0, 3)]
L_TRIANGLES = [(0, 1, 3), (1, 2, 3), (0, 3, 5), (3, 4, 5)]


def l_prism():
    """The L of arms 3 and width 1, height 1."""
    return extrude(L_POLYGON, L_TRIANGLES, 1.0)


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
