"""Masks of MuJoCo, `contype` and `conaffinity`, as collision groups of UsdPhysics."""

from pathlib import Path

from pxr import Usd, UsdPhysics

from warp_rigid.usd.masses import is_of_mujoco
from warp_rigid.usd.opening import open_stage

LIST_MASKS = """
import json, sys
import mujoco

def masks(body):
    for geom in body.geoms:
        if geom.contype or geom.conaffinity:
            yield geom.name, int(geom.contype), int(geom.conaffinity)
    for child in body.bodies:
        yield from masks(child)

print(json.dumps(list(masks(mujoco.MjSpec.from_file(sys.argv[1]).worldbody))))
"""
"""Program that prints name, contype and conaffinity of each geom that can touch others, depth first, as the converter
writes them, which leaves the masks out. It runs in the environment of the converter."""

GROUPS = "/warp_rigid_masks"

Mask = tuple[str, int, int]


def add_masks(file: Path, masks: list[Mask]) -> None:
    """Write one collision group for each pair of masks to a converted file.

    Two geoms touch if the contype of one and the conaffinity of the other have a common bit.

    Args:
        file: the layer that the converter wrote.
        masks: of the geoms with a collider, in the order of the file.

    Raises:
        ValueError: The file has other colliders.
    """
    stage = open_stage(file)
    prims = Usd.PrimRange(stage.GetPseudoRoot(), Usd.TraverseInstanceProxies())
    colliders = [prim for prim in prims if is_of_mujoco(prim)]
    names = [{prim.GetName(), prim.GetDisplayName()} for prim in colliders]
    if len(masks) != len(names) or any(mask[0] and mask[0] not in own for mask, own in zip(masks, names, strict=True)):
        raise ValueError("the converter writes other colliders")
    members: dict[tuple[int, int], list[str]] = {}
    for prim, (_, kind, affinity) in zip(colliders, masks, strict=True):
        members.setdefault((kind, affinity), []).append(str(prim.GetPath()))
    paths = {mask: f"{GROUPS}/group_{index}" for index, mask in enumerate(members)}
    for mask, path in paths.items():
        group = UsdPhysics.CollisionGroup.Define(stage, path)
        group.GetCollidersCollectionAPI().CreateIncludesRel().SetTargets(members[mask])
        apart = [other for (kind, affinity), other in paths.items() if not (kind & mask[1] or mask[0] & affinity)]
        group.CreateFilteredGroupsRel().SetTargets(apart)
    stage.GetRootLayer().Save()
