"""Choices of environments and bodies: none, some, by a mask, twice, and bodies that cannot move."""

import copy
import pickle

import numpy as np
import pytest

import warp_rigid as wr
from warp_rigid.runs.file_scene import NoOutcome
from warp_rigid.scenes import Demo

NOBODY = ([], np.zeros(0, int), np.zeros(3, bool))


def floor_and_ball():
    scene = wr.Scene()
    scene.add_static(wr.Plane(), name="floor")
    scene.add_body(wr.Sphere(0.1), position=(0, 0, 0.1), name="ball")
    scene.add_pool(wr.Sphere(0.1), 2, "shot")
    return scene


@pytest.fixture
def sim(device):
    return wr.Simulator(floor_and_ball(), num_envs=3, device=device)


def everything(sim):
    names = ("position", "orientation", "linear_velocity", "angular_velocity", "active", "friction", "mass", "gravity")
    return [sim.get(name).tobytes() for name in names]


@pytest.mark.parametrize("envs", NOBODY)
def test_no_environment_is_a_choice(sim, envs):
    sim.step(3)
    before, time = everything(sim), sim.time
    sim.reset(envs=envs)
    sim.apply_impulse((1, 0, 0), (0, 0, 0.1), "ball", envs=envs)
    sim.despawn("ball", envs=envs)
    assert sim.spawn("shot", (0, 0, 1), envs=envs).shape == (0,)
    for name, value in (("friction", 0.1), ("mass", 2.0), ("gravity", (0, 0, -1)), ("sleeping", True)):
        sim.set(name, value, envs=envs, **({"bodies": ["ball"]} if name == "mass" else {}))
    assert everything(sim) == before and sim.time == time


def test_no_body_is_a_choice(sim):
    before = everything(sim)
    sim.set("friction", 0.1, bodies=[])
    sim.despawn([])
    assert everything(sim) == before


def test_a_mask_chooses_environments(sim):
    sim.set("linear_velocity", (1, 0, 0), bodies=["ball"])
    sim.step(24)
    sim.reset(envs=np.array([True, False, True]))
    moved = sim.get("position")[:, 1, 0] > 0.05
    assert moved.tolist() == [False, True, False]
    with pytest.raises(ValueError, match=r"^envs: a mask must have the shape \(3,\), got shape \(2,\)$"):
        sim.reset(envs=[True, False])


@pytest.mark.parametrize(
    "attempt",
    [
        lambda sim: sim.apply_impulse((1, 0, 0), (0, 0, 0.1), "ball", envs=[0, 0]),
        lambda sim: sim.set("friction", [[0.1], [0.2]], envs=[1, 1]),
        lambda sim: sim.set("friction", 0.1, bodies=["ball", "ball"]),
        lambda sim: sim.spawn("shot", (0, 0, 1), envs=[2, 2]),
    ],
)
def test_what_is_chosen_twice_is_refused(sim, attempt):
    before = everything(sim)
    with pytest.raises(ValueError, match="^(envs|bodies): must be given once each, got "):
        attempt(sim)
    assert everything(sim) == before


def test_a_floor_does_not_become_a_conveyor(sim):
    """A ball that slides with friction 0.5 rolls after v / (7/2 mu g) at 5/7 of its speed, on a floor at rest."""
    sim.set("linear_velocity", (1, 0, 0))
    assert not sim.get("linear_velocity")[:, 0].any()
    sim.step(60)
    np.testing.assert_allclose(sim.get("linear_velocity")[:, 1, 0], 5 / 7, rtol=1e-3)
    sim.set("linear_velocity", 0, bodies=["floor"])
    with pytest.raises(ValueError, match="^linear_velocity: must be 0 for floor, which is static"):
        sim.set("linear_velocity", (1, 0, 0), bodies=["floor"])


def test_masses_of_all_bodies_are_those_of_the_dynamic_ones(sim):
    """What `get` returns can be set again; a value is refused where no body can have it."""
    sim.set("mass", 2.0)
    mass = sim.get("mass")
    assert (mass[:, 1:] == 2.0).all() and not mass[:, 0].any()
    sim.set("mass", 3.0 * mass)
    sim.set("mass", 0.0, bodies="floor")
    np.testing.assert_array_equal(sim.get("mass"), 3.0 * mass)
    scene = wr.Scene()
    scene.add_kinematic(wr.Sphere(0.1), name="moon")
    with pytest.raises(ValueError, match="^mass: must be 0 for moon, which is kinematic; only dynamic bodies"):
        wr.Simulator(scene, device="cpu").set("mass", 1.0)


@pytest.mark.parametrize("name", ["force", "torque"])
def test_forces_on_bodies_that_they_cannot_move_are_refused(name):
    scene = wr.Scene()
    scene.add_static(wr.Plane(), name="floor")
    scene.add_kinematic(wr.Sphere(0.1), position=(0, 0, 1), name="moon")
    scene.add_body(wr.Sphere(0.1), position=(1, 0, 1), name="ball")
    sim = wr.Simulator(scene, device="cpu")
    for body, motion in (("floor", "static"), ("moon", "kinematic")):
        told = f"^{name}: must be 0 for {body}, which is {motion}; only dynamic bodies can have one$"
        with pytest.raises(ValueError, match=told):
            sim.set(name, (0, 0, 1), bodies=[body, "ball"])
    sim.set(name, (0, 0, 1))
    np.testing.assert_array_equal(sim.get(name)[0], [[0, 0, 0], [0, 0, 0], [0, 0, 1]])
    sim.set(name, 0, bodies=["floor", "moon"])


