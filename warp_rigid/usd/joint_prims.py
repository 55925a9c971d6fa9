"""Joints of UsdPhysics: reading and writing.

A joint of UsdPhysics has a frame on each of two bodies; its second body moves relative to the first. It becomes the
first body of a joint of a scene. An axis Y or Z is turned to the x axis of both frames. Angles in files are in degrees.
"""

import math
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np
from pxr import Gf, Sdf, Usd, UsdPhysics

from warp_rigid import rotations
from warp_rigid.kernels.enums import Coordinate, JointNumber
from warp_rigid.scene.joints import (
    DistanceJoint,
    FixedJoint,
    Joint,
    JointEntry,
    PrismaticJoint,
    RevoluteJoint,
    SphericalJoint,
    local_frame,
    rotation_of_x_to,
    world_frame,
)
from warp_rigid.scene.scene import Motion, Scene
from warp_rigid.usd.actuators import read_servos
from warp_rigid.usd.conventions import MARK, custom_data, gf_quaternion, lineage, quaternion_of_matrix, xyzw
from warp_rigid.usd.masses import SHARE, insert_links, positive, stated_center, states_no_mass, with_point_mass
from warp_rigid.usd.prims import applies
from warp_rigid.usd.specs import define, set_attribute, set_relationship
from warp_rigid.usd.usd_file import JOINT_KINDS, Types, UsdFile

NAMES = Sdf.ValueTypeNames
JOINT_SCHEMAS = {"PhysicsDriveAPI", "PhysicsLimitAPI"}
RESISTANCES = ("newton:friction", "newton:damping", "newton:armature", "mjc:stiffness")
POSSIBLE = {
    Types.RevoluteJoint: {"drive:angular", *RESISTANCES},
    Types.PrismaticJoint: {"drive:linear", *RESISTANCES},
    Types.SphericalJoint: {"newton:damping"},
}
"""Which drives and resistances a kind of joint can have."""
AXES = {"X": (1.0, 0.0, 0.0), "Y": (0.0, 1.0, 0.0), "Z": (0.0, 0.0, 1.0)}
MUJOCO_JOINT = "MjcJointAPI"
"""Schema of the joints of a file that was converted from one of MuJoCo."""
PARALLEL = 0.9999
"""Cosine from which on two axes count as parallel."""
HALF_TURN = np.array([0.0, 1.0, 0.0, 0.0])
"""Rotation that reverses the x axis."""


