"""Nothing dropped, nothing lost: room that grows or raises, limits on memory, and non-finite states kept apart."""

import logging

import numpy as np
import pytest
import warp as wp

import warp_rigid as wr
from tests.oracles import ground_scene, random_pile, rotate_about, stages_of
from warp_rigid.engine import memory
from warp_rigid.engine.simulator import Simulator
from warp_rigid.engine.step import PAIRS
from warp_rigid.errors import CapacityError, NonFiniteError
from warp_rigid.kernels import declare
from warp_rigid.scene.shapes import Box, Sphere

STATE = ("position", "orientation", "linear_velocity", "angular_velocity")


def bits(sim, env=slice(None)):
    return [sim.get(name)[env].tobytes() for name in STATE]


def heap(count):
    """Boxes in layers, each turned a little, that fall onto the ground and each other."""
    scene = ground_scene(friction=0.5)
    side = int(np.ceil(count ** (1 / 3)))
    for k in range(count):
        x, y, z = k % side, k // side % side, k // side**2
        turn = rotate_about((1, 2, 3), 7 * k)
        scene.add_body(Box((0.1,) * 3), position=(0.25 * x, 0.25 * y, 0.2 + 0.25 * z), orientation=turn)
    return scene


@pytest.mark.long
def test_a_thousand_boxes_in_pools_for_ten_end_as_with_room_for_all(device, caplog):
    scene = heap(1000)
    roomy = Simulator(scene, device=device, capacity={"pairs": 40_000, "contacts": 200_000})
    roomy.step(24)
    with caplog.at_level(logging.INFO, logger="warp_rigid"):
        tight = Simulator(scene, device=device, capacity={"pairs": 60, "contacts": 360})
        tight.step(24)
    assert roomy.counts()["most_pairs"] > 1000
    assert bits(tight) == bits(roomy)
    assert tight.contacts().tobytes() == roomy.contacts().tobytes()
    assert roomy.counts()["pair_capacity"] == 40_000 < 10 * tight.counts()["pair_capacity"]
    assert caplog.text.count("capacity grows") == 1, "growth is reported once"


def test_overflow_raises_where_asked_and_loses_nothing(device):
    """The error names what did not fit, where and when; the state is that of the last step that fitted."""
    scene = heap(27)
    free = Simulator(scene, num_envs=3, device=device)
    sim = Simulator(scene, num_envs=3, device=device, on_overflow="raise", capacity={"pairs": 1000, "contacts": 200})
    for one in (free, sim):
        one.set("gravity", (0, 0, -30), envs=[1])
    with pytest.raises(CapacityError, match="^contacts: .* required, capacity 200") as error:
        sim.step(200)
    told = error.value
    assert (told.pool, told.had) == ("contacts", 200) and told.wanted > 200
    assert "\n" not in str(told)
    assert sim.time == pytest.approx(told.step / 240)
    free.step(told.step)
    assert bits(sim) == bits(free)
    free.step(1)
    assert free.counts()["contacts"] == told.wanted
    assert told.env == np.bincount(free.contacts()["env"]).argmax()
    with pytest.raises(CapacityError) as again:
        sim.step(1)
    assert str(again.value) == str(told)
    enough = Simulator(scene, num_envs=3, device=device, on_overflow="raise", capacity={"pairs": 5000})
    enough.set("gravity", (0, 0, -30), envs=[1])
    enough.step(told.step + 1)
    assert bits(enough) == bits(free)


