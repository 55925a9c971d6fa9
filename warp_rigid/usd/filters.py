"""Filtered pairs of a file: its collision groups and filtered-pairs relationships."""

from collections import Counter
from collections.abc import Iterable
from itertools import combinations_with_replacement

from pxr import Usd, UsdPhysics

from warp_rigid.scene.scene import Motion, Scene
from warp_rigid.usd.usd_file import COLLIDERS, JOINT_KINDS, Types, UsdFile


def filter_pairs(file: UsdFile, scene: Scene) -> None:
    """Filter the pairs of bodies all of whose colliders are filtered.

    Where only some colliders of two bodies are filtered, which a scene cannot represent, the filter is left out.

    Args:
        file: the file.
        scene: its scene, which receives the pairs.
    """
    body_of, descriptions = file.body_of, file.described(*COLLIDERS)
    filtered = _by_relationship(file, descriptions) | _by_group(file, descriptions)
    size = Counter(body_of.values())
    colliders = Counter(tuple(sorted((body_of[one], body_of[other]))) for one, other in filtered)
    for (a, b), count in sorted(colliders.items()):
        if a == b or Motion.DYNAMIC not in (scene.bodies[a].motion, scene.bodies[b].motion):
            continue
        if count == size[a] * size[b]:
            scene.filter_pair(a, b)
        else:
            names = scene.bodies[a].name, scene.bodies[b].name
            reason = f"filter between some of its colliders and some of {names[1]}: all of them collide"
            file.leave_out(names[0], reason)


def _members(file: UsdFile) -> dict[str, set[str]]:
    """Paths of the bodies of each articulation and each body, by its path."""
    found = {path: {path} for path, body in file.described(Types.RigidBody).items() if body.rigidBodyEnabled}
    joints = {path: {str(joint.body0), str(joint.body1)} for path, joint in file.described(*JOINT_KINDS).items()}
    for path, articulation in file.described(Types.Articulation).items():
        # The parser names the bodies only if the root is above them, not if it is one of them, or a joint.
        named = {str(body) for body in articulation.articulatedBodies} or joints.get(path, {path})
        found[path] = _linked(named & found.keys(), joints.values())
    return found


def _linked(bodies: set[str], joints: Iterable[set[str]]) -> set[str]:
    """Some bodies, and all that joints connect to them, directly or not, by their paths."""
    ends = [pair - {""} for pair in joints]
    found = set(bodies)
    while more := set().union(*(pair for pair in ends if pair & found)) - found:
        found |= more
    return found


def _by_relationship(file: UsdFile, descriptions: dict) -> set[tuple[str, str]]:
    """Collider pairs filtered by relationships of colliders, bodies, articulations, or other prims above some."""
    members = _members(file)

    def colliders(path: str) -> list[str]:
        if path in members:
            return [collider for collider in file.body_of if str(descriptions[collider].rigidBody) in members[path]]
        return [collider for collider in file.body_of if collider == path or collider.startswith(path + "/")]

    filtered: set[tuple[str, str]] = set()
    for prim in Usd.PrimRange(file.stage.GetPseudoRoot(), Usd.TraverseInstanceProxies()):
        if not prim.HasAPI(UsdPhysics.FilteredPairsAPI):
            continue
        own = colliders(str(prim.GetPath()))
        for target in UsdPhysics.FilteredPairsAPI(prim).GetFilteredPairsRel().GetForwardedTargets():
            filtered |= {_ordered(one, other) for other in colliders(str(target)) for one in own}
    return filtered


def _by_group(file: UsdFile, descriptions: dict) -> set[tuple[str, str]]:
    """Collider pairs filtered by collision groups."""
    members: dict[str, list[str]] = {}
    for collider in file.body_of:
        for group in descriptions[collider].collisionGroups:
            members.setdefault(str(group), []).append(collider)
    if not members:
        return set()
    table = UsdPhysics.CollisionGroup.ComputeCollisionGroupTable(file.stage)
    return {
        _ordered(one, other)
        for first, second in combinations_with_replacement(sorted(members), 2)
        if not table.IsCollisionEnabled(first, second)
        for one in members[first]
        for other in members[second]
        if one != other
    }


def _ordered(one: str, other: str) -> tuple[str, str]:
    return (one, other) if one < other else (other, one)
