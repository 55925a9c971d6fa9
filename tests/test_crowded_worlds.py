"""A batch of different scenes of which some are crowded: the same bits as batches of their own."""

import numpy as np
import pytest
import warp as wp

import warp_rigid as wr
from warp_rigid.engine import hash_grid, teams
from warp_rigid.kernels.common import team
from warp_rigid.kernels.common.crowd import CROWDED
from warp_rigid.scenes.builders import stacks

QUANTITIES = ("position", "orientation", "linear_velocity", "angular_velocity", "level", "asleep")
STEPS = 100


def stack():
    """A stack of four boxes."""
    scene = wr.Scene()
    scene.add_static(wr.Plane())
    for k in range(4):
        scene.add_body(wr.Box((0.1,) * 3), position=(0, 0, 0.1 + 0.2 * k))
    return scene


def pile(count, radius):
    """Balls that fall in layers, each a little beside those below."""
    scene = wr.Scene()
    scene.add_static(wr.Plane())
    side = 7
    for k in range(count):
        x, y, z = k % side, k // side % side, k // side**2
        place = 2.1 * radius * np.array((x + 0.1 * (z % 2), y + 0.13 * (z % 3), z))
        scene.add_body(wr.Sphere(radius), position=place + (0, 0, 0.5), restitution=0.1 * (k % 5 == 0))
    return scene


@pytest.fixture(scope="module")
def scenes():
    """Scenes of few bodies, of enough for rounds, and of enough for candidates."""
    found = [stack(), pile(150, 0.1), pile(300, 0.07)]
    assert len(found[1].bodies) > CROWDED
    assert len(found[1].bodies) <= hash_grid.TRY_ALL_UP_TO < len(found[2].bodies)
    return found


def after_steps(scene, device, num_envs=1, **arguments):
    sim = wr.Simulator(scene, num_envs=num_envs, device=device, **arguments)
    solved = {"islands_rounds": 0, "pairs": 0, "contacts": 0}
    for _ in range(STEPS // 4):
        sim.step(4)
        solved = {name: value + sim.stats()[name] for name, value in solved.items()}
    return sim, solved


def test_crowded_environments_do_not_change_the_others_or_themselves(device, scenes):
    batch, solved = after_steps(scenes, device, num_envs=2)
    for place, scene in enumerate(scenes):
        alone, own = after_steps(scene, device)
        for env in (place, place + len(scenes)):
            for name in QUANTITIES:
                found = batch.get(name)[env, : alone.num_bodies]
                assert np.array_equal(found, alone.get(name)[0]), (name, env)
            for name, total in own.items():
                assert solved[name][env] == total[0], (name, env)
    assert (solved["islands_rounds"][1:3] > 0).all() and solved["islands_rounds"][0] == 0


def test_a_batch_keeps_candidates_of_its_large_environments_only(device, scenes):
    sim = wr.Simulator(scenes, device=device)
    for shard in sim._world.shards:
        cells, layout = shard.stages.grid.cells, shard.layout
        large = layout.bodies_per_env > hash_grid.TRY_ALL_UP_TO
        assert ((np.diff(cells.first_bucket.numpy()) > 0) == large).all()
        assert (cells.first_bucket.numpy()[-1] == shard.stages.grid.buckets) and (shard.stages.grid.buckets > 0) == any(
            large
        )
    sim.step()
    for shard in sim._world.shards:
        listed, env = shard.stages.grid.cells.listed.numpy(), shard.layout.env_of_row
        small = (shard.layout.bodies_per_env <= hash_grid.TRY_ALL_UP_TO)[env]
        assert (listed[small] == -1).all() and (listed[~small] >= 0).all()


def test_a_checkpoint_of_a_crowded_batch_continues_with_the_same_bits(device, scenes, tmp_path):
    whole = wr.Simulator(scenes, device=device)
    whole.step(40)
    whole.save(tmp_path / "crowded.npz")
    resumed = wr.Simulator.load(tmp_path / "crowded.npz", device=device)
    whole.step(12)
    resumed.step(12)
    for name in QUANTITIES:
        assert np.array_equal(whole.get(name), resumed.get(name), equal_nan=whole.get(name).dtype.kind == "f"), name


def struck_pyramid():
    """A pyramid of 33 rows, 561 cubes, and a ball that strikes its side."""
    scene = wr.Scene()
    scene.add_static(wr.Plane())
    for place in stacks.pyramid(33, 0.1):
        scene.add_body(wr.Box((0.1,) * 3), position=place)
    scene.add_body(wr.Sphere(0.3), position=(0.3, -0.45, 1.0), linear_velocity=(0, 6, 0))
    return scene


def test_a_cluster_of_blocks_computes_the_same_bits_as_a_block(device, monkeypatch):
    found = wp.get_device(device)
    if teams.team_lanes(found, 1, 1000, has_joints=False) != team.CLUSTER:
        pytest.skip("this device has no clusters of blocks")
    clustered, _ = after_steps(struck_pyramid(), device)
    monkeypatch.setattr(teams, "MOST_BODIES_OF_A_BLOCK", 1000)
    alone, _ = after_steps(struck_pyramid(), device)
    for name in QUANTITIES:
        assert np.array_equal(clustered.get(name), alone.get(name)), name
