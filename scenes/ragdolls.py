"""Ragdolls fall into a pit and come to rest; no joint opens and none escapes."""

import numpy as np

from warp_rigid.checks import whole_in
from warp_rigid.scene.scene import Scene
from warp_rigid.scene.shapes import Box, Plane
from warp_rigid.scenes.builders.jointed import ROLLING, ClosedJointsOutcome, add_ragdoll
from warp_rigid.scenes.demo import below, rest_verdict

WIDTH = 3.0
STANDING = 1.05


def build(dolls: int = 4) -> Scene:
    """Ragdolls of fifteen bodies above a pit of 3 m.

    Args:
        dolls: number of ragdolls, 1 to 160; nine of them in a layer.
    """
    dolls = whole_in("dolls", dolls, 1, 160)
    scene = Scene()
    scene.add_static(Plane(), friction=0.6, rolling_friction=ROLLING, name="ground")
    for x, y in ((-1, 0), (1, 0), (0, -1), (0, 1)):
        half = (0.1, WIDTH / 2 + 0.2, 2.0) if x else (WIDTH / 2 + 0.2, 0.1, 2.0)
        at = ((WIDTH / 2 + 0.1) * x, (WIDTH / 2 + 0.1) * y, 2.0)
        scene.add_static(Box(half), position=at, friction=0.6, rolling_friction=ROLLING, name="wall")
    for k in range(dolls):
        layer, row, column = k // 9, k // 3 % 3, k % 3
        place = (0.8 * (column - 1), 0.8 * (row - 1), STANDING + 0.1 + 1.9 * layer)
        add_ragdoll(scene, place, f"doll_{k}")
    return scene


class RagdollOutcome(ClosedJointsOutcome):
    """How far joints open, whether any body leaves the pit, and rest."""

    prefix = "doll_"

    def judge(self, sim):
        """Joints closed, all bodies in the pit, and at rest."""
        place = sim.get("position")[:, self.bodies]
        out = np.maximum(np.abs(place[..., :2]).max(-1) - WIDTH / 2, -place[..., 2]).max(axis=1)
        return [
            self.closed_verdict(1e-3),
            below("outside", out, 0.0, "all bodies within the pit", unit="m"),
            rest_verdict(sim, self.bodies),
        ]


outcome = RagdollOutcome
DURATION = 8.0
