"""Checks of a USD file: the validators of the USD library, and additional rules."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pxr import Usd, UsdGeom, UsdPhysics, UsdValidation

from warp_rigid.usd.opening import convert_errors, open_stage

TOKENS = UsdPhysics.Tokens
APPROXIMATIONS = {
    TOKENS.none, TOKENS.convexHull, TOKENS.convexDecomposition, TOKENS.boundingSphere, TOKENS.boundingCube,
    TOKENS.meshSimplification,
}  # fmt: skip


@dataclass(frozen=True)
class UsdProblem:
    """One violation of a rule in a file.

    Attributes:
        path: path of the prim; empty for the stage.
        rule: name of the violated rule.
        text: description of the problem.
    """

    path: str
    rule: str
    text: str

    def __str__(self) -> str:
        """One line."""
        return f"{self.path or 'stage'}: {self.rule}: {self.text}"


def check_usd(path) -> list[UsdProblem]:
    """Check a file and return all problems found; empty for a valid file.

    Raises:
        FileNotFoundError: The file does not exist.
        ValueError: It is not a USD file.
    """
    path = Path(path)
    stage = open_stage(path)
    with convert_errors(path):
        validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
        problems = []
        for error in UsdValidation.ValidationContext(validators).Validate(stage):
            sites = [site for site in error.GetSites() if site.IsPrim() or site.IsProperty()]
            path = str((sites[0].GetPrim() or sites[0].GetProperty()).GetPath()) if sites else ""
            problems.append(UsdProblem(path, str(error.GetName()), error.GetMessage()))
        for prim in stage.Traverse(Usd.TraverseInstanceProxies()):
            for rule, check in RULES.items():
                problems += [UsdProblem(str(prim.GetPath()), rule, text) for text in check(prim)]
        return problems


def _instancer(prim: Usd.Prim) -> list[str]:
    """Prototype indices out of range, and arrays of inconsistent lengths."""
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
    for attribute in map(prim.GetAttribute, ("positions", "orientations", "orientationsf", "scales")):
        value = attribute.Get(_moments(attribute)[0]) if attribute.HasAuthoredValue() else None
        if value is not None and len(value) != wanted:
            found.append(f"{attribute.GetName()} has {len(value)} values for {wanted} instances")
    return found


def _moments(attribute: Usd.Attribute) -> list:
    """The default time if it has a value, and the sample times."""
    default = [Usd.TimeCode.Default()] if attribute.Get() is not None else []
    return [*default, *attribute.GetTimeSamples()] or [Usd.TimeCode.Default()]


def _default_pose(prim: Usd.Prim) -> list[str]:
    """Poses with time samples but no default value, which physics parsers read as the origin."""
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
    """Approximation tokens that UsdPhysics does not define."""
    attribute = prim.GetAttribute("physics:approximation")
    if not attribute or not attribute.HasAuthoredValue() or attribute.Get() in APPROXIMATIONS:
        return []
    return [f"must be one of {', '.join(sorted(APPROXIMATIONS))}, is {attribute.Get()}"]


def _material(prim: Usd.Prim) -> list[str]:
    """Physics materials bound to an ancestor of the collider, which physics parsers ignore."""
    if not prim.HasRelationship("material:binding:physics") or prim.HasAPI(UsdPhysics.CollisionAPI):
        return []
    return ["a physics material must be bound to the collider itself; physics parsers ignore this binding"]


RULES = {
    "InstancerArrays": _instancer,
    "DefaultTimePose": _default_pose,
    "ApproximationToken": _approximation,
    "MaterialOnCollider": _material,
}