class JointReader:
    """Adds the joints of a stage to a scene. A fixed joint makes a body without mass a part of another one.

    Args:
        file: the file.
        scene: the scene, with its bodies.
    """

    def __init__(self, file: UsdFile, scene: Scene):
        """Start without joints."""
        self._file, self._stage, self._scene = file, file.stage, scene
        self._parts: dict[str, str] = {}
        self._servos = read_servos(file)
        angles = [prim.GetAttribute("mjc:compiler:angle").Get() for prim in self._stage.Traverse()]
        # The file of MuJoCo from which a stage was converted states angles in degrees by default.
        self._in_degrees = "radian" not in map(str, angles)

    def read(self) -> None:
        """Add all joints, in the order of their paths."""
        found = self._file.described(*JOINT_KINDS)
        self._find_parts(found)
        self._lighten(found)
        series: dict[tuple[str, str], list[tuple[Usd.Prim, Any]]] = {}
        # MuJoCo applies the joints of a body in the order of the file.
        for prim in Usd.PrimRange(self._stage.GetPseudoRoot(), Usd.TraverseInstanceProxies()):
            path = str(prim.GetPath())
            if path not in found:
                continue
            description = found[path]
            if not description.jointEnabled:
                self._file.leave_out(path, "the joint is disabled")
                continue
            ends = (str(description.rel0), str(description.rel1)) if applies(prim, MUJOCO_JOINT) else (path, "")
            series.setdefault(ends, []).append((prim, description))
        for joints in series.values():
            self._add_series(joints)

    def _find_parts(self, found: dict[str, Any]) -> None:
        """Make each body without mass that fixed joints hold, directly or not, a part of what they hold it to."""
        pairs = _fixed_pairs(found)
        left = dict(self._file.massless)
        while taken := [(part, whole) for part, whole in pairs if part in left and whole not in left]:
            for part, whole in taken:
                self._parts[part] = whole
                left.pop(part, None)
        for part, whole in self._parts.items():
            prim = self._stage.GetPrimAtPath(part)
            self._file.change(prim, f"{self._file.massless[part]}: it is a part of {whole or 'the world'}")
            with suppress(ValueError):  # its mass cannot be read, or what it is a part of was left out
                self._add_mass(prim)
        for path, reason in left.items():
            self._file.leave_out(path, reason)

    def _add_mass(self, part: Usd.Prim) -> None:
        """Add the mass of a part without moments of inertia to the body that it is a part of."""
        index, mass = self._body(part), positive(UsdPhysics.MassAPI(part).GetMassAttr())
        if index is not None and mass is not None and self._scene.bodies[index].motion == Motion.DYNAMIC:
            position, rotation, stretch = self._file.frame(part)
            center = stated_center(part)
            point = position if center is None else position + rotation @ (stretch @ center)
            body = self._scene.bodies[index]
            local = rotations.rotate(rotations.inverse(np.array(body.orientation)), point - body.position)
            self._scene.bodies[index] = with_point_mass(body, local, mass * self._file.kilogram)

    def _lighten(self, found: dict[str, Any]) -> None:
        """Give bodies with colliders, for which the file states no mass, little of that of what they are fixed to."""
        for part, whole in _fixed_pairs(found):
            index, other = self._file.owners.get(part), self._file.owners.get(whole)
            prim = self._stage.GetPrimAtPath(part)
            if index is None or other is None or not states_no_mass(prim):
                continue
            if not states_no_mass(self._stage.GetPrimAtPath(whole)):
                body = self._scene.bodies[index]
                self._scene.bodies[index] = replace(body, mass=SHARE * self._scene.bodies[other].mass)
                self._file.change(prim, f"a mass of 0: it has {SHARE:.1%} of the mass of {whole}")

    def _add_series(self, joints: list[tuple[Usd.Prim, Any]]) -> None:
        """Add one joint, or several in series between two bodies, with bodies between them."""
        last, description = joints[-1]
        try:
            links: list[int | None] = []
            if len(joints) > 1:
                body = self._side(last, "1", description.rel1)[0]
                if body is None:
                    raise ValueError("joints in series must hold a rigid body")
                points = [self._point_of_link(body, prim, own) for prim, own in joints[1:]]
                names = [f"{self._scene.bodies[body].name}_{prim.GetName()}" for prim, _ in joints[:-1]]
                links = list(insert_links(self._scene, body, points, names))
                told = f"{len(joints)} joints in series: each body between them takes {SHARE:.1%} of the mass"
                self._file.change(last, told)
        except ValueError as error:
            self._file.leave_out(last.GetPath(), str(error))
            return
        ends = [None, *links, None]
        for k, (prim, own) in enumerate(joints):
            try:
                self._add(prim, own, (ends[k], ends[k + 1]))
            except ValueError as error:
                self._file.leave_out(prim.GetPath(), str(error))

    def _point_of_link(self, body: int, prim: Usd.Prim, description: Any) -> np.ndarray:
        """Where a body in front of a joint has its mass, in the frame of the body behind it.

        On the axis of a hinge, whose rotation does not move it, and otherwise at the centre of mass.
        """
        center = self._scene.bodies[body].shape.center_of_mass
        if description.type == Types.PrismaticJoint:
            return center
        frame = local_frame(self._scene.bodies[body], *self._side(prim, "1", description.rel1)[1:])
        anchor = np.array(frame.position)
        if description.type != Types.RevoluteJoint:
            return anchor
        axis = rotations.rotate(np.array(frame.orientation), np.array(AXES[str(description.axis)[-1].upper()]))
        return anchor + axis * float(axis @ (center - anchor))

    def _add(self, prim: Usd.Prim, description: Any, links: tuple[int | None, int | None]) -> None:
        """Add one joint; `links`: bodies in place of its first and second one."""
        first, second = self._side(prim, "0", description.rel0), self._side(prim, "1", description.rel1)
        first = first if links[0] is None else (links[0], *first[1:])
        second = second if links[1] is None else (links[1], *second[1:])
        if first[0] == second[0] and {str(description.rel0), str(description.rel1)} & self._parts.keys():
            return  # It holds a part of a body.
        axis = rotation_of_x_to(AXES[str(getattr(description, "axis", "X"))[-1].upper()])
        frames = [(point, rotations.multiply(orientation, axis)) for _, point, orientation in (second, first)]
        body_a, body_b = second[0], first[0]
        if body_a is None:
            body_a, body_b = body_b, body_a
            frames = [(point, rotations.multiply(orientation, HALF_TURN)) for point, orientation in reversed(frames)]
        if body_a is None:
            raise ValueError("the joint holds no rigid body")
        force = self._file.kilogram * self._file.meter
        index = self._scene.add_joint(
            self._joint(prim, description),
            body_a,
            body_b,
            frame_a=local_frame(self._scene.bodies[body_a], *frames[0]),
            frame_b=local_frame(None if body_b is None else self._scene.bodies[body_b], *frames[1]),
            name=prim.GetDisplayName() or prim.GetName(),
            break_force=_limit(description.breakForce * force),
            break_torque=_limit(description.breakTorque * force * self._file.meter),
            collide=bool(description.collisionEnabled),
            armature=_authored(prim, "newton:armature") * self._units(description.type)[2],
        )
        if not description.collisionEnabled:
            for side, path in ((first, description.rel0), (second, description.rel1)):
                self._filter_static(body_a, side[0], str(path))
        self._tell_losses(prim, description.type)
        self._add_drive(index, prim, description)
        if self._is_held_by_others(index):
            held = "another joint holds the same bodies about another axis, which prevents both rotations"
            self._file.change(prim, held)

    def _filter_static(self, body: int, other: int | None, path: str) -> None:
        """Keep a body and the static colliders at or below the prim that a joint holds it to, if any, apart."""
        for collider, index in self._file.body_of.items():
            is_below = collider == path or collider.startswith(path + "/")
            if other is None and path and is_below and self._scene.bodies[index].motion == Motion.STATIC:
                self._scene.filter_pair(body, index)

    def _is_held_by_others(self, index: int) -> bool:
        """Whether another hinge of the same bodies has an axis of another direction: files of robots have such ones."""
        bodies, joints = self._scene.bodies, self._scene.joints[: index + 1]
        if joints[index].joint.coordinate != Coordinate.ANGLE:
            return False
        pair = {joints[index].body_a, joints[index].body_b}
        hinges = [hinge for hinge in joints if hinge.joint.coordinate == Coordinate.ANGLE]
        same = [hinge for hinge in hinges if {hinge.body_a, hinge.body_b} == pair]
        axes = [rotations.matrix(world_frame(bodies[hinge.body_a], hinge.frame_a)[1])[:, 0] for hinge in same]
        return any(abs(float(axes[-1] @ axis)) < PARALLEL for axis in axes[:-1])

    def _side(self, prim: Usd.Prim, end: str, path: Any) -> tuple[int | None, np.ndarray, np.ndarray]:
        """The body of one end, None for the world, and the frame of the joint in the world."""
        target = self._stage.GetPrimAtPath(path) if str(path) else None
        body = self._body(target)
        position, rotation, stretch = self._file.frame(target)
        local = np.array(prim.GetAttribute(f"physics:localPos{end}").Get() or (0, 0, 0), dtype=np.float64)
        given = prim.GetAttribute(f"physics:localRot{end}").Get() or Gf.Quatf(1.0)
        orientation = rotations.multiply(quaternion_of_matrix(rotation), xyzw(given) / np.linalg.norm(xyzw(given)))
        return body, position + rotation @ (stretch @ local), orientation

    def _body(self, prim: Usd.Prim | None) -> int | None:
        """Index of the body to which a prim belongs; None if it belongs to none."""
        for above in lineage(prim):
            path = str(above.GetPath())
            if above.HasAPI(UsdPhysics.RigidBodyAPI) and UsdPhysics.RigidBodyAPI(above).GetRigidBodyEnabledAttr().Get():
                if path in self._parts:
                    whole = self._parts[path]
                    return self._body(self._stage.GetPrimAtPath(whole) if whole else None)
                if path not in self._file.owners:
                    raise ValueError(f"its body {path} was left out")
            found = self._file.owners.get(path, self._file.body_of.get(path))
            if found is not None:
                return found
        return None

    def _joint(self, prim: Usd.Prim, description: Any) -> Joint:
        """The joint with its limits."""
        kind = description.type
        friction = (
            float(custom_data(prim).get("friction", 0.0)) or _authored(prim, "newton:friction") * self._units(kind)[0]
        )
        start = self._mujoco_coordinate(prim, kind, "ref")
        if kind == Types.RevoluteJoint:
            return RevoluteJoint(AXES["X"], _range(description.limit, math.pi / 180.0, start), friction)
        if kind == Types.PrismaticJoint:
            return PrismaticJoint(AXES["X"], _range(description.limit, self._file.meter, start), friction)
        if kind == Types.DistanceJoint:
            low, high = (float(x) * self._file.meter for x in (description.limit.lower, description.limit.upper))
            return DistanceJoint(low if description.minEnabled else None, high if description.maxEnabled else None)
        if kind == Types.FixedJoint:
            return FixedJoint()
        angles = [prim.GetAttribute(f"physics:coneAngle{k}Limit").Get() for k in (0, 1)]
        given = {math.inf if angle is None or angle < 0.0 else math.radians(angle) for angle in angles}
        if len(given) > 1:
            self._file.change(prim, "both cone angles are the smaller one")
        if min(given) < math.inf and applies(prim, MUJOCO_JOINT):
            self._file.change(prim, "its limit, which is one of all rotations, leaves those about its axis free")
        return SphericalJoint(None if min(given) == math.inf else min(given), AXES["X"])

    def _tell_losses(self, prim: Usd.Prim, kind: Any) -> None:
        """Report drives, limits and resistances that a file states for a joint whose kind cannot have them."""
        motors = [name for name in prim.GetAuthoredPropertyNames() if name.startswith(("drive:", "limit:"))]
        stated = dict.fromkeys(":".join(name.split(":")[:2]) for name in motors)
        for name in [*stated, *(name for name in RESISTANCES if _authored(prim, name) > 0.0)]:
            if name not in POSSIBLE.get(kind, ()):
                self._file.leave_out(prim.GetPath(), f"{name}: not supported for a {str(kind).rpartition('.')[2]}")

    def _units(self, kind: Any) -> tuple[float, float, float]:
        """Units of force or torque, of the coordinate, and of the armature of a joint in the file; of none 0."""
        kilogram, meter = self._file.kilogram, self._file.meter
        if kind == Types.PrismaticJoint:
            return kilogram * meter, meter, kilogram
        torque = kilogram * meter**2
        return torque, math.pi / 180.0, torque if kind == Types.RevoluteJoint else 0.0

    def _add_drive(self, joint: int, prim: Usd.Prim, description: Any) -> None:
        """Add the drive or the damping of a joint, in SI units; damping alone is a drive without stiffness."""
        coordinate = self._scene.joints[joint].joint.coordinate
        if coordinate not in (Coordinate.ANGLE, Coordinate.SLIDE, Coordinate.CONE):
            return
        force, unit, _ = self._units(description.type)
        passive = float(custom_data(prim).get("damping", 0.0)) or _authored(prim, "newton:damping") * force / unit
        drive = getattr(description, "drive", None)
        if drive is None or not drive.enabled:
            self._add_spring(joint, prim, description, passive)
            return
        if drive.acceleration:
            self._file.change(prim, "its drive is a force, not an acceleration")
        if passive > 0.0:
            self._file.change(prim, "its damping is that of its drive: newton:damping is added to it")
        self._scene.add_drive(
            joint,
            stiffness=drive.stiffness * force / unit,
            damping=drive.damping * force / unit + passive,
            max_force=_limit(drive.forceLimit * force),
            target_position=drive.targetPosition * unit,
            target_velocity=drive.targetVelocity * unit,
        )

    def _add_spring(self, joint: int, prim: Usd.Prim, description: Any, damping: float) -> None:
        """Add the damping of a joint, and the spring and the servo that files of MuJoCo give it, as one drive."""
        stiffness, servo = _authored(prim, "mjc:stiffness"), self._servos.get(str(prim.GetPath()))
        if description.type == Types.SphericalJoint:
            stiffness = 0.0
        rest, start = (self._mujoco_coordinate(prim, description.type, name) for name in ("springref", "ref"))
        torque = stiffness * (rest - start)
        largest = math.inf
        if servo is not None:
            torque += servo.offset - servo.stiffness * start
            stiffness, damping, largest = stiffness + servo.stiffness, damping + servo.damping, servo.largest
            if servo.largest < math.inf and (stiffness > servo.stiffness or damping > servo.damping):
                self._file.change(prim, "the largest force of its actuator also limits its spring and its damping")
        if stiffness > 0.0 or damping > 0.0:
            target = torque / stiffness if stiffness > 0.0 else 0.0
            self._scene.add_drive(
                joint, stiffness=stiffness, damping=damping, max_force=largest, target_position=target
            )

    def _mujoco_coordinate(self, prim: Usd.Prim, kind: Any, name: str) -> float:
        """A coordinate in the convention of MuJoCo, whose value at the initial pose is `mjc:ref` [rad or m]."""
        value = prim.GetAttribute(f"mjc:{name}").Get()
        if value is None or kind == Types.SphericalJoint:
            return 0.0
        return float(value) * (math.pi / 180.0 if self._in_degrees and kind == Types.RevoluteJoint else 1.0)


