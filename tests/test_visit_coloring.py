"""Colours of the pairs of mechanisms."""

from collections import Counter

import numpy as np
import pytest

import warp_rigid as wr
from warp_rigid import scenes

SOLVED = {1, 2, 3}
"""Values of `Joints.loaded` of mechanisms whose contacts are solved where the joints hold."""


def heap(device, dolls, steps=420):
    """Stages of a simulator in which ragdolls have landed on each other."""
    sim = wr.Simulator(scenes.load("ragdolls", dolls=dolls), device=device)
    sim.step(steps)
    (shard,) = sim._world.shards
    return sim, shard.stages


def turns_of(stages):
    """The entries of the solving order of each colour."""
    order, visits = stages.pools.order, stages.pools.visits
    begin, ends = int(order.color_start.numpy()[0, 0]), visits.end.numpy()
    colors = int(visits.count.numpy()[0])
    bounds = [begin, *ends[begin : begin + colors]]
    return [visits.entries.numpy()[low:high] for low, high in zip(bounds, bounds[1:], strict=False)]


def occupied_by(stages):
    """For each entry of the solving order, what its pair occupies, by the arrays of the mechanisms on the host."""
    order, joints = stages.pools.order, stages.joints.arrays
    end = int(order.color_start.numpy()[0, int(order.color_count.numpy()[0])])
    mechanism, solved = joints.of_body.numpy(), joints.loaded.numpy()
    moves = stages.motions.solver_bodies.numpy()["inverse_mass"] > 0
    found = []
    for entry in order.entries.numpy()[:end]:
        ends = {int(entry["body_a"]), int(entry["body_b"])}
        own = {b: mechanism[b] for b in ends if mechanism[b] >= 0 and solved[mechanism[b]] in SOLVED}
        free = {("body", b) for b in ends if b not in own and moves[b]}
        found.append(({("mechanism", m) for m in own.values()} | free) if own else set())
    return found


@pytest.fixture(scope="module")
def landed():
    """Simulators with twelve ragdolls in a heap, by device."""
    return {}


def stages_of(landed, device):
    if device not in landed:
        landed[device] = heap(device, 12)
    return landed[device][1]


@pytest.mark.long
def test_every_pair_of_a_solved_mechanism_has_one_turn(landed, device):
    stages = stages_of(landed, device)
    wanted = [k for k, touched in enumerate(occupied_by(stages)) if touched]
    assert len(wanted) > 20
    assert sorted(np.concatenate(turns_of(stages)).tolist()) == wanted


def test_the_pairs_of_a_turn_share_nothing(landed, device):
    stages = stages_of(landed, device)
    occupied = occupied_by(stages)
    for entries in turns_of(stages):
        touched = Counter(thing for k in entries for thing in occupied[k])
        assert max(touched.values()) == 1


def test_there_are_hardly_more_turns_than_the_busiest_mechanism_has_pairs(landed, device):
    """A colouring that takes the first free colour needs at most the sum of the pairs at both bodies, less one."""
    stages = stages_of(landed, device)
    pairs = Counter(thing for touched in occupied_by(stages) for thing in touched)
    assert max(pairs.values()) <= len(turns_of(stages)) <= 1.25 * max(pairs.values())


def test_more_pairs_than_marked_turns_follow_one_another(device):
    """A plate that is a mechanism carries 400 balls: each has a colour of its own, and they rest on it."""
    scene = wr.Scene(gravity=(0, 0, -9.81))
    scene.add_static(wr.Plane(), friction=0.5)
    plate = scene.add_body(wr.Box((2.1, 2.1, 0.1)), position=(0, 0, 0.1), mass=100.0, friction=0.5)
    knob = scene.add_body(wr.Box((0.05, 0.05, 0.05)), position=(0, 0, 0.25), mass=1.0)
    scene.add_joint(wr.FixedJoint(), knob, plate, anchor=(0, 0, 0.2))
    places = [(0.2 * x - 1.9, 0.2 * y - 1.9, 0.25) for x in range(20) for y in range(20)]
    for place in places:
        scene.add_body(wr.Sphere(0.05), position=place, mass=0.1, friction=0.5, rolling_friction=0.01)
    sim = wr.Simulator(scene, device=device)
    sim.step(60)
    (shard,) = sim._world.shards
    assert len(turns_of(shard.stages)) >= 400
    assert sim.penetration()[0] < 2e-4
    assert np.abs(sim.get("linear_velocity")[0]).max() < 1e-4


@pytest.mark.long
def test_a_heap_of_mechanisms_ends_with_the_same_bits_alone_and_in_a_batch(device):
    """The colors, and the line searches, depend neither on the order of threads nor on the place in a batch."""
    scene = scenes.load("ragdolls", dolls=6)
    ends = []
    for count in (1, 1, 3):
        sim = wr.Simulator(scene, num_envs=count, device=device)
        sim.step(300)
        assert sim.contacts().size > 0
        ends += [
            b"".join(sim.get(name)[env].tobytes() for name in ("position", "linear_velocity", "joint_force"))
            for env in range(count)
        ]
    assert len(set(ends)) == 1
