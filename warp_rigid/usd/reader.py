"""Reads a stage with UsdPhysics and builds the scene that it describes."""

import math
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from pxr import Sdf, Usd, UsdGeom, UsdPhysics, UsdShade

from warp_rigid.scene.import_report import Finding
from warp_rigid.scene.scene import Motion, Scene
from warp_rigid.scene.shapes import Compound, Heightfield, Shape
from warp_rigid.scene.shapes.base import quaternion_matrix
from warp_rigid.usd.filters import filter_pairs
from warp_rigid.usd.force_fields import fields_from_data
from warp_rigid.usd.geometry import quaternion_of_matrix
from warp_rigid.usd.instancing import expand_instancers
from warp_rigid.usd.materials import read_material
from warp_rigid.usd.opening import open_stage
from warp_rigid.usd.prims import Unreadable, marked, matrix_of, place

__all__ = ["Reader"]

WATER = 1000.0
"""Density where a file gives neither mass nor density, as UsdPhysics has it [kg/m^3]."""
EARTH = 9.81
TOLERANCE = 1e-3
"""Mass properties that differ by less, relative, are those of the shape."""

Types = UsdPhysics.ObjectType
COLLIDERS = {
    Types.SphereShape, Types.CubeShape, Types.CapsuleShape, Types.Capsule1Shape, Types.CylinderShape,
    Types.Cylinder1Shape, Types.ConeShape, Types.MeshShape, Types.PlaneShape,
    Types.CustomShape, Types.SpherePointsShape,
}  # fmt: skip
UNDERSTOOD = {Types.Scene, Types.RigidBody, Types.RigidBodyMaterial, Types.CollisionGroup, *COLLIDERS}

SCHEMAS = {
    "PhysicsRigidBodyAPI", "PhysicsMassAPI", "PhysicsCollisionAPI", "PhysicsMeshCollisionAPI", "PhysicsMaterialAPI",
    "PhysicsFilteredPairsAPI", "NewtonSDFCollisionAPI", "NewtonMaterialAPI",
}  # fmt: skip
FAMILIES = ("Physics", "Physx", "Newton", "Mjc", "Isaac")
"""Applied schemas whose names begin so are about physics."""


@dataclass
class _Collider:
    """A solid in its body's frame."""

    prim: Usd.Prim
    shape: Shape
    position: np.ndarray
    orientation: np.ndarray
    coefficients: dict[str, float]
    density: float | None
    mass: float | None


@dataclass
class _Body:
    """A body as the file has it: a prim, how it moves and its colliders' prims."""

    prim: Usd.Prim
    motion: Motion
    colliders: list[Usd.Prim] = field(default_factory=list)