def _fixed_pairs(found: dict[str, Any]) -> list[tuple[str, str]]:
    """Paths of the bodies that fixed joints hold to each other, in both orders."""
    pairs = [
        (str(description.rel0), str(description.rel1))
        for description in found.values()
        if description.type == Types.FixedJoint and description.jointEnabled
    ]
    return pairs + [pair[::-1] for pair in pairs]


def _authored(prim: Usd.Prim, name: str) -> float:
    """A positive number that a file sets; 0 if it does not."""
    value = prim.GetAttribute(name).Get()
    return max(float(value), 0.0) if value is not None and math.isfinite(value) else 0.0


def _limit(value: float) -> float:
    """A limit of a force; the largest float32 stands for infinity."""
    return value if 0.0 <= value < 1.0e37 else math.inf


def _range(limit: Any, unit: float, start: float) -> tuple[float, float] | None:
    """Limits in SI units, less the coordinate at the initial pose; None if there are none."""
    if not limit.enabled:
        return None
    low, high = (
        value if abs(value) < 1.0e37 else math.copysign(math.inf, value) for value in (limit.lower, limit.upper)
    )
    return low * unit - start, high * unit - start


def write_joint(
    layer: Sdf.Layer, path: str, entry: JointEntry, numbers: dict[JointNumber, float], is_broken: bool, paths: list[str]
) -> None:
    """Define a joint.

    Args:
        layer: receives the prim.
        path: of the prim.
        entry: the joint.
        numbers: its numbers, which can differ from those of the entry.
        is_broken: whether it has no effect.
        paths: paths of the bodies, and last that of the world of their environment.
    """
    coordinate = entry.joint.coordinate
    kind = "angular" if coordinate == Coordinate.ANGLE else "linear"
    has_motor = entry.drive is not None or numbers[JointNumber.STIFFNESS] > 0.0 or numbers[JointNumber.DAMPING] > 0.0
    is_driven = has_motor and coordinate not in (Coordinate.NONE, Coordinate.CONE)
    armature = numbers[JointNumber.ARMATURE]
    schemas = [f"PhysicsDriveAPI:{kind}"] * is_driven + ["NewtonJointAPI"] * (armature > 0.0)
    prim = define(layer, path, f"Physics{type(entry.joint).__name__}", schemas)
    if armature > 0.0:
        set_attribute(prim, "newton:armature", NAMES.Float, armature)
    for end, body, frame in (("0", entry.body_b, entry.frame_b), ("1", entry.body_a, entry.frame_a)):
        set_relationship(prim, f"physics:body{end}", paths[-1 if body is None else body])
        set_attribute(prim, f"physics:localPos{end}", NAMES.Point3f, Gf.Vec3f(*frame.position))
        set_attribute(prim, f"physics:localRot{end}", NAMES.Quatf, gf_quaternion(frame.orientation))
    set_attribute(prim, "physics:collisionEnabled", NAMES.Bool, entry.collide)
    if is_broken:
        set_attribute(prim, "physics:jointEnabled", NAMES.Bool, False)
    if coordinate not in (Coordinate.NONE, Coordinate.LENGTH):
        set_attribute(prim, "physics:axis", NAMES.Token, "X", uniform=True)
    damping = numbers[JointNumber.DAMPING] if has_motor and not is_driven else 0.0
    own = {"friction": numbers[JointNumber.FRICTION], "damping": damping}
    if any(own.values()):
        prim.SetInfo("customData", {MARK: {name: value for name, value in own.items() if value > 0.0}})
    unit = math.pi / 180.0 if coordinate == Coordinate.ANGLE else 1.0
    written = {"breakForce": numbers[JointNumber.BREAK_FORCE], "breakTorque": numbers[JointNumber.BREAK_TORQUE]}
    written |= _limits(coordinate, numbers[JointNumber.LOWER] / unit, numbers[JointNumber.UPPER] / unit)
    drive = {
        "stiffness": numbers[JointNumber.STIFFNESS] * unit,
        "damping": numbers[JointNumber.DAMPING] * unit,
        "maxForce": numbers[JointNumber.MAX_FORCE],
        "targetPosition": numbers[JointNumber.TARGET_POSITION] / unit,
        "targetVelocity": numbers[JointNumber.TARGET_VELOCITY] / unit,
    }
    for space, values_of in (("physics", written), (f"drive:{kind}:physics", drive if is_driven else {})):
        for name, value in values_of.items():
            set_attribute(prim, f"{space}:{name}", NAMES.Float, value)


def _limits(coordinate: Coordinate, low: float, high: float) -> dict[str, float]:
    """The attributes with the limits of a joint, in units of the file but for the cone."""
    least, most = (limit if math.isfinite(limit) else -1.0 for limit in (low, high))  # below 0 there is none
    if coordinate == Coordinate.LENGTH:
        return {"minDistance": least, "maxDistance": most}
    if coordinate == Coordinate.CONE:
        return dict.fromkeys(("coneAngle0Limit", "coneAngle1Limit"), math.degrees(most) if most >= 0.0 else most)
    is_limited = coordinate != Coordinate.NONE and (math.isfinite(low) or math.isfinite(high))
    return {"lowerLimit": low, "upperLimit": high} if is_limited else {}
