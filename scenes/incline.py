"""A bouncy but sticky block stays on a slope, if collisions precede the velocity update."""

import math

import numpy as np

from warp_rigid.checks import number_in
from warp_rigid.scene.camera import Camera
from warp_rigid.scene.scene import Scene
from warp_rigid.scene.shapes import Box, Plane
from warp_rigid.scenes.demo import ONE_PASS_2003, SceneOutcome, below, clearance

HALF = 0.05
PLATFORM_HALF = (1.5, 0.5, 0.1)
GROUND = -2.0
MARGINS = (0.002, 0.02)
"""Relative distance of the friction from the critical one at which the outcome is certain: with the default settings,
and with one pass, which lets the block creep by some millimetres."""


def build(angle: float = 20.0, friction: float = 0.5, restitution: float = 1.0) -> Scene:
    """Cube of 0.1 m on a platform inclined by 20 degrees, as in the test of the authors of the 2003 method.

    Args:
        angle: slope [degree], 0 to 40; a cube does not tip at these angles. Downhill is +x.
        friction: of block and platform, >= 0; the block sticks if it exceeds tan(angle).
        restitution: of block and platform, 0 to 1.
    """
    slope = math.radians(number_in("angle", angle, 0.0, 40.0))
    surface = {
        "friction": number_in("friction", friction, 0.0),
        "restitution": number_in("restitution", restitution, 0.0, 1.0),
    }
    tilt = (0.0, math.sin(0.5 * slope), 0.0, math.cos(0.5 * slope))
    normal = np.array([math.sin(slope), 0.0, math.cos(slope)])
    scene = Scene(camera=Camera.orbit(-110.0, 24.0))
    scene.add_static(Plane(offset=GROUND), name="ground")
    below = -PLATFORM_HALF[2] * normal
    scene.add_static(Box(PLATFORM_HALF), position=below, orientation=tilt, name="platform", **surface)
    scene.add_body(Box((HALF,) * 3), position=HALF * normal, orientation=tilt, name="block", **surface)
    return scene


class InclineOutcome(SceneOutcome):
    """Sliding distance, lift-off and penetration of the block."""

    prefix = "block"

    def observe(self, sim):
        """Record the largest height above the platform and the largest penetration."""
        gap = clearance(sim, sim.scene.index("block"), sim.scene.index("platform"))
        self.keep_largest(lift=gap, depth=-gap)

    def judge(self, sim):
        """Sliding distance, lift and penetration, each of which must stay below 1 mm."""
        body = sim.scene.bodies[sim.scene.index("block")]
        slope = 2.0 * math.atan2(body.orientation[1], body.orientation[3])
        downhill = np.array([math.cos(slope), 0.0, -math.sin(slope)])
        surplus, steep = body.friction - math.tan(slope), slope > math.radians(5.0)
        sharp, blunt = (margin * math.tan(slope) for margin in MARGINS)
        slide = (sim.get("position")[:, self.bodies].astype(np.float64) - self.start)[:, 0] @ downhill
        sound = {"default": True, "one_pass": True}
        stays = {"default": surplus > sharp, "one_pass": surplus > blunt}
        stays = {name: True for name, holds in stays.items() if holds}
        slips = {"default": False, "one_pass": False} if surplus < -blunt else {}
        if surplus < -sharp and steep:
            slips["default"] = False
        chatters = {"collisions_last": False} if body.restitution > 0.9 and steep else {}
        sinks = {"no_contact": False}
        return [
            below("slide", slide, 1e-3, "slides < 1 mm downhill", stays | slips | chatters),
            below("lift", self.largest["lift"], 1e-3, "< 1 mm above the platform at any time", stays | chatters),
            below("depth", self.largest["depth"], 1e-3, "< 1 mm inside the platform at any time", sound | sinks),
        ]


outcome = InclineOutcome
DURATION = 5.0
VARIANTS = {
    "one_pass": ONE_PASS_2003,
    "no_contact": {"contact_iterations": 0, "shock_propagation": "off", "warm_starting": False},
    "collisions_last": {**ONE_PASS_2003, "collision_first": False},
}
