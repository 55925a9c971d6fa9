"""Reader of stages with UsdPhysics."""

from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
from pxr import Sdf, Usd, UsdGeom, UsdPhysics

from warp_rigid import rotations
from warp_rigid.scene.camera import with_body_index
from warp_rigid.scene.pose_path import PosePath
from warp_rigid.scene.scene import Motion, Scene
from warp_rigid.scene.shapes import Compound, Heightfield, Shape
from warp_rigid.usd.actuators import ACTUATOR
from warp_rigid.usd.cameras import read_camera
from warp_rigid.usd.conventions import FOLLOWS_PATH, animation_codes, custom_data, lineage, quaternion_of_matrix
from warp_rigid.usd.field_data import fields_from_data
from warp_rigid.usd.filters import filter_pairs
from warp_rigid.usd.instancing import OF_ORIGIN
from warp_rigid.usd.joint_prims import JOINT_SCHEMAS, JointReader
from warp_rigid.usd.masses import (
    MUJOCO_COLLIDER,
    Collider,
    mass_of_colliders,
    mass_without_colliders,
    positive,
    scale_to_total,
)
from warp_rigid.usd.materials import read_material
from warp_rigid.usd.preview_surface import read_look
from warp_rigid.usd.prims import applies, convert_prim, custom_array, matrix_between
from warp_rigid.usd.surface_motion import SURFACE_SCHEMA, read_surface_motion
from warp_rigid.usd.usd_file import COLLIDERS, JOINT_KINDS, Types, UsdFile

EARTH_GRAVITY = 9.81
SCALE_TOLERANCE = 1e-3
"""Relative change of an animated scale that counts as none."""

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
READ = {
    "newton:armature", "newton:damping", "newton:friction", "newton:inertia", "newton:rollingFriction",
    "newton:torsionalFriction", "mjc:compiler:angle", "mjc:compiler:setTotalMass", "mjc:condim", "mjc:ref",
    "mjc:springref", "mjc:stiffness",
}  # fmt: skip
"""Attributes of these families that have a counterpart in a scene."""


@dataclass
class _Body:
    """A body of the file: its prim, its type of motion and the prims of its colliders."""

    prim: Usd.Prim
    motion: Motion
    colliders: list[Usd.Prim] = field(default_factory=list)

    @property
    def keywords(self) -> dict[str, Any]:
        """Keywords of `Scene.add_body` that the prim alone states."""
        name, active = self.prim.GetDisplayName() or self.prim.GetName(), custom_data(self.prim).get("active", True)
        return {"name": name, "active": active}


