"""`penetration` against float64 overlaps of pairs of every two kinds of shapes, apart from their contacts."""

import itertools

import numpy as np
import pytest
import trimesh

import warp_rigid as wr
from tests.oracles import random_quaternion, rotate_about, rotation_matrix
from tests.overlap_oracle import Solid, deepest_overlap
from warp_rigid import rotations
from warp_rigid.scenes.builders import meshes

BOXES = [
    (wr.Box((0.15, 0.05, 0.05)), (0, 0, 0), (0, 0, 0, 1)),
    (wr.Box((0.05, 0.05, 0.15)), (0.1, 0, 0.1), (0, 0, 0, 1)),
]
ARMS = [
    trimesh.creation.box(2 * shape.half_extents, trimesh.transformations.translation_matrix(place))
    for shape, place, _ in BOXES
]
GROUNDS = {
    "plane": wr.Plane((0.1, -0.2, 1.0), 0.0),
    "field": wr.Heightfield(0.02 * np.random.default_rng(1).normal(size=(13, 13)), (1.0, 1.0)),
}
SHAPES = {
    "sphere": wr.Sphere(0.1),
    "box": wr.Box((0.15, 0.1, 0.05)),
    "capsule": wr.Capsule(0.06, 0.1),
    "cylinder": wr.Cylinder(0.1, 0.08),
    "disc": wr.Cylinder(0.15, 0.02),
    "cube": wr.Mesh.from_trimesh(trimesh.creation.box((0.2, 0.2, 0.2))),
    "ball": wr.Mesh.from_trimesh(trimesh.creation.icosphere(subdivisions=1, radius=0.1)),
    "torus": meshes.torus(0.1, 0.04, segments=12),
    "corner": wr.Mesh.from_trimesh(trimesh.boolean.union(ARMS, engine="manifold")),
    "boxes": wr.Compound(BOXES),
}
PAIRS = [*itertools.product(GROUNDS, SHAPES), *itertools.combinations_with_replacement(SHAPES, 2)]


def two_bodies(device, first, second, count=1):
    """A simulator of two bodies; the first is static if it is a ground."""
    scene = wr.Scene(gravity=(0, 0, 0))
    (scene.add_static if first.static_only else scene.add_body)(first)
    scene.add_body(second)
    return wr.Simulator(scene, num_envs=count, device=device)


def overlapping(device, first, second, count, generator):
    """Pairs at random orientations that overlap by 5 um to 5 cm along a random direction."""
    sim = two_bodies(device, first, second, count)
    orientation = random_quaternion(generator, 2 * count).reshape(count, 2, 4)
    direction = generator.normal(size=(count, 3))
    start = 0.02 * generator.normal(size=(count, 3))
    if first.static_only:
        orientation[:, 0] = (0, 0, 0, 1)
        direction[:] = (0, 0, 1)
        start[:, :2] = generator.uniform(-0.3, 0.3, (count, 2))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    sim.set("orientation", orientation)
    position = np.zeros((count, 2, 3))
    low, high = np.zeros(count), np.full(count, 0.8)
    for _ in range(22):
        middle = 0.5 * (low + high)
        position[:, 1] = start + direction * middle[:, None]
        sim.set("position", position)
        touching = sim.penetration() > 0.0
        low, high = np.where(touching, middle, low), np.where(touching, high, middle)
    low -= 10.0 ** generator.uniform(-5.3, -1.3, count)
    position[:, 1] = start + direction * np.maximum(low, 0.0)[:, None]
    sim.set("position", position)
    return sim


def oracle(sim, env):
    """The deepest overlap of a pair; of an inner ball whose centre is inside the other body, at least its own."""
    poses = zip(sim.get("position")[env].astype(float), sim.get("orientation")[env].astype(float), strict=True)
    shapes = [body.shape for body in sim.scene.bodies]
    poses = [(position, turn / np.linalg.norm(turn)) for position, turn in poses]
    solids = [Solid(shape, *pose) for shape, pose in zip(shapes, poses, strict=True)]
    depths = [deepest_overlap(*solids)]
    for shape, (position, turn), other in zip(shapes, poses, solids[::-1], strict=True):
        center, radius = shape.inner_balls[:, :3], shape.inner_balls[:, 3]
        depth = other.depth(center @ rotation_matrix(turn).T + position)
        depths.extend((radius + depth)[(depth > 0.0) & (radius > 0.0)])
    return max(depths)


