"""Sixth stage: touching pairs by level and colour, so that a group's pairs can be solved at the same time."""

import numpy as np
import pytest
import warp as wp

from tests.oracles import find_contacts, opened, random_pile
from tests.test_levels import A_ON_B, B_ON_A, HandMadeGraph, random_pairs
from warp_rigid.kernels import ordering
from warp_rigid.kernels.ordering import MOST_COLORS
from warp_rigid.scene import Motion


def order(made):
    """Groups of each environment, as (level, pairs) by the arrays, after both ordering kernels."""
    scratch = wp.zeros(made.graph.order.shape[0], dtype=int, device=made.device)
    made.launch(ordering.sort_by_level, made.bodies, made.pairs, made.graph)
    made.launch(ordering.group_by_color, made.bodies, made.pairs, made.graph, scratch)
    return read_groups(made.graph, made.count, made.per_env)


def read_groups(graph, num_envs, bodies_per_env):
    """For each environment its list of (level, list of pairs), in the order of solving."""
    level_start, group_start = graph.level_start.numpy(), graph.group_start.numpy()
    sequence, levels = graph.order.numpy(), graph.level_count.numpy()
    envs = []
    for env in range(num_envs):
        row = env * (bodies_per_env + 2)
        groups = []
        for level in range(levels[env] + 1):
            for group in range(level_start[row + level], level_start[row + level + 1]):
                groups.append((level, sequence[group_start[group] : group_start[group + 1]].tolist()))
        envs.append(groups)
    return envs


def check_groups(groups, touching, body_a, body_b, level, dynamic):
    """The demands on an order: complete, from the ground up, and free of conflicts within a group."""
    listed = [pair for _, pairs in groups for pair in pairs]
    assert sorted(listed) == sorted(touching)
    assert [at for at, _ in groups] == sorted(at for at, _ in groups)
    for at, pairs in groups:
        assert pairs
        for pair in pairs:
            assert max(level[body_a[pair]], level[body_b[pair]]) == at
        busy = [body for pair in pairs for body in (body_a[pair], body_b[pair]) if dynamic[body]]
        assert len(busy) == len(set(busy))


def check_all(made, envs):
    """`check_groups` for every environment; returns the largest number of groups in a level."""
    start = made.pairs.start.numpy()
    body_a, body_b = made.pairs.body_a.numpy(), made.pairs.body_b.numpy()
    touch = np.diff(made.pairs.contact_start.numpy()) > 0
    dynamic = made.bodies.motion.numpy() == int(Motion.DYNAMIC)
    level = made.graph.level.numpy()
    most = 0
    for env, groups in enumerate(envs):
        rows = np.arange(start[env * made.per_env], start[(env + 1) * made.per_env])
        check_groups(groups, rows[touch[rows]].tolist(), body_a, body_b, level, dynamic)
        counts = np.bincount([at for at, _ in groups], minlength=1)
        most = max(most, int(counts.max()))
    return most


@pytest.mark.parametrize("density", [0.0, 0.03, 0.1, 0.4])
def test_groups_of_random_graphs(device, density):
    generator = np.random.default_rng(int(100 * density))
    motions = [Motion.STATIC, *[Motion.DYNAMIC] * 30, Motion.KINEMATIC, *[Motion.DYNAMIC] * 20]
    envs = [random_pairs(generator, motions, density, upward=env % 2 == 0) for env in range(6)]
    envs[3] = [(0, 1, B_ON_A, 1)]
    made = HandMadeGraph(motions, envs, device)
    made.solve()
    check_all(made, order(made))


def test_greedy_colouring_is_not_wasteful(device):
    """A row of bodies on the ground: neighbours alternate, so all their pairs take two colours and the ground's one."""
    count = 40
    motions = [Motion.STATIC, *[Motion.DYNAMIC] * count]
    row = [(0, k, B_ON_A, 1) for k in range(1, count + 1)] + [(k, k + 1, 0, 1) for k in range(1, count)]
    made = HandMadeGraph(motions, [row], device)
    made.solve()
    groups = order(made)
    assert check_all(made, groups) <= 3
    assert {at for at, _ in groups[0]} == {1}


@pytest.mark.parametrize("neighbours", [MOST_COLORS - 1, MOST_COLORS, MOST_COLORS + 1, MOST_COLORS + 2, 75])
def test_more_colours_than_the_mask_holds(device, neighbours):
    """One body touches more others of its level than there are colours: every pair gets a group of its own."""
    motions = [Motion.STATIC, *[Motion.DYNAMIC] * (neighbours + 1)]
    star = [(1, k, 0, 1) for k in range(2, neighbours + 2)]
    chain = [(k, k + 1, 0, 1) for k in range(2, neighbours + 1)]
    made = HandMadeGraph(motions, [star, star + chain, chain], device)
    made.solve()
    groups = order(made)
    check_all(made, groups)
    assert len(groups[0]) == neighbours
    assert len(groups[2]) == 2


def test_a_load_of_pairs_inside_one_cycle(device):
    """Bodies that all rest on each other share a level and are still kept apart in a group."""
    motions = [Motion.STATIC, *[Motion.DYNAMIC] * 12]
    knot = [(a, b, A_ON_B | B_ON_A, 1) for a in range(1, 13) for b in range(a + 1, 13)] + [(0, 5, B_ON_A, 1)]
    made = HandMadeGraph(motions, [knot], device)
    level, _ = made.solve()
    assert set(level[0][1:].tolist()) == {1}
    check_all(made, order(made))


def test_groups_of_a_real_pile(device):
    """The same demands on what a step itself leaves behind, in a batch."""
    scene = random_pile(np.random.default_rng(2))
    sim, stages = opened(scene, device, num_envs=2)
    sim.set("linear_velocity", (0.5, 0.1, 0.0), envs=[1])
    sim.step(150)
    find_contacts(stages)
    stages.build_graph()
    pools = stages.pools
    envs = read_groups(pools.graph, 2, sim.num_bodies)
    start = pools.pairs.start.numpy()
    touch = np.diff(pools.pairs.contact_start.numpy()) > 0
    body_a, body_b = pools.pairs.body_a.numpy(), pools.pairs.body_b.numpy()
    dynamic = stages.model.bodies.motion.numpy() == int(Motion.DYNAMIC)
    for env in range(2):
        rows = np.arange(start[env * sim.num_bodies], start[(env + 1) * sim.num_bodies])
        touching = rows[touch[rows]].tolist()
        assert len(touching) > 20
        check_groups(envs[env], touching, body_a, body_b, pools.graph.level.numpy(), dynamic)
