"""Parts of scenes with joints: ragdolls, how far joints are open, and its verdict."""

from typing import Any

import numpy as np

from warp_rigid.kernels.enums import Coordinate
from warp_rigid.scene.joints import RevoluteJoint, SphericalJoint
from warp_rigid.scene.scene import Scene
from warp_rigid.scene.shapes import Box, Capsule, Sphere
from warp_rigid.scenes.demo import SceneOutcome, Verdict, below

X = (1.0, 0.0, 0.0)
PASSIVE = 0.5
"""Damping of a ragdoll's joints [N m s/rad], about that of relaxed human ones."""
ROLLING = 0.01
"""Rolling friction of a ragdoll's head and limbs [m]: without it, a round head on the ground rolls on for seconds."""


def anchor_errors(sim: Any) -> np.ndarray:
    """Distances between the two anchors of each joint that holds them together, (envs, joints) [m]; else 0."""
    return gaps(sim.scene, *(sim.get(name).astype(np.float64) for name in ("position", "orientation")))


def gaps(scene: Scene, position: np.ndarray, orientation: np.ndarray) -> np.ndarray:
    """The same of poses (..., bodies, 3) and (..., bodies, 4) of a scene's bodies, (..., joints) [m]."""
    apart = [
        np.linalg.norm(np.subtract(*entry.anchors(position, orientation)), axis=-1)
        * (entry.joint.coordinate not in (Coordinate.LENGTH, Coordinate.SLIDE))
        for entry in scene.joints
    ]
    return np.stack(apart, axis=-1)


class ClosedJointsOutcome(SceneOutcome):
    """Base of the outcomes that judge how far joints open."""

    def observe(self, sim: Any) -> None:
        """Record the largest gap of a joint."""
        self.keep_largest(opened=anchor_errors(sim).max(axis=1))

    def closed_verdict(self, limit: float) -> Verdict:
        """Verdict: no joint has opened by `limit` [m]."""
        return below("opened", self.largest["opened"], limit, f"no joint open by {1e3 * limit:g} mm")


def add_ragdoll(scene: Scene, place: Any, name: str, damping: float = PASSIVE) -> None:
    """Add a ragdoll of fifteen bodies that stands upright with its hip at a point [m].

    Its joints are damped [N m s/rad]; without damping, limbs that hang freely swing and turn without end.
    """
    x, y, z = place
    friction = 0.6

    def part(shape, offset, label):
        at = (x + offset[0], y + offset[1], z + offset[2])
        rolling = 0.0 if isinstance(shape, Box) else ROLLING
        return scene.add_body(shape, position=at, friction=friction, rolling_friction=rolling, name=f"{name}_{label}")

    def joined(joint, body, other, offset):
        index = scene.add_joint(joint, body, other, anchor=(x + offset[0], y + offset[1], z + offset[2]))
        scene.add_drive(index, damping=damping)

    hip = part(Box((0.14, 0.08, 0.07)), (0, 0, 0), "hip")
    belly = part(Box((0.12, 0.07, 0.06)), (0, 0, 0.15), "belly")
    chest = part(Box((0.16, 0.09, 0.11)), (0, 0, 0.34), "chest")
    neck = part(Capsule(0.04, 0.02), (0, 0, 0.515), "neck")
    head = part(Sphere(0.1), (0, 0, 0.68), "head")
    joined(SphericalJoint(0.4), belly, hip, (0, 0, 0.08))
    joined(SphericalJoint(0.4), chest, belly, (0, 0, 0.22))
    joined(SphericalJoint(0.4), neck, chest, (0, 0, 0.455))
    joined(SphericalJoint(0.5), head, neck, (0, 0, 0.575))
    for side, label in ((-1, "left"), (1, "right")):
        _add_limb(part, joined, chest, (0.22 * side, 0, 0.42), (0.04, 0.09, 0.28), f"{label}_arm", (-0.1, 2.4))
        _add_limb(part, joined, hip, (0.09 * side, 0, -0.08), (0.055, 0.14, 0.42), f"{label}_leg", (-2.4, 0.1))
        heel = (0.09 * side, -0.06, -0.96)
        foot = part(Box((0.05, 0.12, 0.03)), heel, f"{label}_foot")
        joined(RevoluteJoint(X, (-0.6, 0.6)), foot, foot - 1, (0.09 * side, 0, -0.92))


def _add_limb(part, joined, body, start, size, label, limits):
    """An upper and a lower capsule below a point of a body."""
    radius, half, length = size
    x, y, z = start
    upper = part(Capsule(radius, half), (x, y, z - 0.5 * length), f"{label}_upper")
    lower = part(Capsule(0.9 * radius, half), (x, y, z - 1.5 * length), f"{label}_lower")
    joined(SphericalJoint(1.3), upper, body, start)
    joined(RevoluteJoint(X, limits), lower, upper, (x, y, z - length))
