"""Random assortments of simple convex solids, the same for the same seed."""

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np

from warp_rigid.checks import number_in, one_of, whole_in
from warp_rigid.scene.shapes import Box, Sphere, tessellation
from warp_rigid.scene.shapes.base import Shape
from warp_rigid.scene.shapes.mesh import Mesh
from warp_rigid.scenes.builders import meshes

MOST_SEEDS = 2**32 - 1
SIZES = (0.75, 1.0, 1.25)
"""Few sizes, so that thousands of bodies share a small number of shapes."""

_RESOLUTION = 48


def _prism(radius, half_height):
    """A cylinder of twelve flat sides."""
    profile = [radius, radius], [-half_height, -half_height, half_height, half_height]
    return Mesh(*tessellation.revolve(*profile, 12), sdf_resolution=_RESOLUTION)


_MAKERS: dict[str, Callable[[float], Shape]] = {
    "cube": lambda radius: Box((radius / 3.0**0.5,) * 3),
    "sphere": lambda radius: Sphere(0.75 * radius),
    "octahedron": lambda radius: meshes.octahedron(radius, _RESOLUTION),
    "dodecahedron": lambda radius: meshes.dodecahedron(radius, _RESOLUTION),
    "tetrahedron": lambda radius: meshes.tetrahedron(radius, _RESOLUTION),
    "icosahedron": lambda radius: meshes.icosahedron(radius, _RESOLUTION),
    "cylinder": lambda radius: _prism(0.6 * radius, 0.8 * radius),
}

CONVEX_KINDS = tuple(_MAKERS)
"""Kinds that `convex_solid` accepts."""


def rough_surface(radius: float) -> dict[str, Any]:
    """Coefficients with which solids of a radius [m] come to rest soon."""
    resisting = {"rolling_friction": 0.15 * radius, "spinning_friction": 0.05 * radius}
    return {"friction": 0.9, "restitution": 0.1, **resisting}


@cache
def convex_solid(kind: str, radius: float) -> Shape:
    """A simple convex solid.

    Args:
        kind: one of CONVEX_KINDS.
        radius: of the sphere about the origin that encloses it [m].

    Raises:
        ValueError: There is no such kind, or the radius is not greater than 0.
    """
    return _MAKERS[one_of("kind", kind, CONVEX_KINDS)](number_in("radius", radius, above=0.0))


def convex_solids(count: int, seed: int, radius: float) -> list[Shape]:
    """Solids of random kinds in three sizes.

    Args:
        count: number of solids, 1 to 100 000.
        seed: 0 to 2^32 - 1; the same seed gives the same solids.
        radius: mean radius of the spheres that enclose them [m].

    Raises:
        ValueError: A number is out of its range.
    """
    count = whole_in("count", count, 1, 100_000)
    rng = np.random.default_rng(whole_in("seed", seed, 0, MOST_SEEDS))
    kinds = rng.integers(len(CONVEX_KINDS), size=count)
    sizes = rng.integers(len(SIZES), size=count)
    return [convex_solid(CONVEX_KINDS[kind], radius * SIZES[size]) for kind, size in zip(kinds, sizes, strict=True)]
