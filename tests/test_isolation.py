"""A simulator owns its scene, and a call that is refused changes nothing."""

import numpy as np
import pytest

import warp_rigid as wr
from warp_rigid.engine.quantities import WRITABLE

WATCHED = (*WRITABLE, "kinetic_energy", "potential_energy")


@pytest.fixture
def sim():
    return make()[1]


def make():
    scene = wr.Scene()
    scene.add_static(wr.Plane())
    scene.add_body(wr.Box((0.1, 0.1, 0.1)), position=(0, 0, 0.1))
    scene.add_body(wr.Sphere(0.1), position=(0, 0, 0.4))
    return scene, wr.Simulator(scene, num_envs=2, device="cpu")


def state(sim):
    return {name: np.asarray(sim.get(name)).tobytes() for name in WATCHED}


def test_a_scene_that_changes_later_does_not_change_the_simulator(tmp_path):
    scene, sim = make()
    sim.save(tmp_path / "before.ckpt")
    energy = sim.get("potential_energy")
    scene.add_body(wr.Box((1, 1, 1)), position=(5, 0, 1))
    scene.add_force_field(wr.UniformField((0, 0, 100)))
    scene.filter_pair(0, 1)
    scene.gravity = (0, 0, 5.0)
    assert np.array_equal(sim.get("potential_energy"), energy)
    sim.save(tmp_path / "after.ckpt")
    again = wr.Simulator.load(tmp_path / "after.ckpt", "cpu")
    assert again.num_bodies == sim.num_bodies == len(sim.scene.bodies) == 3 and not again.scene.force_fields
    before = wr.Simulator.load(tmp_path / "before.ckpt", "cpu")
    for one in (sim, again, before):
        one.step(60)
    assert state(sim) == state(again) == state(before)
    assert sim.get("position")[0, 1, 2] == pytest.approx(0.1, abs=1e-3), "still upon the plane"


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (((0, 0, 1e12), (1e30, 0, 0), 1), "impulse: angular_velocity: must be finite numbers"),
        (((0, 0, 1), (0, 0, 0), None), "body: must be a whole number from 0 to 2, got None"),
        (((0, 0, 1), (0, 0, 0), 1.0), "body: must be a whole number from 0 to 2, got 1.0"),
        (((0, 0, 1), (0, 0, 0), [1, 2]), "body: must be a whole number from 0 to 2"),
        (((0, 0, 1), (0, 0, 0), 3), "body: must be a whole number from 0 to 2, got 3"),
        ((("0", "0", "1"), (0, 0, 0), 1), "impulse: must be numbers that broadcast"),
    ],
)
def test_a_refused_impulse_changes_nothing(sim, arguments, told):
    before = state(sim)
    with pytest.raises(ValueError, match=f"^{told}"):
        sim.apply_impulse(*arguments)
    assert state(sim) == before


@pytest.mark.parametrize(
    ("name", "value", "bodies", "told"),
    [
        ("friction", "0.5", None, "friction: must be numbers"),
        ("friction", ["0.5"], None, "friction: must be numbers"),
        ("friction", b"1", None, "friction: must be numbers"),
        ("friction", 0.5 + 0j, None, "friction: must be numbers"),
        ("friction", True, None, "friction: must be numbers"),
        ("friction", [None], None, "friction: must be numbers"),
        ("friction", 1e39, None, "friction: must be finite"),
        ("linear_velocity", (0, 0, np.nan), None, "linear_velocity: must be finite"),
        ("gravity", "0", None, "gravity: must be vectors of 3 numbers"),
        ("mass", 2.0, [1, 0], "mass: must be 0 for plane_0"),
        ("mass", 1e8, [1], "mass: the heaviest dynamic body must have at most 1e.06 times the mass of the lightest"),
        ("active", 1, None, "active: must be True or False"),
        ("active", "True", None, "active: must be True or False"),
    ],
)
def test_a_refused_value_changes_nothing(sim, name, value, bodies, told):
    before = state(sim)
    with pytest.raises(ValueError, match=f"^{told}"):
        sim.set(name, value, bodies=bodies)
    assert state(sim) == before


@pytest.mark.parametrize("dt", [1e-45, 1e-10, 0.0, -1.0, 1.1, "0.01", True, None, np.nan])
def test_time_steps_that_are_none_are_refused(dt):
    with pytest.raises(ValueError, match="^dt: must be a number from 1e-09 to 1, got "):
        wr.Settings(dt=dt)


def one_body(shape, **options):
    scene = wr.Scene()
    scene.add_static(wr.Plane())
    scene.add_body(shape, **options)
    return scene


def test_what_single_precision_does_not_carry_is_refused():
    with pytest.raises(ValueError, match=r"^body 1 \(needle\): must have moments of inertia that differ by at most"):
        wr.Simulator(one_body(wr.Box((0.5, 5e-5, 5e-5)), name="needle"), device="cpu")
    wr.Simulator(one_body(wr.Box((0.5, 1e-4, 1e-4))), device="cpu")
    for plane in ({"shape": wr.Plane(offset=1e5)}, {"shape": wr.Plane(), "position": (0, 0, -1e5)}):
        scene = one_body(wr.Box((0.1, 0.1, 0.1)))
        scene.add_static(**plane)
        with pytest.raises(ValueError, match=r"^body 2 \(plane_2\): must be closer to the origin along gravity, got "):
            wr.Simulator(scene, device="cpu")
    wr.Simulator(one_body(wr.Box((0.1, 0.1, 0.1)), position=(1e7, 0, 1e7)), device="cpu")
    heavy = one_body(wr.Box((0.1, 0.1, 0.1)), mass=1.0)
    heavy.add_body(wr.Box((0.1, 0.1, 0.1)), position=(0, 0, 0.4), mass=1e7)
    with pytest.raises(ValueError, match="^mass: the heaviest dynamic body must have at most 1e.06 times the mass"):
        wr.Simulator(heavy, device="cpu")


def test_what_is_no_scene_is_refused():
    for scene in (None, "box_stack", wr.Box((1, 1, 1))):
        with pytest.raises(ValueError, match="^scene: must be a Scene or a list of at least one Scene, got "):
            wr.Simulator(scene, device="cpu")
