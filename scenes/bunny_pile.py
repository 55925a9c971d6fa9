"""Bunnies fall into an open box."""

import numpy as np

from warp_rigid.checks import whole_in
from warp_rigid.rotations import rotate
from warp_rigid.scene.scene import Scene
from warp_rigid.scene.shapes import Box, Plane
from warp_rigid.scenes.builders import meshes
from warp_rigid.scenes.builders.piles import inner_half, starts, walls
from warp_rigid.scenes.demo import (
    ONE_PASS_2003,
    Demo,
    Verdict,
    indices,
    overlap_verdict,
    rest_verdict,
)


def build(bodies: int = 8, seed: int = 1000) -> Scene:
    """Bunnies of 0.2 m at jittered lattice points above the floor of an open box, turned at random.

    Args:
        bodies: bunnies, 1 to 4096.
        seed: of jitter and rotations.
    """
    position, orientation = starts(whole_in("bodies", bodies, 1, 4096), seed)
    scene = Scene()
    scene.add_static(Plane(normal=(0, 0, 1), offset=0.0), friction=0.5, name="floor")
    for i, (center, half_extents) in enumerate(walls(bodies)):
        scene.add_static(Box(half_extents), position=center, friction=0.5, name=f"wall_{i}")
    bunny = meshes.bunny()
    place = position - rotate(orientation, np.tile(bunny.center_of_mass, (bodies, 1)))
    for i in range(bodies):
        scene.add_body(
            bunny,
            position=place[i],
            orientation=orientation[i],
            density=1000.0,
            friction=0.5,
            name=f"bunny_{i}",
        )
    return scene


class PileOutcome:
    """Whether all bunnies came to rest in the box, none inside another."""

    def __init__(self, scene):
        """Find the bunnies."""
        self.bunnies = indices(scene, "bunny_")
        self.inner = inner_half(len(self.bunnies))

    def observe(self, sim):
        """Nothing: the end tells."""

    def verdicts(self, sim):
        """Bunnies that left the box, overlap and speed at the end."""
        position = sim.get("center_of_mass")[:, self.bunnies]
        # A body that is not a number has left too: the comparison must be true for it.
        inside = (np.abs(position[..., :2]).max(axis=-1) < self.inner) & (position[..., 2] > 0.0)
        left = (~inside).sum(axis=1)
        sound = {"default": True}
        return [
            Verdict("escaped", left, "none outside the box", left == 0, sound),
            overlap_verdict(sim, 2e-3, sound),
            rest_verdict(sim, self.bunnies, sound),
        ]


def vary(sim, bodies, seed, **_):
    """Start environment e as the scene of seed + e does."""
    bunnies = indices(sim.scene, "bunny_")
    position, orientation = zip(*(starts(bodies, seed + env) for env in range(sim.num_envs)), strict=True)
    sim.set("position", np.array(position), bodies=bunnies)
    sim.set("orientation", np.array(orientation), bodies=bunnies)


DEMO = Demo(
    name="bunny_pile",
    summary="bunnies fall into an open box and settle",
    build=build,
    outcome=PileOutcome,
    duration=6.0,
    variants={"default": {}, "one_pass": ONE_PASS_2003},
    vary=vary,
)
