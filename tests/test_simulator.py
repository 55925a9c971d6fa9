"""The simulator's surface: reading and writing, reset, batches, growing pools, failures, and clear errors."""

from dataclasses import replace

import numpy as np
import pytest
import warp as wp

from tests.oracles import ground_scene, random_pile, rotate_about, rotation_matrix
from warp_rigid.engine.settings import PER_ENVIRONMENT, Settings
from warp_rigid.engine.simulator import Simulator
from warp_rigid.scene.coefficients import COEFFICIENTS
from warp_rigid.scene.fields import PointField, UniformField
from warp_rigid.scene.scene import Scene
from warp_rigid.scene.shapes import Box, Compound, Plane, Sphere

STATE = ("position", "orientation", "linear_velocity", "angular_velocity")


def small_scene():
    """Ground, a kinematic table, a box and a ball that fall on it."""
    scene = ground_scene(friction=0.5)
    scene.add_kinematic(Box((1, 1, 0.1)), position=(0, 0, 0.1), angular_velocity=(0, 0, 1))
    scene.add_body(Box((0.1, 0.2, 0.1)), position=(0.3, 0, 0.4), linear_velocity=(0, 0.2, 0), restitution=0.3)
    scene.add_body(Sphere(0.1), position=(-0.3, 0, 0.35), angular_velocity=(3, 0, 0), friction=0.2)
    return scene


def snapshot(sim):
    """All of the state, as one list of bytes."""
    return [sim.get(name).tobytes() for name in STATE]


def same_state(sim, env, other, other_env):
    return all(sim.get(name)[env].tobytes() == other.get(name)[other_env].tobytes() for name in STATE)


READ_WRITE = {
    "position": (3,),
    "linear_velocity": (3,),
    "angular_velocity": (3,),
    "force": (3,),
    "torque": (3,),
    **dict.fromkeys(COEFFICIENTS, ()),
}


@pytest.mark.parametrize("name", READ_WRITE)
def test_set_and_get_round_trip(device, name):
    sim = Simulator(small_scene(), num_envs=3, device=device)
    shape = (3, 4, *READ_WRITE[name])
    assert sim.get(name).shape == shape
    values = np.random.default_rng(0).random(shape).astype(np.float32)
    sim.set(name, values)
    if name.endswith("velocity"):
        values[:, 0] = 0.0  # the ground is static
    if name in ("force", "torque"):
        values[:, :2] = 0.0  # neither on ground nor on the table
    assert sim.get(name).tobytes() == values.tobytes()
    sim.set(name, np.full(READ_WRITE[name], 0.25), envs=[2, 0], bodies=[3])
    values[[2, 0], 3] = 0.25
    assert sim.get(name).tobytes() == values.tobytes()


def test_values_broadcast(device):
    sim = Simulator(small_scene(), num_envs=3, device=device)
    sim.set("friction", np.array([[0.1], [0.2], [0.3]]))
    np.testing.assert_allclose(sim.get("friction"), np.repeat([[0.1], [0.2], [0.3]], 4, axis=1), rtol=1e-6)
    sim.set("linear_velocity", np.arange(6.0).reshape(2, 1, 3), envs=[0, 2], bodies=[1, 3])
    expected = np.zeros((3, 4, 3))
    expected[:, 2] = [0, 0.2, 0]
    expected[0, [1, 3]], expected[2, [1, 3]] = [0, 1, 2], [3, 4, 5]
    np.testing.assert_allclose(sim.get("linear_velocity"), expected, rtol=1e-6)
    sim.set("gravity", np.array([[0, 0, -1.0], [0, 0, -2.0]]), envs=[1, 2])
    np.testing.assert_allclose(sim.get("gravity")[:, 2], [-9.81, -1, -2], rtol=1e-6)


def test_vectors_are_vectors(device):
    sim = Simulator(small_scene(), num_envs=3, device=device)
    for name, value in (
        ("gravity", -9.81),
        ("gravity", [0, 0]),
        ("position", 0.0),
        ("orientation", (0, 0, 1)),
        ("force", 2),
    ):
        with pytest.raises(ValueError, match=f"^{name}: must be vectors of"):
            sim.set(name, value)
    before = sim.get("gravity")
    sim.set("gravity", (0, 0, -1.62), envs=[1])
    sim.set("linear_velocity", 0)
    np.testing.assert_allclose(sim.get("gravity"), [before[0], (0, 0, -1.62), before[2]], rtol=1e-6)
    assert not sim.get("linear_velocity").any()


