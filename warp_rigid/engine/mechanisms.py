"""Mechanisms: groups of joints that dynamic bodies connect, and the order in which their equations are eliminated.

Two joints are coupled if they share a dynamic body. The joints of a mechanism are eliminated by least degree (George
and Liu 1989): the next one is coupled to the fewest others that remain, which are then all coupled to each other. For
trees this creates no additional blocks besides those of bodies with several joints.
"""

from collections.abc import Sequence
from functools import lru_cache
from itertools import combinations, pairwise, permutations
from typing import NamedTuple

import numpy as np

from warp_rigid.scene.shapes.topology import components


class Mechanisms(NamedTuple):
    """Structure of the equations of all mechanisms of one environment, in the terms of kernels/joints/arrays.py.

    Attributes:
        sequence: joints in the order of elimination, mechanism by mechanism.
        first_place: first place of each mechanism in the sequence, and their number of joints.
        column: first block of the joint at each place, and the number of blocks.
        row: joint of each block's rows.
        shared: (2,) bodies that the two joints of each block share, -1 where there are fewer.
        elimination: first elimination of the joint at each place, and their number.
        products: (left, right, target) blocks of each elimination.
        members: bodies of each mechanism.
    """

    sequence: list[int]
    first_place: list[int]
    column: list[int]
    row: list[int]
    shared: list[tuple[int, int]]
    elimination: list[int]
    products: list[tuple[int, int, int]]
    members: list[list[int]]

    @property
    def joints(self) -> list[list[int]]:
        """Joints of each mechanism, in the order of elimination."""
        return [self.sequence[first:last] for first, last in pairwise(self.first_place)]


Links = dict[int, set[int]]


@lru_cache(maxsize=16)
def find_mechanisms(ends: tuple[tuple[int, int | None], ...], dynamic: tuple[bool, ...]) -> Mechanisms:
    """Return the mechanisms of a scene.

    Args:
        ends: the two bodies of each joint; None for the world.
        dynamic: for each body whether it is dynamic.
    """
    shared = _shared_bodies(ends, dynamic)
    links: Links = {joint: set() for joint in range(len(ends))}
    for first, second in shared:
        links[first].add(second)
    found = Mechanisms([], [0], [0], [], [], [0], [], [])
    label = components(np.array([*shared], np.int64).reshape(-1, 2), len(ends))
    order = np.argsort(label, kind="stable")
    for group in np.split(order, np.flatnonzero(np.diff(label[order])) + 1) if ends else ():
        _eliminate({joint: links[joint] for joint in group.tolist()}, shared, found)
        found.first_place.append(len(found.sequence))
        found.members.append(sorted({body for joint in group for body in ends[joint] if body is not None}))
    return found


def _shared_bodies(
    ends: Sequence[tuple[int, int | None]], dynamic: Sequence[bool]
) -> dict[tuple[int, int], tuple[int, ...]]:
    """The dynamic bodies that two joints share, for both orders of each pair that shares any."""
    of_body: dict[int, list[int]] = {}
    for joint, both in enumerate(ends):
        for body in both:
            if body is not None and dynamic[body]:
                of_body.setdefault(body, []).append(joint)
    shared: dict[tuple[int, int], tuple[int, ...]] = {}
    for body, joints in sorted(of_body.items()):
        for first, second in permutations(joints, 2):
            shared[first, second] = (*shared.get((first, second), ()), body)
    return shared


def _eliminate(links: Links, shared: dict[tuple[int, int], tuple[int, ...]], found: Mechanisms) -> None:
    """Append the elimination of one mechanism; `links` is used up."""
    later: dict[int, set[int]] = {}
    while links:
        joint = min(links, key=lambda node: (len(links[node]), node))
        later[joint] = links.pop(joint)
        for other in later[joint]:
            links[other] |= later[joint]
            links[other] -= {joint, other}
    place = {joint: k for k, joint in enumerate(later)}
    block: dict[tuple[int, int], int] = {}
    for joint, others in later.items():
        for other in sorted(others, key=place.__getitem__):
            block[other, joint] = len(found.row)
            found.row.append(other)
            bodies = (*shared.get((other, joint), ()), -1, -1)
            found.shared.append((bodies[0], bodies[1]))
        found.column.append(len(found.row))
    for joint, others in later.items():
        for first, second in combinations(sorted(others, key=place.__getitem__), 2):
            found.products.append((block[second, joint], block[first, joint], block[second, first]))
        found.elimination.append(len(found.products))
    found.sequence.extend(later)
