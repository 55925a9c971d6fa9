"""Pairs that a file keeps from touching: collision groups and filtered pairs."""

from collections import Counter
from collections.abc import Callable

from pxr import Usd, UsdPhysics

from warp_rigid.scene.scene import Motion, Scene

__all__ = ["filter_pairs"]

Told = Callable[[str, str], None]


def filter_pairs(stage: Usd.Stage, scene: Scene, body_of: dict[str, int], told: dict, leave_out: Told) -> None:
    """Filter the pairs of bodies none of whose colliders may touch.

    Args:
        stage: the file.
        scene: takes the filtered pairs.
        body_of: the body to which each collider's path belongs.
        told: for each body's and collider's path the parser's description.
        leave_out: takes a path and a reason where only some colliders of two bodies may touch: a scene cannot say that.
    """
    apart = _by_relationship(body_of, told) | _by_group(stage, body_of, told)
    size = Counter(body_of.values())
    colliders = Counter(tuple(sorted((body_of[one], body_of[other]))) for one, other in apart)
    for (a, b), count in sorted(colliders.items()):
        if a == b:
            continue
        if scene.bodies[a].motion != Motion.DYNAMIC and scene.bodies[b].motion != Motion.DYNAMIC:
            continue
        if count == size[a] * size[b]:
            scene.filter_pair(a, b)
        else:
            names = scene.bodies[a].name, scene.bodies[b].name
            leave_out(names[0], f"some of its colliders pass through some of {names[1]}'s; here all of them meet")


def _by_relationship(body_of: dict[str, int], told: dict) -> set[tuple[str, str]]:
    """Colliders kept apart by name: of themselves, or of the bodies to which they belong."""
    apart: set[tuple[str, str]] = set()
    for path, description in told.items():
        for target in map(str, description.filteredCollisions):
            for one in _below(path, body_of):
                apart |= {(min(one, other), max(one, other)) for other in _below(target, body_of)}
    return apart


def _below(path: str, body_of: dict[str, int]) -> list[str]:
    """Colliders that are a prim or lie below it."""
    return [collider for collider in body_of if collider == path or collider.startswith(path + "/")]


def _by_group(stage: Usd.Stage, body_of: dict[str, int], told: dict) -> set[tuple[str, str]]:
    """Colliders kept apart because their groups are."""
    members: dict[str, list[str]] = {}
    for collider in body_of:
        for group in told[collider].collisionGroups:
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
