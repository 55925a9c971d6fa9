"""The candidates of large environments: complete, kept while fat boxes hold, and as many as their bodies are worth."""

import numpy as np
import pytest

import warp_rigid as wr
from tests.oracles import opened, pair_list, random_quaternion
from tests.test_broadphase import brute_force, found_pairs, mixed_scene, overlapping, scatter
from warp_rigid.engine import hash_grid
from warp_rigid.kernels.collide import candidates
from warp_rigid.scene.scene import Motion


def candidate_lists(stages):
    """The lists of all bodies; None for a body whose candidates are all later ones."""
    cells = stages.grid.cells
    listed, rows = cells.listed.numpy(), cells.candidates.numpy()
    starts = stages.grid.room * np.arange(len(listed))
    return [
        None if n == candidates.ALL_LATER else rows[start : start + n].tolist()
        for n, start in zip(listed, starts, strict=True)
    ]


def boxes_tested(stages):
    """Number of candidates that a step tests."""
    n, rank = stages.model.layout.most_bodies, stages.grid.cells.rank.numpy()
    lists = candidate_lists(stages)
    return sum(n - 1 - rank[i] if some is None else len(some) for i, some in enumerate(lists))


def computed_again(stages, dt=None):
    """Run the stage; environments whose candidates it has computed again."""
    stages.predict(stages.dt if dt is None else dt)
    stages.find_pairs()
    return np.flatnonzero(stages.grid.cells.stale.numpy()).tolist()


