"""Joints: what a scene states about them."""

from warp_rigid.scene.joints.joint import JOINTS, Drive, Joint, JointEntry, JointFrame
from warp_rigid.scene.joints.kinds import DistanceJoint, FixedJoint, PrismaticJoint, RevoluteJoint, SphericalJoint

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
