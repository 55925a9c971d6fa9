"""Conservative advancement: convex solids that meet within a step are stopped where they begin to overlap."""

import numpy as np
import pytest
import warp as wp

from tests.convex_oracle import SOLIDS, overlaps, solid
from tests.oracles import random_quaternion, stages_of
from warp_rigid.bench.cases import find_case
from warp_rigid.engine.cores import shared_by, usable_cores
from warp_rigid.engine.settings import Settings
from warp_rigid.engine.simulator import Simulator
from warp_rigid.kernels import schema
from warp_rigid.kernels.collide.ccd import NEVER, PAIR_NUMBERS, UNITS_OF_TIME
from warp_rigid.kernels.collide.convex import is_solid
from warp_rigid.kernels.tuning import ALLOWED_DEPTH
from warp_rigid.rotations import about_axis, multiply
from warp_rigid.scene.scene import Scene
from warp_rigid.scene.shapes import Box, Capsule, Compound, Cylinder, Heightfield, Plane, Sphere
from warp_rigid.scenes.builders import meshes

wp.set_module_options({"enable_backward": False})

DT = 1 / 60
HALF = 0.1
CUBE = Box((HALF,) * 3)


def turned(orientation, spin, times):
    """Orientations (n, 4) after turning with angular velocities (n, 3) for times (n,)."""
    speed = np.linalg.norm(spin, axis=1)
    turns = [about_axis(w / s, s * time) for w, s, time in zip(spin, speed, times, strict=True)]
    return np.array([multiply(turn, q) for turn, q in zip(turns, orientation, strict=True)])


