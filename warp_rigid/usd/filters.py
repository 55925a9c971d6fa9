"""Filtered pairs of a file: its collision groups and filtered-pairs relationships."""

from collections import Counter
from collections.abc import Callable, Iterable

from pxr import Usd, UsdPhysics

from warp_rigid.scene.scene import Motion, Scene


def filter_pairs(
    stage: Usd.Stage,
    scene: Scene,
    body_of: dict[str, int],
    descriptions: dict,
    members: dict[str, set[str]],
    leave_out: Callable[[str, str], None],
) -> None:
    """Filter the pairs of bodies all of whose colliders are filtered.

    Args:
        stage: the stage.
        scene: receives the filtered pairs.
        body_of: body index by collider path.
        descriptions: the parser's descriptions by collider path.
        members: paths of the bodies of each articulation and each body, by its path.
        leave_out: called with a path and a reason if only some colliders of two bodies are filtered, which a scene
            cannot represent.
    """
    filtered = _by_relationship(stage, body_of, descriptions, members) | _by_group(stage, body_of, descriptions)
    size = Counter(body_of.values())
    colliders = Counter(tuple(sorted((body_of[one], body_of[other]))) for one, other in filtered)
    for (a, b), count in sorted(colliders.items()):
        if a == b or Motion.DYNAMIC not in (scene.bodies[a].motion, scene.bodies[b].motion):
            continue
        if count == size[a] * size[b]:
            scene.filter_pair(a, b)
        else:
            names = scene.bodies[a].name, scene.bodies[b].name
            leave_out(names[0], f"filter between some of its colliders and some of {names[1]}: all of them collide")


def linked(bodies: set[str], joints: Iterable[set[str]]) -> set[str]:
    """Some bodies, and all that joints connect to them, directly or not, by their paths."""
    ends = [pair - {""} for pair in joints]
    found = set(bodies)
    while more := set().union(*(pair for pair in ends if pair & found)) - found:
        found |= more
    return found


def _by_relationship(
    stage: Usd.Stage, body_of: dict[str, int], descriptions: dict, members: dict[str, set[str]]
) -> set[tuple[str, str]]:
    """Collider pairs filtered by relationships of colliders, bodies, articulations, or other prims above some."""

    def colliders(path: str) -> list[str]:
        if path in members:
            return [collider for collider in body_of if str(descriptions[collider].rigidBody) in members[path]]
        return [collider for collider in body_of if collider == path or collider.startswith(path + "/")]

    filtered: set[tuple[str, str]] = set()
    for prim in Usd.PrimRange(stage.GetPseudoRoot(), Usd.TraverseInstanceProxies()):
        if not prim.HasAPI(UsdPhysics.FilteredPairsAPI):
            continue
        own = colliders(str(prim.GetPath()))
        for target in UsdPhysics.FilteredPairsAPI(prim).GetFilteredPairsRel().GetForwardedTargets():
            filtered |= {(min(one, other), max(one, other)) for other in colliders(str(target)) for one in own}
    return filtered


def _by_group(stage: Usd.Stage, body_of: dict[str, int], descriptions: dict) -> set[tuple[str, str]]:
    """Collider pairs filtered by collision groups."""
    members: dict[str, list[str]] = {}
    for collider in body_of:
        for group in descriptions[collider].collisionGroups:
            members.setdefault(str(group), []).append(collider)
    if not members:
        return set()
    table = UsdPhysics.CollisionGroup.ComputeCollisionGroupTable(stage)
    groups = sorted(members)
    return {
        (min(one, other), max(one, other))
        for index, first in enumerate(groups)
        for second in groups[index:]
        if not table.IsCollisionEnabled(first, second)
        for one in members[first]
        for other in members[second]
        if one != other
    }
