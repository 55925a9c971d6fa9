"""A hanging arm of equal links with driven hinges, and the target angles of its drives."""

import numpy as np

from warp_rigid.scene.joints import RevoluteJoint
from warp_rigid.scene.scene import Scene
from warp_rigid.scene.shapes import Box

LINK = Box((0.02, 0.02, 0.08))
PITCH, CLEARANCE = 0.2, 0.3
"""Distance of the hinges, and of the lowest one from the ground when the arm hangs straight [m]."""
AXES = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
"""Axes of the hinges, in turn."""
LIMIT, MOST_TARGET = 2.5, 0.5
"""Limit of each angle, and largest target of a drive [rad]."""
STIFFNESS, DAMPING, MAX_TORQUE = 20.0, 1.0, 50.0
"""Drive of each hinge [N m/rad, N m s/rad, N m]."""


def add_arm(scene: Scene, links: int, density: float, friction: float) -> None:
    """Add an arm that hangs straight down from a hinge above the origin."""
    above, top = None, CLEARANCE + PITCH * links
    for k in range(links):
        center = (0.0, 0.0, top - PITCH * (k + 0.5))
        link = scene.add_body(LINK, position=center, density=density, friction=friction, name=f"link_{k}")
        hinge = RevoluteJoint(AXES[k % 2], limits=(-LIMIT, LIMIT))
        joint = scene.add_joint(hinge, link, above, anchor=(0.0, 0.0, top - PITCH * k), name=f"hinge_{k}")
        scene.add_drive(joint, stiffness=STIFFNESS, damping=DAMPING, max_force=MAX_TORQUE)
        above = link


def targets(links: int, seed: int) -> np.ndarray:
    """Random target angles of the drives of an arm, (links,) [rad]."""
    return np.random.default_rng(seed).uniform(-MOST_TARGET, MOST_TARGET, links)
