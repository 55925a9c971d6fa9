"""Ray casting from the page to the drawn bodies."""

import numpy as np

from warp_rigid.render.film import DrawnMesh, Film
from warp_rigid.rotations import inverse, rotate


def first_hit(film: Film, chosen: np.ndarray, origin: np.ndarray, direction: np.ndarray):
    """The first of some instances that a ray hits in the first frame of a film, and where.

    Args:
        film: the film.
        chosen: indices of the instances.
        origin: (3,) where the ray starts [m].
        direction: (3,) of the ray, any length.

    Returns:
        Index of the instance and point (3,) [m]; None if the ray hits none.
    """
    ahead = np.asarray(direction, np.float64) / np.linalg.norm(direction)
    position, orientation = film.position[0].astype(np.float64), film.orientation[0].astype(np.float64)
    radius = np.array([np.linalg.norm(mesh.vertices, axis=1).max() for mesh in film.meshes])[film.mesh[chosen]]
    away = position[chosen] - origin
    near = np.linalg.norm(away - (away @ ahead)[:, None] * ahead, axis=1) <= radius
    found, nearest = None, np.inf
    for i in chosen[near & film.present[0, chosen]].tolist():
        back = inverse(orientation[i])
        distance = _distance(film.meshes[film.mesh[i]], rotate(back, origin - position[i]), rotate(back, ahead))
        if distance < nearest:
            found, nearest = (i, origin + distance * ahead), distance
    return found


def _distance(mesh: DrawnMesh, start: np.ndarray, ahead: np.ndarray) -> float:
    """Distance along a ray to the first triangle, by Moeller and Trumbore [m]; infinite if it meets none."""
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces].astype(np.float64), 1, 0)
    first, second, offset = b - a, c - a, start - a
    across, turned = np.cross(ahead, second), np.cross(offset, first)
    with np.errstate(divide="ignore", invalid="ignore"):
        u, v, t = np.stack(
            [np.einsum("ij,ij->i", offset, across), turned @ ahead, np.einsum("ij,ij->i", second, turned)]
        ) / np.einsum("ij,ij->i", first, across)
    return float(t[(u >= 0.0) & (v >= 0.0) & (u + v <= 1.0) & (t > 0.0)].min(initial=np.inf))
