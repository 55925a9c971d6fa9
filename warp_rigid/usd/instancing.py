"""Expansion of PointInstancers to Xforms, for readers such as physics parsers that ignore instancers."""

from pathlib import Path

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, UsdPhysics, Vt

from warp_rigid.files.atomic import check_unread
from warp_rigid.files.mesh_files import USD_SUFFIXES
from warp_rigid.usd.conventions import MARK, lineage, polar
from warp_rigid.usd.examination import MAX_PRIMS
from warp_rigid.usd.opening import convert_errors, open_stage
from warp_rigid.usd.prims import matrix_between
from warp_rigid.usd.specs import define, export_layer, set_attribute, set_operations

NAMES = Sdf.ValueTypeNames
VELOCITY, SPIN = f"{MARK}:velocity", f"{MARK}:angularVelocity"
"""Attributes of an instance: its velocities in the frame of the instancer [1/s, degrees/s]."""
OF_ORIGIN = f"{MARK}:velocityOfOrigin"
"""Attribute of a body whose velocity is that of its origin, not of its centre of mass."""

MAX_NESTED = 100
"""Maximum nesting of instancers within prototypes of instancers."""


def flatten_usd(source, target) -> int:
    """Copy a file and replace each PointInstancer by one Xform per instance, including its motion.

    Args:
        source: the file to read.
        target: the file to write: .usd, .usda or .usdc.

    Returns:
        The number of instances.

    Raises:
        FileNotFoundError: The source does not exist.
        ValueError: The source is not a USD file, its number of instances changes over time, or the target has another
            suffix or is a file that is read.
        OSError: The target cannot be written.
    """
    source, target = Path(source), Path(target)
    if target.suffix not in USD_SUFFIXES or target.suffix == ".usdz":
        raise ValueError(f"{target}: must end in .usd, .usda or .usdc")
    stage = open_stage(source)
    check_unread([target], [layer.realPath for layer in stage.GetUsedLayers() if layer.realPath])
    with convert_errors(source):
        # Equal rates keep USD from scaling the times of the session layer.
        stage.GetSessionLayer().timeCodesPerSecond = stage.GetTimeCodesPerSecond()
        stage.SetEditTarget(stage.GetSessionLayer())
        times = sorted(
            {
                time
                for prim in stage.Traverse()
                if prim.IsA(UsdGeom.PointInstancer)
                for attribute in prim.GetAttributes()
                for time in attribute.GetTimeSamples()
            }
        )
        moments = [Usd.TimeCode.Default(), *(Usd.TimeCode(time) for time in times)]
        count = expand_instancers(stage.GetPseudoRoot(), moments)
    export_layer(stage.Flatten(addSourceFileComment=False), target)
    return count


def expand_instancers(root: Usd.Prim, times: list[Usd.TimeCode]) -> int:
    """Expand the instancers below a prim, in the edit target of the stage.

    Each instance becomes an Xform next to its instancer with a reference to its prototype, and the instancer is
    deactivated. The names of the instances sort in the order of the instancer.

    Args:
        root: the prim.
        times: times at which to sample the poses; the first one provides the default values.

    Returns:
        The number of instances.

    Raises:
        ValueError: The arrays of an instancer are inconsistent, it is one of its own prototypes, or the result has
            more than MAX_PRIMS prims.
    """
    total = 0
    stage = root.GetStage()
    plan = _Plan(times[0])
    plan.size(root)
    for path in plan.order:
        # An instancer below another one was deactivated with it. Instancers within prototypes come first.
        if stage.GetPrimAtPath(path):
            total += _expand(UsdGeom.PointInstancer(stage.GetPrimAtPath(path)), times)
    if total:
        _set_velocities(root, times[0])
    return total