def test_orientations_are_made_unit(device):
    sim = Simulator(small_scene(), num_envs=2, device=device)
    sim.set("orientation", (0.0, 0.0, 3.0, 4.0), envs=[1], bodies=[2])
    np.testing.assert_allclose(sim.get("orientation")[1, 2], [0, 0, 0.6, 0.8], rtol=1e-6)
    np.testing.assert_allclose(sim.get("orientation")[0, 2], [0, 0, 0, 1])


def test_mass_takes_the_inertia_along(device):
    scene = small_scene()
    sim = Simulator(scene, num_envs=2, device=device)
    before = sim.get("inertia")
    sim.set("mass", 5.0, envs=[1], bodies=[2])
    assert sim.get("mass")[1, 2] == 5.0
    assert sim.get("mass")[0, 2] == pytest.approx(1000 * 0.2 * 0.4 * 0.2, rel=1e-6)
    box = scene.bodies[2].shape
    np.testing.assert_allclose(sim.get("inertia")[1, 2], 5.0 / box.volume * box.inertia, rtol=1e-5, atol=1e-9)
    np.testing.assert_allclose(sim.get("inertia")[0, 2], before[0, 2])


def test_a_mass_that_is_set_is_that_of_a_scene(device):
    """Bit for bit: a sweep over masses has the results of scenes with these masses."""
    scene = small_scene()
    scene.bodies[2] = replace(scene.bodies[2], mass=2.37)
    sim = Simulator(small_scene(), device=device)
    sim.set("mass", 2.37, bodies=[2])
    assert sim.get("inertia").tobytes() == Simulator(scene, device=device).get("inertia").tobytes()


@pytest.mark.parametrize("name", PER_ENVIRONMENT)
def test_settings_differ_between_environments(device, name):
    sim = Simulator(small_scene(), num_envs=3, device=device)
    default = getattr(Settings(), name)
    other = {"shock_propagation": "off"}.get(name, 7 if name.endswith("_iterations") else not default)
    assert sim.get(name).tolist() == [default] * 3
    sim.set(name, other, envs=[1])
    assert sim.get(name).tolist() == [default, other, default]
    sim.set(name, [other, default, other])
    assert sim.get(name).tolist() == [other, default, other]
    sim.step(2)


def test_get_returns_copies_and_array_the_live_one(device):
    sim = Simulator(small_scene(), num_envs=2, device=device)
    for name in (*STATE, "friction", "mass", "gravity", "contact_iterations", "kinetic_energy", "inertia"):
        values = sim.get(name)
        before = values.copy()
        values[...] = 77
        assert sim.get(name).tobytes() == before.tobytes()
    live = sim.array("position")
    assert live.shape == (8,)
    host = live.numpy().copy()
    host[3] += 1.0
    live.assign(host)
    assert sim.get("position")[0, 3, 2] == pytest.approx(1.35)


def test_derived_quantities(device):
    """Energies, inertia and centres of mass in float64 from what was put in."""
    lopsided = Compound([(Sphere(0.1), (0.3, 0, 0), (0, 0, 0, 1)), (Box((0.1, 0.1, 0.1)), (0, 0, 0), (0, 0, 0, 1))])
    scene = Scene(gravity=(0, 0, -2))
    scene.add_force_field(UniformField(acceleration=(1, 0, 0)))
    scene.add_force_field(PointField(center=(0, 0, -3), strength=4.0))
    scene.add_body(
        lopsided,
        mass=3.0,
        position=(1, 2, 3),
        orientation=rotate_about((0, 0, 1), 90),
        linear_velocity=(1, 2, 2),
        angular_velocity=(0, 0, 2),
    )
    sim = Simulator(scene, device=device)
    center = np.array([1, 2, 3]) + [0, lopsided.center_of_mass[0], 0]
    np.testing.assert_allclose(sim.get("center_of_mass")[0, 0], center, rtol=1e-6)
    unit = lopsided.inertia * 3.0 / lopsided.volume
    turned = np.diag([unit[1, 1], unit[0, 0], unit[2, 2]])
    np.testing.assert_allclose(sim.get("inertia")[0, 0], turned, rtol=1e-5, atol=1e-7)
    assert sim.get("kinetic_energy")[0, 0] == pytest.approx(0.5 * (3 * 9 + unit[2, 2] * 4), rel=1e-5)
    potential = 3 * (2 * center[2] - center[0] - 4 / np.linalg.norm(center - [0, 0, -3]))
    assert sim.get("potential_energy")[0, 0] == pytest.approx(potential, rel=1e-5)


