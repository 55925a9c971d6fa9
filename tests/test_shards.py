"""Environments spread over the cores of a CPU: not a bit depends on how many there are, and nothing is lost.

A machine may have one core: how many the simulator believes to have is set here. One core is the oracle, since then
all environments are one shard, and no thread is started.
"""

import logging
import os
import threading
import time

import numpy as np
import pytest

from tests.oracles import ground_scene, rotate_about
from warp_rigid.engine import batch, cores, shard
from warp_rigid.engine.memory import MemoryLimit
from warp_rigid.engine.simulator import Simulator
from warp_rigid.engine.step_reports import counts_of_environments
from warp_rigid.errors import CapacityError, NonFiniteError
from warp_rigid.scene.shapes import Box, Heightfield, Sphere
from warp_rigid.scene.shapes.heightfield import HarmonicMotion

ENVS = 5
ROOM = ("pair_capacity", "contact_capacity", "repeated_steps")
STATE = ("position", "orientation", "linear_velocity", "angular_velocity", "force", "torque")


@pytest.fixture
def on_cores(monkeypatch):
    """A function that makes simulators of as many shards as it is told of cores, if there are enough environments."""
    monkeypatch.setattr(batch, "LEAST_BODIES", 1)
    monkeypatch.setattr(batch, "SHARDS_A_CORE", 1)

    def make(count, scene, num_envs=ENVS, **arguments):
        monkeypatch.setattr(batch, "usable_cores", lambda: count)
        sim = Simulator(scene, num_envs=num_envs, device="cpu", **arguments)
        assert len(list(sim._world.shards)) == min(count, num_envs)
        return sim

    return make


def lively_scene():
    """Two grounds that move, each in its own way, a turning table, and bodies that fall, slide and come to rest."""
    scene = ground_scene(friction=0.6)
    for k, rate in enumerate((3.0, 5.0)):
        heights = 0.1 + 0.05 * np.random.default_rng(k).random((4 + k, 5))
        field = Heightfield(heights, (2.0, 2.0), HarmonicMotion(0.03, rate, np.arange(20 + 5 * k).reshape(4 + k, 5)))
        scene.add_kinematic(field, position=(5.0 + 3 * k, 0, 0), friction=0.5)
        scene.add_body(Box((0.2, 0.1, 0.1)), position=(5.0 + 3 * k, 0.1, 0.4), orientation=rotate_about((1, 2, 0), 20))
    scene.add_kinematic(Box((0.5, 0.5, 0.1)), position=(-3, 0, 0.1), angular_velocity=(0, 0, 1))
    for k in range(4):
        scene.add_body(Box((0.1, 0.1, 0.1)), position=(0.03 * k, 0, 0.11 + 0.21 * k), friction=0.5)
    scene.add_body(Sphere(0.1), position=(-3, 0.2, 0.35))
    scene.add_body(Sphere(0.1), position=(2, 0, 0.3), restitution=0.5)
    scene.filter_pair(5, 6)
    return scene


def look(sim):
    """All that a user can see, but for the room that there is."""
    searched = [sim.get(name).tobytes() for name in (*STATE, "level", "asleep", "center_of_mass", "kinetic_energy")]
    searched += [sim.contacts().tobytes(), sim.status().tobytes()]
    searched.append({name: count for name, count in sim.counts().items() if name not in ROOM})
    swept = sim.swept_boxes().tobytes()
    return [*searched, sim.penetration().tobytes(), sim.time, swept]


def eventful_run(sim, folder):
    """Everything that can be done to a simulator, and what is seen meanwhile; it is saved in between."""
    sim.set("friction", np.linspace(0.1, 0.9, ENVS)[:, None])
    sim.set("shock_propagation", ["off", "one_pass", "two_pass", "two_pass", "off"])
    sim.set("contact_iterations", [3, 10, 10, 5, 20])
    searched = [look(sim)]
    sim.step(50)
    searched.append(look(sim))
    sim.apply_impulse((20.0, 0, 0), (0, 0, 0.5), body=6, envs=[1, 3])
    sim.set("sleeping", True, envs=[0, 2, 4])
    sim.set("mass", 50.0, envs=[4], bodies=[6])
    sim.set("shock_iterations", [1, 1, 1, 2, 1])
    sim.step(37)
    searched.append(look(sim))
    sim.reset(envs=[0, 3])
    sim.step(3)
    searched.append(look(sim))
    sim.step(300)
    assert sim.get("asleep")[2].any() and not sim.get("asleep")[1].any()
    sim.save(folder / "asleep.ckpt")
    searched.append(look(sim))
    sim.set("force", (0, 0, 30.0), envs=[2], bodies=[7])
    sim.set("active", False, envs=[4], bodies=[6])
    sim.array("linear_velocity").assign(broken(sim, env=3, body=8))
    sim.step(33)
    assert sim.status()["status"].tolist() == ["ok", "ok", "ok", "non-finite", "ok"]
    searched.append(look(sim))
    sim.save(folder / "end.ckpt")
    sim.reset()
    sim.step(20)
    return [*searched, look(sim)]