def test_events_of_a_sweep_set_a_quantity_of_all_bodies_as_a_simulator_does():
    """A sweep gives its events a view of some environments."""
    scene = wr.Scene(gravity=(0, 0, 0))
    scene.add_static(wr.Plane(), name="floor")
    scene.add_body(wr.Sphere(0.1), position=(0, 0, 1))

    def push(sim):
        sim.set("mass", 2.0)
        sim.set("linear_velocity", (1, 0, 0))

    def momentum(sim):
        return (sim.get("mass") * sim.get("linear_velocity")[..., 0])[:, 1]

    demo = Demo("push", "", lambda: scene, NoOutcome, 0.1, {}, events=lambda scene: [(0.0, push)])
    row = wr.sweep(demo, {"friction": [0.5]}, metrics=[momentum], device="cpu").rows[0]
    assert (row["status"], row["momentum"]) == ("ok", pytest.approx(2.0))


def test_bodies_with_names_as_those_of_a_pool_do_not_belong_to_it(tmp_path):
    scene = wr.Scene()
    (own,) = scene.add_pool(wr.Sphere(0.1), 1, "shot")
    scene.add_body(wr.Sphere(0.2), name="shot_7", active=False)
    scene.add_static(wr.Box((0.1, 0.1, 0.1)), name="wall_0", active=False)
    scene.add_body(wr.Sphere(0.3), name="shot")
    assert scene.bodies[scene.add_body(wr.Sphere(0.3), name="shot", active=False)].name == "shot_1"
    sim = wr.Simulator(scene, device="cpu")
    sim.save(tmp_path / "sim.npz")
    for one in (sim, wr.Simulator.load(tmp_path / "sim.npz")):
        assert one.spawn("shot", (0, 0, 1)).tolist() == [own]
        assert one.spawn("shot", (0, 0, 2)).tolist() == [-1]
        with pytest.raises(ValueError, match="^pool: scene 0 has no bodies named wall_0"):
            one.spawn("wall", (0, 0, 3))


@pytest.mark.parametrize(
    ("pose", "message"),
    [
        ({"position": ("0", "0", "1")}, "^position: must be numbers"),
        ({"position": (0, 0)}, r"^position: must be \(3,\) or \(3, 3\) numbers, got \(0, 0\)"),
        ({"position": [[0], [0, 1]]}, "^position: must be"),
        ({"position": (0, 0, 1), "orientation": (0, 0, 0, 0)}, "^orientation: must be quaternions"),
        ({"position": (0, 0, 1), "linear_velocity": (0, 0, np.nan)}, "^linear_velocity: must be finite"),
    ],
)
def test_a_spawn_that_is_refused_changes_nothing(sim, pose, message):
    before = everything(sim)
    with pytest.raises(ValueError, match=message):
        sim.spawn("shot", **pose)
    assert everything(sim) == before


@pytest.mark.parametrize(
    ("attempt", "message"),
    [
        (lambda sim: sim.get(["position"]), "^name: must be a quantity, got"),
        (lambda sim: sim.watch(5), "^watched: must be a list"),
        (lambda sim: sim.watch(None), "^watched: must be a list"),
        (lambda sim: sim.set("active", [[True], [True, False]]), "^active: must be True or False"),
        (lambda sim: sim.set("position", [[1], [1, 2]]), "^position: must be vectors of 3"),
        (lambda sim: sim.set("friction", 0.1, envs=[[0], [0, 1]]), "^envs: must be"),
        (lambda sim: sim.set("orientation", (0, 0, 0, 3e38)), "^orientation: must be quaternions"),
    ],
)
def test_values_of_no_use_are_named(sim, attempt, message):
    before = everything(sim)
    with pytest.raises(ValueError, match=message) as error:
        attempt(sim)
    assert "\n" not in str(error.value) and everything(sim) == before


@pytest.mark.parametrize("duplicate", [copy.copy, copy.deepcopy, pickle.dumps])
def test_a_simulator_is_saved_and_not_pickled(sim, duplicate):
    with pytest.raises(TypeError, match="a Simulator cannot be pickled or copied; write it with save"):
        duplicate(sim)


@pytest.mark.parametrize("value", ["0.5", ["0.5"], True, None, 1j, [[1], [1, 2]]])
def test_values_of_joints_are_numbers(device, value):
    scene = wr.Scene()
    body = scene.add_body(wr.Box((0.1, 0.1, 0.1)), name="door")
    joint = scene.add_joint(wr.RevoluteJoint(axis=(0, 0, 1)), body)
    scene.add_drive(joint, stiffness=1.0)
    sim = wr.Simulator(scene, device=device)
    with pytest.raises(ValueError, match="^joint_target_position: must be numbers"):
        sim.set("joint_target_position", value)
