"""Ray casting from the page to a body: sphere tracing in the signed distance of the body."""

from collections.abc import Sequence

import numpy as np

from warp_rigid.rotations import inverse, rotate
from warp_rigid.scene.shapes.base import Shape

MOST_STEPS = 200
NEAR = 1.0e-3
"""A point counts as on the surface within this part of the shape's size."""
CAUTION = 0.9
"""Part of the distance that a step goes: an interpolated distance may be a little too long."""


def first_hit(
    shapes: Sequence[Shape], position: np.ndarray, orientation: np.ndarray, origin: np.ndarray, direction: np.ndarray
) -> tuple[int, np.ndarray] | None:
    """The first body of finite size that a ray hits, and where; None if it hits none.

    Args:
        shapes: of the bodies.
        position: (bodies, 3) of the bodies [m].
        orientation: (bodies, 4) of the bodies, quaternions (x, y, z, w).
        origin: (3,) where the ray starts [m].
        direction: (3,) of the ray, any length.
    """
    ahead = np.asarray(direction, np.float64) / np.linalg.norm(direction)
    bounds = np.array([np.asarray(shape.bounds) for shape in shapes])
    finite = np.isfinite(bounds).all(axis=(1, 2))
    bounds = np.where(finite[:, None, None], bounds, 0.0)
    radius = 0.5 * np.linalg.norm(np.ptp(bounds, axis=1), axis=1)
    middle = bounds.mean(axis=1)
    away = rotate(orientation.astype(np.float64), middle) + position - origin
    along = away @ ahead
    near = finite & (np.linalg.norm(away - along[:, None] * ahead, axis=1) <= radius) & (along > -radius)
    found, nearest = None, np.inf
    for body in np.flatnonzero(near)[np.argsort((along - radius)[near])].tolist():
        if along[body] - radius[body] > nearest:
            break
        point, hit = trace(shapes[body], position[body], orientation[body], origin, ahead)
        distance = float((point - origin) @ ahead)
        if hit and distance < nearest:
            found, nearest = (body, point), distance
    return found


def trace(shape: Shape, position, orientation, origin, direction) -> tuple[np.ndarray, bool]:
    """Follow a ray to a body's surface.

    Args:
        shape: of the body.
        position: (3,) of the body [m].
        orientation: (4,) of the body, quaternion (x, y, z, w).
        origin: (3,) where the ray starts, in the world [m].
        direction: (3,) of the ray, any length.

    Returns:
        The first point of the surface on the ray, in the world, and True; or the point of the ray nearest to the
        surface, and False.
    """
    orientation = np.asarray(orientation, np.float64)
    back = inverse(orientation)
    start = rotate(back, np.asarray(origin, np.float64) - position)
    ahead = rotate(back, np.asarray(direction, np.float64) / np.linalg.norm(direction))
    lower, upper = (np.clip(corner, -1.0e6, 1.0e6) for corner in shape.bounds)
    tolerance = NEAR * min(shape.size, 1.0)
    t, end = _through_box(start, ahead, lower - tolerance, upper + tolerance)
    nearest, nearest_t = np.inf, t
    for _ in range(MOST_STEPS):
        distance = float(shape.signed_distance(start + t * ahead)[0][0])
        if distance < nearest:
            nearest, nearest_t = distance, t
        if distance < tolerance or t > end:
            break
        t += max(CAUTION * distance, 0.5 * tolerance)
    return rotate(orientation, start + nearest_t * ahead) + position, nearest < tolerance


def _through_box(start, ahead, lower, upper) -> tuple[float, float]:
    """Where the ray enters and leaves a box; past its nearest approach to the middle where it misses."""
    with np.errstate(divide="ignore", invalid="ignore"):
        one, other = (lower - start) / ahead, (upper - start) / ahead
    enter = max(float(np.nanmax(np.minimum(one, other))), 0.0)
    leave = float(np.nanmin(np.maximum(one, other)))
    if leave >= enter:
        return enter, leave
    middle = max(float(np.dot(0.5 * (lower + upper) - start, ahead)), 0.0)
    return middle, middle
