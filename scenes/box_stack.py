"""Boxes fall into a stack on a platform, then a projectile knocks it over."""

import numpy as np

from warp_rigid.checks import whole_in
from warp_rigid.scene.camera import Camera
from warp_rigid.scene.scene import Scene
from warp_rigid.scene.shapes import Box
from warp_rigid.scenes.builders import grounds, stacks
from warp_rigid.scenes.builders.bodies import add_bodies
from warp_rigid.scenes.demo import OFF_2003, ONE_PASS_2003, OverlapOutcome, Verdict, below, indices, rest_verdict

HALF = float(stacks.CUBE.half_extents[2])
PLATFORM_TOP = 0.5
GAP_GROWTH = 0.01
LAUNCH_TIME = 5.0
LAUNCH_VELOCITY = (8.0, 0.0, 2.0)
PROJECTILE_HALF = 0.15
SHELF_X = -4.0
ENOUGH_TO_FALL = 5


def build(height: int = 10) -> Scene:
    """Stack of cubes of 0.2 m and 8 kg above a platform, and a larger cube on a shelf 4 m to the left.

    Args:
        height: number of boxes in the stack, 1 to 50.
    """
    height = whole_in("height", height, 1, 50)
    scene = grounds.level_scene(friction=0.5, name="ground", camera=Camera.orbit(-75.0, 16.0))
    grounds.add_platform(scene, 0.5, 0.5, PLATFORM_TOP, friction=0.5, name="platform")
    # Each gap is larger than the one below it, so that the boxes land one after another.
    rises = [2.0 * HALF + GAP_GROWTH * (i + 1) for i in range(height)]
    heights = np.cumsum([PLATFORM_TOP - HALF, *rises])[1:]
    add_bodies(scene, stacks.CUBE, [(0, 0, z) for z in heights], names="box", friction=0.5)
    half, shelf = PROJECTILE_HALF, PLATFORM_TOP + 1.2 * HALF * height
    grounds.add_platform(scene, 0.3, 0.3, shelf, x=SHELF_X, friction=0.5, name="shelf")
    scene.add_body(Box((half,) * 3), position=(SHELF_X, 0, shelf + half), friction=0.5, name="projectile")
    return scene


def events(scene):
    """Launch the projectile from its shelf."""
    projectile = indices(scene, "projectile")

    def launch(sim):
        sim.set("linear_velocity", LAUNCH_VELOCITY, bodies=projectile)

    return [(LAUNCH_TIME, launch)]


class StackOutcome(OverlapOutcome):
    """Accuracy of the stack before the hit, and its motion after the hit."""

    prefix = "box_"

    top = None

    def observe(self, sim):
        """Record overlap, before the hit for itself, and the deviations in the last second before it."""
        super().observe(sim)
        if sim.time > LAUNCH_TIME + 1e-3:
            return
        self.keep_largest(depth=sim.penetration())
        if sim.time < LAUNCH_TIME - 1.0:
            return
        ideal = PLATFORM_TOP + HALF * (2.0 * np.arange(len(self.bodies)) + 1.0)
        position = sim.get("position")[:, self.bodies].astype(np.float64)
        sideways = np.linalg.norm(position[..., :2], axis=-1).max(axis=1)
        self.keep_largest(drift=sideways, sink=np.abs(position[..., 2] - ideal).max(axis=1))
        self.top = position[:, -1]

    def verdicts(self, sim):
        """Drift, height error and overlap of the stack before the hit; displacement, overlap and speed after it."""
        if self.top is None:
            return []
        stands = {"default": True, "one_pass": True}
        if len(self.bodies) >= ENOUGH_TO_FALL:
            stands["off"] = False
        verdicts = [
            below("drift", self.largest["drift"], 1e-3, "drift < 1 mm before the hit", stands),
            below("sink", self.largest["sink"], 1e-3, "height error < 1 mm before the hit", stands),
            below("depth", self.largest["depth"], 1e-3, "overlap < 1 mm at any time before the hit", stands),
        ]
        if sim.time > LAUNCH_TIME + 1.0:
            moved = np.linalg.norm(sim.get("position")[:, self.bodies[-1]] - self.top, axis=-1)
            hit = {"default": True, "one_pass": True}
            verdicts += [
                Verdict("thrown", moved, "hit moves the top box by > 0.2 m", moved > 0.2, hit, "m"),
                *self.overlap_verdicts(sim, 5e-5, 0.01),
                rest_verdict(sim, self.bodies + indices(sim.scene, "projectile")),
            ]
        return verdicts


outcome = StackOutcome
DURATION = 10.0
VARIANTS = {
    "one_pass": {**ONE_PASS_2003, "contact_iterations": 2},
    "off": {**OFF_2003, "contact_iterations": 2},
}