def broken(sim, env, body):
    """Velocities of all bodies, one of them not a number."""
    velocity = sim.array("linear_velocity").numpy().copy()
    velocity[env * sim.num_bodies + body] = np.nan
    return velocity


@pytest.mark.long
def test_cores_change_no_bit(on_cores, tmp_path):
    """Of states, contacts, counts and checkpoints; a checkpoint of one machine goes on alike on any other."""
    runs = {}
    for count in (1, 2, 3):
        folder = tmp_path / str(count)
        folder.mkdir()
        runs[count] = eventful_run(on_cores(count, lively_scene()), folder)
    assert runs[2] == runs[1] and runs[3] == runs[1]
    for name in ("asleep.ckpt", "end.ckpt"):
        assert len({(tmp_path / str(count) / name).read_bytes() for count in runs}) == 1, name
    goes_on = []
    for count in (1, 3):
        on_cores(count, lively_scene())
        sim = Simulator.load(tmp_path / "2" / "asleep.ckpt")
        assert len(list(sim._world.shards)) == count
        first = look(sim)
        sim.step(40)
        goes_on.append((first, look(sim)))
    assert goes_on[0] == goes_on[1]
    assert goes_on[0][0][:-1] == runs[1][4][:-1], "boxes are those of the next step, all else is as it was saved"


@pytest.mark.long
def test_cores_change_no_bit_of_what_is_found_through_the_hash_grid(on_cores):
    scene = ground_scene()
    for k in range(300):
        x, y, z = k % 7, k // 7 % 7, k // 49
        scene.add_body(Sphere(0.1), position=(0.19 * x, 0.19 * y, 0.1 + 0.19 * z))
    one, two = (on_cores(count, scene, num_envs=2) for count in (1, 2))
    for sim in (one, two):
        sim.set("gravity", (0, 1, -9), envs=[1])
        sim.step(6)
    assert len(one.contacts()) > 1000
    assert look(two) == look(one)


def crowding(sim):
    """Bodies of environment 3 are moved into one heap."""
    sim.set(
        "position", np.random.default_rng(0).uniform(-0.1, 0.1, (12, 3)) + [0, 0, 0.2], envs=[3], bodies=range(1, 13)
    )


def boxes_apart():
    scene = ground_scene()
    for k in range(12):
        scene.add_body(Box((0.1, 0.1, 0.1)), position=(0.5 * k, 0, 0.1))
    return scene


def test_the_room_of_one_shard_grows(on_cores, caplog):
    """Only there, told once, and to the same bits."""
    runs = []
    for count in (1, 3):
        caplog.clear()
        sim = on_cores(count, boxes_apart(), capacity={"pairs": 70, "contacts": 300})
        sim.step(20)
        before = [some.pools.sizes["pairs"] for some in sim._world.shards]
        with caplog.at_level(logging.INFO, logger="warp_rigid"):
            crowding(sim)
            sim.step(40)
        assert caplog.text.count("capacity grows") == 1
        grew = [some.pools.sizes["pairs"] > size for some, size in zip(sim._world.shards, before, strict=True)]
        assert grew == {1: [True], 3: [False, False, True]}[count]
        runs.append(look(sim))
    assert runs[0] == runs[1]


def fall_on_each_other(sim):
    """Boxes of environment 3, one above the other, the upper ones faster."""
    column = [(0.11 * (k % 3), 0.1 * (k % 2), 0.15 + 0.23 * k) for k in range(12)]
    sim.set("position", column, envs=[3], bodies=range(1, 13))
    sim.set("linear_velocity", [(0, 0, -0.5 * k) for k in range(12)], envs=[3], bodies=range(1, 13))


@pytest.mark.parametrize(
    ("place", "room"),
    [
        (fall_on_each_other, {"pairs": 70, "contacts": 2000}),
        (fall_on_each_other, {"pairs": 400, "contacts": 222}),
        # Pairs do not fit into a shard's part, and contacts of the other shards exceed the room in the same step.
        (crowding, {"pairs": 140, "contacts": 140}),
    ],
)
def test_room_that_may_not_grow_is_that_of_all_shards_together(on_cores, place, room):
    """Whoever has most of it: the same steps fit, the same error names the same environment, and all stop there."""
    free = on_cores(1, boxes_apart())
    place(free)
    while all(free.counts()[name] <= most for name, most in room.items()):
        before = look(free)[:-1]
        free.step()
    (name,) = (name for name, most in room.items() if free.counts()[name] > most)
    for count in (1, 2, 3):
        sim = on_cores(count, boxes_apart(), on_overflow="raise", capacity=room)
        place(sim)
        with pytest.raises(CapacityError) as error:
            sim.step(100)
        told = error.value
        assert (told.pool, told.wanted, told.had) == (name, free.counts()[name], room[name])
        most = counts_of_environments(free._world)[list(room).index(name)].argmax()
        assert (told.env, told.step) == (most, round(free.time * 240) - 1)
        assert look(sim)[:-1] == before
        with pytest.raises(CapacityError) as again:
            sim.step(1)
        assert str(again.value) == str(error.value)
        assert [sim.counts()[f"{name}_capacity"] for name in ("pair", "contact")] == list(room.values())