class Reader:
    """One file.

    Args:
        path: where it is.
        root: path of the prim below which to read; None for all.
        sdf_resolution: of meshes that do not say it themselves.

    Attributes:
        findings: what could not be taken over.

    Raises:
        ValueError: It is no USD file or has no such prim.
    """

    def __init__(self, path: Path, root: str | None, sdf_resolution: int):
        """Open the file, and expand its instancers in memory."""
        self.path, self.findings = path, []
        self._sdf_resolution = sdf_resolution
        self._stage = open_stage(path)
        for error in self._stage.GetCompositionErrors():
            self._leave_out(error.rootSite.path, " ".join(str(error).split()))
        self._stage.SetEditTarget(self._stage.GetSessionLayer())
        if root is not None and not (Sdf.Path.IsValidPathString(root) and self._stage.GetPrimAtPath(root)):
            raise ValueError(f"root: {path} has no prim {root}")
        self._root = self._stage.GetPrimAtPath(root) if root else self._stage.GetPseudoRoot()
        expand_instancers(self._root, [Usd.TimeCode.Default()])
        self._places = UsdGeom.XformCache()
        self._meter = UsdGeom.GetStageMetersPerUnit(self._stage)
        self._kilogram = UsdPhysics.GetStageKilogramsPerUnit(self._stage)
        y_up = UsdGeom.GetStageUpAxis(self._stage) == UsdGeom.Tokens.y
        self._upright = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]]) if y_up else np.eye(3)
        self._shapes: dict[str, Shape] = {}
        self._body_of: dict[str, int] = {}

    def scene(self) -> Scene:
        """Build the scene.

        Raises:
            ValueError: The file has no body that can be taken over, or several gravities.
        """
        objects = UsdPhysics.UsdPhysicsLoadStageFromPrimRange(self._stage, [str(self._root.GetPath())])
        self._report_strangers(objects)
        scene = self._empty_scene(objects)
        for body in self._bodies(objects):
            self._add(scene, body)
        told = {
            str(path): description
            for kind in {Types.RigidBody, *COLLIDERS}
            for path, description in zip(*objects.get(kind, ([], [])), strict=True)
        }
        filter_pairs(self._stage, scene, self._body_of, told, self._leave_out)
        if not scene.bodies:
            reason = f"; {self.findings[0]}" if self.findings else ""
            raise ValueError(
                f"{self.path}: has no rigid bodies or colliders of UsdPhysics{reason}. A film in the animation profile "
                "has none; write it with profile='scene'"
            )
        return scene

    def _leave_out(self, prim, reason: str) -> None:
        self.findings.append(Finding(str(prim), "left out", reason))

    def _change(self, prim: Usd.Prim, reason: str) -> None:
        self.findings.append(Finding(str(prim.GetPath()), "changed", reason))

    def _report_strangers(self, objects: dict) -> None:
        """List everything that is about physics and has no counterpart in a scene."""
        for kind, (paths, _) in objects.items():
            if kind not in UNDERSTOOD:
                for path in paths:
                    self._leave_out(path, f"{_words(kind)}: bodies move freely here")
        for prim in Usd.PrimRange(self._root, Usd.TraverseInstanceProxies()):
            for schema in prim.GetPrimTypeInfo().GetAppliedAPISchemas():
                if schema.startswith(FAMILIES) and schema.split(":")[0] not in SCHEMAS | {"PhysicsArticulationRootAPI"}:
                    self._leave_out(prim.GetPath(), f"{schema} is not known here")
            kind = prim.GetTypeName()
            if kind and not prim.GetPrimTypeInfo().GetSchemaTypeName():
                self._leave_out(prim.GetPath(), f"type {kind} is not known here")

    def _empty_scene(self, objects: dict) -> Scene:
        """Gravity, rules of pairs and force fields."""
        paths, descriptions = objects.get(Types.Scene, ([], []))
        found = {}
        for path, description in zip(paths, descriptions, strict=True):
            strength = description.gravityMagnitude * self._meter
            found[str(path)] = tuple(self._upright @ np.array(description.gravityDirection) * strength)
        if len({tuple(np.round(gravity, 6)) for gravity in found.values()}) > 1:
            raise ValueError(f"{self.path}: has several gravities; choose a root, one of {self._environments(found)}")
        told = marked(self._stage.GetPrimAtPath(next(iter(found)))) if found else {}
        scene = Scene(
            gravity=next(iter(found.values()), (0.0, 0.0, -EARTH)),
            friction_combine=told.get("frictionCombine", "min"),
            restitution_combine=told.get("restitutionCombine", "min"),
        )
        for force_field in fields_from_data(told):
            scene.add_force_field(force_field)
        return scene

    @staticmethod
    def _environments(scenes: dict) -> str:
        return ", ".join(str(Sdf.Path(path).GetParentPath()) for path in scenes)

    def _bodies(self, objects: dict) -> list[_Body]:
        """Bodies in the order of the file, each with its enabled colliders."""
        bodies: dict[str, _Body] = {}
        for path, description in zip(*objects.get(Types.RigidBody, ([], [])), strict=True):
            prim = self._stage.GetPrimAtPath(path)
            motion = Motion.KINEMATIC if description.kinematicBody else Motion.DYNAMIC
            bodies[str(path)] = _Body(prim, motion if description.rigidBodyEnabled else Motion.STATIC)
        for kind in COLLIDERS:
            for path, description in zip(*objects.get(kind, ([], [])), strict=True):
                if not description.collisionEnabled:
                    continue
                prim = self._stage.GetPrimAtPath(path)
                owner = str(description.rigidBody)
                if owner not in bodies:
                    group = self._static_owner(prim)
                    owner = str(group.GetPath())
                    bodies.setdefault(owner, _Body(group, Motion.STATIC))
                bodies[owner].colliders.append(prim)
        order = {
            str(prim.GetPath()): index
            for index, prim in enumerate(Usd.PrimRange(self._root, Usd.TraverseInstanceProxies()))
        }
        for body in bodies.values():
            body.colliders.sort(key=lambda prim: order[str(prim.GetPath())])
        return [bodies[path] for path in sorted(bodies, key=lambda path: order[path])]

    @staticmethod
    def _static_owner(prim: Usd.Prim) -> Usd.Prim:
        """The prim that this package wrote for a static body of several colliders, else the collider itself."""
        above = prim
        while above and not above.IsPseudoRoot():
            if "motion" in marked(above):
                return above
            above = above.GetParent()
        return prim

    def _add(self, scene: Scene, body: _Body) -> None:
        """Add one body, or several where statics that cannot be joined share a prim."""
        try:
            position, rotation, stretch = self._frame(body.prim)
        except Unreadable as error:
            self._leave_out(body.prim.GetPath(), str(error))
            return
        found = [collider for prim in body.colliders if (collider := self._collider(prim, body, stretch))]
        if not found:
            reason = "none of its colliders can be taken over" if body.colliders else "it has no enabled collider"
            self._leave_out(body.prim.GetPath(), reason)
            return
        endless = [collider for collider in found if collider.shape.static_only]
        if body.motion == Motion.STATIC:
            solid = [collider for collider in found if not collider.shape.static_only]
            groups = [[collider] for collider in endless] + ([solid] if solid else [])
        else:
            fields = [collider for collider in endless if isinstance(collider.shape, Heightfield)]
            kept = fields if body.motion == Motion.KINEMATIC else []
            for collider in endless:
                if collider not in kept:
                    self._leave_out(collider.prim.GetPath(), "planes and height fields can not be dynamic")
            groups = [[collider] for collider in kept]
            groups.append([collider for collider in found if not collider.shape.static_only])
        self._note_motion(body)
        for group in groups:
            if group:
                self._add_group(scene, body, group, position, rotation)

    def _add_group(self, scene: Scene, body: _Body, group: list[_Collider], position, rotation) -> None:
        shape, where, turn = _joined(group, body.motion)
        common: dict[str, Any] = {
            "position": position + rotation @ where,
            "orientation": quaternion_of_matrix(rotation @ quaternion_matrix(turn)),
            "name": body.prim.GetDisplayName() or body.prim.GetName(),
            **self._coefficients(body, group),
        }
        try:
            if body.motion == Motion.STATIC:
                index = scene.add_static(shape, **common)
            elif body.motion == Motion.KINEMATIC:
                common |= self._velocities(body.prim, rotation)
                index = scene.add_kinematic(shape, **common)
            else:
                common |= self._velocities(body.prim, rotation)
                index = scene.add_body(shape, mass=self._mass(body, group, shape), **common)
        except ValueError as error:
            self._leave_out(body.prim.GetPath(), str(error))
            return
        self._body_of |= {str(collider.prim.GetPath()): index for collider in group}

    def _frame(self, prim: Usd.Prim) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Where a body stands: position [m], rotation (3, 3), and what is left of its transform, which its shapes take.

        The last holds the stage's unit too; it is exact where the transform is a rotation, so that equal bodies share
        one shape.
        """
        if self._root.IsPseudoRoot():
            matrix = matrix_of(self._places.GetLocalToWorldTransform(prim))
        else:
            matrix = matrix_of(self._places.ComputeRelativeTransform(prim, self._root)[0])
        left, sizes, right = np.linalg.svd(matrix[:3, :3])
        rotation, stretch = left @ right, right.T @ np.diag(sizes) @ right
        if np.linalg.det(rotation) < 0.0:
            rotation, stretch = -rotation, -stretch
        if np.abs(stretch - np.eye(3)).max() < 1e-6:
            stretch = np.eye(3)
        stretch = self._meter * np.round(stretch, 9)
        return self._upright @ matrix[:3, 3] * self._meter, self._upright @ rotation, stretch

    def _collider(self, prim: Usd.Prim, body: _Body, stretch: np.ndarray) -> _Collider | None:
        """One collider in its body's frame; None, and a finding, where it cannot be taken over."""
        matrix = np.eye(4)
        notes: list[str] = []
        try:
            if prim != body.prim:
                matrix = matrix_of(self._places.ComputeRelativeTransform(prim, body.prim)[0])
            matrix[:3] = stretch @ matrix[:3]
            shape, position, orientation = place(prim, matrix, self._sdf_resolution, notes)
        except ValueError as error:
            self._leave_out(prim.GetPath(), str(error))
            return None
        for note in notes:
            self._change(prim, note)
        shape = self._shapes.setdefault(shape.key, shape)
        material = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial("physics")[0]
        coefficients, density = self._material(prim, material.GetPrim() if material else None)
        mass_api = UsdPhysics.MassAPI(prim)
        own_density = _positive(mass_api.GetDensityAttr())
        if own_density is None:
            own_density = _positive(UsdPhysics.MassAPI(body.prim).GetDensityAttr()) or density
        mass = _positive(mass_api.GetMassAttr()) if prim != body.prim else None
        return _Collider(prim, shape, position, orientation, coefficients, own_density, mass)

    def _material(self, prim: Usd.Prim, material: Usd.Prim | None) -> tuple[dict[str, float], float | None]:
        """A collider's coefficients, and the density of its material in the stage's units."""
        if not material or not material.HasAPI(UsdPhysics.MaterialAPI):
            return {}, None
        found = read_material(material, self._meter, partial(self._change, prim))
        return found, _positive(UsdPhysics.MaterialAPI(material).GetDensityAttr())

    def _coefficients(self, body: _Body, group: list[_Collider]) -> dict[str, float]:
        if any(collider.coefficients != group[0].coefficients for collider in group):
            self._change(body.prim, f"one material for all its colliders: that of {group[0].prim.GetName()}")
        return group[0].coefficients

    def _velocities(self, prim: Usd.Prim, rotation: np.ndarray) -> dict[str, np.ndarray]:
        """Velocities, which USD gives in the body's own frame, in degrees."""
        api = UsdPhysics.RigidBodyAPI(prim)
        speed = np.array(api.GetVelocityAttr().Get(), dtype=np.float64) * self._meter
        spin = np.radians(np.array(api.GetAngularVelocityAttr().Get(), dtype=np.float64))
        return {"linear_velocity": rotation @ speed, "angular_velocity": rotation @ spin}

    def _mass(self, body: _Body, group: list[_Collider], shape: Shape) -> float:
        """Mass of a dynamic body [kg]: as given, else the sum over its colliders."""
        api = UsdPhysics.MassAPI(body.prim)
        self._compare_mass_properties(body.prim, api, shape)
        given = _positive(api.GetMassAttr())
        if given is not None:
            return given * self._kilogram
        unit = self._kilogram / self._meter**3
        densities = [WATER if c.density is None else c.density * unit for c in group]
        masses = [
            density * c.shape.volume if c.mass is None else c.mass * self._kilogram
            for c, density in zip(group, densities, strict=True)
        ]
        effective = np.array(masses) / [c.shape.volume for c in group]
        if np.ptp(effective) > TOLERANCE * effective.max():
            self._change(body.prim, "one density for all its colliders, from their total mass")
        return float(sum(masses))

    def _compare_mass_properties(self, prim: Usd.Prim, api: UsdPhysics.MassAPI, shape: Shape) -> None:
        """A body's centre of mass and moments follow from its shape here; say where the file wants others."""
        center = api.GetCenterOfMassAttr().Get() if api.GetCenterOfMassAttr().HasAuthoredValue() else None
        size = float(np.max(shape.bounds[1] - shape.bounds[0]))
        if center is not None and np.isfinite(center).all():
            off = np.linalg.norm(np.array(center) * self._meter - shape.center_of_mass)
            if off > TOLERANCE * size:
                self._change(prim, f"centre of mass: that of its shape, {off:g} m from the one given")
        moments, mass = api.GetDiagonalInertiaAttr().Get(), _positive(api.GetMassAttr())
        if mass is not None and moments is not None and min(moments) > 0.0:
            given = np.sort(np.array(moments, dtype=np.float64)) * self._meter**2 / mass
            own = np.linalg.eigvalsh(shape.inertia) / shape.volume
            if np.abs(given - own).max() > TOLERANCE * own.max():
                self._change(prim, "moments of inertia: those of its shape at an even density, not the ones given")

    def _note_motion(self, body: _Body) -> None:
        """Prescribed motion over time is not followed."""
        if body.motion == Motion.DYNAMIC or marked(body.prim):
            return
        above = body.prim
        while above and not above.IsPseudoRoot():
            if UsdGeom.Xformable(above) and UsdGeom.Xformable(above).TransformMightBeTimeVarying():
                self._change(body.prim, "its motion over time is not followed; it starts where it is at default time")
                return
            above = above.GetParent()


def _joined(group: list[_Collider], motion: Motion) -> tuple[Shape, np.ndarray, np.ndarray]:
    """The shape of some colliders in their body's frame, and where it stands there."""
    first = group[0]
    if len(group) > 1:
        return Compound([(c.shape, c.position, c.orientation) for c in group]), np.zeros(3), np.array([0, 0, 0, 1.0])
    still = not first.position.any() and abs(first.orientation[3]) > 1.0 - 1e-12
    if still or motion == Motion.STATIC:
        return first.shape, first.position, first.orientation
    return Compound([(first.shape, first.position, first.orientation)]), np.zeros(3), np.array([0, 0, 0, 1.0])


def _positive(attribute: Usd.Attribute) -> float | None:
    """A number that counts only where it is > 0, as USD has it for masses and densities."""
    value = attribute.Get() if attribute else None
    return float(value) if value is not None and 0.0 < value < math.inf else None


def _words(kind: Any) -> str:
    return str(kind).rpartition(".")[2]
