"""Solids with closed forms or sharp features, as vertices and faces, and the winding number of points."""

import numpy as np

from warp_rigid.scene.shapes import tessellation

Triangles = tuple[np.ndarray, np.ndarray]
"""Vertices (n, 3) and faces (m, 3)."""


def star_prism() -> Triangles:
    """A star of five points with fanned caps, radii 1 and 0.3, thickness 0.2."""
    count, half = 10, 0.1
    angle = np.pi * np.arange(count) / 5
    radius = np.where(np.arange(count) % 2 == 0, 1.0, 0.3)
    flat = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    rings = [np.column_stack([flat, np.full(count, z)]) for z in (-half, half)]
    vertices = np.concatenate([*rings, [[0.0, 0.0, -half], [0.0, 0.0, half]]])
    return vertices, np.concatenate(tessellation.capped_tube(2, count))


def extrude(polygon, triangles, height) -> Triangles:
    """Prism over a counter-clockwise polygon in the plane z = 0, cut into the given triangles."""
    polygon, triangles = np.asarray(polygon, dtype=np.float64), np.asarray(triangles)
    count = len(polygon)
    vertices = np.concatenate([np.column_stack([polygon, np.full(count, z)]) for z in (0.0, height)])
    _, walls, _ = tessellation.capped_tube(2, count)
    return vertices, np.concatenate([triangles[:, ::-1], triangles + count, walls])


def cube(half=0.5) -> Triangles:
    """Cube around the origin."""
    return tessellation.box((half,) * 3)


def hollow_cube() -> Triangles:
    """Cube of width 1 with a cubic cavity of width 0.8, whose faces point into the cavity."""
    wall, hollow = cube(), cube(0.4)
    return np.concatenate([wall[0], hollow[0]]), np.concatenate([wall[1], hollow[1][:, ::-1] + 8])


L_POLYGON = [(0, 0), (3, 0), (3, 1), (1, 1), (1, 3), (0, 3)]
L_TRIANGLES = [(0, 1, 3), (1, 2, 3), (0, 3, 5), (3, 4, 5)]


def l_prism() -> Triangles:
    """The L of arms 3 and width 1, height 1."""
    return extrude(L_POLYGON, L_TRIANGLES, 1.0)


def tetrahedron(corners) -> Triangles:
    """Tetrahedron of four corners, facing outward if the last is on the positive side of the first three."""
    return np.asarray(corners, np.float64), np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])


def spike() -> Triangles:
    """Pyramid of height 3 over a unit square around the origin, its tip up."""
    square = [[-0.5, -0.5, 0], [0.5, -0.5, 0], [0.5, 0.5, 0], [-0.5, 0.5, 0]]
    faces = [[0, 2, 1], [0, 3, 2], [0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]]
    return np.array([*square, [0, 0, 3]], np.float64), np.array(faces)


def wedge() -> Triangles:
    """Prism over a triangle: base 1 along x and 2 along y, height 3, its edge up."""
    x = [-0.5, 0.5, 0.0]
    z = [0.0, 0.0, 3.0]
    ends = [[[x[k], y, z[k]] for k in range(3)] for y in (-1.0, 1.0)]
    faces = [[0, 1, 2], [3, 5, 4], [0, 3, 4], [0, 4, 1], [1, 4, 5], [1, 5, 2], [2, 5, 3], [2, 3, 0]]
    return np.array(ends[0] + ends[1], np.float64), np.array(faces)


def in_portions(function, points, triangles):
    """Apply a function of (p, 3) points and (m, 3, 3) triangles to points, in portions that fit into a cache."""
    portion = max(1, 20_000 // len(triangles))
    return np.concatenate([function(points[i : i + portion], triangles) for i in range(0, len(points), portion)])


def winding(points, triangles):
    """Winding number of each point: the sum of the triangles' solid angles over 4 pi."""
    return in_portions(_winding, points, triangles)


def _winding(points, triangles):
    # Each component is an array of its own: NumPy is slow along axes of three elements.
    a, b, c = ([triangles[:, corner, i] - points[:, i, None] for i in range(3)] for corner in range(3))
    la, lb, lc = (np.sqrt(_dot(v, v)) for v in (a, b, c))
    ab, bc, ca = _dot(a, b), _dot(b, c), _dot(c, a)
    top = _dot(a, [b[1] * c[2] - b[2] * c[1], b[2] * c[0] - b[0] * c[2], b[0] * c[1] - b[1] * c[0]])
    bottom = la * lb * lc + ab * lc + bc * la + ca * lb
    return 2.0 * np.arctan2(top, bottom).sum(axis=1) / (4.0 * np.pi)


def _dot(v, w):
    return v[0] * w[0] + v[1] * w[1] + v[2] * w[2]
