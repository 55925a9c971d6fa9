"""Playing with a scene, without a page: pace, restarts, changes, pushes and pulls."""

import math
import time
from unittest.mock import MagicMock

import numpy as np
import pytest

from warp_rigid.runs import runner
from warp_rigid.scene.shapes import Sphere
from warp_rigid.viewer.history import History
from warp_rigid.viewer.hud import Hud
from warp_rigid.viewer.session import Paced, Session

FALLING = """
import warp_rigid as wr

def scene(friction=0.5):
    made = wr.Scene()
    made.add_static(wr.Plane(), name="ground")
    made.add_body(wr.Sphere(0.1), position=(0, 0, 50.0), mass=2.0, name="ball")
    made.add_body(wr.Box((0.1, 0.2, 0.3)), position=(2, 0, 50.0), density=500.0, name="box")
    return made
"""


@pytest.fixture
def falling(tmp_path):
    path = tmp_path / "falling.py"
    path.write_text(FALLING)
    return Session(str(path), device="cpu")


def test_it_keeps_to_the_clock(falling):
    falling.running = True
    for _ in range(30):
        falling.advance(1.0 / 30.0, budget=10.0)
    assert falling.time == pytest.approx(1.0, abs=2.0 * falling.sim.settings.dt)
    falling.speed = 0.5
    for _ in range(30):
        falling.advance(1.0 / 30.0, budget=10.0)
    assert falling.time == pytest.approx(1.5, abs=2.0 * falling.sim.settings.dt)


def test_paused_it_stands_and_a_step_is_one_step(falling):
    assert falling.advance(1.0, budget=1.0) == 0 and falling.time == 0.0
    falling.step()
    assert falling.time == falling.sim.settings.dt


def test_too_little_time_does_less_and_forgets_old_debts(falling):
    falling.running = True
    falling.advance(0.01, budget=1.0)
    falling._step_seconds = 0.01
    before = falling.time
    assert falling.advance(10.0, budget=0.03) == 3
    assert falling.behind
    # A tenth of a second is the most that is made up for: 24 steps, and one begun.
    falling._step_seconds = 1e-9
    falling.advance(0.0, budget=10.0)
    assert falling.time - before <= 0.11
    assert not falling.behind


def test_restart_brings_back_the_start_bit_for_bit():
    session = Session("showcase", num_envs=2, assignments=["bodies=3"], device="cpu")
    start = session.sim.get("position").copy()
    assert not np.array_equal(start[0], start[1])
    session.step(30)
    assert not np.array_equal(session.sim.get("position"), start)
    session.restart()
    assert np.array_equal(session.sim.get("position"), start) and session.time == 0.0


def test_events_come_in_their_time_after_every_restart():
    session = Session("box_stack", device="cpu")
    (when, _), *_ = session.plan.demo.events(session.plan.scene)
    for _ in range(2):
        session.sim._world.shards.steps = round((when - 0.05) / session.sim.settings.dt)
        session.step(6)
        assert np.linalg.norm(session.sim.get("linear_velocity")[0, -1]) < 1.0
        session.step(12)
        assert session.sim.get("linear_velocity")[0, -1, 0] > 6.0
        session.restart()


def test_variant_sets_all_of_its_settings_and_a_change_by_hand_leaves_it():
    session = Session("seesaw", device="cpu")
    assert session.variant == "default"
    session.use_variant("no_contact")
    told = {name: session.sim.get(name)[0] for name in ("contact_iterations", "shock_propagation", "warm_starting")}
    assert told == {"contact_iterations": 0, "shock_propagation": "one_pass", "warm_starting": False}
    session.change("friction", 0.2)
    assert session.variant == "no_contact"
    session.change("shock_iterations", 2)
    assert session.variant is None
    session.use_variant("default")
    assert session.sim.get("contact_iterations")[0] == 10 and session.sim.get("shock_iterations")[0] == 1


def test_a_scene_without_variants_starts_with_its_own_settings(falling):
    assert falling.variant == "default"
    falling.change("contact_iterations", 3)
    assert falling.variant is None
    falling.use_variant("default")
    assert falling.variant == "default" and falling.sim.get("contact_iterations")[0] == 10


def test_it_starts_as_the_variant_default_which_changes_nothing(tmp_path):
    """Not as the first one of the file, whose settings the simulation does not have."""
    path = tmp_path / "falling.py"
    path.write_text(f"{FALLING}\nVARIANTS = {{'off': {{'shock_propagation': 'off'}}, 'default': {{}}}}\n")
    session = Session(str(path), device="cpu")
    assert session.variant == "default" and session.sim.get("shock_propagation")[0] == "two_pass"
    path.write_text(f"{FALLING}\nVARIANTS = {{'default': {{'sleeping': True}}}}\n")
    with pytest.raises(ValueError, match="VARIANTS default must be {}; the settings of the scene are SETTINGS"):
        Session(str(path), device="cpu")


