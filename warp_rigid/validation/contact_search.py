"""Section H: random pairs of convex solids that overlap must have contacts, and must come apart."""

import itertools
from collections.abc import Sequence
from functools import cache

import numpy as np
import trimesh
from trimesh.grouping import unique_rows
from trimesh.util import unitize, vector_hemisphere

from warp_rigid import rotations
from warp_rigid.engine.settings import Settings
from warp_rigid.engine.simulator import Simulator
from warp_rigid.scenes.builders.assortment import CONVEX_KINDS, convex_solid
from warp_rigid.scenes.builders.scene_parts import body, in_space
from warp_rigid.validation.case import Cases, Check, at_most, case

POLYHEDRA = tuple(kind for kind in CONVEX_KINDS if kind != "sphere")
"""Kinds whose overlap separating axes give exactly."""
RADIUS = 0.4
"""Radius of the spheres that enclose the solids [m]; their size is twice this."""
LEAST, PARTED = 0.02, 0.01
"""Overlaps over the size: of a pair that must have a contact, and of one that has come apart."""
CHUNK = 2000
"""Pairs whose axes are projected at a time."""


def cases(quick: bool) -> Cases:
    """All cases of the section; fewer pairs if quick."""
    if quick:
        return [contacts_found(100, ("cube", "tetrahedron", "cylinder")), pairs_part(50, ("tetrahedron", "cylinder"))]
    return [contacts_found(5000, POLYHEDRA), pairs_part(1000, POLYHEDRA)]


@cache
def features(kind: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices (n, 3) [m], distinct face normals and distinct edge directions of a polyhedron, up to their sign."""
    solid = trimesh.Trimesh(*convex_solid(kind, RADIUS).surface())
    # A diagonal of a face is no edge.
    ends = solid.vertices[solid.face_adjacency_edges[solid.face_adjacency_angles > 1e-3]]
    return np.array(solid.vertices), _distinct(solid.face_normals), _distinct(ends[:, 1] - ends[:, 0])


def _distinct(directions: np.ndarray) -> np.ndarray:
    """Unit directions without repetitions, up to their sign."""
    unit = vector_hemisphere(unitize(directions))
    return unit[unique_rows(unit, digits=6)[0]]


def overlap(kinds: Sequence[str], offset: np.ndarray, orientation: np.ndarray) -> np.ndarray:
    """Exact overlap of pairs of polyhedra by separating axes in float64, (pairs,) [m]; negative if they are apart.

    Args:
        kinds: of both solids.
        offset: (pairs, 3) position of the second one in the frame of the first [m].
        orientation: (pairs, 4) its orientation there.
    """
    parts = range(0, len(offset), CHUNK)
    return np.concatenate([_overlap(kinds, offset[k : k + CHUNK], orientation[k : k + CHUNK]) for k in parts])


def _overlap(kinds, offset, orientation):
    (first, normals_a, edges_a), (second, normals_b, edges_b) = (features(kind) for kind in kinds)
    matrix = rotations.matrix(orientation)
    crossed = np.cross(edges_a[None, :, None], np.einsum("pij,ej->pei", matrix, edges_b)[:, None])
    own = np.broadcast_to(normals_a, (len(offset), *normals_a.shape))
    axes = np.concatenate(
        [own, np.einsum("pij,nj->pni", matrix, normals_b), crossed.reshape(len(offset), -1, 3)], axis=1
    )
    length = np.linalg.norm(axes, axis=-1)
    axes = axes / np.maximum(length, 1e-9)[..., None]
    a = axes @ first.T
    b = axes @ (second @ matrix.transpose(0, 2, 1) + offset[:, None]).transpose(0, 2, 1)
    depth = np.minimum(a.max(axis=-1) - b.min(axis=-1), b.max(axis=-1) - a.min(axis=-1))
    return np.where(length > 1e-6, depth, np.inf).min(axis=1)


def random_pairs(kinds: Sequence[str], count: int, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Offsets, orientations and overlaps of pairs that overlap by more than LEAST of the size, up to a fifth of it."""
    draw = np.random.default_rng((seed, *(CONVEX_KINDS.index(kind) for kind in kinds)))
    found: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    while sum(len(depth) for _, _, depth in found) < count:
        away = draw.normal(size=(4 * count, 3))
        away *= (draw.uniform(0.2, 2.0, 4 * count) * RADIUS / np.linalg.norm(away, axis=1))[:, None]
        orientation = rotations.random(draw, 4 * count)
        depth = overlap(kinds, away, orientation)
        kept = (depth > 2.0 * RADIUS * LEAST) & (depth < 2.0 * RADIUS * 0.2)
        found.append((away[kept], orientation[kept], depth[kept]))
    return tuple(np.concatenate(parts)[:count] for parts in zip(*found, strict=True))  # type: ignore[return-value]


def pair_simulator(kinds: Sequence[str], offset: np.ndarray, orientation: np.ndarray, device: str) -> Simulator:
    """An environment for each pair, without gravity; dt 1/240."""
    scene = in_space(*(body(convex_solid(kind, RADIUS)) for kind in kinds))
    sim = Simulator(scene(), len(offset), Settings(dt=1 / 240), device=device)
    sim.set("position", offset[:, None], bodies=[1])
    sim.set("orientation", orientation[:, None], bodies=[1])
    return sim


def contacts_found(count, among):
    """Pairs of every two kinds of polyhedra: none that overlaps by more than LEAST is without a contact."""
    combinations = list(itertools.combinations_with_replacement(among, 2))

    def missed(kinds, device):
        offset, orientation, _ = random_pairs(kinds, count, 74)
        sim = pair_simulator(kinds, offset, orientation, device)
        sim.step(1)
        return count - len(np.unique(sim.contacts()["env"]))

    return case(
        f"V74 {count} random overlapping pairs of every two kinds of polyhedra, {count * len(combinations)} in all",
        "separating axes in float64",
        Check("pairs without a contact", "", np.asarray, at_most(0)),
        compute=lambda device: [missed(kinds, device) for kinds in combinations],
        labels=[f"{a} and {b}" for a, b in combinations],
    )


def pairs_part(count, kinds):
    """Pairs of equal polyhedra that start with an overlap: it is below PARTED of the size after a second."""

    def stuck(kind, device):
        offset, orientation, _ = random_pairs((kind, kind), count, 75)
        sim = pair_simulator((kind, kind), offset, orientation, device)
        sim.step(240)
        position, orientation = (sim.get(name).astype(np.float64) for name in ("position", "orientation"))
        back = rotations.inverse(orientation[:, 0])
        apart = rotations.rotate(back, position[:, 1] - position[:, 0])
        depth = overlap((kind, kind), apart, rotations.multiply(back, orientation[:, 1]))
        return int((depth > 2.0 * RADIUS * PARTED).sum())

    return case(
        f"V74 {count} overlapping pairs of each kind of polyhedron come apart",
        "separating axes in float64",
        Check("pairs that still overlap by 1 % of the size after 1 s", "", np.asarray, at_most(0)),
        compute=lambda device: [stuck(kind, device) for kind in kinds],
        labels=kinds,
    )