class _Plan:
    """The instancers to expand, those within prototypes first, and the resulting number of prims.

    Attributes:
        order: paths of the instancers.
    """

    def __init__(self, time: Usd.TimeCode):
        """Start with an empty plan."""
        self.order: dict[Sdf.Path, None] = {}
        self._time = time
        self._known: dict[Sdf.Path, int] = {}

    def size(self, prim: Usd.Prim, within: tuple[Sdf.Path, ...] = ()) -> int:
        """Number of prims of an expanded subtree; adds its instancers to the order."""
        path = prim.GetPath()
        if path in within:
            raise ValueError(f"{path}: must not be one of its own prototypes")
        if len(within) > MAX_NESTED:
            raise ValueError(f"{path}: must have at most {MAX_NESTED} nested instancers")
        if path not in self._known:
            size = 0
            for below in Usd.PrimRange(prim, Usd.TraverseInstanceProxies()):
                size += 1
                if below.IsA(UsdGeom.PointInstancer):
                    size += self._instances(UsdGeom.PointInstancer(below), (*within, path))
            if size > MAX_PRIMS:
                raise ValueError(f"{path}: must have at most {MAX_PRIMS} prims including instances, has {size}")
            self._known[path] = size
        return self._known[path]

    def _instances(self, instancer: UsdGeom.PointInstancer, within: tuple[Sdf.Path, ...]) -> int:
        prim, size = instancer.GetPrim(), 0
        prototypes = instancer.GetPrototypesRel().GetForwardedTargets()
        which, counts = np.unique(_indices(instancer, self._time), return_counts=True)
        for index, count in zip(which.tolist(), counts.tolist(), strict=True):
            prototype = prim.GetStage().GetPrimAtPath(prototypes[index]) if 0 <= index < len(prototypes) else None
            size += count * (1 + self.size(prototype, within)) if prototype else 0
        if not prim.IsInstanceProxy():
            self.order[prim.GetPath()] = None
        return size


def _indices(instancer: UsdGeom.PointInstancer, time: Usd.TimeCode) -> np.ndarray:
    return np.array(instancer.GetProtoIndicesAttr().Get(time) or [], dtype=np.int64)


def _expand(instancer: UsdGeom.PointInstancer, times: list[Usd.TimeCode]) -> int:
    """Expand one instancer."""
    prim, stage = instancer.GetPrim(), instancer.GetPrim().GetStage()
    layer = stage.GetEditTarget().GetLayer()
    prototypes = instancer.GetPrototypesRel().GetForwardedTargets()
    poses_alone = UsdGeom.PointInstancer.ExcludeProtoXform, UsdGeom.PointInstancer.IgnoreMask
    moments = [instancer.ComputeInstanceTransformsAtTime(time, time, *poses_alone) for time in times]
    indices = _indices(instancer, times[0])
    if any(len(moment) != len(indices) for moment in moments):
        raise ValueError(f"{prim.GetPath()}: must have a constant number of instances and arrays of equal length")
    if len(indices) and not (0 <= indices.min() and indices.max() < len(prototypes)):
        raise ValueError(f"{prim.GetPath()}: protoIndices must be from 0 to {len(prototypes) - 1}")
    missing = [path for path in prototypes if not stage.GetPrimAtPath(path)]
    if missing:
        raise ValueError(f"{prim.GetPath()}: prototypes: there is no prim {missing[0]}")
    masked = instancer.ComputeMaskAtTime(times[0])
    visible = np.array(masked, dtype=bool) if masked else np.ones(len(indices), dtype=bool)
    outer = UsdGeom.Xformable(prim).GetLocalTransformation(times[0])
    group = f"{prim.GetPath()}_instances"
    width = len(str(max(len(indices) - 1, 0)))
    colors = _colors(instancer, len(indices))
    given = {VELOCITY: instancer.GetVelocitiesAttr(), SPIN: instancer.GetAngularVelocitiesAttr()}
    motion = {name: values for name, attribute in given.items() if (values := _values(attribute, times[0]))}
    motion = {name: values for name, values in motion.items() if len(values) == len(indices)}
    with Sdf.ChangeBlock():
        parent = define(layer, group, "Xform")
        _set_matrix(parent, [outer], times[:1])
        for index in np.flatnonzero(visible).tolist():
            spec = Sdf.PrimSpec(parent, f"instance_{index:0{width}d}", Sdf.SpecifierDef, "Xform")
            _set_matrix(spec, [moment[index] for moment in moments], times)
            inner = Sdf.PrimSpec(spec, "prototype", Sdf.SpecifierDef)
            inner.referenceList.prependedItems = [Sdf.Reference("", prototypes[indices[index]])]
            inner.SetInfo("displayName", f"{prim.GetName()}_{index}")
            if colors is not None:
                color = Vt.Vec3fArray([colors[index]])
                set_attribute(spec, "primvars:displayColor", NAMES.Color3fArray, color, interpolation="constant")
            for name, values in motion.items():
                set_attribute(spec, name, NAMES.Vector3f, values[index])
    prim.SetActive(False)
    return int(visible.sum())


