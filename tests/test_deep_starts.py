"""Bodies that start deep inside each other: the overlap is reported in full, and they come apart."""

import numpy as np
import pytest
import trimesh

import warp_rigid as wr
from warp_rigid.scenes.builders import meshes

RADIUS = 0.15
BALL = wr.Mesh.from_trimesh(trimesh.creation.icosphere(radius=RADIUS))
BOXES = [
    (wr.Box((0.15, 0.05, 0.05)), (0, 0, 0), (0, 0, 0, 1)),
    (wr.Box((0.05, 0.05, 0.15)), (0.1, 0, 0.1), (0, 0, 0, 1)),
]
CORNER = trimesh.boolean.union(
    [
        trimesh.creation.box((0.3, 0.1, 0.1)),
        trimesh.creation.box((0.1, 0.1, 0.3), trimesh.transformations.translation_matrix((0.1, 0, 0.1))),
    ],
    engine="manifold",
)
SHAPES = {
    "sphere": wr.Sphere(RADIUS),
    "box": wr.Box((0.15, 0.1, 0.12)),
    "capsule": wr.Capsule(0.08, 0.12),
    "cube": wr.Mesh.from_trimesh(trimesh.creation.box((0.25,) * 3)),
    "boxes": wr.Compound(BOXES),
    "corner": wr.Mesh.from_trimesh(CORNER),
    "ball": BALL,
    "bunny": meshes.bunny(0.2),
    "torus": meshes.torus(0.2, 0.08),
    "cranium": meshes.cranium(),
}


def overlapping(device, first, second, count=24):
    """Pairs at random orientations whose centres of mass are at most a third of their size apart."""
    scene = wr.Scene(gravity=(0, 0, 0))
    scene.add_body(first)
    scene.add_body(second)
    generator = np.random.default_rng(0)
    sim = wr.Simulator(scene, num_envs=count, device=device)
    turns = generator.normal(size=(count, 1, 4))
    sim.set("orientation", turns / np.linalg.norm(turns, axis=2, keepdims=True), bodies=[1])
    apart = generator.normal(size=(count, 3))
    apart *= generator.uniform(0.0, 0.33 * min(first.size, second.size), (count, 1)) / np.linalg.norm(
        apart, axis=1, keepdims=True
    )
    center = sim.get("center_of_mass")
    sim.set("position", (sim.get("position")[:, 1] + center[:, 0] - center[:, 1] + apart)[:, None], bodies=[1])
    return sim, np.linalg.norm(apart, axis=1)


def test_the_overlap_of_two_balls_is_the_way_they_must_move(device):
    """Of meshes whose centres are up to a third of the diameter apart: the sum of the radii less their distance."""
    sim, apart = overlapping(device, BALL, BALL)
    np.testing.assert_allclose(sim.penetration(), 2 * RADIUS - apart, atol=0.02 * RADIUS)  # they are polyhedra


@pytest.mark.parametrize(
    ("first", "second"),
    [("ball", "ball"), ("bunny", "bunny"), ("torus", "torus"), ("cranium", "cranium"), ("ball", "bunny")]
    + [("cube", "corner")]
    + [(name, "boxes") for name in ("sphere", "box", "capsule", "boxes")],
)
def test_meshes_that_start_deep_inside_each_other_come_apart(device, first, second):
    """Within a second the overlap is below 0.1 % of the size, and no speed is left of it."""
    sim, _ = overlapping(device, SHAPES[first], SHAPES[second])
    assert sim.penetration().max() > 0.3 * SHAPES[first].size
    sim.step(240)
    assert sim.penetration().max() < 1e-3 * min(SHAPES[first].size, SHAPES[second].size)
    assert np.abs(sim.get("linear_velocity")).max() < 1e-3