def test_force_fields_pull_on_dynamic_bodies_alone(device):
    """A step in a uniform and a point field: strength / distance^2 toward the centre, static and kinematic unmoved."""
    scene = Scene(gravity=(0, 0, 0))
    scene.add_force_field(UniformField(acceleration=(0.5, 0, 0)))
    scene.add_force_field(PointField(center=(0, 0, -10), strength=100.0))
    for add in (scene.add_static, scene.add_kinematic, scene.add_body):
        add(Sphere(0.1), position=(0, 3 * len(scene.bodies), -6))
    sim = Simulator(scene, device=device)
    sim.step()
    away = np.array([0, 6, 4.0])
    expected = np.array([0.5, 0, 0]) - 100.0 * away / np.linalg.norm(away) ** 3
    np.testing.assert_allclose(sim.get("linear_velocity")[0, 2], expected / 240, rtol=1e-5)
    assert sim.get("linear_velocity")[0, :2].tolist() == [[0, 0, 0], [0, 0, 0]]


def test_time_counts_steps(device):
    sim = Simulator(small_scene(), settings=Settings(dt=0.01), device=device)
    sim.step(7)
    sim.step()
    assert sim.time == pytest.approx(0.08)
    sim.step(0)
    assert sim.time == pytest.approx(0.08)
    sim.reset()
    assert sim.time == 0.0


def test_steps_in_one_call_or_many_are_the_same(device):
    whole = Simulator(random_pile(np.random.default_rng(0)), device=device)
    whole.step(100)
    single = Simulator(random_pile(np.random.default_rng(0)), device=device)
    for count in (1, 2, 3, 17, 33, 44):
        single.step(count)
    assert snapshot(whole) == snapshot(single)


def test_reset_of_some_environments_leaves_the_others(device):
    sim = Simulator(random_pile(np.random.default_rng(1)), num_envs=3, device=device)
    other = Simulator(random_pile(np.random.default_rng(1)), num_envs=1, device=device)
    sim.step(100)
    sim.reset(envs=[1])
    assert sim.time == pytest.approx(100 / 240)
    sim.step(60)
    other.step(60)
    assert same_state(sim, 1, other, 0)
    other.step(100)
    assert same_state(sim, 0, other, 0)
    assert same_state(sim, 2, other, 0)
    sim.set("friction", 0.05)
    sim.reset()
    assert sim.get("friction").max() == pytest.approx(0.05), "what was set stays"


TINY = {"pairs": 1, "contacts": 1}


def crowded_after_five_steps(device):
    """Boxes that rested apart, moved into one heap: more pairs than the last step had."""
    scene = ground_scene()
    for k in range(12):
        scene.add_body(Box((0.1, 0.1, 0.1)), position=(0.5 * k, 0, 0.1))
    sim = Simulator(scene, device=device, capacity=TINY)
    sim.step(5)
    sim.set("position", np.random.default_rng(0).uniform(-0.1, 0.1, (12, 3)) + [0, 0, 0.2], bodies=range(1, 13))
    return sim


def test_measuring_penetration_does_not_change_the_run(device):
    runs = []
    for look in (False, True):
        sim = crowded_after_five_steps(device)
        if look:
            assert sim.penetration()[0] > 0.05
            assert sim.counts()["most_pairs"] > 40
        sim.step(5)
        runs.append(snapshot(sim))
    assert runs[0] == runs[1]


def test_penetration_is_the_deepest_sample(device):
    """Against float64 depths of all vertices, both ways round; per environment."""
    scene = ground_scene()
    box = scene.add_body(Box((0.1, 0.2, 0.3)), position=(0, 0, 1))
    ball = scene.add_body(Sphere(0.15), position=(3, 0, 1))
    sim = Simulator(scene, num_envs=4, device=device)
    turn = rotate_about((1, 1, 0), 30)
    sim.set("orientation", turn, bodies=[box])
    height = scene.bodies[box].shape.support(-rotation_matrix(turn)[2:])[0]
    sim.set("position", (0, 0, height - 0.02), envs=[1], bodies=[box])
    sim.set("position", (3, 0, 0.15 - 0.03), envs=[2], bodies=[ball])
    sim.set("position", (0, 0, 0.1), envs=[3], bodies=[ball])
    sim.set("position", (0, 0, 5.0), envs=[3], bodies=[box])
    np.testing.assert_allclose(sim.penetration(), [0, 0.02, 0.03, 0.05], atol=2e-6)


