"""Watches and observers: impulses against momenta, contacts against times of fall, and what they cost."""

import numpy as np
import pytest

import warp_rigid as wr
from warp_rigid.engine.step import Stages

DT, GRAVITY = 1 / 240, 9.81


def drop(height=0.5, restitution=0.0, mass=2.0, extra=True):
    """A ball above the ground, and a box that rests some way off."""
    scene = wr.Scene()
    scene.add_static(wr.Plane(), restitution=1.0, name="ground")
    scene.add_body(wr.Sphere(0.1), position=(0, 0, 0.1 + height), mass=mass, restitution=restitution, name="ball")
    if extra:
        scene.add_body(wr.Box((0.1, 0.1, 0.1)), position=(2, 0, 0.1), mass=3.0, name="box")
    return scene


@pytest.mark.parametrize("restitution", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("collision_first", [True, False])
def test_impulse_of_an_impact_is_the_change_of_momentum(device, restitution, collision_first):
    """The ball arrives with sqrt(2 g h); a step of the fall more or less changes that by g dt."""
    settings = wr.Settings(collision_first=collision_first)
    sim = wr.Simulator(drop(restitution=restitution), settings=settings, device=device)
    sim.watch([None, "ball", ("ground", "box"), ("ball", "box")])
    speed = np.sqrt(2 * GRAVITY * 0.5)
    sim.step(round(1.4 * speed / GRAVITY / DT))
    found = {name: values[0] for name, values in sim.watched().items()}
    impulse = 2.0 * (1 + restitution) * speed
    # Without a bounce, a ball that is about to touch is slowed to reach the ground first, and stopped a step later.
    assert (0.5 if restitution == 0.0 else 0.95) * impulse < found["peak_impulse"][1] < 1.02 * impulse
    gained = 2.0 * (sim.get("linear_velocity")[0, 1, 2] + GRAVITY * sim.time)
    assert found["summed_impulse"][1] == pytest.approx(gained, rel=1e-4)
    assert found["peak_impulse"][0] == found["peak_impulse"][1]
    assert found["first_contact"][1] == pytest.approx(speed / GRAVITY, abs=3 * DT)
    assert found["peak_impulse"][2] == pytest.approx(3.0 * GRAVITY * DT, rel=0.05)
    assert found["summed_impulse"][2] == pytest.approx(3.0 * GRAVITY * sim.time, rel=0.01)
    assert found["first_contact"][2] == pytest.approx(DT)
    assert found["impacts"][1:].tolist() == [1, 1, 0]
    assert found["peak_impulse"][3] == 0.0 and np.isnan(found["first_contact"][3])
    assert 0.0 <= found["largest_overlap"][1] < speed * DT


def test_every_bounce_is_counted(device):
    """A ball that keeps all its speed touches the ground once in 2 sqrt(2 h / g)."""
    sim = wr.Simulator(drop(0.2, 1.0, extra=False), device=device)
    sim.watch(["ball"])
    period = 2 * np.sqrt(2 * 0.2 / GRAVITY)
    sim.step(round(5.0 * period / DT))
    found = sim.watched()
    assert found["impacts"][0, 0] == 5
    assert found["rest_time"][0, 0] == pytest.approx(sim.time)
    assert found["summed_impulse"][0, 0] == pytest.approx(5 * found["peak_impulse"][0, 0], rel=0.02)


def test_summed_impulse_holds_the_weight(device):
    """Over a fall and the rest after it the ground gives back what gravity gave: m g t."""
    sim = wr.Simulator([drop(0.3, mass=mass, extra=False) for mass in (1e-3, 1.0, 1e3)], device=device)
    sim.watch([("ball", "ground")])
    sim.step(480)
    np.testing.assert_allclose(
        sim.watched()["summed_impulse"][:, 0] / (GRAVITY * sim.time), [1e-3, 1.0, 1e3], rtol=2e-3
    )
    assert sim.watched()["rest_time"][1, 0] == pytest.approx(np.sqrt(2 * 0.3 / GRAVITY), abs=3 * DT)


@pytest.mark.parametrize("size", [1e-4, 1e-3, 100.0])
def test_summed_impulse_holds_at_every_scale(device, size):
    """A cube at rest, of 1 ug to 2500 t: in steps that scale with it, the ground carries m g t."""
    scene = wr.Scene()
    scene.add_static(wr.Plane(), name="ground")
    scene.add_body(wr.Box((size / 2,) * 3), position=(0, 0, size / 2), name="cube")
    sim = wr.Simulator(scene, settings=wr.Settings(dt=float(DT * np.sqrt(size / 0.2))), device=device)
    sim.watch(["cube"])
    sim.step(240)
    weight = sim.get("mass")[0, 1] * GRAVITY
    assert sim.watched()["summed_impulse"][0, 0] == pytest.approx(weight * sim.time, rel=1e-5)


def test_summed_impulse_of_sleeping_bodies(device):
    """Asleep, two boxes still press on each other and on the ground: m g t. A wall that they do not touch has none."""
    scene = wr.Scene()
    scene.add_static(wr.Plane(), name="ground")
    scene.add_static(wr.Box((0.1, 1, 1)), position=(0.201, 0, 1), name="wall")
    for i, name in enumerate(("lower", "upper")):
        scene.add_body(wr.Box((0.1, 0.1, 0.1)), position=(0, 0, 0.1 + 0.2 * i), mass=2.0, name=name)
    sim = wr.Simulator(scene, settings=wr.Settings(sleeping=True), device=device)
    sim.watch([("lower", "ground"), "upper", ("upper", "wall")])
    sim.step(480)
    assert sim.get("asleep")[0, 2:].all()
    found = {name: values[0] for name, values in sim.watched().items()}
    expected = np.array([4.0, 2.0, 0.0]) * GRAVITY * sim.time
    np.testing.assert_allclose(found["summed_impulse"], expected, rtol=1e-3)
    assert found["impacts"].tolist() == [1, 1, 0] and np.isnan(found["first_contact"][2])
    sim.set("force", (0, 0, -1.0), bodies=["upper"])
    sim.step(60)
    assert sim.watched()["impacts"][0].tolist() == [1, 1, 0]


def test_watches_change_no_bit_and_do_not_depend_on_the_batch(device):
    scenes = [drop(0.3, 0.5), drop(0.1, 0.0, extra=False)]
    plain, sim = (wr.Simulator(scenes, num_envs=2, device=device) for _ in range(2))
    sim.watch(["box", ("ball", "ground")])
    for some in (plain, sim):
        some.step(120)
    np.testing.assert_array_equal(plain.get("position"), sim.get("position"))
    assert np.isnan(sim.watched()["first_contact"][1, 0])
    alone = wr.Simulator(scenes[0], device=device)
    alone.watch(["box", ("ground", "ball")])
    alone.step(120)
    for name, values in alone.watched().items():
        np.testing.assert_array_equal(sim.watched()[name][[0, 2]], values.repeat(2, axis=0), name)


def test_repeated_steps_count_once(device):
    """Steps that are undone because a pool was too small leave nothing behind."""
    found = []
    for capacity in ({"pairs": 1, "contacts": 1}, None):
        sim = wr.Simulator(drop(0.2, 0.5), num_envs=3, device=device, capacity=capacity)
        sim.watch([None, "ball"])
        sim.step(100)
        found.append(sim.watched())
    for name in found[0]:
        np.testing.assert_array_equal(found[0][name], found[1][name], name)


def test_a_reset_begins_anew(device):
    sim = wr.Simulator(drop(), num_envs=2, device=device)
    sim.watch([None])
    sim.step(60)
    kept = sim.watched()["summed_impulse"][1]
    sim.reset(envs=[0])
    assert sim.watched()["summed_impulse"][0] == 0.0 and np.isnan(sim.watched()["first_contact"][0])
    assert sim.watched()["summed_impulse"][1] == kept > 0


@pytest.mark.parametrize(
    "watched", ["box", [], ["lid"], [("ball", "box", "ground")], [1.5], [99], [(1, 1)], [("ball", 1)]]
)
def test_bad_watches_are_named(watched):
    sim = wr.Simulator(drop(), device="cpu")
    with pytest.raises(ValueError, match="^watched: "):
        sim.watch(watched)
    with pytest.raises(ValueError, match="^watched: nothing is watched"):
        sim.watched()


def test_changes_before_the_first_step_cost_one_recording(device, monkeypatch):
    made = []

    def recorded(stages, step=Stages.step):
        made.append(stages)
        step(stages)

    monkeypatch.setattr(Stages, "step", recorded)
    sim = wr.Simulator(drop(), device=device)
    sim.watch([None])
    sim.set("sleeping", True)
    sim.set("shock_iterations", 2)
    sim.step(2)
    sim.step(2)
    assert len(made) == len(list(sim._world.shards))
