"""The same bits every time: over runs, batch sizes, places in the batch, growth of pools, and restarts."""

import json
import platform

import numpy as np
import pytest

import warp_rigid as wr
from tests import pin_hashes
from tests.oracles import moving, random_pile
from warp_rigid.engine.settings import Settings
from warp_rigid.engine.simulator import Simulator
from warp_rigid.scene.shapes import Box, Sphere

STATE = ("position", "orientation", "linear_velocity", "angular_velocity")
STARTS = 5
"""Different starts of the scene, so that neighbours in a batch differ."""


def end_bits(sim, env):
    return b"".join(sim.get(name)[env].tobytes() for name in STATE)


def settings_with_and_without_sleep():
    """Sleeping is off by default; it must not change what this file tests."""
    return [Settings(), Settings(sleeping=True)]


def run(device, starts, settings=None, steps=90, capacity=None, restart=None):
    """Ends of a batch, one an environment, each from its own start."""
    scene = random_pile(np.random.default_rng(7))
    dynamic = np.flatnonzero(moving(scene))
    sim = Simulator(scene, num_envs=len(starts), settings=settings, device=device, capacity=capacity)
    kicks = [np.random.default_rng(start).normal(scale=0.5, size=(len(dynamic), 3)) for start in starts]
    sim.set("linear_velocity", np.array(kicks), bodies=dynamic)
    sim.set("friction", np.array([[0.1 + 0.2 * start] for start in starts]))
    sim.set("contact_iterations", [4 + start for start in starts])
    if restart:
        sim.step(steps // 2)
        sim.save(restart)
        sim = Simulator.load(restart)
        steps -= steps // 2
    sim.step(steps)
    assert (sim.status()["status"] == "ok").all()
    return [end_bits(sim, env) for env in range(len(starts))]


@pytest.mark.long
@pytest.mark.parametrize("settings", settings_with_and_without_sleep(), ids=lambda s: "sleeping" if s.sleeping else "")
def test_ends_depend_on_nothing_but_the_start(device, tmp_path, settings):
    """Batches of 1, 7 and 24 (4096 on a GPU), every start at many places, tight pools, a restart on the way."""
    alone = [run(device, [start], settings)[0] for start in range(STARTS)]
    assert len(set(alone)) == STARTS, "the starts must differ for this to tell anything"
    assert run(device, [0], settings) == [alone[0]]
    for size in (24,) if device == "cpu" else (24, 4096):
        starts = np.random.default_rng(size).integers(0, STARTS, size).tolist()
        ends = run(device, starts, settings)
        assert [end == alone[start] for start, end in zip(starts, ends, strict=True)] == [True] * size
    starts = [3, 0, 4, 4, 1, 2, 3]
    ends = run(device, starts, settings, capacity={"pairs": 1, "contacts": 1}, restart=tmp_path / "a.ckpt")
    assert ends == [alone[start] for start in starts]


def break_state(sim, envs):
    """A velocity that is no number, of the last body of some environments, behind the simulator's back."""
    array = sim.array("linear_velocity")
    host = array.numpy().copy()
    host.reshape(sim.num_envs, sim.num_bodies, 3)[envs, -1] = np.nan
    array.assign(host)


SPEEDS = (0.1, 0.4, 0.4, 1.0, 2.0)
"""Of the ball in each start [m/s]: it never gets to the box, comes when the box sleeps, or before."""


def ball_and_box(device, starts, broken=()):
    """A ball rolls towards a box at rest; every other start lets bodies sleep; some environments break on the way."""
    starts = np.array(starts)
    scene = pin_hashes.ground_scene(friction=0.4)
    scene.add_body(Box((0.1, 0.1, 0.1)), position=(0, 0, 0.1))
    ball = scene.add_body(Sphere(0.08), position=(-0.4, 0.03, 0.08))
    sim = Simulator(scene, num_envs=len(starts), device=device)
    speeds = np.array(SPEEDS)[starts]
    sim.set("linear_velocity", np.stack([speeds, 0 * speeds, 0 * speeds], axis=1)[:, None], bodies=[ball])
    sim.set("angular_velocity", np.stack([0 * speeds, speeds / 0.08, 0 * speeds], axis=1)[:, None], bodies=[ball])
    sim.set("sleeping", (starts % 2 == 0).tolist())
    sim.step(50)
    break_state(sim, list(broken))
    sim.step(100)
    assert np.flatnonzero(sim.status()["status"] != "ok").tolist() == list(broken)
    return sim


@pytest.mark.long
def test_thousands_of_small_environments_end_as_each_alone(device):
    """Where bodies sleep, are woken or stay awake, and one environment in seven breaks down on the way.

    On a GPU teams of lanes solve an environment, and are smaller the more environments there are.
    """
    runs = [ball_and_box(device, [start]) for start in range(STARTS)]
    alone = [end_bits(sim, 0) for sim in runs]
    assert len(set(alone)) == STARTS
    assert [sim.get("asleep")[0].any() for sim in runs] == [True, False, False, False, False]
    assert [sim.get("position")[0, 1, 0] > 1e-4 for sim in runs] == [False, True, True, True, True]
    for size in (4096,) if device == "cpu" else (4096, 9000):
        starts = np.random.default_rng(size).integers(0, STARTS, size)
        broken = np.arange(3, size, 7)
        batch = ball_and_box(device, starts, broken)
        rows = np.concatenate([batch.get(name).reshape(size, -1) for name in STATE], axis=1).view(np.int32)
        expected = np.stack([np.frombuffer(end, np.int32) for end in alone])[starts]
        different = np.flatnonzero((rows != expected).any(axis=1))
        assert np.setdiff1d(different, broken).tolist() == []


@pytest.mark.long
def test_bodies_that_meet_through_the_grid_end_the_same_at_any_place(device):
    """All environments share the grid's cells; one of them breaks down, and pools grow from next to nothing."""

    def hail(envs, **options):
        sim = Simulator(pin_hashes.hail(), num_envs=len(envs), device=device, **options)
        for place, env in enumerate(envs):
            sim.set("linear_velocity", (0.5 * env, 0, -1.0), envs=[place], bodies=range(1, sim.num_bodies))
        sim.step(4)
        return sim

    alone = [hail([env]) for env in range(2)]
    batch = hail([1, 0, 0, 1], capacity={"pairs": 1, "contacts": 1})
    break_state(batch, [2])
    for sim in (*alone, batch):
        sim.step(8)
    assert batch.status()["status"].tolist() == ["ok", "ok", "non-finite", "ok"]
    assert [end_bits(batch, place) for place in (0, 1, 3)] == [end_bits(alone[env], 0) for env in (1, 0, 1)]
    assert end_bits(batch, 0) != end_bits(batch, 1)
    assert alone[0].counts()["contacts"] > 500


DEEDS = (
    lambda sim, env, body, v: sim.set("position", 0.2 * v + [0, 0, 0.8], envs=[env], bodies=[body]),
    lambda sim, env, body, v: sim.set("active", bool(v[0] > 0), envs=[env], bodies=[body]),
    lambda sim, env, body, v: sim.apply_impulse(2 * v, sim.get("center_of_mass")[env, body], body, envs=[env]),
    lambda sim, env, body, v: sim.set("force", 20 * v, envs=[env], bodies=[body]),
    lambda sim, env, body, v: sim.set("mass", 1 + 10 * v[0] ** 2, envs=[env], bodies=[body]),
    lambda sim, env, body, v: sim.set("friction", abs(v[0]), envs=[env]),
    lambda sim, env, body, v: sim.set("gravity", (v[0], v[1], -9.81), envs=[env]),
    lambda sim, env, body, v: sim.set("contact_iterations", 1 + int(8 * abs(v[0])), envs=[env]),
    lambda sim, env, body, v: sim.set("shock_propagation", ["off", "two_pass"][int(v[0] > 0)], envs=[env]),
    lambda sim, env, body, v: sim.set("sleeping", bool(v[0] > -0.5), envs=[env]),
    lambda sim, env, body, v: sim.reset(envs=[env]),
)
"""What can be done to an environment, with a body of it and three numbers."""


def play(device, scene, scripts, restart=None, broken=()):
    """Environments to which things are done at certain steps, each by its own script; saved and loaded at `restart`."""
    sim = Simulator(scene, num_envs=len(scripts), device=device, capacity={"pairs": 1, "contacts": 1})
    events = sorted((step, env, deed) for env, script in enumerate(scripts) for step, *deed in script)
    for step in range(200):
        if restart is not None and step == 120:
            break_state(sim, list(broken))
            sim.save(restart)
            sim = Simulator.load(restart)
            sim.penetration()
        while events and events[0][0] == step:
            _, env, (which, body, numbers) = events.pop(0)
            DEEDS[which](sim, env, body, np.array(numbers))
        sim.step()
    return sim


@pytest.mark.parametrize("seed", range(4))
def test_what_is_done_to_others_changes_nothing(device, tmp_path, seed):
    """Random deeds in each environment of a batch that is saved, loaded and partly broken, against each alone."""
    generator = np.random.default_rng(seed)
    scene = pin_hashes.ground_scene(friction=0.6)
    scene.add_kinematic(wr.Cylinder(0.5, 0.05), position=(0, 0, 0.05), angular_velocity=(0, 0, 1))
    for k, shape in enumerate((Box((0.1, 0.1, 0.1)), Sphere(0.1), wr.Capsule(0.06, 0.08), Box((0.1, 0.1, 0.05)))):
        scene.add_body(shape, position=(0.03 * k, 0, 0.25 + 0.22 * k), restitution=0.1 * k, rolling_friction=0.003)

    def script():
        deeds = generator.integers((0, 0, 2), (200, len(DEEDS), 6), (generator.integers(7), 3)).tolist()
        return [(*deed, generator.normal(size=3).tolist()) for deed in deeds]

    scripts = [script() for _ in range(3)]
    alone = [end_bits(play(device, scene, [one]), 0) for one in scripts]
    places = [2, 0, 1, 1, 0, 2]
    batch = play(device, scene, [scripts[k] for k in places] + [[]], tmp_path / "a.ckpt", broken=[6])
    assert [end_bits(batch, place) == alone[k] for place, k in enumerate(places)] == [True] * 6
    assert batch.status()["status"].tolist() == ["ok"] * 6 + ["non-finite"]


def test_ends_are_the_pinned_ones():
    """Renewed by `python -m tests.pin_hashes`, which also shows that the instruction set does not matter."""
    if platform.machine().lower() not in ("x86_64", "amd64"):
        pytest.skip("pinned for x86-64: elsewhere the C library rounds sine and cosine differently")
    pinned, found = json.loads(pin_hashes.FILE.read_text()), pin_hashes.ends()
    assert len(pinned) == 10
    assert [name for name in pinned if found[name] != pinned[name]] == []
