"""Layout: the scene of each environment, and the ranges of its rows in the arrays of all environments.

Environments are stored one after another without gaps, also where their scenes differ in the number of bodies, fields,
filtered pairs or joints. An array of distinct scenes is computed once per scene and copied to its environments.
"""

from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any

import numpy as np

from warp_rigid.checks import shown, whole_in
from warp_rigid.engine import joints
from warp_rigid.kernels.common.crowd import CROWDED
from warp_rigid.scene.body_columns import is_dynamic, shapes_of
from warp_rigid.scene.look import check_looks
from warp_rigid.scene.scene import Body, Scene
from warp_rigid.scene.shapes import Box, Capsule, Compound, Cylinder, Heightfield, Mesh, Shape, Sphere
from warp_rigid.scene.shapes.heightfield import moves

MOST_ENVIRONMENTS = 10_000_000

LACKING = -1
"""Row index, and integer value, of a body that an environment lacks."""


class Layout:
    """Which scene each environment has, and where its rows begin.

    Args:
        scenes: the distinct scenes.
        scene_of: (envs,) index into `scenes` for each environment.

    Attributes:
        scenes: as given.
        scene_of: as given, int64.
        num_envs: number of environments.
        has_joints: whether an environment has joints.
        starts: for each symbol of `counts`, (envs + 1,) the first row of each environment; the last entry is their
            number.
    """

    def __init__(self, scenes: Sequence[Scene], scene_of: np.ndarray) -> None:
        """Sum the rows of the environments."""
        self.scenes, self.scene_of = tuple(scenes), np.asarray(scene_of, np.int64)
        self.num_envs = len(self.scene_of)
        counted = [counts(scene) for scene in self.scenes]
        self.starts = {
            symbol: exclusive_sums(np.array([some[symbol] for some in counted])[self.scene_of]) for symbol in counted[0]
        }
        self.has_joints = bool(self.starts[joints.NAME][-1])
        self.starts[joints.FROM_BODIES] = self.starts["bodies"] * self.has_joints

    @property
    def sizes(self) -> dict[str, int]:
        """Number of rows of all environments, by symbol."""
        return {"envs": self.num_envs, **{symbol: int(start[-1]) for symbol, start in self.starts.items()}}

    @property
    def first_body(self) -> np.ndarray:
        """First body of each environment, (envs + 1,); the last entry is the number of bodies."""
        return self.starts["bodies"]

    @cached_property
    def bodies_per_env(self) -> np.ndarray:
        """Number of bodies of each environment, (envs,)."""
        return np.diff(self.first_body)

    @cached_property
    def most_bodies(self) -> int:
        """Number of bodies of the largest environment."""
        return int(self.bodies_per_env.max())

    @property
    def is_crowded(self) -> bool:
        """Whether the largest environment may have islands that are solved in rounds."""
        return self.most_bodies > CROWDED

    @cached_property
    def has_many_samples(self) -> bool:
        """Whether a shape may have hundreds of samples: a mesh, a compound or a height field."""
        return any(isinstance(shape, Mesh | Compound | Heightfield) for shape in self.shapes)

    @cached_property
    def has_only_solids(self) -> bool:
        """Whether each shape is a convex solid (`is_solid` in convex.py). No compound counts as one."""
        return all(isinstance(shape, Sphere | Box | Capsule | Cylinder) or len(shape.hull) > 0 for shape in self.shapes)

    @cached_property
    def rows(self) -> np.ndarray:
        """Row of each body of each environment, (envs, most bodies); LACKING where an environment has no such body."""
        return self.table("bodies")

    def table(self, symbol: str) -> np.ndarray:
        """Rows that a symbol counts, (envs, most of an environment); LACKING where an environment has fewer."""
        start = self.starts[symbol]
        count = np.diff(start)
        index = np.arange(int(count.max()))
        rows = start[:-1, None] + index
        return rows if (count == count[0]).all() else np.where(index < count[:, None], rows, LACKING)

    def rows_of(self, symbol: str, chosen: np.ndarray) -> np.ndarray:
        """Rows that a symbol counts in the chosen environments, (n,)."""
        if symbol == "envs":
            return chosen
        rows = self.table(symbol)[chosen].ravel()
        return rows[rows != LACKING]

    @cached_property
    def env_of_row(self) -> np.ndarray:
        """Environment of each body, (bodies,)."""
        return np.repeat(np.arange(self.num_envs), self.bodies_per_env)

    @cached_property
    def scene_bodies(self) -> list[Body]:
        """The bodies of the distinct scenes, one scene after another."""
        return [body for scene in self.scenes for body in scene.bodies]

    @cached_property
    def shapes_of_bodies(self) -> tuple[list[Shape], np.ndarray]:
        """The distinct shapes of `scene_bodies`, and the index of that of each of them."""
        return shapes_of(self.scene_bodies)

    @property
    def shapes(self) -> list[Shape]:
        """The distinct shapes of all scenes."""
        return self.shapes_of_bodies[0]

    @cached_property
    def source(self) -> np.ndarray:
        """Index into `scene_bodies` for each body of all environments, (bodies,)."""
        return self.copies([len(scene.bodies) for scene in self.scenes])

    @cached_property
    def dynamic_per_env(self) -> np.ndarray:
        """Number of dynamic bodies of each environment, (envs,)."""
        found = [int(is_dynamic(scene.bodies).sum()) for scene in self.scenes]
        return np.array(found)[self.scene_of]

    def copies(self, lengths: Sequence[int]) -> np.ndarray:
        """Indices that copy a list from the scenes to the environments.

        Args:
            lengths: number of consecutive entries of each scene in the list.

        Returns:
            For each entry of all environments its index in the list.
        """
        length = np.asarray(lengths, np.int64)
        first, count = exclusive_sums(length)[self.scene_of], length[self.scene_of]
        offset = np.arange(count.sum()) - np.repeat(exclusive_sums(count)[:-1], count)
        return np.repeat(first, count) + offset

    def entries(self, of_scene: Callable[[Scene], Sequence]) -> tuple[list, np.ndarray]:
        """Entries of the distinct scenes, one scene after another, and the index of each entry of all environments."""
        parts = [list(of_scene(scene)) for scene in self.scenes]
        return [entry for part in parts for entry in part], self.copies([len(part) for part in parts])

    def by_environment(self, values: np.ndarray) -> np.ndarray:
        """Rows of all bodies as (envs, most bodies, ...); NaN, False or LACKING where an environment has no body."""
        if (self.bodies_per_env == self.bodies_per_env[0]).all():  # a view
            return values.reshape(self.num_envs, self.most_bodies, *values.shape[1:])
        return spread_rows(values, self.rows)

    def ranges(self, first: int, end: int) -> dict[str, tuple[int, int]]:
        """Rows of the environments from `first` to before `end`, by the symbol that counts them."""
        found = {symbol: (int(start[first]), int(start[end])) for symbol, start in self.starts.items()}
        return {"envs": (first, end), **found}

    def part(self, first: int, end: int) -> "Layout":
        """The layout of the environments from `first` to before `end`."""
        used, scene_of = np.unique(self.scene_of[first:end], return_inverse=True)
        return Layout([self.scenes[index] for index in used], scene_of)


