"""The large block tips the seesaw and slides off, then the small one tips it back."""

import math

import numpy as np

from warp_rigid.checks import number_in
from warp_rigid.rotations import rotate
from warp_rigid.scene.camera import Camera
from warp_rigid.scene.scene import Scene
from warp_rigid.scene.shapes import Box
from warp_rigid.scenes.builders import grounds
from warp_rigid.scenes.demo import ONE_PASS_2003, SceneOutcome, Verdict

PIVOT_HEIGHT = 0.35
PLANK_HALF = (1.2, 0.25, 0.04)
LARGE_HALF = 0.15
SMALL_HALF = 0.1
LARGE_X = 0.8
SMALL_X = -1.0
SPIN = 0.2
TIPPED = 10.0


def build(large_mass: float = 10.0, small_mass: float = 5.0) -> Scene:
    """Plank of 10 kg on a fixed ridge, a slippery large block right and a sticky small one left.

    All three start level with the same slow rotation to the right, which lifts the small block even if contacts
    transmit no load to the plank.

    Args:
        large_mass: of the block on the right [kg], > 0.
        small_mass: of the block on the left [kg], > 0.
    """
    large_mass = number_in("large_mass", large_mass, above=0.0)
    small_mass = number_in("small_mass", small_mass, above=0.0)
    scene = grounds.level_scene(friction=0.5, name="ground", camera=Camera.orbit(-84.0, 14.0))
    # A cube on its edge: on a cylinder the plank would have a stable equilibrium to return to.
    side = math.sqrt(0.5) * PIVOT_HEIGHT
    turn = (0, math.sin(math.pi / 8.0), 0, math.cos(math.pi / 8.0))
    scene.add_static(Box((side, 0.4, side)), orientation=turn, friction=1.0, name="pivot")
    z = PIVOT_HEIGHT + PLANK_HALF[2]
    _add_turning(scene, "plank", PLANK_HALF, (0.0, z), 10.0, 1.0)
    z += PLANK_HALF[2]
    _add_turning(scene, "large", (LARGE_HALF,) * 3, (LARGE_X, z + LARGE_HALF), large_mass, 0.1)
    _add_turning(scene, "small", (SMALL_HALF,) * 3, (SMALL_X, z + SMALL_HALF), small_mass, 0.8)
    return scene


def _add_turning(scene, name, half_extents, place, mass, friction):
    """Add a box centred at (x, z) = `place` [m] that rotates about the ridge."""
    x, z = place
    motion = {"linear_velocity": (SPIN * (z - PIVOT_HEIGHT), 0, -SPIN * x), "angular_velocity": (0, SPIN, 0)}
    scene.add_body(Box(half_extents), position=(x, 0, z), mass=mass, friction=friction, name=name, **motion)


class SeesawOutcome(SceneOutcome):
    """The plank's largest tilt to the right, and the largest tilt to the left after that."""

    def observe(self, sim):
        """Record the largest tilts; tilt to the left counts only after the plank has tipped right."""
        orientation = sim.get("orientation")[:, sim.scene.index("plank")].astype(np.float64)
        along = rotate(orientation, np.broadcast_to([1.0, 0.0, 0.0], (len(orientation), 3)))
        tilt = np.degrees(np.arcsin(np.clip(-along[:, 2], -1.0, 1.0)))
        self.keep_largest(right=np.maximum(0.0, tilt))
        self.keep_largest(left=np.where(self.largest["right"] > TIPPED, np.maximum(0.0, -tilt), 0.0))

    def judge(self, sim):
        """Both tilts, which must exceed 10 degrees."""
        blocks = [sim.scene.bodies[sim.scene.index(name)] for name in ("large", "small")]
        moments = [block.mass * block.position[0] for block in blocks]
        # There is no expectation if the blocks nearly balance or the small one is heavier.
        uneven = sum(moments) > 0.1 * moments[0]
        tips = {"default": True, "one_pass": True, "no_contact": True} if uneven else {}
        back = tips | {"no_contact": False} if uneven else {}
        right, left = self.largest["right"], self.largest["left"]
        return [
            Verdict("tips", right, f"tips right > {TIPPED:g} degrees", right > TIPPED, tips, "degrees"),
            Verdict("tips_back", left, f"then left > {TIPPED:g} degrees", left > TIPPED, back, "degrees"),
        ]


outcome = SeesawOutcome
DURATION = 4.0
VARIANTS = {"one_pass": ONE_PASS_2003, "no_contact": {**ONE_PASS_2003, "contact_iterations": 0}}
