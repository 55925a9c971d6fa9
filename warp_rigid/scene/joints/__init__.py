"""Joints: what a scene states about them, one file a kind."""

from warp_rigid.scene.joints.distance_joint import DistanceJoint
from warp_rigid.scene.joints.fixed_joint import FixedJoint
from warp_rigid.scene.joints.joint import JOINTS, Drive, Joint, JointEntry, JointFrame
from warp_rigid.scene.joints.prismatic_joint import PrismaticJoint
from warp_rigid.scene.joints.revolute_joint import RevoluteJoint
from warp_rigid.scene.joints.spherical_joint import SphericalJoint

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