def _set_matrix(spec: Sdf.PrimSpec, matrices: list[Gf.Matrix4d], times: list[Usd.TimeCode]) -> None:
    (attribute,) = set_operations(spec, {"transform": (NAMES.Matrix4d, matrices[0])})
    for time, matrix in zip(times, matrices, strict=True):
        if time.IsNumeric() and not time.IsEarliestTime():
            spec.layer.SetTimeSample(attribute.path, time.GetValue(), matrix)


def _values(attribute: Usd.Attribute, time: Usd.TimeCode):
    """The values of an array at a time, else the first ones."""
    return attribute.Get(time) or attribute.Get(Usd.TimeCode.EarliestTime())


def _set_velocities(root: Usd.Prim, time: Usd.TimeCode) -> None:
    """Give the rigid bodies in moving instances the velocities of their origins, in the frames of the bodies."""
    while proxies := [body for body in _carried(root) if body.IsInstanceProxy()]:
        held = {next(prim for prim in lineage(body) if not prim.IsInstanceProxy()).GetPath() for body in proxies}
        for path in held:  # Bodies within native instances have no velocities of their own.
            root.GetStage().GetPrimAtPath(path).SetInstanceable(False)
    places = UsdGeom.XformCache(time)
    found = {body.GetPath(): _velocity_of(body, root, places) for body in _carried(root)}
    layer = root.GetStage().GetEditTarget().GetLayer()
    with Sdf.ChangeBlock():
        for path, velocities in found.items():
            spec = Sdf.CreatePrimInLayer(layer, path)
            for name, value in zip(("physics:velocity", "physics:angularVelocity"), velocities, strict=True):
                set_attribute(spec, name, NAMES.Vector3f, Gf.Vec3f(*value.tolist()))
            set_attribute(spec, OF_ORIGIN, NAMES.Bool, True)


def _carried(root: Usd.Prim) -> list[Usd.Prim]:
    """The rigid bodies in moving instances below a prim."""
    prims = Usd.PrimRange(root, Usd.TraverseInstanceProxies())
    return [prim for prim in prims if prim.HasAPI(UsdPhysics.RigidBodyAPI) and _instances_above(prim)]


def _instances_above(prim: Usd.Prim) -> list[Usd.Prim]:
    """The moving instances that a prim belongs to, the innermost first."""
    above = lineage(prim.GetParent())
    return [instance for instance in above if instance.HasAttribute(VELOCITY) or instance.HasAttribute(SPIN)]


def _velocity_of(body: Usd.Prim, root: Usd.Prim, places: UsdGeom.XformCache) -> tuple[np.ndarray, np.ndarray]:
    """Velocity of the origin [1/s] and angular velocity [degrees/s] of a body, in its frame.

    They are those of the rigid motions of all instances that it belongs to, or its own where these do not state them.
    """

    def frame(prim: Usd.Prim) -> np.ndarray:
        return (
            np.array(places.GetLocalToWorldTransform(prim)).T
            if root.IsPseudoRoot()
            else matrix_between(places, prim, root)
        )

    instances, own = _instances_above(body), frame(body)
    rotation, api = polar(own[:3, :3])[0], UsdPhysics.RigidBodyAPI(body)
    linear, angular = np.zeros(3), np.zeros(3)
    for instance in instances:
        outer, arm = frame(instance.GetParent()), own[:3, 3] - frame(instance)[:3, 3]
        if instance.HasAttribute(SPIN):
            spin = polar(outer[:3, :3])[0] @ instance.GetAttribute(SPIN).Get()
            linear, angular = linear + np.cross(np.radians(spin), arm), angular + spin
        if instance.HasAttribute(VELOCITY):
            linear = linear + outer[:3, :3] @ instance.GetAttribute(VELOCITY).Get()
    if not any(instance.HasAttribute(VELOCITY) for instance in instances):
        linear = linear + rotation @ api.GetVelocityAttr().Get()
    if not any(instance.HasAttribute(SPIN) for instance in instances):
        angular = angular + rotation @ api.GetAngularVelocityAttr().Get()
    return rotation.T @ linear, rotation.T @ angular


def _colors(instancer: UsdGeom.PointInstancer, count: int):
    """One colour per instance; None without colours."""
    primvar = UsdGeom.PrimvarsAPI(instancer).GetPrimvar("displayColor")
    values = primvar.Get() if primvar else None
    return values if values and len(values) == count else None
