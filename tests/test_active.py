"""Bodies that are switched off and on while running, and bodies that leave the scene's bounds."""

import gc
import tracemalloc

import numpy as np
import pytest

from tests.oracles import ground_scene
from warp_rigid.engine.settings import Settings
from warp_rigid.engine.simulator import Simulator
from warp_rigid.scene.scene import Scene
from warp_rigid.scene.shapes import Box, Sphere
from warp_rigid.scenes.builders import stacks
from warp_rigid.scenes.builders.bodies import add_bodies

HALF, CUBE = 0.1, stacks.CUBE
STATE = ("position", "orientation", "linear_velocity", "angular_velocity")


def stack(height=3, **options):
    scene = ground_scene(friction=0.5)
    add_bodies(scene, stacks.CUBE, stacks.column(height), **options)
    return scene


def test_all_are_active_unless_told_otherwise(device):
    scene = stack(2)
    spare = scene.add_body(CUBE, position=(5, 0, 1), active=False)
    sim = Simulator(scene, num_envs=2, device=device)
    assert sim.get("active").dtype == bool
    assert sim.get("active").tolist() == [[True, True, True, False]] * 2
    sim.set("active", True, envs=[1], bodies=[spare])
    sim.set("active", [False, True], envs=[0], bodies=[1, 2])
    assert sim.get("active").tolist() == [[True, False, True, False], [True, True, True, True]]
    sim.reset()
    assert sim.get("active").tolist() == [[True, True, True, False]] * 2


def test_an_inactive_body_takes_no_part(device):
    """It does not fall, nothing meets it, it has no energy; it is the same as if it were not in the scene."""
    scene = stack(2)
    ghost = scene.add_body(CUBE, position=(0, 0, 0.3), linear_velocity=(1, 0, 0))
    sim = Simulator(scene, num_envs=2, device=device)
    sim.set("active", False, bodies=[ghost])
    sim.set("force", (0, 0, 100.0), bodies=[ghost])
    start = [sim.get(name)[:, ghost] for name in STATE]
    assert (sim.get("kinetic_energy")[:, ghost] == 0).all() and (sim.get("potential_energy")[:, ghost] == 0).all()
    sim.step(120)
    for name, before in zip(STATE, start, strict=True):
        assert sim.get(name)[:, ghost].tobytes() == before.tobytes()
    assert not {ghost} & {*sim.contacts()["body_a"], *sim.contacts()["body_b"]}
    assert sim.penetration().max() < 1e-4
    alone = Simulator(stack(2), device=device)
    alone.step(120)
    for name in STATE:
        assert sim.get(name)[1, :3].tobytes() == alone.get(name)[0].tobytes()


@pytest.mark.parametrize("sleeping", [False, True])
@pytest.mark.parametrize("gone", [0, 1])
def test_what_lay_on_it_falls(device, sleeping, gone):
    """Ground or lowest cube switched off in one environment; the rest falls freely there and stays elsewhere."""
    sim = Simulator(stack(3), num_envs=2, settings=Settings(sleeping=sleeping), device=device)
    sim.step(240)
    assert sim.get("asleep").any() == sleeping
    before = sim.get("position")
    sim.set("active", False, envs=[1], bodies=[gone])
    sim.step(24)
    moved = sim.get("position")[..., 2] - before[..., 2]
    assert np.abs(moved[0]).max() < 1e-6
    np.testing.assert_allclose(moved[1, gone + 1 :], -0.5 * 9.81 * (24 * 25) / 240**2, rtol=1e-3)


def test_switched_on_again_it_is_there(device):
    """With a new pose and velocity, in one environment."""
    sim = Simulator(stack(1), num_envs=2, device=device)
    sim.set("active", False, bodies=[1])
    sim.step(10)
    sim.set("position", (3, 0, 1.0), envs=[0], bodies=[1])
    sim.set("linear_velocity", (1, 0, 0), envs=[0], bodies=[1])
    sim.set("active", True, envs=[0], bodies=[1])
    sim.step(24)
    np.testing.assert_allclose(sim.get("position")[0, 1], [3.1, 0, 1 - 0.5 * 9.81 * (24 * 25) / 240**2], rtol=1e-4)
    sim.step(240)
    assert sim.get("position")[0, 1, 2] == pytest.approx(HALF, abs=1e-4)
    np.testing.assert_allclose(sim.get("position")[1, 1], [0, 0, HALF], atol=1e-6)


