"""Second stage: the pairs found are those of brute force over the swept boxes, in an order of the scene's own."""

import numpy as np
import pytest

from tests.oracles import ground_scene, moving, opened, pair_list, random_quaternion, rotation_matrix
from warp_rigid.engine import hash_grid
from warp_rigid.engine.model import OVERSIZED
from warp_rigid.engine.settings import Settings
from warp_rigid.engine.simulator import Simulator
from warp_rigid.scene.scene import Motion, Scene
from warp_rigid.scene.shapes import Box, Capsule, Compound, Plane, Sphere


@pytest.fixture(params=["all", "grid"])
def search(request, monkeypatch):
    """Both kinds of candidates: all pairs, and those of the hash grid."""
    monkeypatch.setattr(hash_grid, "TRY_ALL_UP_TO", 10_000 if request.param == "all" else 0)
    return request.param


def mixed_scene(generator, count=120, spread=2.0):
    """Bodies of equal mass whose sizes differ by a factor of 100, between statics, kinematic bodies and a plane."""
    scene = ground_scene()
    scene.add_static(Plane(normal=(1, 0, 0), offset=-5.0))
    scene.add_static(Box((spread, 0.1, 0.1)), position=(0, 0, 0.5))
    scene.add_static(Sphere(0.1), position=(0.2, 0, 0))
    scene.add_kinematic(Box((0.2, 0.2, 1.5)), position=(0.3, 0.2, 1), angular_velocity=(0, 0, 2))
    scene.add_kinematic(Box((0.1, 0.1, 0.1)), position=(-0.2, 0, 0))
    for size in np.geomspace(0.01, 1.0, count):
        shape = (Sphere(size), Box(size * generator.uniform(0.2, 1.0, 3)), Capsule(0.5 * size, 0.5 * size))
        scene.add_body(
            shape[generator.integers(3)],
            position=generator.uniform(-spread, spread, 3),
            orientation=random_quaternion(generator),
            mass=1.0,
        )
    order = generator.permutation(len(scene.bodies))
    scene.bodies[:] = [scene.bodies[k] for k in order]
    return scene


def overlapping(lower, upper):
    """Pairs of boxes that overlap, as a set of sets."""
    overlap = (lower[:, None] <= upper[None]).all(-1) & (lower[None] <= upper[:, None]).all(-1)
    return {frozenset(pair) for pair in np.argwhere(np.triu(overlap, 1)).tolist()}


