"""Scenes of the benchmarks, by name and number of bodies."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from warp_rigid.checks import one_of, whole_in
from warp_rigid.engine.simulator import Simulator
from warp_rigid.scene.scene import Motion, Scene
from warp_rigid.scene.shapes import Box, Plane
from warp_rigid.scenes import rings_on_poles
from warp_rigid.scenes.builders import meshes, piles

STANDARD = ("stack:10", "pile_box:32", "pile_torus:16", "pile_bunny:8", "rings:12")
"""What is measured unless something else is asked for."""
EDGE, GAP = 0.2, 0.001
"""Edge of a cube, and what is between two of a stack at the start [m]."""
FRICTION, DENSITY = 0.5, 1000.0
FIRST_SEED = 1000
"""Environment e of a pile draws its start from this seed + e."""
MARGIN = 0.05
"""A body this far outside its box has escaped [m]."""


@dataclass(frozen=True)
class Case:
    """One scene at one size.

    Attributes:
        name: "stack", "pile_box", "pile_torus", "pile_bunny" or "rings".
        bodies: dynamic bodies in an environment.
    """

    name: str
    bodies: int

    def __str__(self) -> str:
        """As on the command line."""
        return f"{self.name}:{self.bodies}"

    def build(self) -> Scene:
        """The scene, as environment 0 starts."""
        return _BUILDERS[self.name](self.bodies)

    def scatter(self, sim: Simulator) -> None:
        """Start every environment in its own way, where the scene has several."""
        starts = _STARTS.get(self.name)
        if starts is not None:
            drawn = [starts(self.bodies, env) for env in range(sim.num_envs)]
            rows = moving(sim.scene)
            sim.set("position", np.array([position for position, _ in drawn]), bodies=rows)
            sim.set("orientation", np.array([orientation for _, orientation in drawn]), bodies=rows)

    def escaped(self, position: np.ndarray) -> int:
        """How many bodies are not where the scene can have them; one that is not a number is not.

        Args:
            position: (envs, bodies, 3) of the dynamic bodies [m].
        """
        if self.name == "stack":
            return int((~(np.abs(self.drift(position)) < 0.5 * EDGE)).sum())
        if self.name == "rings":
            bound = rings_on_poles.LOST * rings_on_poles.CYLINDER_A_SIDE * _poles_a_side(self.bodies)
        else:
            bound = piles.inner_half(self.bodies) + MARGIN
        inside = (np.abs(position[..., :2]).max(axis=-1) < bound) & (position[..., 2] > -MARGIN)
        return int((~inside).sum())

    def drift(self, position: np.ndarray) -> np.ndarray:
        """How far the cubes of a stack are from its axis, (envs, bodies) [m]."""
        return np.linalg.norm(position[..., :2], axis=-1)

    def height_error(self, position: np.ndarray) -> np.ndarray:
        """How far above their rest the cubes of a stack are, (envs, bodies) [m]."""
        return position[..., 2] - EDGE * (np.arange(self.bodies) + 0.5)


def find_case(text: str) -> Case:
    """The case that a text such as "stack:10" names.

    Raises:
        ValueError: There is no such scene, or the number of bodies is missing or out of range.
    """
    name, _, count = text.partition(":")
    one_of("SCENE", name, tuple(_BUILDERS))
    if not count.isdigit():
        raise ValueError(f"SCENE: must be a name and a number of bodies, such as stack:10, got {text!r}")
    most = 2000 if name == "rings" else piles.MOST_BODIES
    return Case(name, whole_in(f"SCENE: bodies of {name}", int(count), 1, most))


def moving(scene: Scene) -> list[int]:
    """Indices of the dynamic bodies."""
    return [i for i, body in enumerate(scene.bodies) if body.motion == Motion.DYNAMIC]


def _stack(bodies: int) -> Scene:
    scene = _ground()
    cube = Box((0.5 * EDGE,) * 3)
    for i in range(bodies):
        height = 0.5 * EDGE + GAP + i * (EDGE + GAP)
        scene.add_body(cube, position=(0.0, 0.0, height), density=DENSITY, friction=FRICTION)
    return scene


def _pile(shape: Callable[[], Any]) -> Callable[[int], Scene]:
    def build(bodies: int) -> Scene:
        scene, made = _ground(), shape()
        for center, half_extents in piles.walls(bodies):
            scene.add_static(Box(half_extents), position=center, friction=FRICTION)
        for place, turned in zip(*piles.starts(bodies, FIRST_SEED), strict=True):
            scene.add_body(made, position=place, orientation=turned, density=DENSITY, friction=FRICTION)
        return scene

    return build


def _ground() -> Scene:
    scene = Scene()
    scene.add_static(Plane(normal=(0, 0, 1), offset=0.0), friction=FRICTION)
    return scene


def _poles_a_side(rings: int) -> int:
    """The paper's 5 x 5 poles from 500 rings on, fewer for fewer rings."""
    return max(2, min(5, math.ceil(math.sqrt(rings / 20.0))))


def _pile_starts(bodies: int, env: int) -> tuple[np.ndarray, np.ndarray]:
    return piles.starts(bodies, FIRST_SEED + env)


_BUILDERS: dict[str, Callable[[int], Scene]] = {
    "stack": _stack,
    "pile_box": _pile(lambda: Box((0.5 * EDGE,) * 3)),
    "pile_torus": _pile(meshes.torus),
    "pile_bunny": _pile(lambda: meshes.bunny(EDGE)),
    "rings": lambda rings: rings_on_poles.build(rings, _poles_a_side(rings) ** 2),
}
_STARTS: dict[str, Callable[[int, int], tuple[np.ndarray, np.ndarray]]] = {
    "pile_box": _pile_starts,
    "pile_torus": _pile_starts,
    "pile_bunny": _pile_starts,
    "rings": lambda rings, env: rings_on_poles.starts(rings, _poles_a_side(rings), env),
}