def heap(count, spacing=0.25, ground=True):
    """Boxes of 0.2 m in a block, and its side length."""
    scene = wr.Scene()
    if ground:
        scene.add_static(wr.Plane())
    side = round(count ** (1 / 3) + 0.5)
    for k in range(count):
        place = np.array((k % side, k // side % side, k // side**2))
        scene.add_body(wr.Box((0.1,) * 3), position=spacing * place + (0, 0, 0.15))
    return scene, spacing * side


@pytest.mark.parametrize("offset", [0.0, -300.0, 1e4])
def test_candidates_are_the_overlapping_fat_boxes(device, monkeypatch, offset):
    """Sizes differ by 100, some bodies are fast; brute force over the fat boxes finds the same pairs."""
    monkeypatch.setattr(hash_grid, "TRY_ALL_UP_TO", 0)
    generator = np.random.default_rng(1)
    sim, stages = opened(mixed_scene(generator), device, num_envs=2)
    scatter(sim, generator, 1.5, (offset, -offset, offset))
    assert computed_again(stages) == [0, 1]
    cells, n = stages.grid.cells, stages.model.layout.most_bodies
    dynamic = stages.model.bodies.motion.numpy() == int(Motion.DYNAMIC)
    expected = {
        pair
        for pair in overlapping(cells.lower.numpy(), cells.upper.numpy())
        if len({body // n for body in pair}) == 1 and any(dynamic[body] for body in pair)
    }
    found = [frozenset((i, j)) for i, row in enumerate(candidate_lists(stages)) for j in row]
    assert len(found) == len(set(found)) > 1000
    assert set(found) == expected


def test_candidates_are_kept_until_a_body_leaves_its_fat_box(device):
    """Each environment by itself; what is found is what brute force finds, whether kept or computed again."""
    scene, _ = heap(300, ground=False)
    sim, stages = opened(scene, device, num_envs=2)
    sim.set("linear_velocity", (0.3, 0, 0), bodies=[7])
    assert computed_again(stages) == [0, 1]
    margin = float(candidates.FAT_MARGIN) * 0.2
    for shift, again in ((0.9 * margin, []), (1.1 * margin, [1]), (1.2 * margin, [])):
        place = sim.get("position")[1, 40]
        sim.set("position", np.array(scene.bodies[40].position) + (shift, 0, 0), envs=[1], bodies=[40])
        assert not np.array_equal(place, sim.get("position")[1, 40])
        assert computed_again(stages) == again
        assert found_pairs(stages) == brute_force(stages)


def test_steps_ahead_are_within_the_fat_boxes(device):
    """Boxes that fly at 6 m/s, more than the margin in each step: computed again only in every fourth step."""
    scene = wr.Scene(gravity=(0, 0, 0))
    for k in range(300):
        scene.add_body(wr.Box((0.1,) * 3), position=(k, 0, 0), linear_velocity=(0, 12.0, 0))
    sim, stages = opened(scene, device)
    assert 12.0 * stages.dt > float(candidates.FAT_MARGIN) * 0.2
    again = []
    for _ in range(12):
        sim.step()
        again.append(int(stages.grid.cells.stale.numpy()[0]))
    assert 3 <= sum(again) <= 4


@pytest.mark.parametrize("speed", [300.0, 3000.0])
def test_a_fast_body_costs_only_itself(device, speed):
    """A ball that crosses a heap in a step is a candidate of each box, and widens no cell of the others."""
    counts = {}
    for v in (0.0, speed):
        scene, side = heap(400)
        scene.add_body(wr.Sphere(0.1), position=(side, side, side), linear_velocity=(-v, 0, 0))
        _, stages = opened(scene, device)
        assert computed_again(stages) == [0]
        assert found_pairs(stages) == brute_force(stages)
        counts[v] = boxes_tested(stages)
    assert counts[0.0] < 20 * 400
    assert counts[0.0] < counts[speed] <= counts[0.0] + 401


def test_a_body_with_too_many_candidates_finds_all_of_them(device):
    """The ball is the first body, so that the pairs with all boxes are in its list, which would be too long."""
    scene = wr.Scene()
    scene.add_body(wr.Sphere(0.1), position=(1, 1, 1), linear_velocity=(1000, 0, 0))
    for k in range(400):
        scene.add_body(wr.Box((0.1,) * 3), position=(0.25 * (k % 8), 0.25 * (k // 8 % 8), 0.25 * (k // 64)))
    _, stages = opened(scene, device)
    expected = brute_force(stages)
    assert found_pairs(stages) == expected
    lists = candidate_lists(stages)
    assert lists[0] is None and None not in lists[1:]
    assert sum(0 in pair for pair in expected) == 400


def test_statics_cost_only_themselves(device):
    """Ten thousand static boxes below 300 bodies: as many tests as boxes near the bodies, none among the statics."""
    scene = wr.Scene()
    for k in range(10_000):
        scene.add_static(wr.Box((0.1,) * 3), position=(0.2 * (k % 100), 0.2 * (k // 100), -0.1))
    for k in range(300):
        scene.add_body(wr.Box((0.1,) * 3), position=(0.3 * (k % 17), 0.3 * (k // 17), 0.1))
    sim = wr.Simulator(scene, device=device)
    sim.step()
    (shard,) = sim._world.shards
    assert boxes_tested(shard.stages) < 300 * 12
    assert sim.counts()["most_pairs"] >= 300


def test_lists_grow_beyond_their_first_capacity(device):
    """A dense crowd, whose bodies have more candidates than there is room for at first: nothing is lost."""
    generator = np.random.default_rng(3)
    scene = wr.Scene(gravity=(0, 0, 0))
    for _ in range(400):
        scene.add_body(
            wr.Box((0.3, 0.02, 0.02)),
            position=generator.uniform(-0.5, 0.5, 3),
            orientation=random_quaternion(generator),
        )
    sim = wr.Simulator(scene, device=device)
    (shard,) = sim._world.shards
    first = shard.stages.grid.room
    roomy, stages = opened(scene, device)
    for one in (sim, roomy):
        one.step()
    assert shard.stages.grid.room > first
    assert max(len(some) for some in candidate_lists(shard.stages)) > first
    assert pair_list(shard.stages).tolist() == pair_list(stages).tolist()
    assert len(pair_list(stages)) > 10_000
    for name in ("position", "linear_velocity", "angular_velocity"):
        assert sim.get(name).tobytes() == roomy.get(name).tobytes()


def test_a_given_capacity_is_that_of_pairs_and_contacts_alone(device):
    """With a fixed capacity the lists of candidates grow all the same."""
    scene, _ = heap(300, spacing=0.12, ground=False)
    free = wr.Simulator(scene, device=device)
    free.step()
    needed = free.counts()
    room = {"pairs": needed["most_pairs"], "contacts": needed["most_contacts"]}
    with pytest.raises(ValueError, match="^capacity: must be a dictionary"):
        wr.Simulator(scene, device=device, capacity=room["pairs"])
    fixed = wr.Simulator(scene, device=device, capacity=room, on_overflow="raise")
    (shard,) = fixed._world.shards
    first = shard.stages.grid.room
    fixed.step()
    assert shard.stages.grid.room > first
    assert fixed.get("position").tobytes() == free.get("position").tobytes()