@pytest.mark.long
def test_bodies_come_and_go_without_a_leak(device):
    """Each of four spare bodies is dropped onto a sleeping stack, removed, dropped again."""
    scene = stack(2)
    spares = [scene.add_body(Sphere(0.05), active=False) for _ in range(4)]
    sim = Simulator(scene, settings=Settings(sleeping=True), device=device)

    def cycle(k):
        body = spares[k % 4]
        sim.set("position", (0.02 * (k % 3), 0, 0.47), bodies=[body])
        sim.set("linear_velocity", (0, 0, -1.0), bodies=[body])
        sim.set("active", True, bodies=[body])
        sim.step(3)
        sim.set("active", False, bodies=[body])

    for k in range(40):
        cycle(k)
    size = sim.counts()["pair_capacity"], sim.counts()["contact_capacity"]
    tracemalloc.start()
    for k in range(200):
        cycle(k)
    gc.collect()
    # Threads that other tests have left do not count.
    own = [tracemalloc.Filter(True, f"*/{package}/*") for package in ("warp_rigid", "kernels", "warp")]
    grown = sum(trace.size for trace in tracemalloc.take_snapshot().filter_traces(own).traces)
    tracemalloc.stop()
    assert grown < 20_000
    assert (sim.counts()["pair_capacity"], sim.counts()["contact_capacity"]) == size
    assert (sim.status()["status"] == "ok").all()
    np.testing.assert_allclose(sim.get("position")[0, 1:3, 2], [HALF, 3 * HALF], atol=1e-3)


@pytest.mark.parametrize("value", [1, 0.0, "yes", [1, 0]])
def test_active_is_true_or_false(device, value):
    sim = Simulator(stack(2), device=device)
    with pytest.raises(ValueError, match="^active: must be True or False"):
        sim.set("active", value, bodies=[1, 2])
    with pytest.raises(ValueError, match="^active: must be True or False"):
        Scene().add_body(CUBE, active=value)


def bounded(out_of_bounds):
    """A ball that falls beside the ground, one that flies sideways, one that stays; the ground lies outside."""
    scene = Scene(bounds=((-2, -2, -1), (2, 2, np.inf)), out_of_bounds=out_of_bounds)
    scene.add_static(Box((0.5, 0.5, 1)), position=(0, 0, -1))
    scene.add_body(Sphere(0.1), position=(0, 0, 0.1))
    scene.add_body(Sphere(0.1), position=(1, 0, 0))
    scene.add_body(Sphere(0.1), position=(-1, 0, 50), linear_velocity=(0, 12, 0))
    return scene


@pytest.mark.parametrize("out_of_bounds", ["report", "remove"])
def test_who_leaves_the_bounds_is_reported_or_removed(device, out_of_bounds):
    """The first one, with its step; in the environment where it happens; a reset forgets it."""
    sim = Simulator(bounded(out_of_bounds), num_envs=2, device=device)
    sim.set("linear_velocity", 0.0, envs=[1], bodies=[3])
    sim.step(240)
    # The flyer passes y = 2 after 12 v t > 2: at the end of step 40; the faller z = -1 with k (k + 1) g dt^2 / 2 > 1.
    fall = next(k for k in range(1, 200) if 0.5 * 9.81 * k * (k + 1) / 240**2 > 1.0)
    status = sim.status()
    assert status["status"].tolist() == ["out of bounds", "out of bounds"]
    assert status["body"].tolist() == [3, 2]
    assert status["step"].tolist() == [40, fall - 1]
    removed = out_of_bounds == "remove"
    assert sim.get("active").tolist() == [[True, True, not removed, not removed], [True, True, not removed, True]]
    if removed:
        assert sim.get("position")[0, 3, 1] == pytest.approx(2.05, abs=1e-4)
    sim.reset(envs=[1])
    assert sim.status()["status"].tolist() == ["out of bounds", "ok"]
    assert sim.get("active")[1].all()


def test_removal_wakes_what_lay_on_the_removed(device):
    """A shelf that sinks out of bounds goes, and its sleeping load falls."""
    scene = Scene(bounds=((-9, -9, -0.5), (9, 9, 9)), out_of_bounds="remove")
    shelf = scene.add_kinematic(Box((1, 1, 0.05)), position=(0, 0, -0.45))
    scene.add_body(CUBE, position=(0, 0, -0.3))
    sim = Simulator(scene, settings=Settings(sleeping=True), device=device)
    sim.step(240)
    assert sim.get("asleep")[0].tolist() == [False, True]
    sim.set("linear_velocity", (0, 0, -0.1), bodies=[shelf])
    sim.step(200)
    assert not sim.get("active")[0, shelf]
    assert sim.status()["body"][0] == shelf
    assert sim.get("linear_velocity")[0, 1, 2] < -0.5 or not sim.get("active")[0, 1]


def test_without_bounds_nothing_is_out(device):
    scene = Scene()
    scene.add_body(Sphere(0.1), position=(0, 0, -1e6))
    sim = Simulator(scene, device=device)
    sim.step(5)
    assert sim.status()["status"].tolist() == ["ok"]


@pytest.mark.parametrize(
    "bounds",
    [((0, 0, 0), (1, 1)), ((0, 0, 0), (1, 1, 0)), ((0, 0, 2), (1, 1, 1)), ((0, 0, np.nan), (1, 1, 1)), 3.0, "box"],
)
def test_bounds_are_a_box(bounds):
    with pytest.raises(ValueError, match="^bounds: must be"):
        Scene(bounds=bounds)
    with pytest.raises(ValueError, match="^out_of_bounds: must be one of report, remove"):
        Scene(bounds=((0, 0, 0), (1, 1, 1)), out_of_bounds="kill")
    assert Scene(bounds=((0, 0, -np.inf), (1, 1, 1))).bounds == ((0.0, 0.0, -np.inf), (1.0, 1.0, 1.0))