def brute_force(stages):
    """Overlapping pairs of the coming step's swept boxes within an environment of which one is dynamic."""
    stages.predict(stages.dt)
    dynamic = stages.model.bodies.motion.numpy() == int(Motion.DYNAMIC)
    pairs = overlapping(stages.motions.lower.numpy(), stages.motions.upper.numpy())
    return {
        pair
        for pair in pairs
        if len({body // stages.model.layout.most_bodies for body in pair}) == 1 and any(dynamic[body] for body in pair)
    }


def found_pairs(stages):
    """What the stage lists, as a set of sets; no pair twice."""
    stages.predict(stages.dt)
    stages.find_pairs()
    listed = pair_list(stages).tolist()
    found = {frozenset(pair) for pair in listed}
    assert len(found) == len(listed)
    return found


def scatter(sim, generator, spread, offset):
    """Give every environment its own positions and velocities."""
    shape = (sim.num_envs, sim.num_bodies, 3)
    sim.set("position", generator.uniform(-spread, spread, shape) + offset)
    sim.set("linear_velocity", generator.normal(size=shape))
    sim.set("angular_velocity", 5.0 * generator.normal(size=shape))


@pytest.mark.parametrize("offset", [0.0, -300.0, 1e4])
def test_pairs_are_those_of_brute_force(device, search, offset):
    generator = np.random.default_rng(1)
    sim, stages = opened(mixed_scene(generator), device, num_envs=3)
    assert (stages.grid.buckets > 0) == (search == "grid")
    assert sim.get("position").max() < 100.0
    scatter(sim, generator, 1.5, (offset, -offset, offset))
    expected = brute_force(stages)
    assert len(expected) > 1000
    assert found_pairs(stages) == expected


@pytest.mark.parametrize("seed", range(4))
def test_pairs_of_dense_and_sparse_scenes(device, search, seed):
    generator = np.random.default_rng(seed)
    spread = (0.5, 2.0, 8.0, 40.0)[seed]
    _, stages = opened(mixed_scene(generator, 60, spread), device, num_envs=2)
    assert found_pairs(stages) == brute_force(stages)


def test_pairs_of_equal_bodies(device, search):
    """Without a largest body among them, bodies that touch at their corners are as far apart as the search looks."""
    generator = np.random.default_rng(10)
    scene = Scene()
    for _ in range(300):
        scene.add_body(Box((0.1, 0.1, 0.1)), position=generator.uniform(-1, 1, 3))
    _, stages = opened(scene, device)
    assert found_pairs(stages) == brute_force(stages)


def test_order_does_not_depend_on_the_number_of_environments(device, search):
    generator = np.random.default_rng(5)
    scene = mixed_scene(generator, 60)
    batch, batch_stages = opened(scene, device, num_envs=4)
    scatter(batch, generator, 1.0, 0.0)
    found_pairs(batch_stages)
    listed = pair_list(batch_stages)
    single, single_stages = opened(scene, device)
    for env in range(4):
        for name in ("position", "linear_velocity", "angular_velocity"):
            single.set(name, batch.get(name)[env])
        found_pairs(single_stages)
        own = listed[listed[:, 0] // batch.num_bodies == env] - env * batch.num_bodies
        assert own.tolist() == pair_list(single_stages).tolist()


def test_both_searches_list_the_same_pairs_in_the_same_order(device, monkeypatch):
    listed = []
    for limit in (0, 10_000):
        monkeypatch.setattr(hash_grid, "TRY_ALL_UP_TO", limit)
        _, stages = opened(mixed_scene(np.random.default_rng(6), 60), device)
        found_pairs(stages)
        listed.append(pair_list(stages).tolist())
    assert listed[0] == listed[1]


def test_ordinary_dynamic_bodies_come_first_in_the_order_of_pairs(device, search):
    scene = mixed_scene(np.random.default_rng(7))
    _, stages = opened(scene, device)
    small, wide, width = stages.model.size_groups[stages.model.layout.scenes[0]]
    found_pairs(stages)
    order, rank = stages.grid.cells.order.numpy(), stages.grid.cells.rank.numpy()
    assert order.tolist() == [*small, *wide]
    places = rank[pair_list(stages)]
    assert (places[:, 0] < places[:, 1]).all() and (np.diff(pair_list(stages)[:, 0]) >= 0).all()
    assert all(np.diff(places[places[:, 0] == first, 1]).min(initial=1) > 0 for first in rank)
    assert sorted([*small, *wide]) == list(range(len(scene.bodies)))
    assert all(scene.bodies[k].motion == Motion.DYNAMIC for k in small)
    dynamic = np.flatnonzero(moving(scene))
    extent = {k: np.linalg.norm(np.ptp(scene.bodies[k].shape.bounds, axis=0)) for k in dynamic}
    assert len(small) < len(dynamic)
    assert max(extent[k] for k in small) <= OVERSIZED * np.median(list(extent.values()))
    assert width >= max(extent[k] for k in small)


def test_halted_environments_have_no_pairs(device, search):
    _, stages = opened(mixed_scene(np.random.default_rng(8), 60), device, num_envs=3)
    stages.envs.failed.assign(np.array([0, 1, 0], np.int32))
    found_pairs(stages)
    env = pair_list(stages)[:, 0] // stages.model.layout.most_bodies
    assert set(env) == {0, 2}


def box_corners(body):
    """Corners of the box around a shape in its own frame, (8, 3)."""
    lower, upper = body.shape.bounds
    return lower + (upper - lower) * np.array(list(np.ndindex(2, 2, 2)))


def true_boxes(scene, time, dt):
    """World boxes (n, 3) of all bodies `time` into a step of straight flight and steady spin, in float64."""
    lower, upper = [], []
    for body in scene.bodies:
        v = np.array(body.linear_velocity) + dt * np.array(scene.gravity)
        w = np.array(body.angular_velocity)
        angle = 0.5 * time * np.linalg.norm(w)
        axis = w / max(np.linalg.norm(w), 1e-300)
        spin = rotation_matrix((*(np.sin(angle) * axis), np.cos(angle)))
        corners = box_corners(body) @ (spin @ rotation_matrix(body.orientation)).T
        corners += np.array(body.position) + time * v
        lower.append(corners.min(axis=0))
        upper.append(corners.max(axis=0))
    return np.array(lower), np.array(upper)


def test_fast_movers_lose_no_pair(device, search):
    """Bullets that cross several others within a step: whoever overlaps at any time of the step is listed."""
    generator = np.random.default_rng(9)
    scene = Scene()
    for _ in range(80):
        scene.add_body(
            Box(generator.uniform(0.02, 0.2, 3)),
            position=generator.uniform(-2, 2, 3),
            orientation=random_quaternion(generator),
            linear_velocity=generator.normal(scale=100.0, size=3),
            angular_velocity=generator.normal(scale=60.0, size=3),
        )
    check_sweep(scene, device)


def test_spinning_bodies_lose_no_pair(device, search):
    """Rods that sweep over each other by their rotation alone."""
    generator = np.random.default_rng(11)
    scene = Scene(gravity=(0, 0, 0))
    for _ in range(60):
        scene.add_body(
            Box((0.5, 0.02, 0.02)),
            position=generator.uniform(-1, 1, 3),
            angular_velocity=(0, *generator.normal(scale=40.0, size=2)),
        )
    check_sweep(scene, device)


def check_sweep(scene, device):
    """All pairs that overlap at any of many instants of a step are found, and many of them only later in the step."""
    _, stages = opened(scene, device, settings=Settings(dt=1 / 60))
    at_start = overlapping(*true_boxes(scene, 0.0, stages.dt))
    ever = set(at_start)
    for time in np.linspace(0.0, stages.dt, 41):
        ever |= overlapping(*true_boxes(scene, time, stages.dt))
    assert len(ever) > 2 * len(at_start)
    assert ever <= found_pairs(stages)


def test_filtered_pairs_are_left_out_of_both_searches(search):
    """Of all pairs of a crowd some are filtered, wide bodies' too; the others stay as they are."""
    generator = np.random.default_rng(5)
    scene = mixed_scene(generator, count=40)
    count = len(scene.bodies)
    whole = found_pairs(opened(scene, "cpu", num_envs=2)[1])
    chosen = generator.permutation(sorted(sorted(body % count for body in pair) for pair in whole))[::3]
    for a, b in chosen.tolist():
        scene.filter_pair(b, a)
    left = found_pairs(opened(scene, "cpu", num_envs=2)[1])
    gone = {frozenset((env * count + a, env * count + b)) for env in range(2) for a, b in chosen.tolist()}
    assert len(gone & whole) >= 20 and left == whole - gone


def test_bodies_of_a_filtered_pair_fall_through_each_other(device):
    scene = ground_scene()
    table = scene.add_static(Box((1.0, 1.0, 0.1)), position=(0, 0, 1.0))
    balls = [scene.add_body(Sphere(0.1), position=(x, 0, 1.3)) for x in (-0.5, 0.5)]
    scene.filter_pair(balls[0], table)
    sim = Simulator(scene, num_envs=2, device=device)
    sim.step(240)
    height = sim.get("position")[:, balls, 2]
    np.testing.assert_allclose(height, [[0.1, 1.2]] * 2, atol=2e-3)
    assert (sim.penetration() < 1e-3).all()


def test_only_two_bodies_of_the_scene_can_be_filtered():
    scene = ground_scene()
    for pair, message in (((0, 1), "b: must be a whole number from 0 to 0"), ((0, 0), "b: must be another body")):
        with pytest.raises(ValueError, match=message):
            scene.filter_pair(*pair)


@pytest.mark.long
def test_two_simulators_search_in_their_own_cells(device):
    """Made one after the other and stepped in turn, each finds the pairs that it finds alone."""
    scenes = [mixed_scene(np.random.default_rng(seed), 300, 2.0) for seed in range(2)]
    alone = []
    for scene in scenes:
        sim = Simulator(scene, device=device)
        sim.step(2)
        alone.append(sim.counts()["most_pairs"])
    together = [Simulator(scene, device=device) for scene in scenes]
    for _ in range(2):
        for sim in together:
            sim.step()
    assert [sim.counts()["most_pairs"] for sim in together] == alone
    assert min(alone) > 1000


@pytest.mark.parametrize("beside", [False, True])
def test_bodies_without_colliders_touch_nothing(device, beside):
    """They fall freely through each other, and through a box; alone, the pool of shapes has no distance functions."""
    nothing, scene = Compound([], (0.0, 0.0, 0.0), 0.1 * np.eye(3)), Scene()
    for height in (1.0, 1.2):
        scene.add_body(nothing, mass=1.0, position=(0, 0, height), linear_velocity=(1, 0, 0))
    if beside:
        scene.add_static(Box((1.0, 1.0, 1.0)))
        scene.add_body(Box((0.1, 0.1, 0.1)), position=(0, 0, 1.1))
    sim = Simulator(scene, device=device)
    steps, dt = 60, sim.settings.dt
    sim.step(steps)
    fallen = 0.5 * 9.81 * dt**2 * steps * (steps + 1)
    expected = [[steps * dt, 0, height - fallen] for height in (1.0, 1.2)]
    np.testing.assert_allclose(sim.get("position")[0, :2], expected, atol=1e-5)
    assert sim.counts()["pairs"] == beside and sim.penetration()[0] < 1e-3
