"""Reader of stages with UsdPhysics."""

from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from pxr import Sdf, Usd, UsdGeom, UsdPhysics, UsdShade

from warp_rigid import rotations
from warp_rigid.scene.camera import Camera, with_body_index
from warp_rigid.scene.import_report import ImportFinding
from warp_rigid.scene.pose_path import PosePath
from warp_rigid.scene.scene import Motion, Scene
from warp_rigid.scene.shapes import Compound, Heightfield, Shape
from warp_rigid.usd.actuators import ACTUATOR
from warp_rigid.usd.cameras import read_camera
from warp_rigid.usd.conventions import (
    FOLLOWS_PATH,
    FROM_Y_UP,
    animation_codes,
    custom_data,
    first_time,
    is_y_up,
    kilograms_per_unit,
    lineage,
    meters_per_unit,
    polar,
    quaternion_of_matrix,
    transform,
)
from warp_rigid.usd.field_data import fields_from_data
from warp_rigid.usd.filters import filter_pairs, linked
from warp_rigid.usd.instancing import OF_ORIGIN, expand_instancers
from warp_rigid.usd.joint_prims import JOINT_KINDS, JOINT_SCHEMAS, JointReader
from warp_rigid.usd.masses import Collider, MassReader, is_of_mujoco, positive, scale_to_total
from warp_rigid.usd.materials import read_material
from warp_rigid.usd.opening import open_stage
from warp_rigid.usd.preview_surface import read_look
from warp_rigid.usd.prims import Unreadable, convert_prim, described, matrix_of
from warp_rigid.usd.surface_motion import SURFACE_SCHEMA, has_surface_motion, read_surface_motion

EARTH_GRAVITY = 9.81
SCALE_TOLERANCE = 1e-3
"""Relative change of an animated scale that counts as none."""

Types = UsdPhysics.ObjectType
COLLIDERS = {
    Types.SphereShape, Types.CubeShape, Types.CapsuleShape, Types.Capsule1Shape, Types.CylinderShape,
    Types.Cylinder1Shape, Types.ConeShape, Types.MeshShape, Types.PlaneShape,
    Types.CustomShape, Types.SpherePointsShape,
}  # fmt: skip
SUPPORTED = {
    Types.Scene, Types.RigidBody, Types.RigidBodyMaterial, Types.CollisionGroup, *COLLIDERS, *JOINT_KINDS,
    Types.Articulation,
}  # fmt: skip
"""Kinds of objects with a counterpart in a scene. An articulation is no more than its joints."""

SCHEMAS = {
    "PhysicsRigidBodyAPI", "PhysicsMassAPI", "PhysicsCollisionAPI", "PhysicsMeshCollisionAPI", "PhysicsMaterialAPI",
    "PhysicsFilteredPairsAPI", "NewtonSDFCollisionAPI", "NewtonMaterialAPI", SURFACE_SCHEMA, *JOINT_SCHEMAS,
}  # fmt: skip
FAMILIES = ("Physics", "Physx", "Newton", "Mjc", "Isaac")
"""Prefixes of physics schemas."""


NAMED = {"Newton": "newton:", "Mjc": "mjc:"}
"""Families whose schemas are applied without need: only the attributes with this prefix that a file sets count."""
CUSTOM = ("mjc:body:",)
"""Prefixes of attributes that the converter of MuJoCo's files writes without a schema."""
READ = {
    "newton:armature", "newton:damping", "newton:friction", "newton:inertia", "newton:rollingFriction",
    "newton:torsionalFriction", "mjc:compiler:angle", "mjc:compiler:setTotalMass", "mjc:ref", "mjc:springref",
    "mjc:stiffness",
}  # fmt: skip
"""Attributes of these families that have a counterpart in a scene."""


@dataclass
class _Body:
    """A body of the file: its prim, its type of motion and the prims of its colliders."""

    prim: Usd.Prim
    motion: Motion
    colliders: list[Usd.Prim] = field(default_factory=list)