class Reader:
    """Builds the scene that a file describes.

    Args:
        file: the file.
        sdf_resolution: resolution of meshes without their own.
    """

    def __init__(self, file: UsdFile, sdf_resolution: int):
        """Prepare without reading."""
        self._file, self._sdf_resolution = file, sdf_resolution
        self._shapes: dict[str, Shape] = {}

    def scene(self) -> Scene:
        """Build the scene.

        Raises:
            ValueError: The file has no body that can be imported, or several different rules.
        """
        file = self._file
        self._report_unsupported()
        scene = self._scene = self._empty_scene()
        bodies = self._bodies()
        self._report_surfaces(bodies)
        for body in bodies:
            self._add(body)
        scale_to_total(file, scene)
        filter_pairs(file, scene)
        JointReader(file, scene).read()
        self._read_cameras()
        if not scene.bodies:
            reason = file.findings[0] if file.findings else "export animations with profile='scene' to include them"
            raise ValueError(f"{file.path}: has no rigid bodies or colliders of UsdPhysics; {reason}")
        return scene

    def _read_cameras(self) -> None:
        """Read the cameras of the file; the scene gets the only one."""
        scene = self._scene
        middle = np.median([body.position for body in scene.bodies], axis=0) if scene.bodies else np.zeros(3)
        names = [body.name for body in scene.bodies]
        for prim in filter(UsdGeom.Camera, self._file.below):
            try:
                camera = read_camera(self._file, prim, middle)
                self._file.cameras[str(prim.GetPath())] = with_body_index(camera, names)
            except ValueError as error:
                self._file.leave_out(prim.GetPath(), str(error))
        if len(self._file.cameras) == 1:
            (scene.camera,) = self._file.cameras.values()

    def _report_unsupported(self) -> None:
        """Report physics content without a counterpart in a scene."""
        for kind, (paths, _) in self._file.objects.items():
            if kind not in SUPPORTED:
                for path in paths:
                    self._file.leave_out(path, f"{str(kind).rpartition('.')[2]} is not supported: bodies move freely")
        for prim in self._file.below:
            unsupported = [
                schema
                for schema in prim.GetPrimTypeInfo().GetAppliedAPISchemas()
                if schema.startswith(FAMILIES) and schema.split(":")[0] not in SCHEMAS | {"PhysicsArticulationRootAPI"}
            ]
            for reason in _losses(prim, unsupported):
                self._file.leave_out(prim.GetPath(), reason)
            kind = prim.GetTypeName()
            if kind and kind != ACTUATOR and not prim.GetPrimTypeInfo().GetSchemaTypeName():
                self._file.leave_out(prim.GetPath(), f"type {kind} is not supported")

    def _report_surfaces(self, bodies: list[_Body]) -> None:
        """Report surfaces that run, but not on a static or kinematic body."""
        running = {str(body.prim.GetPath()) for body in bodies if body.motion != Motion.DYNAMIC}
        for prim in self._file.below:
            if applies(prim, SURFACE_SCHEMA) and str(prim.GetPath()) not in running:
                self._file.leave_out(prim.GetPath(), "only the surface of a static or kinematic body can run")

    def _empty_scene(self) -> Scene:
        """Create a scene with gravity, combine modes, bounds and force fields."""
        file = self._file
        # MuJoCo takes the larger friction of two bodies.
        of_mujoco = any(applies(file.stage.GetPrimAtPath(path), MUJOCO_COLLIDER) for path in file.described(*COLLIDERS))
        usual: dict[str, Any] = {
            "gravity": (0.0, 0.0, -EARTH_GRAVITY),
            "friction_combine": "max" if of_mujoco else "min",
        }
        found = {path: usual | self._rules(path, own) for path, own in file.physics_scenes().items()}
        if len({repr(rules | {"gravity": np.round(rules["gravity"], 6) + 0.0}) for rules in found.values()}) > 1:
            roots = ", ".join(str(Sdf.Path(path).GetParentPath()) for path in found)
            raise ValueError(f"{file.path}: has several gravities, force fields or bounds; set root to one of {roots}")
        rules = next(iter(found.values()), usual)
        force_fields = rules.pop("force_fields", [])
        scene = Scene(**rules)
        for force_field in force_fields:
            scene.add_force_field(force_field)
        return scene

    def _rules(self, path: str, description: Any) -> dict[str, Any]:
        """What a physics scene states, as keywords of Scene and the list of force fields."""
        file, prim = self._file, self._file.stage.GetPrimAtPath(path)
        custom, place = custom_data(prim), file.frame(prim)[0]
        strength = description.gravityMagnitude * file.meter
        names = {"frictionCombine": "friction_combine", "restitutionCombine": "restitution_combine"}
        rules = {name: custom[key] for key, name in names.items() if key in custom}
        rules["gravity"] = tuple(file.frame(None)[1] @ np.array(description.gravityDirection) * strength)
        if "bounds" in custom:
            corners = custom_array(custom, "bounds", (2, 3)) + place
            rules |= {"bounds": tuple(corners), "out_of_bounds": custom.get("outOfBounds", "report")}
        return rules | {"force_fields": fields_from_data(custom, place)}

    def _bodies(self) -> list[_Body]:
        """Bodies in file order, each with its enabled colliders."""
        file = self._file
        bodies: dict[str, _Body] = {}
        for path, description in file.described(Types.RigidBody).items():
            if description.rigidBodyEnabled:
                motion = Motion.KINEMATIC if description.kinematicBody else Motion.DYNAMIC
                bodies[path] = _Body(file.stage.GetPrimAtPath(path), motion)
                if description.startsAsleep and motion == Motion.DYNAMIC:
                    file.change(bodies[path].prim, "it starts awake: physics:startsAsleep is ignored")
        for path, description in file.described(*COLLIDERS).items():
            if not description.collisionEnabled:
                continue
            prim = file.stage.GetPrimAtPath(path)
            owner = str(description.rigidBody)
            if owner not in bodies:
                group = self._static_owner(prim)
                owner = str(group.GetPath())
                bodies.setdefault(owner, _Body(group, Motion.STATIC))
            bodies[owner].colliders.append(prim)
        order = {str(prim.GetPath()): index for index, prim in enumerate(self._file.below)}
        for body in bodies.values():
            body.colliders.sort(key=lambda prim: order[str(prim.GetPath())])
        return [bodies[path] for path in sorted(bodies, key=lambda path: order[path])]

    def _static_owner(self, prim: Usd.Prim) -> Usd.Prim:
        """The prim written by this package for a static body with several colliders, else the collider itself."""
        root = self._file.root.GetPath()
        within = [above for above in lineage(prim) if above.GetPath().HasPrefix(root)]
        return next((above for above in within if "motion" in custom_data(above)), prim)

    def _add(self, body: _Body) -> None:
        """Add one body, or several for static colliders of one prim that cannot form a compound."""
        try:
            frame = self._file.frame(body.prim)
        except ValueError as error:
            self._file.leave_out(body.prim.GetPath(), str(error))
            return
        found = [collider for prim in body.colliders if (collider := self._collider(prim, body, frame[2]))]
        if not found:
            self._add_without_colliders(body, *frame)
            return
        groups = []
        for collider in found:
            moves = body.motion == Motion.KINEMATIC and isinstance(collider.shape, Heightfield)
            if collider.shape.static_only and (moves or body.motion == Motion.STATIC):
                groups.append([collider])
            elif collider.shape.static_only:
                self._file.leave_out(collider.prim.GetPath(), "planes and height fields cannot be dynamic")
        groups.append([collider for collider in found if not collider.shape.static_only])
        motion = self._motion(body)
        for group in filter(None, groups):
            self._add_group(body, group, *frame, motion)

    def _add_without_colliders(self, body: _Body, position, rotation: np.ndarray, stretch: np.ndarray) -> None:
        """Add a dynamic body that touches nothing, from its mass and its moments of inertia."""
        reason = "none of its colliders can be imported" if body.colliders else "it has no enabled collider"
        if body.motion != Motion.DYNAMIC:
            self._file.leave_out(body.prim.GetPath(), reason)
            return
        given = {"position": position, "orientation": quaternion_of_matrix(rotation), **body.keywords}
        try:
            shape, given["mass"] = mass_without_colliders(self._file, body.prim, stretch)
            given |= self._velocities(body.prim, rotation, shape.center_of_mass)
            index = self._scene.add_body(shape, **given)
        except ValueError as error:
            self._file.massless[str(body.prim.GetPath())] = f"{reason}, {error}"
            return
        self._keep_index(body, index)
        self._file.change(body.prim, f"{reason}: it touches nothing")

    def _add_group(
        self, body: _Body, group: list[Collider], position, rotation, stretch, motion: PosePath | None
    ) -> None:
        """Add a body with some colliders, and with the motion of a kinematic one."""
        shape, place_in_body, orientation = _joined(group, body.motion)
        turn = rotations.matrix(orientation)
        given: dict[str, Any] = {
            "position": position + rotation @ place_in_body,
            "orientation": quaternion_of_matrix(rotation @ turn),
            **body.keywords,
            **group[0].coefficients,
        }
        if any(collider.coefficients != group[0].coefficients for collider in group):
            self._file.change(body.prim, f"all its colliders get the material of {group[0].prim.GetName()}")
        scene = self._scene
        add: Any = scene.add_body
        if body.motion != Motion.DYNAMIC:
            add = scene.add_static if body.motion == Motion.STATIC else scene.add_kinematic
        try:
            if body.motion == Motion.DYNAMIC:
                shape, given["mass"] = mass_of_colliders(self._file, body.prim, group, shape, stretch)
            else:
                given |= read_surface_motion(self._file, body.prim, rotation, stretch, place_in_body, turn)
            if motion is not None:
                del given["position"], given["orientation"]
                given["path"] = motion
            elif body.motion != Motion.STATIC:
                center = place_in_body + rotations.rotate(orientation, shape.center_of_mass)
                given |= self._velocities(body.prim, rotation, center)
            index = add(shape, **given)
        except ValueError as error:
            self._file.leave_out(body.prim.GetPath(), str(error))
            return
        self._file.body_of |= {str(collider.prim.GetPath()): index for collider in group}
        look = read_look(body.prim, shape.surface_uv() is not None, partial(self._file.change, body.prim))
        if look is not None:
            scene.looks[index] = look
        self._keep_index(body, index)

    def _keep_index(self, body: _Body, index: int) -> None:
        """Note which body of the scene a prim became."""
        path = str(body.prim.GetPath())
        self._file.owners.setdefault(path, index)
        if body.motion != Motion.STATIC and not body.prim.IsInstanceProxy():
            self._file.prims.setdefault(path, index)

    def _collider(self, prim: Usd.Prim, body: _Body, stretch: np.ndarray) -> Collider | None:
        """One collider in the frame of its body; None, with a finding, if it cannot be imported."""
        matrix = np.eye(4)
        notes: list[str] = []
        try:
            if prim != body.prim:
                matrix = matrix_between(self._file.transforms, prim, body.prim)
            matrix[:3] = stretch @ matrix[:3]
            shape, position, orientation = convert_prim(prim, matrix, self._sdf_resolution, notes)
            coefficients, density = read_material(self._file, prim)
            mass_api = UsdPhysics.MassAPI(prim)
            own_density = positive(mass_api.GetDensityAttr())
            if own_density is None:
                own_density = positive(UsdPhysics.MassAPI(body.prim).GetDensityAttr()) or density
            mass = positive(mass_api.GetMassAttr()) if prim != body.prim else None
            if mass is None and own_density is None and applies(prim, MUJOCO_COLLIDER):
                mass = 0.0  # Where USD has a default density, MuJoCo states that there is no mass.
        except ValueError as error:
            self._file.leave_out(prim.GetPath(), str(error))
            return None
        for note in notes:
            self._file.change(prim, note)
        shape = self._shapes.setdefault(shape.key, shape)
        frame = matrix if prim != body.prim else None
        return Collider(prim, shape, position, orientation, coefficients, own_density, mass, frame)

    def _velocities(self, prim: Usd.Prim, rotation: np.ndarray, center: np.ndarray) -> dict[str, Any]:
        """Velocities in the world frame; USD has them in the body frame, in degrees, as is the centre of mass."""
        api, start = UsdPhysics.RigidBodyAPI(prim), self._file.start
        speed = np.array(api.GetVelocityAttr().Get(start), dtype=np.float64) * self._file.meter
        spin = np.radians(np.array(api.GetAngularVelocityAttr().Get(start), dtype=np.float64))
        if prim.HasAttribute(OF_ORIGIN):
            speed = speed + np.cross(spin, center)
        return {"linear_velocity": rotation @ speed, "angular_velocity": rotation @ spin}

    def _motion(self, body: _Body) -> PosePath | None:
        """The motion of an animated kinematic body; that of a static one is reported."""
        custom = custom_data(body.prim)  # of this package, which animates every body that moves
        movable = filter(None, map(UsdGeom.Xformable, lineage(body.prim)))
        is_animated = any(above.TransformMightBeTimeVarying() for above in movable)
        if body.motion == Motion.DYNAMIC or (custom and FOLLOWS_PATH not in custom) or not is_animated:
            return None
        if body.motion == Motion.STATIC:
            self._file.change(body.prim, "its animated motion is ignored; it stays at the first pose of the animation")
            return None
        codes = animation_codes(self._file.stage, body.prim)
        frames = [self._file.frame(body.prim, UsdGeom.XformCache(code)) for code in codes]
        if np.ptp([stretch for _, _, stretch in frames], axis=0).max() > SCALE_TOLERANCE * self._file.meter:
            self._file.change(body.prim, "its animated scale is ignored; it keeps the first one")
        orientations = [quaternion_of_matrix(rotation) for _, rotation, _ in frames]
        times = (np.array(codes) - codes[0]) / self._file.stage.GetTimeCodesPerSecond()
        return PosePath(times, [position for position, _, _ in frames], orientations)


def _joined(group: list[Collider], motion: Motion) -> tuple[Shape, np.ndarray, np.ndarray]:
    """The common shape of some colliders, and its pose in the body frame."""
    first = group[0]
    identity = not first.position.any() and abs(first.orientation[3]) > 1.0 - 1e-12
    if len(group) == 1 and (identity or motion == Motion.STATIC):
        return first.shape, first.position, first.orientation
    return Compound([(c.shape, c.position, c.orientation) for c in group]), np.zeros(3), np.array([0, 0, 0, 1.0])


def _losses(prim: Usd.Prim, schemas: list[str]) -> list[str]:
    """What a prim says in schemas that are not supported."""
    named = (prefix for family, prefix in NAMED.items() if any(name.startswith(family) for name in schemas))
    prefixes = (*named, "mjc:body:")  # which the converter of MuJoCo's files writes without a schema
    told = [f"schema {name} is not supported" for name in schemas if not name.startswith(tuple(NAMED))]
    authored = [entry.GetName() for entry in prim.GetAuthoredProperties()]
    lost = [name for name in authored if name.startswith(prefixes) and name not in READ]
    if lost:
        told.append(f"{', '.join(lost)}: not supported")
    return told