def test_memory_refused_to_one_shard_stops_all_at_the_same_step(on_cores):
    sim = on_cores(3, boxes_apart(), capacity={"pairs": 70, "contacts": 300})
    sim.step(20)
    crowding(sim)
    before = [sim.get(name).tobytes() for name in STATE], sim.time
    sim._world.shards._limit = MemoryLimit(sim.device, sim.memory + 1000)
    with pytest.raises(CapacityError, match=r"^memory_limit: larger capacity \(pairs 70 -> "):
        sim.step(40)
    assert ([sim.get(name).tobytes() for name in STATE], sim.time) == before


def test_an_error_in_one_environment_names_it(on_cores):
    sim = on_cores(3, boxes_apart(), on_nonfinite="raise")
    sim.step(5)
    sim.array("linear_velocity").assign(broken(sim, env=4, body=2))
    with pytest.raises(NonFiniteError) as error:
        sim.step(30)
    assert (error.value.env, error.value.step, error.value.body) == (4, 5, 2)


@pytest.mark.parametrize("count", [1, 3])
def test_an_interrupt_leaves_all_environments_at_the_same_step(on_cores, monkeypatch, count):
    """Even amid a step of one shard while others are done: the run goes on as if nothing had been."""
    sim, other = on_cores(count, boxes_apart()), on_cores(1, boxes_apart())
    for one in (sim, other):
        one.set("gravity", (0, 5, -9))
        one.step(16)
    before = look(sim)
    replay, calls = shard.Stages.replay, []

    def interrupted(stages):
        calls.append(stages)
        if calls.count(stages) == 5 and stages is list(sim._world.shards)[-1].stages:
            raise KeyboardInterrupt
        replay(stages)

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(shard.Stages, "replay", interrupted)
        sim.step(16)
    assert len(calls) > 4
    assert look(sim)[:-1] == before[:-1]
    for one in (sim, other):
        one.step(30)
    assert look(sim) == look(other)


def test_shards_are_stepped_at_the_same_time(on_cores, monkeypatch):
    """Two threads wait for each other within a step; one shard starts no thread."""
    sim, replay, meeting = on_cores(2, boxes_apart()), shard.Stages.replay, threading.Barrier(2)

    def met(stages):
        meeting.wait(timeout=60)
        replay(stages)

    monkeypatch.setattr(shard.Stages, "replay", met)
    sim.step(3)
    monkeypatch.setattr(shard.Stages, "replay", replay)
    monkeypatch.setattr(cores, "_threads", lambda: pytest.fail("a thread was started"))
    on_cores(1, boxes_apart()).step(3)
    on_cores(4, boxes_apart(), num_envs=1).step(3)


@pytest.mark.long
def test_other_threads_run_while_a_step_does(on_cores):
    """Python's lock is not held during a step: without that, threads would be of no use."""
    sim = on_cores(1, boxes_apart(), num_envs=2500)
    sim.step(1)
    naps, done = 0, threading.Event()
    stepping = threading.Thread(target=lambda: (next(iter(sim._world.shards)).stages.replay(), done.set()))
    begin = time.perf_counter()
    stepping.start()
    while not done.is_set():
        time.sleep(0.001)
        naps += 1
    stepping.join()
    assert time.perf_counter() - begin > 0.02, "the step is too short to tell"
    assert naps > 3


def test_a_forked_process_starts_its_own_threads():
    assert cores.spread(lambda n: n, range(4), 4) == list(range(4))
    child = os.fork()
    if child == 0:
        os._exit(0 if cores.spread(lambda n: n, range(4), 4) == list(range(4)) else 1)
    deadline = time.monotonic() + 30
    ended = (0, 0)
    while ended[0] == 0 and time.monotonic() < deadline:
        ended = os.waitpid(child, os.WNOHANG)
        time.sleep(0.01)
    if ended[0] == 0:
        os.kill(child, 9)
    assert ended == (child, 0)


def test_cores_are_those_of_the_process_and_its_container(monkeypatch, tmp_path):
    monkeypatch.setattr(cores, "QUOTA", tmp_path / "cpu.max")
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(8)), raising=False)
    assert cores.usable_cores() == 8
    for text, count in (("max 100000", 8), ("250000 100000", 3), ("1000 100000", 1), ("nonsense", 8), ("9 0", 8)):
        cores.QUOTA.write_text(text)
        assert cores.usable_cores() == count, text
    with cores.shared_by(3):
        assert cores.usable_cores() == 2
    assert cores.usable_cores() == 8
