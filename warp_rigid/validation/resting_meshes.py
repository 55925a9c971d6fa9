"""Section I: the true overlap of meshes at rest, apart from contacts, grids and `Simulator.penetration`.

The deepest point of each mesh in each other body is searched for with the distances to the triangles of the latter. The
depth of the point that is found is evaluated in float64.
"""

from collections.abc import Callable
from itertools import combinations

import numpy as np
from trimesh.triangles import area, closest_point

from warp_rigid import rotations
from warp_rigid.engine.simulator import Simulator
from warp_rigid.scene.scene import Scene
from warp_rigid.scene.shapes import Mesh, Shape, topology
from warp_rigid.scenes.builders import grounds, meshes, piles
from warp_rigid.scenes.builders.bodies import add_bodies
from warp_rigid.validation.case import Cases, Check, ValidationCase, at_most, case
from warp_rigid.validation.solids import winding

SECONDS = 6.0
SIZE = 0.2
ENVS = 3
"""Piles of each kind, which differ in their starts."""
DEEPEST = 2e-5
"""Largest overlap at rest, a ten-thousandth of the size [m]."""
ACCURACY = 1e-7
"""Of a depth [m]."""
KEPT = 150
"""Pieces of triangles that are searched further, at most."""
DepthFunction = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
PILES: dict[str, tuple[int, tuple[Callable[[], Mesh], ...]]] = {
    "16 tori": (16, (lambda: meshes.torus(0.5 * SIZE, 0.2 * SIZE),)),
    "8 bunnies": (8, (lambda: meshes.bunny(SIZE),)),
    "40 bones": (40, (meshes.cranium, meshes.pelvis, meshes.femur)),
    "32 mixed meshes": (
        32,
        (meshes.brain_like, meshes.skull_like, meshes.cranium, lambda: meshes.bunny(SIZE), meshes.torus, meshes.femur),
    ),
}


def cases(quick: bool) -> Cases:
    """The case of the section; only the smallest pile if quick."""
    return [resting(["8 bunnies"] if quick else list(PILES))]


def pile(name: str) -> Scene:
    """Meshes that fall into a bin."""
    count, kinds = PILES[name]
    scene = grounds.level_scene(friction=0.5)
    piles.add_pile_bin(scene, count, friction=0.5)
    made = [kind() for kind in kinds]
    add_bodies(scene, [made[k % len(made)] for k in range(count)], *piles.starts(count, 0), density=500.0, friction=0.5)
    return scene


