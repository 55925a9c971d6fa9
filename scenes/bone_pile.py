"""Craniums, pelvises and femurs fall through a funnel into a walled plot.

Friction, restitution and the kinds' shares are those of Guendelman, Bridson and Fedkiw 2003 (300 craniums, 150 pelvises
and 50 femurs). Their rolling friction of 0.1 has no unit; here it is a tenth of a femur's thickness [m]. The shapes and
starts are not theirs.
"""

import math
from typing import Any

import numpy as np

from warp_rigid import rotations
from warp_rigid.checks import whole_in
from warp_rigid.scene.camera import Camera
from warp_rigid.scene.scene import Scene
from warp_rigid.scene.shapes import Mesh, tessellation
from warp_rigid.scenes.builders import assortment, grounds, meshes, piles
from warp_rigid.scenes.builders.bodies import add_bodies
from warp_rigid.scenes.demo import ONE_PASS_2003, SOUND, OverlapOutcome, Verdict, outside, vary_starts

SURFACE: dict[str, Any] = {"friction": 0.4, "restitution": 0.3, "rolling_friction": 0.003}
DENSITY = 1500.0
PITCH = 0.5
JITTER = 0.02
SLOPE = math.radians(55.0)
OPENING = 0.45
"""Radius of the funnel's lower opening [m]; a femur passes through it in any orientation."""
SHELL = 0.05
WALL_THICKNESS = 0.1
KINDS = ("cranium", "pelvis", "femur")


def build(bones: int = 20, seed: int = 0) -> Scene:
    """Craniums, pelvises and femurs, 6 : 3 : 1, on a jittered lattice above a funnel, with random orientations.

    Args:
        bones: number of bones, 1 to 2000; 500 in the paper.
        seed: of jitter, orientations and order.
    """
    bones = whole_in("bones", bones, 1, 2000)
    position, orientation = starts(bones, seed)
    scene = grounds.level_scene(name="floor", **SURFACE, camera=Camera.orbit(-70.0, 26.0))
    plot = Plot(bones)
    grounds.add_bin(scene, plot.half, plot.height, WALL_THICKNESS, names="wall", **SURFACE)
    scene.add_static(_funnel(plot), position=(0, 0, plot.opening), name="funnel", **SURFACE)
    shapes = {"cranium": meshes.cranium(), "pelvis": meshes.pelvis(), "femur": meshes.femur()}
    femurs, pelvises = round(0.1 * bones), round(0.3 * bones)
    ordered = np.repeat(KINDS, (bones - pelvises - femurs, pelvises, femurs))
    kinds = np.random.default_rng((seed, 4)).permutation(ordered).tolist()
    names = [f"bone_{i}_{kind}" for i, kind in enumerate(kinds)]
    drawn = [shapes[kind] for kind in kinds]
    add_bodies(scene, drawn, position, orientation, names=names, density=DENSITY, **SURFACE)
    return scene


def starts(bones: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Where the bones start: centres of mass (bones, 3) [m] and unit quaternions (bones, 4)."""
    rng = np.random.default_rng((whole_in("seed", seed, 0, assortment.MOST_SEEDS), 5))
    plot = Plot(bones)
    lowest = plot.opening + plot.rise + 0.6 * PITCH
    position = piles.lattice(bones, plot.side, PITCH, lowest) + rng.uniform(-JITTER, JITTER, (bones, 3))
    return position, rotations.random(rng, bones)


class Plot:
    """Dimensions of the plot and the funnel for a number of bones.

    Attributes:
        side: bones along each side of the lattice, which is about as high as wide.
        half: half of the plot's inner width [m].
        height: of the plot's walls [m].
        opening: height of the funnel's lower opening, above the top of the final pile [m].
        radius: inner radius of the funnel's upper rim, which encloses the whole lattice [m].
        rise: height of the funnel [m].
    """

    def __init__(self, bones: int):
        """Compute them."""
        self.side = max(2, math.ceil(bones ** (1.0 / 3.0)))
        self.half = max(0.6, 0.14 * bones ** (1.0 / 3.0))
        self.height = 0.5 + 0.1 * self.side
        self.opening = self.height + 0.25
        self.radius = 2.0**0.5 * 0.5 * self.side * PITCH + 0.1
        self.rise = (self.radius - OPENING) * math.tan(SLOPE)


def _funnel(plot):
    """A conical shell with an upper and a lower opening; the lower one is at z = 0."""
    radius, rise = plot.radius, plot.rise
    out, down = SHELL * math.sin(SLOPE), SHELL * math.cos(SLOPE)
    section = [[OPENING, 0.0], [OPENING + out, -down], [radius + out, rise - down], [radius, rise]]
    return Mesh(*tessellation.wheel(np.array(section), 48), sdf_resolution=128)


class BonesOutcome(OverlapOutcome):
    """Whether all bones fell through the funnel into the plot and none overlaps another."""

    prefix = "bone_"

    def verdicts(self, sim):
        """Bones that left the plot, bones still in the funnel, and overlap."""
        count, plot = len(self.bodies), Plot(len(self.bodies))
        above = sim.get("center_of_mass")[:, self.bodies, 2] > plot.opening
        left, waiting = (outside(sim, self.bodies, plot.half) & ~above).sum(axis=1), above.sum(axis=1)
        through = SOUND if count <= 100 else {}
        return [
            Verdict("escaped", left, "no bone outside the plot", left == 0),
            Verdict("waiting", waiting, "no bone above the funnel's lower opening", waiting == 0, through),
            *self.overlap_verdicts(sim, 5e-4, 0.035),
        ]


outcome = BonesOutcome
DURATION = 4.0
VARIANTS = {"one_pass": ONE_PASS_2003}
vary = vary_starts("bone_", starts)
