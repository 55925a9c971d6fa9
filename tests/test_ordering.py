"""Sixth stage: touching pairs by colour, so that a colour's pairs can be solved at the same time."""

import numpy as np
import pytest

from tests.oracles import find_contacts, opened, random_pile
from tests.test_levels import A_ON_B, B_ON_A, HandMadeGraph, random_pairs
from warp_rigid.kernels.graph import coloring
from warp_rigid.kernels.graph.coloring import Color
from warp_rigid.scene.scene import Motion


def ordered(made):
    """Groups of each environment, as (colour, pairs) by the arrays, after the ordering kernel."""
    made.launch(coloring.order_constraints, made.bodies, made.constraints, made.graph, made.order)
    return read_groups(made.order, made.constraints)


def slots_by_row(constraints):
    """The active constraint that begins with a row."""
    end = int(constraints.start.numpy()[-1])
    active = np.flatnonzero(constraints.row_count.numpy()[:end])
    return dict(zip(constraints.first_row.numpy()[active].tolist(), active.tolist(), strict=True))


def read_groups(order, constraints):
    """For each environment its list of (colour, list of constraints), in the order of solving."""
    start, count = order.color_start.numpy(), order.color_count.numpy()
    slots = slots_by_row(constraints)
    sequence = np.array([slots.get(row, -1) for row in order.entries.numpy()["begin"].tolist()])
    envs = []
    for env, colors in enumerate(count):
        assert start[env, colors] == start[env, -1]
        ranges = [(color, *start[env, color : color + 2]) for color in range(colors)]
        envs.append([(color, sequence[begin:end].tolist()) for color, begin, end in ranges if end > begin])
    return envs


def check_groups(groups, touching, body_a, body_b, dynamic):
    """The demands on an order: complete, and free of conflicts within a colour.

    Pairs that are solved in turn may share bodies, but their order is fixed.
    """
    listed = [pair for _, pairs in groups for pair in pairs]
    assert sorted(listed) == sorted(touching)
    for color, pairs in groups:
        if color == Color.SERIAL:
            assert pairs == sorted(pairs)
            continue
        busy = [body for pair in pairs for body in (body_a[pair], body_b[pair]) if dynamic[body]]
        assert len(busy) == len(set(busy))


def check_entries(order, constraints, level):
    """A body of a pair is upper unless the other is in a higher level."""
    entries, start = order.entries.numpy(), order.color_start.numpy()
    body_a, body_b, slots = constraints.body_a.numpy(), constraints.body_b.numpy(), slots_by_row(constraints)
    for begin, end in zip(start[:, 0], start[:, -1], strict=True):
        for entry in entries[begin:end]:
            slot = slots[entry["begin"]]
            assert (entry["body_a"], entry["body_b"]) == (body_a[slot], body_b[slot])
            a, b = level[body_a[slot]], level[body_b[slot]]
            assert (entry["upper_a"], entry["upper_b"]) == (a >= b, b >= a)


def check_all(made, envs):
    """`check_groups` for every environment, and the levels; returns the largest number of colours."""
    start = made.constraints.start.numpy()
    body_a, body_b = made.constraints.body_a.numpy(), made.constraints.body_b.numpy()
    touch = made.constraints.row_count.numpy() > 0
    dynamic = made.bodies.motion.numpy() == int(Motion.DYNAMIC)
    level, highest = made.graph.level.numpy(), made.graph.level_count.numpy()
    for env, groups in enumerate(envs):
        rows = np.arange(start[env], start[env + 1])
        touching = rows[touch[rows]]
        check_groups(groups, touching.tolist(), body_a, body_b, dynamic)
        assert highest[env] == max([0, *level[body_a[touching]], *level[body_b[touching]]])
    return max(len(groups) for groups in envs)


@pytest.mark.parametrize("density", [0.0, 0.03, 0.1, 0.4])
def test_groups_of_random_graphs(device, density):
    generator = np.random.default_rng(int(100 * density))
    motions = [Motion.STATIC, *[Motion.DYNAMIC] * 30, Motion.KINEMATIC, *[Motion.DYNAMIC] * 20]
    envs = [random_pairs(generator, motions, density, upward=env % 2 == 0) for env in range(6)]
    envs[3] = [(0, 1, B_ON_A, 1)]
    made = HandMadeGraph(motions, envs, device)
    made.solve()
    check_all(made, ordered(made))


def test_colouring_is_not_wasteful(device):
    """A row of bodies on the ground: a pair meets at most four others, so five colours do in any case."""
    count = 40
    motions = [Motion.STATIC, *[Motion.DYNAMIC] * count]
    row = [(0, k, B_ON_A, 1) for k in range(1, count + 1)] + [(k, k + 1, 0, 1) for k in range(1, count)]
    made = HandMadeGraph(motions, [row], device)
    made.solve()
    assert check_all(made, ordered(made)) <= 4


@pytest.mark.parametrize("neighbours", [Color.SERIAL - 1, Color.SERIAL, Color.SERIAL + 1, 75])
def test_more_pairs_at_a_body_than_colours(device, neighbours):
    """One body touches more others than there are colours: what finds none is solved in turn."""
    motions = [Motion.STATIC, *[Motion.DYNAMIC] * (neighbours + 1)]
    star = [(1, k, 0, 1) for k in range(2, neighbours + 2)]
    chain = [(k, k + 1, 0, 1) for k in range(2, neighbours + 1)]
    made = HandMadeGraph(motions, [star, star + chain, chain], device)
    made.solve()
    groups = ordered(made)
    check_all(made, groups)
    assert len(groups[0]) == min(neighbours, Color.SERIAL + 1)
    assert sum(len(pairs) for color, pairs in groups[0] if color == Color.SERIAL) == max(0, neighbours - Color.SERIAL)
    assert len(groups[2]) <= 3


def test_a_load_of_pairs_inside_one_cycle(device):
    """Bodies that all rest on each other share a level and are still kept apart in a group."""
    motions = [Motion.STATIC, *[Motion.DYNAMIC] * 12]
    knot = [(a, b, A_ON_B | B_ON_A, 1) for a in range(1, 13) for b in range(a + 1, 13)] + [(0, 5, B_ON_A, 1)]
    made = HandMadeGraph(motions, [knot], device)
    level, _ = made.solve()
    assert set(level[0][1:].tolist()) == {1}
    check_all(made, ordered(made))


def test_groups_of_a_real_pile(device):
    """The same demands on what a step itself leaves behind, in a batch."""
    scene = random_pile(np.random.default_rng(2))
    sim, stages = opened(scene, device, num_envs=2)
    sim.set("linear_velocity", (0.5, 0.1, 0.0), envs=[1])
    sim.step(150)
    find_contacts(stages)
    stages.build_graph()
    pools = stages.pools
    envs = read_groups(pools.order, pools.constraints)
    check_entries(pools.order, pools.constraints, pools.graph.level.numpy())
    start = pools.pairs.start.numpy()
    touch = np.diff(pools.pairs.contact_start.numpy()) > 0
    body_a, body_b = pools.pairs.body_a.numpy(), pools.pairs.body_b.numpy()
    dynamic = stages.model.bodies.motion.numpy() == int(Motion.DYNAMIC)
    for env in range(2):
        rows = np.arange(start[env * sim.num_bodies], start[(env + 1) * sim.num_bodies])
        touching = rows[touch[rows]].tolist()
        assert len(touching) > 20
        check_groups(envs[env], touching, body_a, body_b, dynamic)
