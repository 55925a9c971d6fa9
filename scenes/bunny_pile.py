"""Bunnies fall into an open box and settle."""

import numpy as np

from warp_rigid.checks import whole_in
from warp_rigid.rotations import rotate
from warp_rigid.scene.camera import Camera
from warp_rigid.scene.scene import Scene
from warp_rigid.scenes.builders import grounds, meshes, piles
from warp_rigid.scenes.builders.bodies import add_bodies
from warp_rigid.scenes.demo import ONE_PASS_2003, OverlapOutcome, Verdict, outside, rest_verdict, vary_starts


def build(bodies: int = 8, seed: int = 1000) -> Scene:
    """Bunnies of 0.2 m at jittered lattice points above the floor of an open box, with random orientations.

    Args:
        bodies: number of bunnies, 1 to 4096.
        seed: of jitter and orientations.
    """
    position, orientation = piles.starts(whole_in("bodies", bodies, 1, 4096), seed)
    scene = grounds.level_scene(friction=0.5, name="floor", camera=Camera.orbit(-62.0, 26.0))
    piles.add_pile_bin(scene, bodies, names="wall", friction=0.5)
    bunny = meshes.bunny()
    place = position - rotate(orientation, np.tile(bunny.center_of_mass, (bodies, 1)))
    add_bodies(scene, bunny, place, orientation, names="bunny", density=1000.0, friction=0.5)
    return scene


class PileOutcome(OverlapOutcome):
    """Whether all bunnies came to rest in the box and none overlaps another."""

    prefix = "bunny_"

    def verdicts(self, sim):
        """Bunnies outside the box, overlap, and speed at the end."""
        left = outside(sim, self.bodies, piles.inner_half(len(self.bodies))).sum(axis=1)
        return [
            Verdict("escaped", left, "no bunny outside the box", left == 0),
            # Six seeds: 2.3 to 5.1 mm while the bunnies land, in steps of up to 17 mm. At rest, 0.06 to 0.15 mm remain
            # between the samples at which contacts are made.
            *self.overlap_verdicts(sim, 2e-4, 0.01),
            rest_verdict(sim, self.bodies),
        ]


outcome = PileOutcome
# A bunny that lands on its back may rock for seven seconds.
DURATION = 10.0
VARIANTS = {"one_pass": ONE_PASS_2003}
vary = vary_starts("bunny_", piles.starts)
