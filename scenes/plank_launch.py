"""A large box falls on one end of a plank and launches small boxes from the other."""

import math

from warp_rigid.checks import number_in, whole_in
from warp_rigid.scene.camera import Camera
from warp_rigid.scene.scene import Scene
from warp_rigid.scene.shapes import Box
from warp_rigid.scenes.builders import grounds, stacks
from warp_rigid.scenes.builders.bodies import add_bodies
from warp_rigid.scenes.demo import OFF_2003, ONE_PASS_2003, SceneOutcome, Verdict, below, clearance

BASE_HALF = (1.0, 0.25, 0.5)
PLANK_HALF = (1.25, 0.3, 0.05)
PLANK_X = 0.4
SMALL_HALF = 0.1
LARGE_HALF = 0.25
LAUNCH_LASTS = 0.25


def build(blocks: int = 7, drop: float = 2.0) -> Scene:
    """Plank of 10 kg on a fixed box, small boxes of 1 kg on one end, and a box of 100 kg that falls on the other.

    Args:
        blocks: number of small boxes, which form a stack, 1 to 20.
        drop: initial height of the large box above the plank [m], 0.1 to 5.
    """
    blocks = whole_in("blocks", blocks, 1, 20)
    drop = number_in("drop", drop, 0.1, 5.0)
    scene = grounds.level_scene(friction=0.5, name="ground", camera=Camera.orbit(-84.0, 14.0))
    grounds.add_platform(scene, BASE_HALF[0], BASE_HALF[1], 2.0 * BASE_HALF[2], friction=0.5, name="base")
    z = 2.0 * BASE_HALF[2]
    scene.add_body(Box(PLANK_HALF), position=(PLANK_X, 0, z + PLANK_HALF[2]), mass=10.0, name="plank")
    z += 2.0 * PLANK_HALF[2]
    left = PLANK_X - PLANK_HALF[0] + 1.5 * SMALL_HALF
    places = stacks.column(blocks, bottom=z) + [left, 0.0, 0.0]
    add_bodies(scene, stacks.CUBE, places, names="small", mass=1.0, restitution=0.3)
    right = PLANK_X + PLANK_HALF[0] - LARGE_HALF
    scene.add_body(Box((LARGE_HALF,) * 3), position=(right, 0, z + drop + LARGE_HALF), mass=100.0, name="large")
    return scene


class LaunchOutcome(SceneOutcome):
    """Height of the small boxes' flight, and penetration of the plank into the base."""

    prefix = "small_"

    def observe(self, sim):
        """Record each small box's largest rise, and the plank's deepest penetration during the launch."""
        self.keep_largest(rises=sim.get("position")[:, self.bodies, 2] - self.start[:, 2])
        scene = sim.scene
        drop = scene.bodies[scene.index("large")].position[2] - LARGE_HALF - 2.0 * (BASE_HALF[2] + PLANK_HALF[2])
        if sim.time < math.sqrt(2.0 * drop / -scene.gravity[2]) + LAUNCH_LASTS:
            self.keep_largest(depth=-clearance(sim, scene.index("plank"), scene.index("base")))

    def judge(self, sim):
        """The smallest rise, and the penetration, which must stay below 2 % of the plank's thickness."""
        least = self.largest["rises"].min(axis=1)
        limit = 0.02 * 2.0 * PLANK_HALF[2]
        text = f"plank in base < {1e3 * limit:g} mm during the launch"
        sound = {"default": True, "one_pass": True}
        verdicts = [Verdict("rise", least, "every small box rises by > 0.3 m", least > 0.3, sound, "m")]
        if "depth" in self.largest:
            verdicts.append(below("depth", self.largest["depth"], limit, text, sound))
        return verdicts


outcome = LaunchOutcome
DURATION = 3.0
VARIANTS = {"one_pass": ONE_PASS_2003, "off": OFF_2003}
