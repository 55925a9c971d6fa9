"""The last ball of Newton's cradle flies off with the speed of the first."""

import math

import numpy as np

from warp_rigid.checks import number_in
from warp_rigid.scene.camera import Camera
from warp_rigid.scene.joints import DistanceJoint
from warp_rigid.scene.scene import Scene
from warp_rigid.scene.shapes import Sphere
from warp_rigid.scenes.demo import SceneOutcome, Verdict

RADIUS = 0.05
LENGTH = 0.5
SPREAD = 0.2
GRAVITY = 9.81


def build(angle: float = 0.5) -> Scene:
    """Five balls, each on two strings; the first one is let go from the side.

    Args:
        angle: of the first ball's strings [rad], 0.1 to 1.
    """
    angle = number_in("angle", angle, 0.1, 1.0)
    scene = Scene(gravity=(0, 0, -GRAVITY), camera=Camera.orbit(-80.0, 14.0))
    for k in range(5):
        lean = angle if k == 0 else 0.0
        x = 2.0 * RADIUS * k
        place = (x - LENGTH * math.sin(lean), 0.0, -LENGTH * math.cos(lean))
        ball = scene.add_body(Sphere(RADIUS), position=place, restitution=1.0, friction=0.0, name=f"ball_{k}")
        for y in (-SPREAD, SPREAD):
            string = DistanceJoint(maximum=math.hypot(LENGTH, SPREAD))
            scene.add_joint(string, ball, anchor=place, anchor_b=(x, y, 0))
    return scene


class CradleOutcome(SceneOutcome):
    """Speeds of all balls right after the first impact."""

    prefix = "ball_"
    after = None

    def observe(self, sim):
        """Record the speeds of each environment once its last ball moves, over that of the first at its lowest."""
        fallen = LENGTH + self.start[0, 2]
        speeds = np.abs(sim.get("linear_velocity")[:, :, 0]) / math.sqrt(2.0 * GRAVITY * fallen)
        if self.after is None:
            self.after = np.full(speeds.shape, np.nan)
        first = np.isnan(self.after[:, 0]) & (speeds[:, -1] > 0.5)
        self.after[first] = speeds[first]

    def verdicts(self, sim):
        """The last ball has the speed; the others have none."""
        if self.after is None or np.isnan(self.after).any():
            return []
        last, rest = self.after[:, -1], self.after[:, :-1].max(axis=1)
        return [
            Verdict("last", last, "speed of the last ball > 0.95 of the first", last > 0.95),
            Verdict("others", rest, "speed of the others < 0.02 of it", rest < 0.02),
        ]


outcome = CradleOutcome
DURATION = 2.0
