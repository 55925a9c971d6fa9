"""Add many bodies to a scene at once."""

from collections.abc import Iterable, Sequence
from typing import Any

from warp_rigid.scene.scene import Scene
from warp_rigid.scene.shapes.base import Shape


def add_bodies(
    scene: Scene,
    shapes: Shape | Sequence[Shape],
    positions: Iterable,
    orientations: Iterable | None = None,
    *,
    linear_velocities: Iterable | None = None,
    masses: Iterable[float] | None = None,
    names: str | Iterable[str] | None = None,
    **coefficients: Any,
) -> list[int]:
    """Add one dynamic body per position.

    Args:
        scene: the scene to which bodies are added.
        shapes: one shape for all bodies, or one for each.
        positions: (n, 3) [m], as `position` of `Scene.add_body`.
        orientations: (n, 4) quaternions (x, y, z, w); identity if None.
        linear_velocities: (n, 3) [m/s]; 0 if None.
        masses: (n,) [kg]; from the density if None.
        names: a prefix, which is followed by the number of the body from 0, or one name for each body; the scene's
            default names if None.
        **coefficients: further keywords of `Scene.add_body`, the same for all bodies.

    Returns:
        Indices of the bodies.
    """
    positions = list(positions)
    count = len(positions)
    columns = {
        "shape": [shapes] * count if isinstance(shapes, Shape) else shapes,
        "position": positions,
        "orientation": orientations,
        "linear_velocity": linear_velocities,
        "mass": masses,
        "name": [f"{names}_{i}" for i in range(count)] if isinstance(names, str) else names,
    }
    given = {name: column for name, column in columns.items() if column is not None}
    rows = zip(*given.values(), strict=True)
    return [scene.add_body(**dict(zip(given, row, strict=True)), **coefficients) for row in rows]