@pytest.mark.parametrize("count", [3, 4, 6])
@pytest.mark.parametrize("on_overflow", ["grow", "raise"])
def test_totals_beyond_32_bits_are_refused(device, monkeypatch, on_overflow, count):
    """2^30 pairs for each of some bodies: their sum in 32 bits is negative, zero or positive again, and never right."""
    sim = Simulator(heap(8), device=device, on_overflow=on_overflow)
    sim.step(2)
    before = bits(sim)
    stages = stages_of(sim)
    pairs = stages.pools.pairs
    counts = np.zeros(pairs.count.shape, np.int32)
    counts[1 : 1 + count] = 2**30

    def replay():
        pairs.count.assign(counts)
        stages._sum(pairs.count, pairs.start, PAIRS, pairs.body_a.shape[0])

    monkeypatch.setattr(stages, "replay", replay)
    with pytest.raises(CapacityError, match="^pairs: 2147483647 required, .* simulate fewer environments") as error:
        sim.step(3)
    assert not pairs.start.numpy().any(), "nothing may be read or written at places that do not exist"
    assert (error.value.pool, error.value.wanted, error.value.step) == ("pairs", 2**31 - 1, 2)
    monkeypatch.undo()
    assert bits(sim) == before
    sim.step(1)


def test_measuring_penetration_raises_too(device):
    sim = Simulator(heap(27), device=device, on_overflow="raise", capacity={"pairs": 2})
    for _ in range(2):
        with pytest.raises(CapacityError, match="^pairs: .* required, capacity 2"):
            sim.penetration()


def test_a_limit_on_memory_stops_growth_and_names_the_number_to_raise(device):
    scene = heap(64)
    small = {"pairs": 10, "contacts": 10}
    held = Simulator(scene, device=device, capacity=small).memory
    sim = Simulator(scene, device=device, capacity=small, memory_limit=held + 10_000)
    with pytest.raises(CapacityError, match="^memory_limit: larger capacity .pairs 10 -> ") as error:
        sim.step(30)
    assert error.value.pool == "memory" and error.value.had == held + 10_000
    assert str(error.value.wanted) in str(error.value)
    assert sim.time == 0.0
    # Raising the limit to the number told lets the same step through.
    while True:
        try:
            Simulator(scene, device=device, capacity=small, memory_limit=error.value.wanted).step(30)
            break
        except CapacityError as next_error:
            assert next_error.wanted > error.value.wanted
            error.value.wanted = next_error.wanted


@pytest.mark.long
def test_what_does_not_fit_is_refused_before_it_is_taken(device, monkeypatch):
    """With the number, and before a byte is allocated."""
    scene = heap(10)
    needed = Simulator(scene, num_envs=4, device=device).memory

    def no_more(*_):
        raise AssertionError("allocated")

    monkeypatch.setattr(declare, "allocate", no_more)
    with pytest.raises(CapacityError, match="^memory_limit: simulating 4 environment.s. needs") as error:
        Simulator(scene, num_envs=4, device=device, memory_limit=needed - 1)
    assert error.value.wanted == needed
    with pytest.raises(
        CapacityError, match="^memory: simulating 10000000 environment.s. needs .* free; simulate fewer"
    ):
        Simulator(scene, num_envs=10_000_000, device=device)
    monkeypatch.setattr(memory, "device_memory", lambda device: (2 * needed, needed - 1))
    with pytest.raises(CapacityError, match="^memory: "):
        Simulator(scene, num_envs=4, device=device)
    with pytest.raises(CapacityError, match="^memory_limit: "):
        Simulator(scene, num_envs=4, device=device, memory_limit=0.49)


@pytest.mark.parametrize("limit", [0, -1, 0.0, 1.5, float("nan"), "1GB", True])
def test_limits_that_are_none_are_refused(device, limit):
    with pytest.raises(ValueError, match="^memory_limit: must be"):
        Simulator(heap(1), device=device, memory_limit=limit)


@pytest.mark.parametrize(
    ("arguments", "field"),
    [
        ({"on_overflow": "drop"}, "on_overflow"),
        ({"on_nonfinite": "ignore"}, "on_nonfinite"),
        ({"capacity": {"pears": 3}}, "capacity"),
        ({"capacity": {"pairs": 0}}, "capacity pairs"),
        ({"capacity": {"contacts": 2**40}}, "capacity contacts"),
    ],
)
def test_other_arguments_are_refused(device, arguments, field):
    with pytest.raises(ValueError, match=f"^{field}: must be"):
        Simulator(heap(1), device=device, **arguments)