def test_a_failed_environment_is_halted_and_the_others_run_on(device):
    """NaN in one environment: reported with step and body, and the rest goes on bit for bit."""
    sim = Simulator(random_pile(np.random.default_rng(5)), num_envs=3, device=device)
    clean = Simulator(random_pile(np.random.default_rng(5)), num_envs=3, device=device)
    sim.step(20)
    clean.step(20)
    velocity = sim.array("linear_velocity")
    host = velocity.numpy().copy()
    host[sim.num_bodies + 9] = np.nan
    velocity.assign(host)
    sim.step(80)
    clean.step(80)
    assert same_state(sim, 0, clean, 0)
    assert same_state(sim, 2, clean, 2)
    status = sim.status()
    assert status["status"].tolist() == ["ok", "non-finite", "ok"]
    assert status["step"].tolist() == [-1, 20, -1]
    assert status["body"].tolist() == [-1, 9, -1]
    assert np.isfinite(sim.get("position")).all()
    sim.reset(envs=[1])
    assert (sim.status()["status"] == "ok").all()
    sim.step(20)
    fresh = Simulator(random_pile(np.random.default_rng(5)), device=device)
    fresh.step(20)
    assert same_state(sim, 1, fresh, 0)


def test_apply_impulse(device):
    """Closed form: velocity by the impulse, spin by its moment about the centre of mass, in the chosen environments."""
    shape = Box((0.1, 0.2, 0.3))
    scene = Scene(gravity=(0, 0, 0))
    wall = scene.add_static(Plane(normal=(0, 0, 1), offset=-5))
    body = scene.add_body(shape, mass=2.0, position=(1, 0, 0), orientation=rotate_about((0, 0, 1), 90))
    sim = Simulator(scene, num_envs=3, device=device)
    impulse, point = np.array([1.0, 2.0, 3.0]), np.array([1.1, 0.05, 0.2])
    sim.apply_impulse(impulse, point, body, envs=[0, 2])
    inertia = 2.0 / 3.0 * np.array([0.1**2 + 0.3**2, 0.2**2 + 0.3**2, 0.1**2 + 0.2**2])
    spin = np.cross(point - [1, 0, 0], impulse) / inertia
    for env in (0, 2):
        np.testing.assert_allclose(sim.get("linear_velocity")[env, body], impulse / 2.0, rtol=1e-6)
        np.testing.assert_allclose(sim.get("angular_velocity")[env, body], spin, rtol=1e-5)
    assert (sim.get("linear_velocity")[1] == 0).all() and (sim.get("angular_velocity")[1] == 0).all()
    with pytest.raises(ValueError, match=r"^body: plane_0 is static, and an impulse cannot move it$"):
        sim.apply_impulse((1e6, 0, 0), (0, 0, 0), wall)
    assert (sim.get("linear_velocity")[:, wall] == 0).all()
    before = sim.get("angular_velocity")
    sim.apply_impulse((0, 0, 4.0), body=body, envs=[1])  # at the centre of mass
    assert sim.get("linear_velocity")[1, body].tolist() == [0, 0, 2]
    np.testing.assert_array_equal(sim.get("angular_velocity"), before)
    with pytest.raises(ValueError, match="^body: must be a whole number from 0 to 1, got None$"):
        sim.apply_impulse((0, 0, 1))


def test_contact_records(device):
    """Environment, bodies, place, normal, depth and force of a resting box: its weight in each environment."""
    scene = ground_scene(friction=0.5)
    box = scene.add_body(Box((0.1, 0.2, 0.1)), position=(0.5, 0, 0.1), mass=3.0)
    sim = Simulator(scene, num_envs=2, device=device)
    sim.set("gravity", (0, 0, -5), envs=[1])
    sim.step(60)
    records = sim.contacts()
    assert len(records) == sim.counts()["contacts"] == 8
    for env, gravity in enumerate((9.81, 5.0)):
        own = records[records["env"] == env]
        sign = np.where(own["body_a"] == box, 1.0, -1.0)
        assert {*zip(own["body_a"].tolist(), own["body_b"].tolist(), strict=True)} <= {(0, box), (box, 0)}
        np.testing.assert_allclose(sign * own["normal"][:, 2], 1.0, atol=1e-5)
        assert (sign * own["impulse"][:, 2]).sum() == pytest.approx(3.0 * gravity / 240, rel=1e-3)
        np.testing.assert_allclose(np.abs(own["position"][:, 0] - 0.5), 0.1, atol=1e-5)
        assert np.abs(own["depth"]).max() < 1e-4