def check(device, first, second, count):
    """Within 1 % or 2 um of the oracle in `count` poses."""
    generator = np.random.default_rng(3)
    sim = overlapping(device, {**GROUNDS, **SHAPES}[first], SHAPES[second], count, generator)
    expected = [oracle(sim, env) for env in range(count)]
    np.testing.assert_allclose(sim.penetration(), expected, rtol=0.01, atol=2e-6)


FEW = [*PAIRS[::9], ("torus", "torus"), ("sphere", "disc"), ("field", "corner")]


@pytest.mark.parametrize(
    ("first", "second"), [pytest.param(*pair, marks=() if pair in FEW else pytest.mark.long) for pair in PAIRS]
)
def test_penetration_is_the_deepest_overlap(device, first, second):
    check(device, first, second, 6)


@pytest.mark.long
@pytest.mark.xfail(strict=True, reason="0.133 mm are found of 0.147 mm in one of the poses")
def test_penetration_of_more_poses_is_the_deepest_overlap(device):
    check(device, "field", "corner", 12)


def test_edges_that_cross(device):
    """Two cubes turned onto an edge, one across the other: both edges are h / sqrt(2) below the faces of the other."""
    for shift in (0.0, 0.013, 0.031):
        sim = two_bodies(device, SHAPES["cube"], SHAPES["cube"])
        sim.set("orientation", [rotate_about((1, 0, 0), 45), rotate_about((0, 1, 0), 45)])
        sim.set("position", [(0, 0, 0), (shift, shift, 2 * 0.1 * 2**0.5 - 1e-3)])
        np.testing.assert_allclose(sim.penetration(), 1e-3 / 2**0.5, rtol=1e-3)


@pytest.mark.long
def test_tubes_that_cross_between_their_samples(device):
    """Two tori whose outer edges cross; their faces bend by pi / 8 there, which leaves edges without samples."""
    torus = meshes.torus(0.07, 0.03, segments=32)
    sim = two_bodies(device, torus, torus)
    aside = 0.9 * np.pi / 32
    half = rotate_about((0, 0, 1), np.degrees(np.pi / 32 - aside))
    sim.set("orientation", [half, rotations.multiply(rotate_about((1, 0, 0), 90), half)])
    sim.set("position", (2 * 0.1 * np.cos(np.pi / 32) / np.cos(aside) - 1e-4, 0, 0), bodies=[1])
    expected = oracle(sim, 0)
    assert 5e-5 < expected < 1e-4
    np.testing.assert_allclose(sim.penetration(), expected, rtol=0.01)


def test_a_cylinder_on_its_rim(device):
    """It is as deep below a plane as its lowest point, wherever on the rim this is."""
    sim = two_bodies(device, GROUNDS["plane"], SHAPES["cylinder"])
    normal = GROUNDS["plane"].normal
    for degrees in (0.1, 5.0, 40.0):
        turn = rotate_about((0.3, 1.0, 0.2), degrees)
        lowest = SHAPES["cylinder"].support(-(rotation_matrix(np.array(turn)).T @ normal)[None])[0]
        sim.set("orientation", turn, bodies=[1])
        sim.set("position", (lowest - 1e-4) * normal, bodies=[1])
        np.testing.assert_allclose(sim.penetration(), 1e-4, atol=2e-7)


def test_the_deepest_overlap_does_not_depend_on_the_other_pairs(device):
    """Pieces are left out where an overlap that is found elsewhere is deeper: the deepest one stays the same."""
    generator = np.random.default_rng(8)
    scene, alone = wr.Scene(gravity=(0, 0, 0)), []
    shape = meshes.torus(0.1, 0.04)
    for k in range(6):
        pair = wr.Scene(gravity=(0, 0, 0))
        at, turns = generator.uniform(-0.02, 0.02, 3) + [0.2, 0, 0], random_quaternion(generator, 2)
        for place, turn in zip((np.zeros(3), at), turns, strict=True):
            pair.add_body(shape, position=place, orientation=turn)
            scene.add_body(shape, position=place + [0, 0, 2.0 * k], orientation=turn)
        alone.append(wr.Simulator(pair, device=device).penetration()[0])
    together = wr.Simulator(scene, device=device).penetration()[0]
    assert max(alone) > 1e-3 and together == pytest.approx(max(alone), rel=1e-5)