def layout_of(scene: Any, num_envs: int) -> Layout:
    """The layout of the arguments of a Simulator.

    Args:
        scene: a Scene, or a sequence of scenes.
        num_envs: number of environments of each scene; environment e has scene e modulo their number.

    Raises:
        ValueError: there is no scene, one of them is no Scene, has no bodies or a wrong look, or num_envs is out of
            range.
    """
    given = [scene] if isinstance(scene, Scene) else scene
    if not isinstance(given, list | tuple) or not given:
        raise ValueError(f"scene: must be a Scene or a list of at least one Scene, got {shown(scene)}")
    for index, one in enumerate(given):
        name = "scene" if isinstance(scene, Scene) else f"scene {index}"
        if not isinstance(one, Scene):
            raise ValueError(f"{name}: must be a Scene, got {shown(one)}")
        if not one.bodies:
            raise ValueError(f"{name}.bodies: must hold at least one body")
        check_looks(f"{name}.looks", one.looks, len(one.bodies))
    distinct = {id(one): one for one in given}
    place = {key: index for index, key in enumerate(distinct)}
    whole_in("num_envs", num_envs, 1, MOST_ENVIRONMENTS // len(given))
    return Layout([one.copy() for one in distinct.values()], np.tile([place[id(one)] for one in given], num_envs))


def counts(scene: Scene) -> dict[str, int]:
    """Rows of an environment, by the symbol that counts them."""
    return {
        "bodies": len(scene.bodies),
        "filtered": 2 * len(scene.filtered_pairs),
        "fields": len(scene.force_fields),
        "paths": sum(body.path is not None for body in scene.bodies),
        "vertices": sum(shape.grid_nodes for shape in shapes_of(scene.bodies)[0] if moves(shape)),
        **joints.counts(scene),
    }


def spread_rows(values: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Values at rows (n, m), as (n, m, ...); NaN, False or LACKING where a row is LACKING."""
    lacking = {"f": np.nan, "b": False}.get(values.dtype.kind, LACKING)
    found = values[np.maximum(rows, 0)] if len(values) else np.zeros((*rows.shape, *values.shape[1:]), values.dtype)
    found[rows == LACKING] = lacking
    return found


def exclusive_sums(counted: np.ndarray) -> np.ndarray:
    """Exclusive sums of counts, with the total at the end, (n + 1,) int64."""
    return np.concatenate([[0], np.cumsum(counted, dtype=np.int64)])
