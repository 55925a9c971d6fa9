"""A rope bridge of fifty planks carries a load a thousand times heavier than one of them."""

import numpy as np

from warp_rigid.checks import number_in, whole_in
from warp_rigid.scene.joints import DistanceJoint, RevoluteJoint
from warp_rigid.scene.scene import Scene
from warp_rigid.scene.shapes import Box, Sphere
from warp_rigid.scenes.builders.jointed import ClosedJointsOutcome
from warp_rigid.scenes.demo import Verdict, rest_verdict

PLANK = (0.09, 0.5, 0.02)
SPACING = 0.2
PLANK_MASS = 1.0
SLACK = 1.03
"""Length of the bridge over the distance of its ends."""
HEIGHT, ROPE = 4.0, 0.5


def build(planks: int = 50, ratio: float = 1000.0, damping: float = 20.0) -> Scene:
    """Bridge between two points of equal height, in the shape of an arc that its weight changes to a catenary.

    Args:
        planks: number of planks, 4 to 100.
        ratio: mass of the load over that of a plank, 0.1 to 10000.
        damping: of the hinges [N m s/rad], 0 to 1000.
    """
    planks = whole_in("planks", planks, 4, 100)
    ratio = number_in("ratio", ratio, 0.1, 10_000.0)
    damping = number_in("damping", damping, 0.0, 1000.0)
    scene = Scene()
    corners = _arc(planks)
    above = None
    for k in range(planks):
        along = corners[k + 1] - corners[k]
        lean = -0.5 * np.arctan2(along[2], along[0])
        place, turn = 0.5 * (corners[k] + corners[k + 1]), (0, np.sin(lean), 0, np.cos(lean))
        plank = scene.add_body(Box(PLANK), position=place, orientation=turn, mass=PLANK_MASS, name=f"plank_{k}")
        _hinge(scene, plank, above, corners[k], damping)
        above = plank
    _hinge(scene, above, None, corners[-1], damping)
    middle = corners[planks // 2]
    load = scene.add_body(Sphere(0.3), position=middle - (0, 0, ROPE), mass=ratio * PLANK_MASS, name="load")
    scene.add_joint(DistanceJoint(maximum=ROPE), load, planks // 2, anchor=middle - (0, 0, ROPE), anchor_b=middle)
    scene.filter_pair(load, planks // 2 - 1)
    return scene


def _hinge(scene, body, other, point, damping):
    hinge = scene.add_joint(RevoluteJoint((0, 1, 0)), body, other, anchor=point)
    scene.add_drive(hinge, damping=damping)


def _arc(planks):
    """Ends of the planks on an arc of a circle of the given length, (planks + 1, 3) [m]."""
    low, high = 1e-3, np.pi
    for _ in range(60):
        half = 0.5 * (low + high)
        low, high = (half, high) if half / np.sin(half) < SLACK else (low, half)
    # Chords of equal length instead of arcs: the planks keep their distance exactly.
    angles = np.linspace(-half, half, planks + 1)
    radius = 0.5 * SPACING / np.sin(half / planks)
    x, z = radius * np.sin(angles), -radius * np.cos(angles)
    return np.stack([x, np.zeros_like(x), HEIGHT + z - z[0]], axis=1)


class BridgeOutcome(ClosedJointsOutcome):
    """Sag of the bridge, gaps of its joints, and rest."""

    prefix = ""

    def judge(self, sim):
        """Joints closed; the load in its place, and at rest."""
        planks = len(self.bodies) - 1
        span = planks * SPACING / SLACK
        # With a load that is much heavier than the bridge, its two halves are straight.
        deepest = HEIGHT - np.sqrt((0.5 * planks * SPACING) ** 2 - (0.5 * span) ** 2)
        height = sim.get("position")[:, -1, 2].astype(np.float64) + ROPE
        away = np.abs(height - deepest)
        text = f"load hangs within 0.1 m of the height of straight halves, {deepest:.3f} m"
        return [
            self.closed_verdict(1e-3),
            Verdict("sag", away, text, away < 0.1, unit="m"),
            rest_verdict(sim, self.bodies),
        ]


outcome = BridgeOutcome
DURATION = 12.0
