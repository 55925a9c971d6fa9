"""Boxes stacked with an offset, each as far sideways from the one below: does the tower fall?"""

import numpy as np

from warp_rigid.checks import number_in, whole_in
from warp_rigid.scene.scene import Scene
from warp_rigid.scenes.builders import grounds, stacks
from warp_rigid.scenes.demo import OFF_2003, ONE_PASS_2003, Demo, Verdict, indices

HALF = float(stacks.CUBE.half_extents[2])
PLATFORM_TOP = 0.5


def build(height: int = 10, offset: float = 0.15) -> Scene:
    """Leaning tower of cubes of 0.2 m and 8 kg on a fixed platform.

    Args:
        height: boxes, 2 to 50.
        offset: sideways step from box to box over their width, 0 to 0.45.
    """
    height = whole_in("height", height, 2, 50)
    offset = number_in("offset", offset, 0.0, 0.45)
    scene = grounds.level_scene(friction=0.5, name="ground")
    grounds.add_platform(scene, 0.5, 0.5, PLATFORM_TOP, friction=0.5, name="platform")
    stacks.add_stack(scene, height, bottom=PLATFORM_TOP, lean=2.0 * HALF * offset, names="box", friction=0.5)
    return scene


class TowerOutcome:
    """Whether the tower does what statics says."""

    def __init__(self, scene):
        """Ask statics."""
        self.boxes = indices(scene, "box_")
        self.start = np.array([scene.bodies[i].position for i in self.boxes])
        self.falls = stacks.leaning_tower_falls(self.start[:, 0], HALF)

    def observe(self, sim):
        """Nothing: the end tells."""

    def verdicts(self, sim):
        """Height of the top box above the platform, against statics."""
        position = sim.get("position")[:, self.boxes].astype(np.float64)
        top = position[:, -1, 2] - PLATFORM_TOP
        moved = np.linalg.norm(position - self.start, axis=-1).max(axis=1)
        if self.falls:
            limit = 0.5 * (self.start[-1, 2] - PLATFORM_TOP)
            text, passed = f"falls: top box below {limit:.2f} m", top < limit
        else:
            text, passed = "stands: no box moved 2 cm", moved < 0.02
        # One pass never lets the lower joints feel the load above: its tower stands regardless.
        # From cold starts, few iterations may drop even a tower that balances.
        expected = {"default": True, "one_pass": not self.falls}
        if self.falls:
            expected |= {"off": True, "two_pass": True}
        return [Verdict("top_height", top, text, passed, expected)]


DEMO = Demo(
    name="leaning_tower",
    summary="a tower of boxes that leans too far must fall; one pass of 2003 holds it up",
    build=build,
    outcome=TowerOutcome,
    duration=4.0,
    variants={
        "default": {},
        "off": OFF_2003,
        "one_pass": ONE_PASS_2003,
        "two_pass": {"shock_propagation": "two_pass", "warm_starting": False},
    },
    # One pass holds up what must fall only where every step starts from zero impulses, as in 2003. Without shock
    # propagation ten boxes need remembered impulses and more iterations than the default for their joints to hold.
    goes_with={
        "shock_propagation": {"one_pass": {"warm_starting": False}, "off": {"contact_iterations": 40}},
    },
)
