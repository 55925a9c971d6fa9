"""Benchmark cases: a table of scenes, each with its builder, the starts of its environments and where bodies belong."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property, partial
from typing import Any

import numpy as np

from warp_rigid import scenes
from warp_rigid.checks import shown, suggestion, whole_in
from warp_rigid.engine.simulator import Simulator
from warp_rigid.runs.runner import find_scene
from warp_rigid.scene.scene import Motion, Scene
from warp_rigid.scene.shapes import Box
from warp_rigid.scene.shapes.base import Shape
from warp_rigid.scenes import rings_on_poles
from warp_rigid.scenes.builders import arms, grounds, meshes, piles, stacks
from warp_rigid.scenes.builders.bodies import add_bodies
from warp_rigid.scenes.demo import start_apart

STANDARD = ("stack:10", "pile_box:32", "pile_torus:16", "pile_bunny:8", "rings:12")
"""Cases that are measured by default."""
EDGE, GAP = 0.2, 0.001
"""Edge of a cube, and vertical distance of the cubes of a stack at the start [m]."""
FRICTION, DENSITY = 0.5, 1000.0
FIRST_SEED = 1000
"""The start of environment e of a pile is drawn from seed FIRST_SEED + e."""
MARGIN = 0.05
"""A body has escaped if it is this far outside its bin [m]."""
PYRAMID_HALF, PYRAMID_FRICTION, PYRAMID_DENSITY = 0.5, 0.6, 100.0
"""Half of the width of a cube of the pyramid [m], friction and density, as in Box3D's benchmark large_pyramid."""


@dataclass(frozen=True)
class BenchmarkScene:
    """One row of the table of scenes.

    Attributes:
        build: function(bodies) -> Scene; the start is that of environment 0.
        half_width: function(bodies) -> horizontal distance beyond which a body has escaped [m]: along x or y from the
            z axis, or from its place at rest where that is known; None if the scene does not say where bodies belong.
        vary: function(sim, bodies) that gives environments different starts, or different targets of their drives;
            None if they start alike.
        rest: function(bodies) -> (bodies, 3) positions of the bodies at rest [m]; None where they are not known.
        max_bodies: largest number of bodies.
    """

    build: Callable[[int], Scene]
    half_width: Callable[[int], float] | None
    vary: Callable[[Simulator, int], None] | None = None
    rest: Callable[[int], np.ndarray] | None = None
    max_bodies: int = piles.MOST_BODIES


@dataclass(frozen=True)
class BenchmarkCase:
    """One scene at one size.

    Attributes:
        name: key of SCENES, or a built-in scene or the path of a .py file, with its default parameters.
        size: dynamic bodies in an environment; 0 where the scene with its default parameters determines them.
    """

    name: str
    size: int = 0

    @cached_property
    def bodies(self) -> int:
        """Dynamic bodies in an environment."""
        return self.size or len(moving(self.build()))

    def __str__(self) -> str:
        """As on the command line."""
        return f"{self.name}:{self.bodies}" if self.name in SCENES else self.name

    @property
    def scene(self) -> BenchmarkScene:
        """The row of the table, or one made of the scene."""
        return SCENES[self.name] if self.name in SCENES else _row_of_demo(self.name)

    def build(self) -> Scene:
        """The scene, with the start of environment 0."""
        return self.scene.build(self.size)

    def scatter(self, sim: Simulator) -> None:
        """Give each environment a different start, or different targets of its drives, where the scene has several."""
        if self.scene.vary is not None:
            self.scene.vary(sim, self.bodies)

    def escaped(self, position: np.ndarray) -> int:
        """Number of bodies outside the region that the scene allows; a position that is not finite counts as outside.

        Args:
            position: (envs, bodies, 3) of the dynamic bodies [m].
        """
        inside, moved = np.isfinite(position).all(axis=-1), self.displacement(position)
        if self.scene.half_width is not None:
            half_width = self.scene.half_width(self.bodies)
            if moved is not None:
                inside &= np.linalg.norm(moved[..., :2], axis=-1) < half_width
            else:
                inside &= (np.abs(position[..., :2]).max(axis=-1) < half_width) & (position[..., 2] > -MARGIN)
        return int((~inside).sum())

    def displacement(self, position: np.ndarray) -> np.ndarray | None:
        """Positions of the bodies relative to those at rest, (envs, bodies, 3) [m]; None where these are not known."""
        return None if self.scene.rest is None else position - self.scene.rest(self.bodies)


def find_case(text: str) -> BenchmarkCase:
    """Parse a case such as "stack:10", or the name or .py file of a scene.

    Raises:
        ValueError: There is no such scene, or the number of bodies is missing or out of range.
    """
    if text.endswith(".py") or text in scenes.names():
        return BenchmarkCase(text)
    name, _, count = text.partition(":")
    if name not in SCENES:
        where = f"{', '.join(SCENES)} and those of warp-rigid scenes"
        raise ValueError(
            "SCENE: must be a name and a number of bodies, such as stack:10, a built-in scene or a .py file, got "
            f"{shown(text)}{suggestion(name, (*SCENES, *scenes.names()), where)}"
        )
    if not count.isdigit():
        raise ValueError(f"SCENE: must be a name and a number of bodies, such as stack:10, got {text!r}")
    return BenchmarkCase(name, whole_in(f"SCENE: bodies of {name}", int(count), 1, SCENES[name].max_bodies))