class Solid:
    """A shape in the world. The triangles of a mesh, its holes closed, are in float64; other shapes have none."""

    def __init__(self, shape: Shape, position: np.ndarray, orientation: np.ndarray):
        """Place it by its pose."""
        self.shape, self.position, self.turn = shape, position, rotations.matrix(orientation)
        self.triangles = np.zeros((0, 3, 3))
        self.lower, self.upper, self.unit = np.full(3, -np.inf), np.full(3, np.inf), 1.0
        if isinstance(shape, Mesh):
            vertices, faces = topology.close_boundaries(shape.vertices, shape.faces)
            self.triangles = (vertices @ self.turn.T + position)[faces]
            self.unit = float(np.sqrt(area(self.triangles).mean()))
            self.lower, self.upper = self.triangles.min(axis=(0, 1)), self.triangles.max(axis=(0, 1))

    def depth_at(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Depth of (n, 3) points, in a mesh by the nearest triangle; negative outside [m]. All of them count."""
        return -self.shape.signed_distance((points - self.position) @ self.turn)[0], np.ones(len(points), bool)

    def exact_depth(self, point: np.ndarray) -> float:
        """Depth of a point in float64, in a mesh by the winding number and the distances to all triangles [m]."""
        if not len(self.triangles):
            return float(self.depth_at(point[None])[0][0])
        # `closest_point` compares areas and products of them with 1e-13, so the unit is the size of a triangle.
        corners = (self.triangles - point) / self.unit
        distance = self.unit * np.linalg.norm(closest_point(corners, np.zeros_like(corners[:, 0])), axis=1).min()
        return float(distance if winding(point[None], self.triangles)[0] > 0.5 else -distance)

    def may_touch(self, other: "Solid") -> bool:
        """Whether the boxes around both meet."""
        return bool((self.lower < other.upper).all() and (other.lower < self.upper).all())


def deepest_point(corners: np.ndarray, depth_at: DepthFunction, best: float = 0.0, accuracy: float = ACCURACY):
    """The deepest point of triangles, if it is deeper than `best`.

    Triangles are divided into four, and left out where no point can be deeper than the deepest one so far: the depths
    of two points differ by at most their distance. Of those that are left the most promising are kept.

    Args:
        corners: (n, 3, 3) [m].
        depth_at: function of (m, 3) points: their depths (m,) [m], and which of them count (m,).
        best: depth that is known [m].
        accuracy: of the depth, or a thousandth of it if that is more [m].

    Returns:
        The depth [m], and the point; `best` and None if there is none.
    """
    deepest = None
    points = np.unique(corners.reshape(-1, 3), axis=0)
    radius = np.zeros(0)
    while len(points):
        depth, counts = depth_at(points)
        counted = np.where(counts, depth, -np.inf)
        if counted.max() > best:
            best, deepest = float(counted.max()), points[counted.argmax()]
        if len(radius):
            bound = depth + radius
            kept = np.flatnonzero(bound > best + max(accuracy, 1e-3 * best))
            corners = _divided(corners[kept[np.argsort(-bound[kept])][:KEPT]])
            if radius.max() < accuracy:
                break
        points = corners.mean(axis=1)
        radius = np.linalg.norm(corners - points[:, None], axis=2).max(axis=1, initial=0.0)
    return best, deepest


def _divided(corners):
    """Each triangle as four."""
    a, b, c = np.moveaxis(corners, 1, 0)
    ab, bc, ca = 0.5 * (a + b), 0.5 * (b + c), 0.5 * (c + a)
    return np.concatenate([np.stack(some, axis=1) for some in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (bc, ca, ab))])


def overlap_of(first: Solid, second: Solid) -> float:
    """The deepest overlap of two solids [m], 0 if they are apart."""
    depths = [0.0]
    for own, other in ((first, second), (second, first)):
        near = (own.triangles.max(axis=1) > other.lower) & (own.triangles.min(axis=1) < other.upper)
        _, point = deepest_point(own.triangles[near.all(axis=1)], other.depth_at)
        if point is not None:
            depths.append(other.exact_depth(point))
    return max(depths)


def deepest_overlap(sim: Simulator, env: int) -> float:
    """The deepest overlap of an environment's bodies, of which at least one is a mesh [m]."""
    poses = zip(sim.get("position")[env].astype(float), sim.get("orientation")[env].astype(float), strict=True)
    solids = [Solid(body.shape, *pose) for body, pose in zip(sim.scene.bodies, poses, strict=True)]
    return max((overlap_of(*pair) for pair in combinations(solids, 2) if pair[0].may_touch(pair[1])), default=0.0)


def at_rest(name: str, device: str) -> tuple[list[float], list[float]]:
    """The deepest overlaps of some piles at the end, measured and as reported [m]."""
    count, _ = PILES[name]
    sim = Simulator(pile(name), ENVS, device=device)
    fallen = list(range(sim.num_bodies - count, sim.num_bodies))
    starts = [piles.starts(count, env) for env in range(ENVS)]
    for state, values in zip(("position", "orientation"), zip(*starts, strict=True), strict=True):
        sim.set(state, np.array(values), bodies=fallen)
    sim.step(round(SECONDS / sim.settings.dt))
    return [deepest_overlap(sim, env) for env in range(ENVS)], sim.penetration().tolist()


def resting(names: list[str]) -> ValidationCase:
    """Piles of meshes at rest do not overlap, and their overlap is the reported one."""

    def compute(device: str) -> np.ndarray:
        """Measured and reported overlaps (kinds, 2, ENVS) [m]."""
        return np.array([at_rest(name, device) for name in names])

    def error(found: np.ndarray) -> np.ndarray:
        """By how much the reported overlaps are wrong, beyond 1 % [m]."""
        return np.maximum(np.abs(found[:, 1] - found[:, 0]) - 0.01 * found[:, 0], 0.0).max(axis=1)

    return case(
        f"V104 {ENVS} piles of meshes of each kind after {SECONDS:g} s",
        "points of the meshes; winding number and distances to all triangles, float64",
        Check("deepest overlap", "m", lambda found: found[:, 0].max(axis=1), at_most(DEEPEST)),
        Check("difference of the reported overlap beyond 1 %", "m", error, at_most(2e-6)),
        compute=compute,
        labels=names,
    )
