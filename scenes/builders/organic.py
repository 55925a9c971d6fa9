"""Procedural surfaces of two organic shapes: a skull-like shell and a brain-like solid.

Both are spheres of directions whose radius is modified by ellipsoids, dents and bumps. Units are
arbitrary; x points forward, y to the left, z up.
"""

import numpy as np

from warp_rigid.scene.shapes import tessellation

SKULL_FREQUENCY = 14  # 3920 triangles before the openings are cut
BRAIN_FREQUENCY = 20  # 8000 triangles


def skull() -> tuple[np.ndarray, np.ndarray]:
    """An open shell with eye sockets, nose and mouth, open below: vertices (n, 3), faces (m, 3)."""
    directions, faces = tessellation.geodesic(SKULL_FREQUENCY)
    directions = _normalized(directions + TOWARD_FACE)
    for _ in range(4):
        for opening in SKULL_OPENINGS:
            directions = _snap(directions, opening)
    inside = np.min([opening(directions) for opening in SKULL_OPENINGS], axis=0) < 0.02
    faces = faces[~inside[faces].all(axis=1)]
    used, faces = np.unique(faces, return_inverse=True)
    directions = directions[used]
    return directions * skull_radius(directions)[:, None], faces.reshape(-1, 3).astype(np.int32)


def brain() -> tuple[np.ndarray, np.ndarray]:
    """A closed surface of two folded halves with a small brain: vertices (n, 3), faces (m, 3)."""
    directions, faces = tessellation.geodesic(BRAIN_FREQUENCY)
    return directions * _brain_radius(directions)[:, None], faces


def _normalized(vectors) -> np.ndarray:
    vectors = np.asarray(vectors, dtype=np.float64)
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def _mirrored(directions: np.ndarray) -> np.ndarray:
    """Directions with those on the right moved to the left."""
    return directions * np.where(directions[:, 1:2] < 0.0, [1.0, -1.0, 1.0], [1.0, 1.0, 1.0])


def _oval(center, half_width: float, half_height: float, taper: float = 0.0):
    """Function of directions, negative within an oval around a direction and its mirror image.

    Args:
        center: direction of the middle; on the left, or in the middle plane.
        half_width: tangent of the angle from the middle to the side.
        half_height: tangent of the angle from the middle to the top.
        taper: how much narrower the oval is at its top, and wider at its bottom.
    """
    forward = _normalized(center)
    left = _normalized(np.cross([0.0, 0.0, 1.0], forward))
    up = np.cross(forward, left)

    def opening(directions: np.ndarray) -> np.ndarray:
        nearest = directions if center[1] == 0.0 else _mirrored(directions)
        ahead = np.maximum(nearest @ forward, 1e-3)
        above = nearest @ up / ahead / half_height
        across = nearest @ left / ahead / half_width
        return np.hypot(across / (1.0 - taper * np.clip(above, -1.0, 1.0)), above) - 1.0

    return opening


def _snap(directions: np.ndarray, opening) -> np.ndarray:
    """Move directions near an opening's rim onto the rim, so that the cut is smooth."""
    step = 1e-4
    value = opening(directions)
    slope = np.stack([(opening(directions + step * axis) - value) / step for axis in np.eye(3)], axis=1)
    slope -= np.einsum("ij,ij->i", slope, directions)[:, None] * directions
    steepness = np.maximum(np.einsum("ij,ij->i", slope, slope), 1e-9)
    move = -(value / steepness)[:, None] * slope
    near = np.linalg.norm(move, axis=1) < RIM_REACH
    return _normalized(np.where(near[:, None], directions + move, directions))


TOWARD_FACE = np.array([0.45, 0.0, -0.25])  # crowds the sphere's vertices where the detail is
RIM_REACH = 0.032  # a little over half of a triangle's side there, in radians
EYE = (1.0, 0.41, -0.02)
NOSE = (1.0, 0.0, -0.42)
MOUTH = (1.0, 0.0, -0.98)
SKULL_OPENINGS = (
    _oval(EYE, 0.20, 0.19),
    _oval(NOSE, 0.085, 0.14, taper=0.45),
    _oval(MOUTH, 0.46, 0.055),
    _oval((-0.25, 0.0, -1.0), 0.50, 0.42),
)


def _bump(directions: np.ndarray, center, width: float, steep: int = 2) -> np.ndarray:
    """Bell of height 1 around a direction on the left (or in the middle) and its mirror image.

    Args:
        directions: (n, 3) unit vectors.
        center: direction of the middle.
        width: angle at which the bell has decreased to 1 / e [rad].
        steep: even power of the angle; larger makes a flatter top and steeper sides.
    """
    angle = np.arccos(np.clip(_mirrored(directions) @ _normalized(center), -1.0, 1.0))
    return np.exp(-((angle / width) ** steep))


