"""A file that is read: its stage, units, axes and transforms, and what becomes of its prims in the scene."""

from pathlib import Path
from typing import Any

import numpy as np
from pxr import Sdf, Usd, UsdGeom, UsdPhysics

from warp_rigid.checks import number_in
from warp_rigid.scene.camera import Camera
from warp_rigid.scene.import_report import ImportFinding
from warp_rigid.usd.conventions import FROM_Y_UP, UNITS, first_time, is_y_up, meters_per_unit, polar
from warp_rigid.usd.instancing import expand_instancers
from warp_rigid.usd.opening import open_stage
from warp_rigid.usd.prims import matrix_between, matrix_of

Types = UsdPhysics.ObjectType
COLLIDERS = {
    Types.SphereShape, Types.CubeShape, Types.CapsuleShape, Types.Capsule1Shape, Types.CylinderShape,
    Types.Cylinder1Shape, Types.ConeShape, Types.MeshShape, Types.PlaneShape,
    Types.CustomShape, Types.SpherePointsShape,
}  # fmt: skip
JOINT_KINDS = (Types.FixedJoint, Types.RevoluteJoint, Types.PrismaticJoint, Types.SphericalJoint, Types.DistanceJoint)


class UsdFile:
    """A file with UsdPhysics, whose instancers are expanded in memory.

    Args:
        path: path of the file.
        root: path of the prim below which to read; None reads the whole stage.

    Attributes:
        path: path of the file.
        files: paths of the file and of all that it refers to.
        stage: the stage.
        root: the prim below which it is read.
        start: time of the poses.
        below: the prims, those of instances included.
        objects: paths and descriptions by kind, from the parser of UsdPhysics.
        meter: length unit [m].
        kilogram: mass unit [kg].
        to_z_up: rotation (3, 3) from the world of the file to that of the scene.
        findings: differences between the file and the scene.
        prims: indices of the movable bodies by the paths of their prims.
        cameras: cameras by the paths of their prims.
        body_of: body index by collider path.
        owners: body index by the path of the prim that is the body.
        massless: reasons why bodies have no mass, by the paths of their prims.

    Raises:
        ValueError: The file is not a USD file or does not have the root prim.
    """

    def __init__(self, path: Path, root: str | None):
        """Open the file and parse it."""
        self.path = path
        self.findings: list[ImportFinding] = []
        self.prims: dict[str, int] = {}
        self.cameras: dict[str, Camera] = {}
        self.body_of: dict[str, int] = {}
        self.owners: dict[str, int] = {}
        self.massless: dict[str, str] = {}
        self.stage = open_stage(path)
        self.files = tuple(layer.realPath for layer in self.stage.GetUsedLayers() if layer.realPath)
        for error in self.stage.GetCompositionErrors():
            self.leave_out(error.rootSite.path, " ".join(str(error).split()))
        self.stage.SetEditTarget(self.stage.GetSessionLayer())
        if root is not None and not (Sdf.Path.IsValidPathString(root) and self.stage.GetPrimAtPath(root)):
            raise ValueError(f"root: {path} has no prim {root}")
        self.root = self.stage.GetPrimAtPath(root) if root else self.stage.GetPseudoRoot()
        self.start = first_time(self.stage)
        expand_instancers(self.root, [self.start])
        self.transforms = UsdGeom.XformCache(self.start)
        self.meter = meters_per_unit(self.stage)
        self.kilogram = number_in("kilogramsPerUnit", UsdPhysics.GetStageKilogramsPerUnit(self.stage), *UNITS)
        self.below = list(Usd.PrimRange(self.root, Usd.TraverseInstanceProxies()))
        self.to_z_up = FROM_Y_UP if is_y_up(self.stage) else np.eye(3)
        self.objects = UsdPhysics.UsdPhysicsLoadStageFromPrimRange(self.stage, [str(self.root.GetPath())])

    def described(self, *kinds: Any, objects: dict | None = None) -> dict[str, Any]:
        """Descriptions of the objects of some kinds by their paths, below the root or of others."""
        found = self.objects if objects is None else objects
        pairs = [zip(*found.get(kind, ([], [])), strict=True) for kind in kinds]
        return {str(path): description for of_kind in pairs for path, description in of_kind}

    def physics_scenes(self) -> dict[str, Any]:
        """Descriptions of the physics scenes by their paths, below the root or else below the nearest prim above it."""
        above, found = self.root, self.described(Types.Scene)
        while not found and not above.IsPseudoRoot():
            above = above.GetParent()
            objects = UsdPhysics.UsdPhysicsLoadStageFromPrimRange(self.stage, [str(above.GetPath())])
            found = self.described(Types.Scene, objects=objects)
        return found

    def leave_out(self, path: Any, reason: str) -> None:
        """Report what of a path the scene lacks."""
        self.findings.append(ImportFinding(str(path), "left out", reason))

    def change(self, prim: Usd.Prim, reason: str) -> None:
        """Report what of a prim is different in the scene."""
        self.findings.append(ImportFinding(str(prim.GetPath()), "changed", reason))

    def frame(
        self, prim: Usd.Prim | None, transforms: UsdGeom.XformCache | None = None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Polar decomposition of the transform of a body: position [m], rotation (3, 3) and stretch (3, 3).

        The stretch, which includes the length unit of the stage, is applied to the shapes. It is exact for a pure
        rotation, so that equal bodies share one shape.

        Args:
            prim: of the body; None for the world of the file.
            transforms: those of another time than the start.
        """
        places = self.transforms if transforms is None else transforms
        if prim is None:
            matrix = np.linalg.inv(matrix_of(places.GetLocalToWorldTransform(self.root)))
        elif prim == self.root:
            matrix = np.eye(4)
        elif self.root.IsPseudoRoot():
            matrix = matrix_of(places.GetLocalToWorldTransform(prim))
        else:
            matrix = matrix_between(places, prim, self.root)
        rotation, stretch = polar(matrix[:3, :3])
        if np.abs(stretch - np.eye(3)).max() < 1e-6:
            stretch = np.eye(3)
        stretch = self.meter * np.round(stretch, 9)
        return self.to_z_up @ matrix[:3, 3] * self.meter, self.to_z_up @ rotation, stretch
