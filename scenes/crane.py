"""A crane lifts the upper box from a pile without moving the others."""

import numpy as np

from warp_rigid.checks import number_in
from warp_rigid.scene.joints import DistanceJoint, PrismaticJoint
from warp_rigid.scene.scene import Scene
from warp_rigid.scene.shapes import Box
from warp_rigid.scenes.builders import grounds, stacks
from warp_rigid.scenes.builders.bodies import add_bodies
from warp_rigid.scenes.demo import SceneOutcome, Verdict, below

HALF = 0.1
ROWS = 3
ROPE, SLACK = 1.0, 0.1
LIFT = 0.6
"""Height by which the hook rises [m]."""


def build(speed: float = 0.25) -> Scene:
    """Pyramid of six boxes of 8 kg, and a hook on a driven vertical slider, with a rope to the uppermost box.

    The rope is slack at first, so that the pile is at rest when the crane pulls.

    Args:
        speed: with which the hook rises [m/s], 0.05 to 0.5.
    """
    speed = number_in("speed", speed, 0.05, 0.5)
    scene = grounds.level_scene(friction=0.5, name="ground")
    places = stacks.pyramid(ROWS, HALF)
    boxes = add_bodies(scene, Box((HALF,) * 3), places, names="box", friction=0.5)
    top = np.array(places[-1]) + (0, 0, HALF)
    end = top + (0, 0, ROPE - SLACK)
    hook = scene.add_body(Box((0.05, 0.05, 0.03)), position=end, mass=2.0, name="hook")
    slider = scene.add_joint(PrismaticJoint((0, 0, 1), (-LIFT, LIFT)), hook, anchor=end, name="winch")
    scene.add_drive(slider, damping=1e5, max_force=1000.0, target_velocity=speed)
    scene.add_joint(DistanceJoint(maximum=ROPE), boxes[-1], hook, anchor=top, anchor_b=end, name="rope")
    return scene


class CraneOutcome(SceneOutcome):
    """How far the box was lifted, and how far the others moved."""

    prefix = "box_"

    def observe(self, sim):
        """Record the largest displacement of the lower boxes."""
        self.keep_largest(moved=self.displacement(sim)[:, :-1].max(axis=1))

    def judge(self, sim):
        """Both distances."""
        lifted = sim.get("position")[:, self.bodies[-1], 2] - self.start[-1, 2]
        aim = LIFT - SLACK
        text = f"upper box lifted by {aim:g} m to 1 mm at the end"
        return [
            Verdict("lifted", lifted, text, np.abs(lifted - aim) < 1e-3, unit="m"),
            below("moved", self.largest["moved"], 1e-4, "no other box moved by 0.1 mm at any time"),
        ]


outcome = CraneOutcome
DURATION = 4.0