class Reader:
    """Reads one file and builds the scene that it describes.

    Args:
        path: path of the file.
        root: path of the prim below which to read; None reads the whole stage.
        sdf_resolution: resolution of meshes without their own.

    Attributes:
        findings: differences between the file and the scene.
        prims: indices of the movable bodies by the paths of their prims.
        cameras: cameras by the paths of their prims.
        files: paths of the file and of all that it refers to.
        stage: the stage.
        meter: its length unit [m].
        kilogram: its mass unit [kg].
        body_of: body index by collider path.
        owners: body index by the path of the prim that is the body.
        massless: reasons why bodies have no mass, by the paths of their prims.

    Raises:
        ValueError: The file is not a USD file or does not have the root prim.
    """

    def __init__(self, path: Path, root: str | None, sdf_resolution: int):
        """Open the file and expand its instancers in memory."""
        self.path, self.findings = path, []
        self.prims: dict[str, int] = {}
        self.cameras: dict[str, Camera] = {}
        self._sdf_resolution = sdf_resolution
        self.stage = open_stage(path)
        self.files = tuple(layer.realPath for layer in self.stage.GetUsedLayers() if layer.realPath)
        for error in self.stage.GetCompositionErrors():
            self.leave_out(error.rootSite.path, " ".join(str(error).split()))
        self.stage.SetEditTarget(self.stage.GetSessionLayer())
        if root is not None and not (Sdf.Path.IsValidPathString(root) and self.stage.GetPrimAtPath(root)):
            raise ValueError(f"root: {path} has no prim {root}")
        self._root = self.stage.GetPrimAtPath(root) if root else self.stage.GetPseudoRoot()
        self._start = first_time(self.stage)
        expand_instancers(self._root, [self._start])
        self._transforms = UsdGeom.XformCache(self._start)
        self.meter = meters_per_unit(self.stage)
        self.kilogram = kilograms_per_unit(self.stage)
        self._below = list(Usd.PrimRange(self._root, Usd.TraverseInstanceProxies()))
        self._to_z_up = FROM_Y_UP if is_y_up(self.stage) else np.eye(3)
        self._shapes: dict[str, Shape] = {}
        self.body_of: dict[str, int] = {}
        self.owners: dict[str, int] = {}
        self.massless: dict[str, str] = {}

    def scene(self) -> Scene:
        """Build the scene.

        Raises:
            ValueError: The file has no body that can be imported, or several different gravities.
        """
        objects = UsdPhysics.UsdPhysicsLoadStageFromPrimRange(self.stage, [str(self._root.GetPath())])
        self._report_unsupported(objects)
        scene = self._empty_scene(objects)
        bodies = self._bodies(objects)
        self._report_surfaces(bodies)
        for body in bodies:
            self._add(scene, body)
        scale_to_total(self.stage, scene)
        descriptions = dict(described(objects, COLLIDERS))
        members = {path: {path} for path, body in described(objects, {Types.RigidBody}) if body.rigidBodyEnabled}
        joints = {path: {str(joint.body0), str(joint.body1)} for path, joint in described(objects, JOINT_KINDS)}
        for path, articulation in described(objects, {Types.Articulation}):
            # The parser names the bodies only if the root is above them, not if it is one of them, or a joint.
            named = {str(body) for body in articulation.articulatedBodies} or joints.get(path, {path})
            members[path] = linked(named & members.keys(), joints.values())
        filter_pairs(self.stage, scene, self.body_of, descriptions, members, self.leave_out)
        JointReader(self, scene).read(objects)
        self._read_cameras(scene)
        if not scene.bodies:
            reason = f"; {self.findings[0]}" if self.findings else ""
            raise ValueError(
                f"{self.path}: has no rigid bodies or colliders of UsdPhysics{reason}; export animations with "
                "profile='scene' to include them"
            )
        return scene

    def _read_cameras(self, scene: Scene) -> None:
        """Read the cameras of the file; the scene gets the only one."""
        middle = np.median([body.position for body in scene.bodies], axis=0) if scene.bodies else np.zeros(3)
        for prim in self._below:
            if prim.IsA(UsdGeom.Camera):
                try:
                    position, rotation, _ = self._frame(prim, self._transforms)
                    camera = read_camera(prim, transform(rotation, position), self.meter, middle, self.change)
                    self.cameras[str(prim.GetPath())] = with_body_index(camera, [body.name for body in scene.bodies])
                except ValueError as error:
                    self.leave_out(prim.GetPath(), str(error))
        if len(self.cameras) == 1:
            scene.camera = next(iter(self.cameras.values()))

    def leave_out(self, prim, reason: str) -> None:
        """Report what of a path the scene lacks."""
        self.findings.append(ImportFinding(str(prim), "left out", reason))

    def change(self, prim: Usd.Prim, reason: str) -> None:
        """Report what of a prim is different in the scene."""
        self.findings.append(ImportFinding(str(prim.GetPath()), "changed", reason))

    def _report_unsupported(self, objects: dict) -> None:
        """Report physics content without a counterpart in a scene."""
        for kind, (paths, _) in objects.items():
            if kind not in SUPPORTED:
                for path in paths:
                    self.leave_out(path, f"{str(kind).rpartition('.')[2]} is not supported: bodies move freely")
        for prim in self._below:
            unsupported = [
                schema
                for schema in prim.GetPrimTypeInfo().GetAppliedAPISchemas()
                if schema.startswith(FAMILIES) and schema.split(":")[0] not in SCHEMAS | {"PhysicsArticulationRootAPI"}
            ]
            for reason in _losses(prim, unsupported):
                self.leave_out(prim.GetPath(), reason)
            kind = prim.GetTypeName()
            if kind and kind != ACTUATOR and not prim.GetPrimTypeInfo().GetSchemaTypeName():
                self.leave_out(prim.GetPath(), f"type {kind} is not supported")

    def _report_surfaces(self, bodies: list[_Body]) -> None:
        """Report surfaces that run, but not on a static or kinematic body."""
        running = {str(body.prim.GetPath()) for body in bodies if body.motion != Motion.DYNAMIC}
        for prim in self._below:
            if has_surface_motion(prim) and str(prim.GetPath()) not in running:
                self.leave_out(prim.GetPath(), "only the surface of a static or kinematic body can run")

    def _empty_scene(self, objects: dict) -> Scene:
        """Create a scene with gravity, combine modes and force fields."""
        found = {}
        for path, description in described(objects, {Types.Scene}):
            strength = description.gravityMagnitude * self.meter
            found[path] = tuple(self._to_z_up @ np.array(description.gravityDirection) * strength)
        if len({tuple(np.round(gravity, 6)) for gravity in found.values()}) > 1:
            roots = ", ".join(str(Sdf.Path(path).GetParentPath()) for path in found)
            raise ValueError(f"{self.path}: has several gravities; set root to one of {roots}")
        custom = custom_data(self.stage.GetPrimAtPath(next(iter(found)))) if found else {}
        # MuJoCo takes the larger friction of two bodies.
        of_mujoco = any(is_of_mujoco(self.stage.GetPrimAtPath(path)) for path, _ in described(objects, COLLIDERS))
        scene = Scene(
            gravity=next(iter(found.values()), (0.0, 0.0, -EARTH_GRAVITY)),
            friction_combine=custom.get("frictionCombine", "max" if of_mujoco else "min"),
            restitution_combine=custom.get("restitutionCombine", "min"),
        )
        for force_field in fields_from_data(custom):
            scene.add_force_field(force_field)
        return scene

    def _bodies(self, objects: dict) -> list[_Body]:
        """Bodies in file order, each with its enabled colliders."""
        bodies: dict[str, _Body] = {}
        for path, description in described(objects, {Types.RigidBody}):
            if description.rigidBodyEnabled:
                motion = Motion.KINEMATIC if description.kinematicBody else Motion.DYNAMIC
                bodies[path] = _Body(self.stage.GetPrimAtPath(path), motion)
        for path, description in described(objects, COLLIDERS):
            if not description.collisionEnabled:
                continue
            prim = self.stage.GetPrimAtPath(path)
            owner = str(description.rigidBody)
            if owner not in bodies:
                group = self._static_owner(prim)
                owner = str(group.GetPath())
                bodies.setdefault(owner, _Body(group, Motion.STATIC))
            bodies[owner].colliders.append(prim)
        order = {str(prim.GetPath()): index for index, prim in enumerate(self._below)}
        for body in bodies.values():
            body.colliders.sort(key=lambda prim: order[str(prim.GetPath())])
        return [bodies[path] for path in sorted(bodies, key=lambda path: order[path])]

    @staticmethod
    def _static_owner(prim: Usd.Prim) -> Usd.Prim:
        """The prim written by this package for a static body with several colliders, else the collider itself."""
        return next((above for above in lineage(prim) if "motion" in custom_data(above)), prim)

    def _add(self, scene: Scene, body: _Body) -> None:
        """Add one body, or several for static colliders of one prim that cannot form a compound."""
        try:
            position, rotation, stretch = self._frame(body.prim, self._transforms)
        except Unreadable as error:
            self.leave_out(body.prim.GetPath(), str(error))
            return
        found = [collider for prim in body.colliders if (collider := self._collider(prim, body, stretch))]
        if not found:
            self._add_without_colliders(scene, body, position, rotation, stretch)
            return
        groups = []
        for collider in found:
            moves = body.motion == Motion.KINEMATIC and isinstance(collider.shape, Heightfield)
            if collider.shape.static_only and (moves or body.motion == Motion.STATIC):
                groups.append([collider])
            elif collider.shape.static_only:
                self.leave_out(collider.prim.GetPath(), "planes and height fields cannot be dynamic")
        groups.append([collider for collider in found if not collider.shape.static_only])
        motion = self._motion(body)
        for group in filter(None, groups):
            self._add_group(scene, body, group, (position, rotation, stretch), motion)

    @property
    def _masses(self) -> MassReader:
        # Not kept: a reader that refers to itself would keep the stage open, and a changed file would not be read anew.
        return MassReader(self.kilogram, self.meter, self.change)

    def _add_without_colliders(self, scene: Scene, body: _Body, position, rotation, stretch: np.ndarray) -> None:
        """Add a dynamic body that touches nothing, from its mass and its moments of inertia."""
        reason = "none of its colliders can be imported" if body.colliders else "it has no enabled collider"
        if body.motion == Motion.DYNAMIC:
            try:
                shape, mass = self._masses.without_colliders(body.prim, stretch)
                index = scene.add_body(
                    shape,
                    mass=mass,
                    position=position,
                    orientation=quaternion_of_matrix(rotation),
                    name=body.prim.GetDisplayName() or body.prim.GetName(),
                    **self._velocities(body.prim, rotation, shape.center_of_mass),
                )
                self._keep_index(body, index)
                self.change(body.prim, f"{reason}: it touches nothing")
                return
            except ValueError as error:
                self.massless[str(body.prim.GetPath())] = f"{reason}, {error}"
                return
        self.leave_out(body.prim.GetPath(), reason)

    def _add_group(self, scene: Scene, body: _Body, group: list[Collider], frame, motion: PosePath | None) -> None:
        position, rotation, stretch = frame
        shape, place_in_body, orientation = _joined(group, body.motion)
        common: dict[str, Any] = {
            "position": position + rotation @ place_in_body,
            "orientation": quaternion_of_matrix(rotation @ rotations.matrix(orientation)),
            "name": body.prim.GetDisplayName() or body.prim.GetName(),
            **group[0].coefficients,
        }
        if any(collider.coefficients != group[0].coefficients for collider in group):
            self.change(body.prim, f"all its colliders get the material of {group[0].prim.GetName()}")
        try:
            if body.motion != Motion.DYNAMIC:
                surface = read_surface_motion(body.prim, rotation, stretch, self._to_z_up, self.meter)
                common |= surface.in_frame(place_in_body, rotations.matrix(orientation)).keywords
            if body.motion == Motion.STATIC:
                index = scene.add_static(shape, **common)
            elif motion is not None:
                del common["position"], common["orientation"]
                index = scene.add_kinematic(shape, **common, path=motion)
            elif body.motion == Motion.KINEMATIC:
                center = place_in_body + rotations.rotate(orientation, shape.center_of_mass)
                index = scene.add_kinematic(shape, **common, **self._velocities(body.prim, rotation, center))
            else:
                shape, mass = self._masses.of_colliders(body.prim, group, shape, stretch)
                center = place_in_body + rotations.rotate(orientation, shape.center_of_mass)
                velocities = self._velocities(body.prim, rotation, center)
                index = scene.add_body(shape, mass=mass, **common, **velocities)
        except ValueError as error:
            self.leave_out(body.prim.GetPath(), str(error))
            return
        self.body_of |= {str(collider.prim.GetPath()): index for collider in group}
        look = read_look(body.prim, shape.surface_uv() is not None, partial(self.change, body.prim))
        if look is not None:
            scene.looks[index] = look
        self._keep_index(body, index)

    def _keep_index(self, body: _Body, index: int) -> None:
        """Note which body of the scene a prim became."""
        path = str(body.prim.GetPath())
        self.owners.setdefault(path, index)
        if body.motion != Motion.STATIC and not body.prim.IsInstanceProxy():
            self.prims.setdefault(path, index)

    def _frame(self, prim: Usd.Prim, transforms: UsdGeom.XformCache) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Polar decomposition of the transform of a body: position [m], rotation (3, 3) and stretch (3, 3).

        The stretch, which includes the length unit of the stage, is applied to the shapes. It is exact for a pure
        rotation, so that equal bodies share one shape.
        """
        if self._root.IsPseudoRoot():
            matrix = matrix_of(transforms.GetLocalToWorldTransform(prim))
        else:
            matrix = matrix_of(transforms.ComputeRelativeTransform(prim, self._root)[0])
        rotation, stretch = polar(matrix[:3, :3])
        if np.abs(stretch - np.eye(3)).max() < 1e-6:
            stretch = np.eye(3)
        stretch = self.meter * np.round(stretch, 9)
        return self._to_z_up @ matrix[:3, 3] * self.meter, self._to_z_up @ rotation, stretch

    def frame_or_root(self, prim: Usd.Prim | None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """As `_frame`; for None that of the root."""
        if prim is None or prim.IsPseudoRoot() or prim == self._root:
            return np.zeros(3), self._to_z_up, self.meter * np.eye(3)
        return self._frame(prim, self._transforms)

    def _collider(self, prim: Usd.Prim, body: _Body, stretch: np.ndarray) -> Collider | None:
        """One collider in the frame of its body; None, with a finding, if it cannot be imported."""
        matrix = np.eye(4)
        notes: list[str] = []
        try:
            if prim != body.prim:
                matrix = matrix_of(self._transforms.ComputeRelativeTransform(prim, body.prim)[0])
            matrix[:3] = stretch @ matrix[:3]
            shape, position, orientation = convert_prim(prim, matrix, self._sdf_resolution, notes)
            material = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial("physics")[0]
            coefficients, density = self._material(prim, material.GetPrim() if material else None)
            mass_api = UsdPhysics.MassAPI(prim)
            own_density = positive(mass_api.GetDensityAttr())
            if own_density is None:
                own_density = positive(UsdPhysics.MassAPI(body.prim).GetDensityAttr()) or density
            mass = positive(mass_api.GetMassAttr()) if prim != body.prim else None
            if mass is None and own_density is None and is_of_mujoco(prim):
                mass = 0.0  # Where USD has a default density, MuJoCo states that there is no mass.
        except ValueError as error:
            self.leave_out(prim.GetPath(), str(error))
            return None
        for note in notes:
            self.change(prim, note)
        shape = self._shapes.setdefault(shape.key, shape)
        frame = matrix if prim != body.prim else None
        return Collider(prim, shape, position, orientation, coefficients, own_density, mass, frame)

    def _material(self, prim: Usd.Prim, material: Usd.Prim | None) -> tuple[dict[str, float], float | None]:
        """Coefficients of a collider, and the density of its material in stage units."""
        if not material or not material.HasAPI(UsdPhysics.MaterialAPI):
            return {}, None
        found = read_material(material, self.meter, partial(self.change, prim))
        return found, positive(UsdPhysics.MaterialAPI(material).GetDensityAttr())

    def _velocities(self, prim: Usd.Prim, rotation: np.ndarray, center: np.ndarray) -> dict[str, Any]:
        """Velocities in the world frame; USD has them in the body frame, in degrees, as is the centre of mass."""
        api = UsdPhysics.RigidBodyAPI(prim)
        speed = np.array(api.GetVelocityAttr().Get(self._start), dtype=np.float64) * self.meter
        spin = np.radians(np.array(api.GetAngularVelocityAttr().Get(self._start), dtype=np.float64))
        if prim.HasAttribute(OF_ORIGIN):
            speed = speed + np.cross(spin, center)
        return {"linear_velocity": rotation @ speed, "angular_velocity": rotation @ spin}

    def _motion(self, body: _Body) -> PosePath | None:
        """The motion of an animated kinematic body; that of a static one is reported."""
        custom = custom_data(body.prim)  # of this package, which animates every body that moves
        if body.motion == Motion.DYNAMIC or (custom and FOLLOWS_PATH not in custom) or not _is_animated(body.prim):
            return None
        if body.motion == Motion.STATIC:
            self.change(body.prim, "its animated motion is ignored; it stays at the first pose of the animation")
            return None
        codes = animation_codes(self.stage, body.prim)
        frames = [self._frame(body.prim, UsdGeom.XformCache(code)) for code in codes]
        if np.ptp([stretch for _, _, stretch in frames], axis=0).max() > SCALE_TOLERANCE * self.meter:
            self.change(body.prim, "its animated scale is ignored; it keeps the first one")
        orientations = [quaternion_of_matrix(rotation) for _, rotation, _ in frames]
        times = (np.array(codes) - codes[0]) / self.stage.GetTimeCodesPerSecond()
        return PosePath(times, [position for position, _, _ in frames], orientations)


def _is_animated(prim: Usd.Prim) -> bool:
    """Whether the transform of a prim, or of one above it, changes with time."""
    return any(movable.TransformMightBeTimeVarying() for movable in filter(None, map(UsdGeom.Xformable, lineage(prim))))


def _joined(group: list[Collider], motion: Motion) -> tuple[Shape, np.ndarray, np.ndarray]:
    """The common shape of some colliders, and its pose in the body frame."""
    first = group[0]
    if len(group) > 1:
        return Compound([(c.shape, c.position, c.orientation) for c in group]), np.zeros(3), np.array([0, 0, 0, 1.0])
    identity = not first.position.any() and abs(first.orientation[3]) > 1.0 - 1e-12
    if identity or motion == Motion.STATIC:
        return first.shape, first.position, first.orientation
    return Compound([(first.shape, first.position, first.orientation)]), np.zeros(3), np.array([0, 0, 0, 1.0])


def _losses(prim: Usd.Prim, schemas: list[str]) -> list[str]:
    """What a prim says in schemas that are not supported."""
    prefixes = tuple(prefix for family, prefix in NAMED.items() if any(name.startswith(family) for name in schemas))
    prefixes += CUSTOM
    told = [f"schema {name} is not supported" for name in schemas if not name.startswith(tuple(NAMED))]
    authored = [entry.GetName() for entry in prim.GetAuthoredProperties()]
    lost = [name for name in authored if name.startswith(prefixes) and name not in READ]
    if lost:
        told.append(f"{', '.join(lost)}: not supported")
    return told