def test_scenes_without_movers_or_contacts(device):
    """Nothing to solve is no special case for the user."""
    scene = ground_scene()
    sim = Simulator(scene, num_envs=2, device=device)
    sim.step(3)
    assert len(sim.contacts()) == 0 and sim.penetration().tolist() == [0, 0]
    lone = Scene()
    lone.add_body(Sphere(0.1))
    sim = Simulator(lone, device=device)
    sim.step(3)
    assert sim.counts()["pairs"] == 0 and sim.penetration().tolist() == [0]


SCENE = small_scene()


@pytest.mark.parametrize(
    ("attempt", "field"),
    [
        (lambda sim: sim.set("frictoin", 1.0), "name"),
        (lambda sim: sim.get("mess"), "name"),
        (lambda sim: sim.array("inertia"), "name"),
        (lambda sim: sim.set("inertia", 1.0), "name"),
        (lambda sim: sim.set("friction", -0.1), "friction"),
        (lambda sim: sim.set("restitution", 1.1), "restitution"),
        (lambda sim: sim.set("mass", 0.0, bodies=[2]), "mass"),
        (lambda sim: sim.set("mass", 1.0, bodies=[0]), "mass"),
        (lambda sim: sim.set("position", np.nan), "position"),
        (lambda sim: sim.set("position", np.zeros((5, 3))), "position"),
        (lambda sim: sim.set("linear_velocity", "fast"), "linear_velocity"),
        (lambda sim: sim.set("orientation", (0, 0, 0, 0)), "orientation"),
        (lambda sim: sim.set("gravity", (0, 1)), "gravity"),
        (lambda sim: sim.set("friction", 1.0, envs=[2]), "envs"),
        (lambda sim: sim.set("friction", 1.0, bodies=[-1]), "bodies"),
        (lambda sim: sim.set("friction", 1.0, bodies=[0.5]), "bodies"),
        (lambda sim: sim.set("shock_propagation", "three_pass"), "shock_propagation"),
        (lambda sim: sim.set("contact_iterations", -1), "contact_iterations"),
        (lambda sim: sim.set("contact_iterations", 2.5), "contact_iterations"),
        (lambda sim: sim.set("warm_starting", 3), "warm_starting"),
        (lambda sim: sim.set("contact_iterations", [1, 2, 3]), "contact_iterations"),
        (lambda sim: sim.step(-1), "count"),
        (lambda sim: sim.step(1.5), "count"),
        (lambda sim: sim.reset(envs=[7]), "envs"),
        (lambda sim: sim.apply_impulse((1, 0), (0, 0, 0), 2), "impulse"),
        (lambda sim: sim.apply_impulse((1, 0, 0), (0, 0, 0), 9), "body"),
        (lambda sim: Simulator(SCENE, num_envs=0, device=sim.device), "num_envs"),
        (lambda sim: Simulator(SCENE, seed=-1, device=sim.device), "seed"),
        (lambda sim: Simulator(SCENE, device="cuda:99"), "device"),
        (lambda sim: Simulator(Scene(), device=sim.device), "scene"),
        (lambda sim: Settings(dt=0.0), "dt"),
        (lambda sim: Settings(shock_propagation="on"), "shock_propagation"),
        (lambda sim: Settings(collision_iterations=10**6), "collision_iterations"),
    ],
)
def test_errors_name_the_field_in_one_line(device, attempt, field):
    sim = Simulator(SCENE, num_envs=2, device=device)
    before = snapshot(sim)
    with pytest.raises(ValueError) as error:
        attempt(sim)
    text = str(error.value)
    assert text.startswith(field)
    assert "\n" not in text
    assert snapshot(sim) == before


def test_no_device_given_takes_the_first_cuda_device_or_the_cpu(caplog):
    with caplog.at_level("INFO", logger="warp_rigid"):
        sim = Simulator(SCENE)
    assert sim.device == (wp.get_cuda_device() if wp.is_cuda_available() else wp.get_device("cpu"))
    assert str(sim.device) in caplog.text