def arrays_within(thing, searched):
    """All device arrays that an object holds, each once, and none that is a part of another."""
    if id(thing) in searched:
        return
    searched[id(thing)] = thing
    if isinstance(thing, wp.array):
        if not isinstance(thing._ref, wp.array):
            yield thing
    elif isinstance(thing, list | tuple):
        for part in thing:
            yield from arrays_within(part, searched)
    elif type(thing).__module__.split(".")[0] == "warp_rigid":
        for part in vars(thing).values():
            yield from arrays_within(part, searched)
    elif hasattr(thing, "_cls"):
        for name in thing._cls.vars:
            yield from arrays_within(getattr(thing, name), searched)


def test_the_memory_told_is_the_memory_held(device):
    """Against the sum over all arrays that can be reached from the simulator."""
    scene = heap(20)
    scene.add_body(wr.scenes.load("bunny_pile").bodies[-1].shape, position=(0, 0, 5))
    sim = Simulator(scene, num_envs=50, device=device, capacity={"pairs": 3000, "contacts": 9000})
    sim.step()  # The first step allocates arrays of its own.
    held = sum(array.size * wp.types.type_size_in_bytes(array.dtype) for array in arrays_within(sim, {}))
    assert sim.memory == pytest.approx(held, rel=0.02)


def broken(sim, env, body, name, value):
    """Write a value behind the simulator's back, as only a fault or a wild force would."""
    array = sim.array(name)
    host = array.numpy().copy()
    host[env * sim.num_bodies + body] = value
    array.assign(host)


WRONG = (
    ("position", np.nan),
    ("position", 1e30),
    ("linear_velocity", np.inf),
    ("linear_velocity", 1e30),
    ("angular_velocity", 1e30),
    ("force", np.inf),
    ("linear_velocity", 3e38),
    ("angular_velocity", 3e38),
    ("position", -3e38),
    ("orientation", np.nan),
    ("torque", np.nan),
    ("friction", np.nan),
    ("restitution", np.nan),
    ("rolling_friction", np.inf),
    ("spinning_friction", np.nan),
)
"""What is broken in one environment each, between two that stay as they are."""


def test_environments_gone_wrong_leave_the_others_their_bits(device):
    """Through the hash grid too, whose cells all environments share."""
    scene, count = heap(300), 2 * len(WRONG) + 1
    alone, sim = Simulator(scene, device=device), Simulator(scene, num_envs=count, device=device)
    for one in (alone, sim):
        one.step(3)
    for place, (name, value) in enumerate(WRONG):
        broken(sim, 2 * place + 1, 150, name, value)
    for one in (alone, sim):
        one.step(8)
    assert [env for env in range(0, count, 2) if bits(sim, env) != bits(alone, 0)] == []
    status = sim.status()
    assert status["status"].tolist() == ["ok", *["non-finite", "ok"] * len(WRONG)]
    assert set(status["step"][1::2]) == {3} and status["time"][1::2] == pytest.approx(3 / 240)


def test_a_non_finite_state_raises_where_asked(device):
    sim = Simulator(random_pile(np.random.default_rng(0)), num_envs=3, device=device, on_nonfinite="raise")
    sim.step(5)
    broken(sim, 2, 4, "linear_velocity", np.nan)
    with pytest.raises(NonFiniteError, match="^environment 2: body 4 is not finite since step 5 ") as error:
        sim.step(100)
    assert (error.value.env, error.value.step, error.value.body) == (2, 5, 4)
    assert error.value.time == pytest.approx(5 / 240)


def test_status_tells_when(device):
    scene = ground_scene()
    scene.add_body(Sphere(0.1), position=(0, 0, 1))
    sim = Simulator(scene, num_envs=2, device=device)
    sim.step(7)
    assert sim.status().tolist() == [("ok", -1, -1.0, -1, "")] * 2
    broken(sim, 0, 1, "position", np.nan)
    sim.step(2)
    assert sim.status()[0].tolist() == ("non-finite", 7, pytest.approx(7 / 240), 1, "")
