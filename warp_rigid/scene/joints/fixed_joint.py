"""Fixed joint (weld): no relative motion."""

from dataclasses import dataclass

from warp_rigid.scene.joints.joint import ANGULAR, LINEAR, Joint


@dataclass(frozen=True)
class FixedJoint(Joint):
    """Holds two bodies in their relative pose, as if they were welded."""

    locked = LINEAR | ANGULAR