@pytest.mark.long
@pytest.mark.parametrize("kind", ["slab", "bar", "octahedron", "rod"])
def test_the_time_of_impact_is_that_of_float64(device, kind):
    """Tumbling solids fly past or into a tumbling cube; the oracle looks for the first overlap that is too deep."""
    generator = np.random.default_rng(4)
    count, shape = 40, SOLIDS[kind]()
    scene = Scene(gravity=(0, 0, 0))
    scene.add_body(CUBE)
    scene.add_body(shape)
    with shared_by(usable_cores()):  # one core, so one shard
        sim = Simulator(scene, num_envs=count, settings=Settings(dt=DT), device=device)
    orientation = random_quaternion(generator, 2 * count).reshape(count, 2, 4)
    spin = generator.normal(size=(count, 2, 3)) * 8.0
    toward = generator.normal(size=(count, 3))
    toward /= np.linalg.norm(toward, axis=1, keepdims=True)
    position, velocity = np.zeros((2, count, 2, 3))
    position[:, 1] = 0.6 * toward
    velocity[:, 1] = -40.0 * toward + generator.normal(size=(count, 3)) * 12.0
    start = {"position": position, "orientation": orientation, "linear_velocity": velocity, "angular_velocity": spin}
    for name, values in start.items():
        sim.set(name, values)
    cube, flying = solid(CUBE), solid(shape)

    def overlap(times):
        turns = np.stack([turned(orientation[:, k], spin[:, k], times) for k in range(2)], axis=1)
        return overlaps(cube, flying, position + times[:, None, None] * velocity, turns)

    stages = stages_of(sim)
    stages.predict(DT)
    stages.find_pairs()
    stages.find_contacts()
    stages.open_iteration(is_first=1)
    stages._trace_fast_pairs()
    first = stages.motions.first_impact.numpy().reshape(count, 2).min(axis=1)
    hit = first < int(NEVER)
    times = np.where(hit, first // int(PAIR_NUMBERS) / float(UNITS_OF_TIME), 1.0) * DT
    shapes = stages.model.shapes.shapes.numpy()
    allowed = float(ALLOWED_DEPTH) * min(shapes["size"].min(), 2.0 * shapes["wall"].min())
    before = np.max([overlap(times * share) for share in np.linspace(0.0, 0.999, 100)], axis=0)
    assert 10 < hit.sum() < count - 5
    # An advancement ends at 2e-3 sizes; the oracle of round solids finds depths that are slightly too large.
    np.testing.assert_allclose(overlap(times)[hit], allowed, atol=0.25 * allowed)
    assert before.max() < 1.05 * allowed


def test_flush_cubes_that_fall_in_a_column_do_not_enter_each_other(device):
    """Their corners and edges run along each other's faces, so no sample is inside the next cube."""
    case = find_case("stack:10")
    sim = Simulator(case.build(), settings=Settings(dt=DT), device=device)
    case.scatter(sim)
    deepest = 0.0
    for _ in range(30):
        sim.step()
        deepest = max(deepest, sim.penetration().max())
    assert deepest < 0.07 * 2 * HALF


def test_a_slower_body_keeps_its_motion_and_the_faster_one_turns_with_it(device):
    """A cube that turns slowly about its contact with the ground is hit by a fast one; alone it moves the same."""
    scene = Scene(gravity=(0, 0, 0))
    scene.add_body(CUBE, angular_velocity=(0.0, 4.0, 0.0), linear_velocity=(0.4, 0.0, 0.0))
    scene.add_body(CUBE, position=(0.02, 0.01, 0.9), linear_velocity=(0.4, 0.0, -60.0))
    sim = Simulator(scene, num_envs=2, settings=Settings(dt=DT), device=device)
    sim.set("position", (9.0, 0.0, 0.9), envs=[1], bodies=[1])
    sim.step()
    hit, alone = sim.get("position")[:, 0].astype(float)
    assert np.abs(hit - alone).max() < 2e-3
    turns = sim.get("orientation").astype(float)
    np.testing.assert_allclose(np.abs(turns[0, 0] @ turns[1, 0]), 1.0, atol=1e-4)
    left = 1.0 - (0.7 + float(ALLOWED_DEPTH) * 2 * HALF) / (60.0 * DT)
    assert abs(turns[0, 1, 1]) == pytest.approx(0.5 * 4.0 * DT * left, rel=0.05)
    overlap = overlaps(solid(CUBE), solid(CUBE), sim.get("position")[:1].astype(float), turns[:1])
    assert overlap[0] == pytest.approx(float(ALLOWED_DEPTH) * 2 * HALF, abs=1e-3)


@wp.kernel
def note_solids(shapes: schema.Shapes, solid: wp.array[int]):
    """One thread per shape: whether it is a convex solid."""
    solid[wp.tid()] = wp.where(is_solid(shapes, wp.tid()), 1, 0)


SHAPES = {
    "ball": lambda: Sphere(0.1),
    "capsule": lambda: Capsule(0.1, 0.1),
    "cylinder": lambda: Cylinder(0.1, 0.1),
    "cube": lambda: CUBE,
    "octahedron": SOLIDS["octahedron"],
    "torus": lambda: meshes.torus(0.2, 0.05),
    "pair": lambda: Compound([(CUBE, (-0.1, 0, 0), (0, 0, 0, 1)), (CUBE, (0.1, 0, 0), (0, 0, 0, 1))]),
    "field": lambda: Heightfield(np.zeros((4, 4)), (1.0, 1.0)),
    "plane": Plane,
}


@pytest.mark.parametrize("name", SHAPES)
def test_samples_are_traced_unless_all_shapes_are_solids(device, name):
    """The decision of the host, taken once, is that of the kernels for each pair."""
    scene = Scene(gravity=(0, 0, 0))
    scene.add_body(CUBE, position=(0, 0, 1.0))
    scene.add_static(SHAPES[name]())
    model = stages_of(Simulator(scene, device=device)).model
    count = model.shapes.shapes.shape[0]
    solid = wp.zeros(count, dtype=int, device=device)
    wp.launch(note_solids, dim=count, inputs=[model.shapes], outputs=[solid], device=device)
    assert model.layout.has_only_solids == bool(solid.numpy().all())


@pytest.mark.parametrize("height, sampled", [(0.5, 1), (8.0, 0)])
def test_samples_are_traced_only_in_rounds_with_pairs_that_need_them(device, height, sampled):
    """Two cubes meet at 60 m/s, and the lower one also hits a plane if it is near."""
    scene = Scene(gravity=(0, 0, 0))
    scene.add_static(Plane())
    scene.add_body(CUBE, position=(0, 0, height), linear_velocity=(0, 0, -30.0))
    scene.add_body(CUBE, position=(0, 0, height + 0.5), linear_velocity=(0, 0, -90.0))
    stages = stages_of(Simulator(scene, settings=Settings(dt=DT), device=device))
    stages.predict(DT)
    stages.find_pairs()
    stages.find_contacts()
    stages.open_iteration(is_first=1)
    suspects = stages.pools.suspects
    assert (suspects.again.numpy()[0], suspects.sampled.numpy()[0]) == (1, sampled)
    stages._trace_fast_pairs()
    assert (suspects.count.numpy()[0] > 0) == bool(sampled)
