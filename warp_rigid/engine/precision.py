"""What single precision does not carry, refused before a simulation starts."""

from collections.abc import Iterable

import numpy as np

from warp_rigid import rotations
from warp_rigid.scene.body_columns import column, extents, is_dynamic, shapes_of
from warp_rigid.scene.scene import Motion, Scene
from warp_rigid.scene.shapes import Plane

MOST_MASS_RATIO = 1e6
"""Largest ratio of the masses of two dynamic bodies; at 1e7 a heavy body squeezes out a light one that carries it."""
MOST_MOMENT_RATIO = 2.0**24
"""Largest ratio of the moments of inertia of a body: the number of steps between 1 and 2 in single precision, twice."""
LARGEST_STEP = 5e-3
"""Largest distance of neighbouring positions in single precision, relative to the size of a body."""


def check_precision(scene: Scene) -> None:
    """Check that the bodies of a scene can be simulated in single precision.

    Raises:
        ValueError: The masses of the dynamic bodies or the moments of inertia of one differ too much, or a body that
            does not move is too far from the origin along gravity for the smallest dynamic body to rest on it.
    """
    dynamic = np.flatnonzero(is_dynamic(scene.bodies))
    check_mass_ratio(column(scene.bodies, "mass")[dynamic].tolist())
    shapes, shape_of = shapes_of(scene.bodies)
    used, first = np.unique(shape_of[dynamic], return_index=True)
    for index, which in sorted(zip(dynamic[first].tolist(), used.tolist(), strict=True)):
        moments = shapes[which].moments
        if moments[2] > MOST_MOMENT_RATIO * moments[0]:
            raise ValueError(
                f"body {index} ({scene.bodies[index].name}): must have moments of inertia that differ by at most a "
                f"factor of {MOST_MOMENT_RATIO:.3g}, got {moments[2] / moments[0]:.3g}; a thicker shape "
                "has a smaller one"
            )
    if len(used):
        _check_heights(scene, float(extents([shapes[which] for which in used]).max(axis=1).min()))


def _check_heights(scene: Scene, size: float) -> None:
    """Check the height of the bodies that do not move, for dynamic bodies of a size [m]."""
    strength = float(np.linalg.norm(scene.gravity))
    down = np.array(scene.gravity) / strength if strength > 0.0 else np.zeros(3)
    for index, body in enumerate(scene.bodies):
        if body.motion == Motion.DYNAMIC:
            continue
        place = np.array(body.position, dtype=np.float64)
        if isinstance(body.shape, Plane):
            place = place + rotations.matrix(np.array(body.orientation)) @ (body.shape.offset * body.shape.normal)
        step = float(np.spacing(np.float32(abs(place @ down))))
        if step > LARGEST_STEP * size:
            raise ValueError(
                f"body {index} ({body.name}): must be closer to the origin along gravity, got {place @ down:.6g} m; "
                f"heights there are multiples of {step:.2g} m in single precision, too coarse for {size:.3g} m"
            )


def check_mass_ratio(masses: Iterable[float]) -> None:
    """Check the ratio of the masses of the dynamic bodies of an environment [kg].

    Raises:
        ValueError: It is too large.
    """
    found = list(masses)
    if found and max(found) > 1.0001 * MOST_MASS_RATIO * min(found):
        raise ValueError(
            f"mass: the heaviest dynamic body must have at most {MOST_MASS_RATIO:g} times the mass of the lightest, "
            f"got {max(found):g} kg and {min(found):g} kg; a body that does not move can be static or kinematic"
        )