def _ellipsoid(directions: np.ndarray, center, semi_axes) -> np.ndarray:
    """Distance from the origin, which is inside, to the surface of an ellipsoid along each direction."""
    scaled = directions / semi_axes
    offset = np.asarray(center, dtype=np.float64) / semi_axes
    square = np.einsum("ij,ij->i", scaled, scaled)
    along = scaled @ offset
    return (along + np.sqrt(np.maximum(along**2 - square * (offset @ offset - 1.0), 0.0))) / square


def _smooth_union(*radii: np.ndarray, sharpness: float) -> np.ndarray:
    """The largest of several radii, blended over differences of about 1 / sharpness."""
    return np.logaddexp.reduce([sharpness * radius for radius in radii]) / sharpness


def skull_radius(directions: np.ndarray) -> np.ndarray:
    """Distance of the skull's surface from its middle along unit directions (n, 3), (n,)."""
    cranium = _ellipsoid(directions, (-0.09, 0.0, 0.15), np.array([0.54, 0.40, 0.40]))
    face = _ellipsoid(directions, (0.20, 0.0, -0.24), np.array([0.27, 0.27, 0.41]))
    radius = _smooth_union(cranium, face, sharpness=30.0)
    radius += 0.030 * _bump(directions, (1.0, 0.42, 0.30), 0.20)  # brow
    radius += 0.080 * _bump(directions, (0.80, 0.62, -0.24), 0.17)  # cheek bone
    radius += 0.050 * _bump(directions, (1.0, 0.0, -0.14), 0.10)  # bridge of the nose
    radius += 0.035 * _bump(directions, (1.0, 0.0, -0.80), 0.30)  # jaws
    radius += 0.045 * _bump(directions, (0.75, 0.0, -1.05), 0.18)  # chin
    radius += 0.060 * _bump(directions, (0.35, 0.55, -0.85), 0.20)  # angle of the jaw
    radius -= 0.050 * _bump(directions, (0.45, 1.0, 0.10), 0.25)  # temple
    radius -= 0.060 * _bump(directions, (0.70, 0.55, -0.62), 0.15)  # hollow of the cheek
    radius -= 0.110 * _bump(directions, EYE, 0.245, steep=8)
    radius -= 0.050 * _bump(directions, NOSE, 0.14, steep=4)
    radius += _teeth(directions)
    return radius


def _teeth(directions: np.ndarray) -> np.ndarray:
    """Upright ridges along both lips of the mouth."""
    forward = _normalized(MOUTH)
    up = np.cross(forward, [0.0, 1.0, 0.0])
    ahead = np.maximum(directions @ forward, 1e-3)
    across, above = directions[:, 1] / ahead, directions @ up / ahead
    row = np.exp(-((above / 0.16) ** 6) - (across / 0.42) ** 8)
    return row * (0.01 + 0.012 * np.cos(2.0 * np.pi * across / 0.12))


def _brain_radius(directions: np.ndarray) -> np.ndarray:
    _, y, z = directions.T
    halves = _ellipsoid(directions, (0.0, 0.0, 0.06), np.array([0.62, 0.50, 0.44]))
    small = _ellipsoid(directions, (-0.34, 0.0, -0.24), np.array([0.26, 0.34, 0.17]))
    furrow = np.exp(-((_folds(directions) / 0.42) ** 2))
    radius = halves * (1.0 - 0.10 * furrow)
    radius *= 1.0 - 0.24 * np.exp(-((y / 0.07) ** 2)) / (1.0 + np.exp(-25.0 * (z + 0.4)))
    radius += 0.03 * _bump(directions, (0.35, 1.0, -0.45), 0.35)
    radius -= 0.07 * _bump(directions, (0.75, 0.75, -0.35), 0.10)
    leaves = 1.0 - 0.05 * np.exp(-((np.sin(34.0 * z) / 0.5) ** 2))
    below = np.where(small > halves, small * leaves, 0.0)
    return np.maximum(radius, below)


def _folds(directions: np.ndarray) -> np.ndarray:
    """A random wave field of one wavelength, whose zero lines are used as the furrows of the brain."""
    generator = np.random.default_rng(7)
    waves = generator.normal(size=(40, 3))
    waves *= 15.0 / np.linalg.norm(waves, axis=1, keepdims=True)
    phases = generator.uniform(0.0, 2.0 * np.pi, 40)
    return np.cos(directions @ waves.T + phases).sum(axis=1) / np.sqrt(20.0)
