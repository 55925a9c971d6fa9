"""A built-in scene, or one from a user's file, as a benchmark case."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from warp_rigid.engine.simulator import Simulator
from warp_rigid.runs.runner import find_scene
from warp_rigid.scene.scene import Motion, Scene
from warp_rigid.scenes import Demo

__all__ = ["SceneCase"]


@dataclass(frozen=True)
class SceneCase:
    """A scene with its default parameters, measured as a BenchmarkCase.

    Attributes:
        name: built-in name or path of the file.
    """

    name: str

    def __str__(self) -> str:
        """As on the command line."""
        return self.name

    @cached_property
    def demo(self) -> Demo:
        """The description of the scene."""
        return find_scene(self.name)

    @cached_property
    def bodies(self) -> int:
        """Number of dynamic bodies."""
        return sum(body.motion == Motion.DYNAMIC for body in self.build().bodies)

    def build(self) -> Scene:
        """Build the scene."""
        return self.demo.build()

    def scatter(self, sim: Simulator) -> None:
        """Give each environment a different start, where the scene has several."""
        if self.demo.vary is not None and sim.num_envs > 1:
            self.demo.vary(sim, **self.demo.parameters)

    def escaped(self, position: np.ndarray) -> int:
        """Number of bodies whose position is not finite; the scene does not say where bodies belong."""
        return int((~np.isfinite(position).all(axis=-1)).sum())

    def height_error(self, position: np.ndarray) -> None:
        """Nothing: heights at rest are not known."""
