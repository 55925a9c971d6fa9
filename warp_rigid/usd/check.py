"""Checks a USD file: the USD library's own validators, and what they miss."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pxr import Usd, UsdGeom, UsdPhysics, UsdValidation

from warp_rigid.usd.opening import open_stage, reading

__all__ = ["Problem", "check_usd"]

TOKENS = UsdPhysics.Tokens
APPROXIMATIONS = {
    TOKENS.none, TOKENS.convexHull, TOKENS.convexDecomposition, TOKENS.boundingSphere, TOKENS.boundingCube,
    TOKENS.meshSimplification,
}  # fmt: skip


@dataclass(frozen=True)
class Problem:
    """One thing that is wrong with a file.

    Attributes:
        path: of the prim; empty where it is the stage.
        rule: which check found it.
        text: what is wrong.
    """

    path: str
    rule: str
    text: str

    def __str__(self) -> str:
        """One line."""
        return f"{self.path or 'stage'}: {self.rule}: {self.text}"


def check_usd(path) -> list[Problem]:
    """Everything that is wrong with a file; empty for a sound one.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It is no USD file.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    stage = open_stage(path)
    with reading(path):
        validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
        problems = [
            Problem(_site(error), str(error.GetName()), error.GetMessage())
            for error in UsdValidation.ValidationContext(validators).Validate(stage)
        ]
        for prim in stage.Traverse(Usd.TraverseInstanceProxies()):
            for rule, check in RULES.items():
                problems += [Problem(str(prim.GetPath()), rule, text) for text in check(prim)]
        return problems


def _site(error: UsdValidation.ValidationError) -> str:
    sites = [site.GetPrim() or site.GetProperty() for site in error.GetSites() if site.IsPrim() or site.IsProperty()]
    return str(sites[0].GetPath()) if sites else ""


def _instancer(prim: Usd.Prim) -> list[str]:
    """Indices of prototypes that do not exist, arrays of other lengths."""
    if not prim.IsA(UsdGeom.PointInstancer):
        return []
    instancer = UsdGeom.PointInstancer(prim)
    found = []
    count = len(instancer.GetPrototypesRel().GetForwardedTargets())
    indices = instancer.GetProtoIndicesAttr()
    for time in _moments(indices):
        values = np.array(indices.Get(time) or [], dtype=np.int64)
        if len(values) and not (0 <= values.min() and values.max() < count):
            found.append(f"protoIndices are from {values.min()} to {values.max()}, but there are {count} prototypes")
            break
    wanted = len(indices.Get(_moments(indices)[0]) or [])
    for attribute in (
        instancer.GetPositionsAttr(),
        instancer.GetOrientationsAttr(),
        instancer.GetOrientationsfAttr(),
        instancer.GetScalesAttr(),
    ):
        value = attribute.Get(_moments(attribute)[0]) if attribute.HasAuthoredValue() else None
        if value is not None and len(value) != wanted:
            found.append(f"{attribute.GetName()} has {len(value)} values for {wanted} instances")
    return found


def _moments(attribute: Usd.Attribute) -> list:
    """The default time, where there is a value, and the samples."""
    default = [Usd.TimeCode.Default()] if attribute.Get() is not None else []
    return [*default, *attribute.GetTimeSamples()] or [Usd.TimeCode.Default()]


def _default_pose(prim: Usd.Prim) -> list[str]:
    """Poses that have time samples only: without a time, as physics parsers look, they are at the origin."""
    if not prim.IsA(UsdGeom.Xformable):
        return []
    poses = list(prim.GetAttributes()) if prim.IsA(UsdGeom.PointInstancer) else []
    poses = [attribute for attribute in poses if attribute.GetName() in ("positions", "orientations", "orientationsf")]
    poses += [operation.GetAttr() for operation in UsdGeom.Xformable(prim).GetOrderedXformOps()]
    return [
        f"{attribute.GetName()} has {attribute.GetNumTimeSamples()} time samples but no default value"
        for attribute in poses
        if attribute and attribute.GetNumTimeSamples() and attribute.Get() is None
    ]


def _approximation(prim: Usd.Prim) -> list[str]:
    """Words that UsdPhysics does not know."""
    attribute = prim.GetAttribute("physics:approximation")
    if not attribute or not attribute.HasAuthoredValue() or attribute.Get() in APPROXIMATIONS:
        return []
    return [f"{attribute.Get()} is none of {', '.join(sorted(APPROXIMATIONS))}"]


def _material(prim: Usd.Prim) -> list[str]:
    """Physics materials bound above the collider, which physics parsers do not see."""
    if not prim.HasRelationship("material:binding:physics") or prim.HasAPI(UsdPhysics.CollisionAPI):
        return []
    return ["a physics material must be bound on the collider itself: parsers see none here"]


RULES = {
    "InstancerArrays": _instancer,
    "DefaultTimePose": _default_pose,
    "ApproximationToken": _approximation,
    "MaterialOnCollider": _material,
}
