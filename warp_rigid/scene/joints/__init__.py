"""Joints: what a scene states about them."""

from warp_rigid.scene.joints.joint import (
    JOINTS,
    DistanceJoint,
    Drive,
    FixedJoint,
    Joint,
    JointEntry,
    JointFrame,
    PrismaticJoint,
    RevoluteJoint,
    SphericalJoint,
)

__all__ = [
    "JOINTS",
    "DistanceJoint",
    "Drive",
    "FixedJoint",
    "JointFrame",
    "Joint",
    "JointEntry",
    "PrismaticJoint",
    "RevoluteJoint",
    "SphericalJoint",
]