def test_verdicts_are_those_of_a_run():
    session = Session("seesaw", device="cpu")
    plan = runner.plan_run(runner.find_scene("seesaw"), device="cpu", fps=30)
    expected = {verdict.name: verdict.values[0] for verdict in runner.execute(plan).verdicts}
    session._judge = lambda action, *arguments: action(*arguments)
    for _ in range(120):
        session.step(8)
    assert {verdict.name: verdict.values[0] for verdict in session.verdicts} == expected


def test_verdicts_that_take_long_are_seldom_renewed_while_it_runs(monkeypatch):
    """Those of meshes take 0.1 s and more, in which the page would stand still; a pause shows them as they are."""
    session, judged = Session("seesaw", device="cpu"), []
    monkeypatch.setattr(Session, "verdicts", property(lambda session: judged.append(busy(0.02)) or []))
    hud = Hud(MagicMock())
    hud._refresh = lambda action, *arguments: action(*arguments)
    for session.running, most in ((True, 1), (False, 9)):
        for _ in range(8):
            hud.update(session, np.arange(1), 60.0, 1.0)
        assert len(judged) == most


def test_another_time_step_goes_on_from_the_same_state(falling):
    falling.step(24)
    falling.change("contact_iterations", 3)
    falling.sim.set("mass", 7.0, bodies=[2])
    before = {name: falling.sim.get(name) for name in ("position", "linear_velocity", "mass")}
    falling.change("dt", 1.0 / 960.0)
    assert falling.sim.settings.dt == 1.0 / 960.0 and falling.time == pytest.approx(0.1)
    for name, value in before.items():
        assert np.array_equal(falling.sim.get(name), value)
    assert falling.sim.get("contact_iterations")[0] == 3
    falling.step(96)
    assert falling.time == pytest.approx(0.2)
    # Free fall of semi-implicit steps, whose speed is exact.
    assert falling.sim.get("linear_velocity")[0, 1, 2] == pytest.approx(-9.81 * 0.2, rel=1e-4)


def test_events_wait_for_their_time_through_a_change_of_the_step():
    session = Session("box_stack", device="cpu")
    session.sim._world.shards.steps = round(4.9 / session.sim.settings.dt)
    session.change("dt", 1.0 / 480.0)
    session.step(24)
    assert np.linalg.norm(session.sim.get("linear_velocity")[0, -1]) < 1.0
    session.step(48)
    assert session.sim.get("linear_velocity")[0, -1, 0] > 6.0


def test_what_is_refused_changes_nothing(falling):
    with pytest.raises(ValueError, match="restitution"):
        falling.change("restitution", 2.0)
    with pytest.raises(ValueError, match="dt"):
        falling.change("dt", 0.0)
    assert falling.sim.settings.dt == 1.0 / 240.0 and (falling.sim.get("restitution") == 0.0).all()


def test_full_turns_of_hinges_stay_with_another_step(tmp_path):
    """A motor of 20 rad/s for 0.6 s: twelve radians, with a time step that changes on the way and with a body more."""
    path = tmp_path / "motor.py"
    path.write_text(
        "import warp_rigid as wr\n\ndef scene():\n    made = wr.Scene(gravity=(0, 0, 0))\n"
        "    made.add_body(wr.Box((0.2, 0.03, 0.03)), mass=1.0)\n    made.add_joint(wr.RevoluteJoint((0, 0, 1)), 0)\n"
        "    made.add_drive(0, damping=10.0, target_velocity=20.0)\n    return made\n"
    )
    session = Session(str(path), device="cpu")
    session.step(48)
    session.change("dt", 1.0 / 480.0)
    session.step(96)
    session.spawn(Sphere(0.1), np.array([[5.0, 0.0, 0.0]]))
    session.step(96)
    assert session.sim.get("joint_position")[0, 0] == pytest.approx(12.0, abs=0.1)


def test_push_through_the_centre_changes_the_velocity_by_as_much(falling):
    impulse = falling.push(0, 1, np.array([0.0, 0.0, 50.0]), np.array([3.0, 0.0, 1.0]))
    assert impulse == pytest.approx([6.0, 0.0, 2.0])
    assert falling.sim.get("linear_velocity")[0, 1] == pytest.approx([3.0, 0.0, 1.0], abs=1e-6)
    assert falling.sim.get("angular_velocity")[0, 1] == pytest.approx([0.0, 0.0, 0.0], abs=1e-6)
    assert falling.push(0, 0, np.zeros(3), np.array([0.0, 0.0, 1.0])) == pytest.approx([0.0, 0.0, 0.0])


def test_pull_brings_the_held_place_to_the_pointer_and_lets_go(falling):
    corner = np.array([2.1, 0.2, 50.3])
    target = np.array([3.0, 0.5, 51.0])
    falling.pull(0, 2, corner, target)
    for _ in range(150):
        falling.step(8)
    env, held, end = falling.pull_ends
    assert env == 0 and np.array_equal(end, target)
    assert held == pytest.approx(target, abs=0.02)
    falling.move_pull(target + [0.0, 0.0, 1.0])
    for _ in range(150):
        falling.step(8)
    assert falling.pull_ends[1] == pytest.approx(target + [0.0, 0.0, 1.0], abs=0.02)
    falling.release()
    assert falling.pull_ends is None
    assert (falling.sim.get("force") == 0.0).all() and (falling.sim.get("torque") == 0.0).all()