@cache
def _row_of_demo(name: str) -> BenchmarkScene:
    """A built-in scene, or one from a user's file, with its default parameters."""
    demo = find_scene(name)

    def vary(sim: Simulator, _: int) -> None:
        if demo.vary is not None and sim.num_envs > 1:
            demo.vary(sim, **demo.parameters)

    return BenchmarkScene(lambda _: demo.build(), half_width=None, vary=vary)


def moving(scene: Scene) -> list[int]:
    """Indices of the dynamic bodies."""
    return [i for i, body in enumerate(scene.bodies) if body.motion == Motion.DYNAMIC]


def _on_ground(add: Callable[..., Any], friction: float = FRICTION, density: float = DENSITY) -> Callable[[int], Scene]:
    """A function of the number of bodies that builds level ground and the bodies that `add` adds to the scene."""

    def build(bodies: int) -> Scene:
        scene = grounds.level_scene(friction=friction)
        add(scene, bodies, density=density, friction=friction)
        return scene

    return build


def _pyramid_rest(cubes: int) -> np.ndarray:
    """The lowest cubes of the smallest pyramid that has enough of them."""
    rows = math.ceil((math.sqrt(8.0 * cubes + 1.0) - 1.0) / 2.0)
    return stacks.pyramid(rows, PYRAMID_HALF)[:cubes]


def _apart(starts: Callable[[int, int], tuple[np.ndarray, ...]]) -> Callable[[Simulator, int], None]:
    """A `vary` by the starts (positions, orientations) for a number of bodies and an environment."""
    return lambda sim, bodies: start_apart(sim, moving(sim.scene), partial(starts, bodies))


def _vary_arm(sim: Simulator, links: int) -> None:
    targets = [arms.targets(links, FIRST_SEED + env) for env in range(sim.num_envs)]
    sim.set("joint_target_position", np.array(targets))


def _pile_of(shape: Callable[[], Shape]) -> BenchmarkScene:
    def add(scene: Scene, bodies: int, friction: float, density: float) -> None:
        piles.add_pile_bin(scene, bodies, friction=friction)
        add_bodies(scene, shape(), *piles.starts(bodies, FIRST_SEED), density=density, friction=friction)

    starts = _apart(lambda bodies, env: piles.starts(bodies, FIRST_SEED + env))
    return BenchmarkScene(_on_ground(add), lambda bodies: piles.inner_half(bodies) + MARGIN, starts)


def _poles_a_side(rings: int) -> int:
    """The 5 x 5 poles of the 2003 paper from 500 rings on, fewer for fewer rings."""
    return max(2, min(5, math.ceil(math.sqrt(rings / 20.0))))


SCENES: dict[str, BenchmarkScene] = {
    "stack": BenchmarkScene(
        _on_ground(lambda scene, n, **own: add_bodies(scene, stacks.CUBE, stacks.column(n, gap=GAP), **own)),
        half_width=lambda cubes: 0.5 * EDGE,
        rest=stacks.column,
    ),
    "pile_box": _pile_of(lambda: stacks.CUBE),
    "pile_torus": _pile_of(meshes.torus),
    "pile_bunny": _pile_of(lambda: meshes.bunny(EDGE)),
    "rings": BenchmarkScene(
        lambda rings: rings_on_poles.build(rings, _poles_a_side(rings) ** 2),
        half_width=lambda rings: rings_on_poles.LOST * rings_on_poles.CYLINDER_A_SIDE * _poles_a_side(rings),
        vary=_apart(lambda rings, env: rings_on_poles.starts(rings, _poles_a_side(rings) ** 2, env)),
        max_bodies=2000,
    ),
    "pyramid": BenchmarkScene(
        _on_ground(
            lambda scene, cubes, **own: add_bodies(scene, Box((PYRAMID_HALF,) * 3), _pyramid_rest(cubes), **own),
            PYRAMID_FRICTION,
            PYRAMID_DENSITY,
        ),
        half_width=lambda cubes: PYRAMID_HALF,
        rest=_pyramid_rest,
    ),
    "kapla": BenchmarkScene(
        _on_ground(lambda scene, n, **own: add_bodies(scene, Box(stacks.BRICK), *stacks.brick_tower(n), **own)),
        half_width=lambda bricks: stacks.BRICK[1],
        rest=lambda bricks: stacks.brick_tower(bricks)[0],
    ),
    "arm": BenchmarkScene(
        _on_ground(arms.add_arm),
        half_width=lambda links: arms.PITCH * links + MARGIN,
        vary=_vary_arm,
        max_bodies=100,
    ),
}
"""Scenes by name."""
