"""Twelve welded boxes fall on the ground and keep their common shape."""

import numpy as np

from warp_rigid.checks import number_in
from warp_rigid.rotations import inverse, rotate
from warp_rigid.scene.joints import FixedJoint
from warp_rigid.scene.scene import Scene
from warp_rigid.scene.shapes import Box, Plane
from warp_rigid.scenes.demo import OverlapOutcome, below, rest_verdict

HALF = 0.1
CELLS = [(x, y, z) for x in range(3) for y in range(2) for z in range(2)]


def build(drop: float = 0.3) -> Scene:
    """Pallet above the ground; neighbouring boxes are welded in closed loops.

    Args:
        drop: height of fall [m], 0 to 2.
    """
    drop = number_in("drop", drop, 0.0, 2.0)
    scene = Scene()
    scene.add_static(Plane(), friction=0.5, name="ground")
    place = {cell: 2 * HALF * np.array(cell) + (0, 0, HALF + drop) for cell in CELLS}
    body = {
        cell: scene.add_body(Box((HALF,) * 3), position=place[cell], friction=0.5, name=f"box_{k}")
        for k, cell in enumerate(CELLS)
    }
    for cell in CELLS:
        for axis in np.eye(3, dtype=int):
            x, y, z = (np.array(cell) + axis).tolist()
            if (x, y, z) in body:
                anchor = (place[cell] + place[x, y, z]) / 2
                scene.add_joint(FixedJoint(), body[cell], body[x, y, z], anchor=anchor)
    return scene


class PalletOutcome(OverlapOutcome):
    """How far boxes move relative to the first one."""

    prefix = "box_"

    def observe(self, sim):
        """Record the overlap and the largest displacement."""
        super().observe(sim)
        place = sim.get("position")[:, self.bodies].astype(np.float64)
        to_frame = inverse(sim.get("orientation")[:, self.bodies[0]].astype(np.float64))
        moved = rotate(to_frame[:, None], place - place[:, :1]) - (self.start - self.start[0])
        self.keep_largest(drift=np.linalg.norm(moved, axis=-1).max(axis=1))

    def judge(self, sim):
        """Shape, rest and overlap."""
        return [
            below("drift", self.largest["drift"], 4e-5, "no box displaced by 0.04 mm at any time"),
            rest_verdict(sim, self.bodies),
            *self.overlap_verdicts(sim, 5e-5, 0.01),
        ]


outcome = PalletOutcome
DURATION = 3.0