def test_another_thread_may_let_go_while_the_ends_are_asked_for(falling, monkeypatch):
    falling.pull(0, 2, falling.sim.get("position")[0, 2], np.array([0.0, 0.0, 2.0]))
    get = falling.sim.get

    def release_and_get(name):
        falling._pull = None
        return get(name)

    monkeypatch.setattr(falling.sim, "get", release_and_get)
    assert falling.pull_ends is not None
    assert falling.pull_ends is None


def busy(seconds):
    end = time.thread_time() + seconds
    while time.thread_time() < end:
        pass


@pytest.mark.parametrize(("patience", "least", "most"), [(math.inf, 2, 11), (0.02, 12, 26)])
def test_paced_keeps_to_its_share_but_not_beyond_its_patience(patience, least, most):
    runs = []
    paced = Paced(share=0.1, patience=patience)
    end = time.perf_counter() + 0.5
    while time.perf_counter() < end:
        paced(lambda: (runs.append(0), busy(0.005)))
        time.sleep(0.001)
    assert least <= len(runs) <= most


def test_joints_stay_as_they_were_set_through_a_change_of_the_step():
    session = Session("crane", device="cpu")
    session.sim.set("joint_target_velocity", 0.1, joints="winch")
    session.sim.set("joint_broken", True, joints="rope")
    before = {name: session.sim.get(name) for name in ("joint_target_velocity", "joint_broken", "joint_damping")}
    session.change("dt", 1.0 / 480.0)
    for name, value in before.items():
        assert np.array_equal(session.sim.get(name), value)


FIELDS = """
import warp_rigid as wr

def scene():
    made = wr.Scene(gravity=(0, 0, 0))
    made.add_force_field(wr.UniformField((1.0, 0.0, 0.0)))
    made.add_force_field(wr.PointField((0.0, 0.0, 9.0), 2.0))
    made.add_body(wr.Sphere(0.1))
    return made
"""


def test_force_fields_stay_as_they_were_set_through_a_change_of_the_step(tmp_path):
    path = tmp_path / "fields.py"
    path.write_text(FIELDS)
    session = Session(str(path), assignments=("field_strength=7",), device="cpu")
    session.sim.set("field_acceleration", (0.0, 3.0, 0.0))
    names = ("field_strength", "field_acceleration", "field_center")
    before = {name: session.sim.get(name) for name in names}
    session.change("dt", 1.0 / 480.0)
    for name, value in before.items():
        np.testing.assert_array_equal(session.sim.get(name), value)


LIFT = """
import warp_rigid as wr

def scene():
    made = wr.Scene()
    path = wr.PosePath((0.0, 4.0), ((0, 0, 0), (0, 0, 4.0)))
    made.add_kinematic(wr.Box((0.5, 0.5, 0.1)), path=path, name="lift")
    made.add_body(wr.Sphere(0.1), position=(0, 0, 0.2))
    return made
"""


@pytest.mark.parametrize("change", ["dt", "spawn"])
def test_a_body_continues_on_its_path_in_a_new_simulator(tmp_path, change):
    path = tmp_path / "lift.py"
    path.write_text(LIFT)
    session = Session(str(path), num_envs=2, device="cpu")
    session.step(round(1.0 / session.sim.settings.dt))
    if change == "dt":
        session.change("dt", 1.0 / 480.0)
    else:
        session.spawn(Sphere(0.1), np.array([(2.0, 0.0, 5.0)] * 2))
    assert session.time == pytest.approx(1.0)
    np.testing.assert_allclose(session.sim.get("position")[:, 0, 2], 1.0, atol=0.01)
    session.step(round(1.0 / session.sim.settings.dt))
    assert session.time == pytest.approx(2.0)
    np.testing.assert_allclose(session.sim.get("position")[:, :2, 2], [[2.0, 2.2]] * 2, atol=0.01)
    session.restart()
    session.step(round(1.0 / session.sim.settings.dt))
    np.testing.assert_allclose(session.sim.get("position")[:, 0, 2], 1.0, atol=0.01)


def test_a_body_on_a_path_continues_from_an_earlier_moment(tmp_path):
    path = tmp_path / "lift.py"
    path.write_text(LIFT)
    session, history = Session(str(path), device="cpu"), History()
    second = round(1.0 / session.sim.settings.dt)
    for _ in range(2):
        session.step(second)
        history.add(session.time, session.sim)
    session.show(history.moments[0])
    assert session.time == pytest.approx(1.0)
    session.step(second // 2)
    assert session.time == pytest.approx(1.5)
    np.testing.assert_allclose(session.sim.get("position")[0, :, 2], [1.5, 1.7], atol=0.01)
