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


def arms(*others):
    """A bar of 0.3 m along x, and bars of 0.3 m along z about other centres."""
    bars = [trimesh.creation.box((0.3, 0.1, 0.1))]
    for center in others:
        bars.append(trimesh.creation.box((0.1, 0.1, 0.3), trimesh.transformations.translation_matrix(center)))
    return trimesh.boolean.union(bars, engine="manifold")


def open_ring():
    """A ring from which a piece is cut: a C."""
    ring = trimesh.creation.annulus(0.1, 0.16, 0.1, sections=32)
    gap = trimesh.creation.box((0.2, 0.08, 0.3), trimesh.transformations.translation_matrix((0.13, 0, 0)))
    return trimesh.boolean.difference([ring, gap], engine="manifold")


def tray(wall, height):
    """A box of 0.3 m width, open at the top."""
    hollow = trimesh.creation.box(
        (0.3 - 2 * wall,) * 2 + (height,), trimesh.transformations.translation_matrix((0, 0, wall))
    )
    return trimesh.boolean.difference([trimesh.creation.box((0.3, 0.3, height)), hollow], engine="manifold")


BRANCHED = {
    "corner": arms((0.1, 0, 0.1)),
    "channel": arms((0.1, 0, 0.1), (-0.1, 0, 0.1)),
    "tee": arms((0, 0, 0.1)),
    "plus": arms((0, 0, 0)),
    "open ring": open_ring(),
}
VESSELS = {"tray": tray(0.02, 0.1), "thick tray": tray(0.05, 0.12), "crate": tray(0.02, 0.3)}
SHAPES = {
    **{name: wr.Mesh.from_trimesh(mesh) for name, mesh in {**BRANCHED, **VESSELS}.items()},
    "sphere": wr.Sphere(RADIUS),
    "box": wr.Box((0.15, 0.1, 0.12)),
    "capsule": wr.Capsule(0.08, 0.12),
    "cube": wr.Mesh.from_trimesh(trimesh.creation.box((0.25,) * 3)),
    "boxes": wr.Compound(BOXES),
    "rod": wr.Box((0.2, 0.03, 0.03)),
    "disc": wr.Cylinder(RADIUS, 0.05),
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
    [("ball", "ball"), pytest.param("ball", "bunny", marks=pytest.mark.long)]
    + [pytest.param(name, name, marks=pytest.mark.long) for name in ("torus", "cranium", "bunny")]
    + [("cube", "corner"), ("rod", "corner"), ("corner", "channel")]
    + [(name, "boxes") for name in ("sphere", "box", "rod", "capsule", "boxes")],
)
def test_meshes_that_start_deep_inside_each_other_come_apart(device, first, second):
    """Within a second the overlap is below 0.1 % of the size, and no speed is left of it."""
    sim, _ = overlapping(device, SHAPES[first], SHAPES[second])
    assert sim.penetration().max() > 0.3 * SHAPES[first].size
    sim.step(240)
    assert sim.penetration().max() < 1e-3 * min(SHAPES[first].size, SHAPES[second].size)
    assert np.abs(sim.get("linear_velocity")).max() < 1e-3


@pytest.mark.parametrize("name", BRANCHED)
def test_no_arms_of_meshes_that_start_deep_stay_crossed(device, name):
    """The same, and by the volume that both meshes share, of Manifold's intersection: none after a second."""
    shape = SHAPES[name]
    sim, _ = overlapping(device, shape, shape)
    assert sim.penetration().max() > 0.3 * shape.size and max(shared_volumes(sim, BRANCHED[name])) > 0.1
    sim.step(240)
    assert sim.penetration().max() < 1e-3 * shape.size and max(shared_volumes(sim, BRANCHED[name])) < 1e-4
    assert np.abs(sim.get("linear_velocity")).max() < 1e-3


@pytest.mark.long
@pytest.mark.parametrize("name", VESSELS)
def test_no_walls_that_cross_at_the_start_stay_crossed(device, name):
    """By the volume that both meshes share, of Manifold's intersection: none after a second."""
    sim, _ = overlapping(device, SHAPES[name], SHAPES[name])
    assert min(shared_volumes(sim, VESSELS[name])) > 1e-3
    sim.step(240)
    assert max(shared_volumes(sim, VESSELS[name])) < 1e-4
    assert np.abs(sim.get("linear_velocity")).max() < 1e-3


@pytest.mark.long
@pytest.mark.parametrize("second", ["boxes", "corner", "tray"])
def test_a_disc_that_starts_in_arms_or_walls_comes_apart(device, second):
    """Its rim may be in an inner corner, and an arm may pierce it: within two seconds none of it is left."""
    sim, _ = overlapping(device, SHAPES["disc"], SHAPES[second])
    assert sim.penetration().max() > 0.3 * SHAPES["disc"].size
    sim.step(480)
    assert sim.penetration().max() < 1e-3 * SHAPES["disc"].size
    assert np.abs(sim.get("linear_velocity")).max() < 1e-3


def shared_volumes(sim, mesh):
    """Volume of the intersection of two meshes of a kind in each environment, as a fraction of one's."""
    for position, orientation in zip(sim.get("position"), sim.get("orientation"), strict=True):
        placed = []
        for x, q in zip(position, orientation, strict=True):
            pose = trimesh.transformations.quaternion_matrix(np.roll(q, 1))
            pose[:3, 3] = x
            placed.append(mesh.copy().apply_transform(pose))
        yield trimesh.boolean.intersection(placed, engine="manifold").volume / mesh.volume


@pytest.mark.parametrize("name", ["box", "boxes"])
def test_a_body_on_a_plane_is_not_in_the_origin_of_its_frame(device, name):
    """A plane has no inside, hence no balls: it carries a body that contains the origin of its frame as any other."""
    scene = wr.Scene()
    low = SHAPES[name].bounds[0][2]
    scene.add_static(wr.Plane(offset=low))
    scene.add_body(SHAPES[name])
    sim = wr.Simulator(scene, device=device)
    sim.step(60)
    contacts = sim.contacts()
    assert len(contacts) >= 4
    np.testing.assert_allclose(np.abs(contacts["normal"]), [[0, 0, 1]] * len(contacts), atol=1e-4)
    assert np.abs(sim.get("position")[0, 1]).max() < 1e-4
