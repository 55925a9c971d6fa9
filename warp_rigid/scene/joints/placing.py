"""Placing a joint between two bodies of a scene, with all checks."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from warp_rigid import rotations
from warp_rigid.checks import finite_vector, number_in, shown, unit_quaternion
from warp_rigid.kernels.enums import Coordinate, Motion
from warp_rigid.scene.joints.joint import JOINTS, Joint, JointEntry, JointFrame, largest

FURTHEST = 0.1
"""Largest distance of two anchors that should coincide, as a fraction of the smaller body's size."""


def place_joint(
    bodies: Sequence[Any],
    joint: Joint,
    body_a: int,
    body_b: int | None,
    anchors: tuple[Any, Any],
    frames: tuple[JointFrame | None, JointFrame | None],
    **more: Any,
) -> JointEntry:
    """Return the entry of a joint; see Scene.add_joint.

    Args:
        bodies: the bodies of the scene.
        joint: the joint.
        body_a: index of the first body.
        body_b: index of the second body; None for the world.
        anchors: (3,) points of the two bodies in the world [m]; the second one None where both are the same.
        frames: frames fixed to the bodies, used instead of the anchors; None for both otherwise.
        **more: the other attributes of JointEntry.
    """
    _check_bodies(bodies, joint, body_a, body_b)
    a = bodies[body_a]
    b = None if body_b is None else bodies[body_b]
    if frames[0] is None or frames[1] is None:
        point_a = finite_vector("anchor", anchors[0])
        point_b = point_a if anchors[1] is None else finite_vector("anchor_b", anchors[1])
        orientation = rotation_of_x_to(joint.world_axis)
        frame_a, frame_b = local_frame(a, point_a, orientation), local_frame(b, point_b, orientation)
    else:
        frame_a, frame_b = _checked_frame("frame_a", frames[0]), _checked_frame("frame_b", frames[1])
    _check_anchors(joint, a, b, frame_a, frame_b)
    return JointEntry(joint, body_a, body_b, frame_a, frame_b, **_checked_rest(joint, more))


def rotation_of_x_to(axis: Sequence[float]) -> np.ndarray:
    """Return the shortest rotation of the x axis to a unit vector, as a quaternion (x, y, z, w)."""
    x, y, z = axis
    if x < -0.999999:
        return np.array([0.0, 0.0, 1.0, 0.0])
    orientation = np.array([0.0, -z, y, 1.0 + x])
    return orientation / np.linalg.norm(orientation)


def world_frame(body: Any, frame: JointFrame) -> tuple[np.ndarray, np.ndarray]:
    """Return the origin and the orientation of a frame in the world, at the body's initial pose; None is the world."""
    if body is None:
        return np.array(frame.position), np.array(frame.orientation)
    orientation = np.array(body.orientation)
    origin = np.array(body.position) + rotations.matrix(orientation) @ np.array(frame.position)
    return origin, rotations.multiply(orientation, np.array(frame.orientation))


def local_frame(body: Any, point: Sequence[float] | np.ndarray, orientation: np.ndarray) -> JointFrame:
    """Return a frame of the world (3,), (4,) in the frame of a body at its initial pose; None is the world."""
    position = np.array(point, np.float64)
    if body is not None:
        own = np.array(body.orientation)
        position = rotations.rotate(rotations.inverse(own), position - body.position)
        orientation = rotations.multiply(rotations.inverse(own), orientation)
    x, y, z, w = orientation.tolist()
    return JointFrame((float(position[0]), float(position[1]), float(position[2])), (x, y, z, w))


def _checked_frame(name: str, frame: JointFrame) -> JointFrame:
    if not isinstance(frame, JointFrame):
        raise ValueError(f"{name}: must be a JointFrame, got {shown(frame)}")
    return JointFrame(
        finite_vector(f"{name} position", frame.position), unit_quaternion(f"{name} orientation", frame.orientation)
    )


def _check_bodies(bodies: Sequence[Any], joint: Joint, body_a: int, body_b: int | None) -> None:
    if not isinstance(joint, Joint):
        raise ValueError(f"joint: must be a {', '.join(sorted(JOINTS))}, got {shown(joint)}")
    if body_a == body_b:
        raise ValueError(f"body_b: must be another body than body_a, got {body_b} for both")
    both = [bodies[body].motion for body in (body_a, body_b) if body is not None]
    if Motion.DYNAMIC not in both:
        kinds = " and ".join([motion.name.lower() for motion in both] + ["the world"] * (body_b is None))
        raise ValueError(f"body_b: one of the two bodies must be dynamic, got {kinds}")


def _check_anchors(joint: Joint, a: Any, b: Any, frame_a: JointFrame, frame_b: JointFrame) -> None:
    """Points that the joint holds together must be close, and a distance must not be far from its limits."""
    (point_a, _), (point_b, turn_b) = world_frame(a, frame_a), world_frame(b, frame_b)
    size = min(float(body.shape.size) for body in (a, b) if body is not None)
    apart = rotations.matrix(turn_b).T @ (point_a - point_b)
    if joint.coordinate == Coordinate.LENGTH:
        lower, upper = joint.range
        distance = float(np.linalg.norm(apart))
        error, what = max(lower - distance, distance - upper, 0.0), f"distance {distance:g} m from its limits"
        if distance < 1e-6 and upper > 1e-6 and lower > 0.0:
            raise ValueError("anchor_b: must not coincide with anchor for a joint with a minimum")
    else:
        held = np.array([bool(joint.locked >> axis & 1) for axis in range(3)])
        error, what = float(np.linalg.norm(apart[held])), "anchors"
    if error > FURTHEST * size:
        raise ValueError(
            f"anchor: the {what} must be at most {FURTHEST * size:g} m apart, a tenth of the smaller body's size, "
            f"got {error:g} m"
        )


def _checked_rest(joint: Joint, more: dict[str, Any]) -> dict[str, Any]:
    """Check the remaining attributes of an entry."""
    for name in ("break_force", "break_torque"):
        more[name] = largest(name, more[name], above=0.0)
    more["armature"] = number_in("armature", more["armature"], 0.0)
    if more["armature"] > 0.0 and joint.coordinate not in (Coordinate.ANGLE, Coordinate.SLIDE):
        raise ValueError(f"armature: needs a RevoluteJoint or a PrismaticJoint, got a {type(joint).__name__}")
    if not isinstance(more["collide"], bool):
        raise ValueError(f"collide: must be True or False, got {shown(more['collide'])}")
    if not isinstance(more["name"], str):
        raise ValueError(f"name: must be a string, got {shown(more['name'])}")
    return more
