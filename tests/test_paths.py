"""Kinematic bodies that follow a path: lifts, doors and gates, and what they do with other bodies."""

import numpy as np
import pytest

import warp_rigid as wr
from tests.oracles import rotate_about
from warp_rigid import rotations

UP = wr.PosePath([0.0, 0.5, 1.5, 2.0], [(0, 0, 0.05), (0, 0, 0.05), (0, 0, 1.05), (0, 0, 1.05)])
"""A lift that rises by 1 m from 0.5 s to 1.5 s."""

TURNS = [rotate_about((0, 0, 1), angle) for angle in (0, 100, 200, 300, 360)]
ROUND = wr.PosePath([0.0, 1.0, 1.5, 2.5, 3.0], [(1, 2, 0.5)] * 5, TURNS, loop=True)
"""A door that turns round and round, unevenly."""

DTS = [pytest.param(1 / 60, id="60"), pytest.param(1 / 240, id="240")]


def lift_scene(path=UP):
    scene = wr.Scene()
    scene.add_static(wr.Plane())
    scene.add_kinematic(wr.Box((0.5, 0.5, 0.05)), path=path, name="lift")
    scene.add_body(wr.Box((0.1, 0.1, 0.1)), position=(0, 0, 0.2), name="box")
    return scene


def angle_between(q, r):
    return 2.0 * np.arccos(np.clip(np.abs((q * r).sum(-1)), 0.0, 1.0))


def test_a_path_interpolates_its_keyframes():
    """Evenly in place and angle; the first pose before it, the last one after it."""
    path = wr.PosePath([1.0, 3.0], [(0, 0, 0), (2, 0, 4)], [(0, 0, 0, 2), rotate_about((1, 0, 0), 120)])
    for time, share in ((0.0, 0.0), (1.0, 0.0), (1.5, 0.25), (2.0, 0.5), (3.0, 1.0), (9.0, 1.0)):
        position, orientation = path.at(time)
        np.testing.assert_allclose(position, (2 * share, 0, 4 * share), atol=1e-12)
        np.testing.assert_allclose(orientation, rotate_about((1, 0, 0), 120 * share), atol=1e-12)
    turning = [ROUND.at(time + 6.0)[1] for time in (0.5, 1.25, 2.0, 2.75)]
    expected = np.array([rotate_about((0, 0, 1), angle) for angle in (50, 150, 250, 330)])
    assert angle_between(np.array(turning), expected).max() < 1e-6


@pytest.mark.parametrize("dt", DTS)
def test_bodies_are_where_their_paths_are(device, dt):
    """After every step, of an off-centre body too, whose centre of mass moves on an arc."""
    hammer = wr.Compound([(wr.Box((0.4, 0.05, 0.05)), (0.4, 0, 0), (0, 0, 0, 1))])
    scene = lift_scene()
    scene.add_kinematic(hammer, path=ROUND, name="door")
    sim = wr.Simulator(scene, settings=wr.Settings(dt=dt), device=device)
    for _ in range(round(7.0 / dt)):
        before = sim.get("center_of_mass")[0, 3]
        sim.step()
        for body in (1, 3):
            position, orientation = scene.bodies[body].path.at(sim.time)
            np.testing.assert_allclose(sim.get("position")[0, body], position, atol=2e-6)
            assert angle_between(sim.get("orientation")[0, body].astype(float), orientation) < 1e-3
        way = sim.get("center_of_mass")[0, 3] - before
        np.testing.assert_allclose(sim.get("linear_velocity")[0, 3], way / dt, atol=2e-6 / dt)


@pytest.mark.parametrize("loop", [False, True], ids=["once", "loop"])
@pytest.mark.parametrize("turn", [100.0, 170.0, -170.0, 120.0])
def test_a_rotor_can_turn_by_more_than_half_a_turn_in_a_step(device, turn, loop):
    """Its velocity is that of the path, not that of the shorter way round; at 120 degrees it turns twice a step."""
    times, dt = np.arange(37) / 100, 0.06 if turn == 120.0 else 1 / 60
    turns = [rotate_about((0, 0.6, 0.8), turn * k) for k in range(37)]
    scene = wr.Scene(gravity=(0, 0, 0))
    velocity = np.radians(turn) * 100 * np.array([0, 0.6, 0.8])
    rotor = wr.PosePath(times, np.zeros((37, 3)), turns, loop=loop)
    scene.add_kinematic(wr.Box((0.3, 0.05, 0.05)), path=rotor, name="rotor")
    sim = wr.Simulator(scene, settings=wr.Settings(dt=dt), device=device)
    for _ in range(round((0.6 if loop else 0.35) / dt)):
        sim.step()
        np.testing.assert_allclose(sim.get("angular_velocity")[0, 0], velocity, rtol=1e-5, atol=1e-4)
        assert angle_between(sim.get("orientation")[0, 0].astype(float), rotor.at(sim.time)[1]) < 1e-3


@pytest.mark.parametrize("dt", DTS)
@pytest.mark.parametrize("shock", ["off", "one_pass", "two_pass"])
def test_a_lift_carries_a_box(device, dt, shock):
    """The box stays on it: while it stands, from its start with a jerk, and while it rises."""
    settings = wr.Settings(dt=dt, shock_propagation=shock)
    sim = wr.Simulator(lift_scene(), settings=settings, device=device)
    for _ in range(round(1.4 / dt)):
        sim.step()
        top = UP.at(sim.time)[0][2] + 0.05
        assert sim.get("position")[0, 2, 2] - 0.1 == pytest.approx(top, abs=0.01 * top)
    assert sim.get("linear_velocity")[0, 2, 2] == pytest.approx(1.0, rel=0.01)


def test_a_gate_holds_parcels_back(device):
    """On a belt of 0.5 m/s: none passes while it is closed, and all pass when it has risen."""
    scene = wr.Scene()
    scene.add_static(wr.Box((5, 0.3, 0.1)), position=(0, 0, -0.1), surface_velocity=(0.5, 0, 0), name="belt")
    path = wr.PosePath([0.0, 3.0, 3.5], [(1, 0, 0.3), (1, 0, 0.3), (1, 0, 1.0)])
    scene.add_kinematic(wr.Box((0.05, 0.3, 0.28)), path=path, friction=0.0, name="gate")
    parcels = [
        scene.add_body(wr.Box((0.1, 0.1, 0.1)), position=(x, 0, 0.1), name=f"parcel_{k}")
        for k, x in enumerate((-0.8, -0.2, 0.4))
    ]
    sim = wr.Simulator(scene, settings=wr.Settings(dt=1 / 120), device=device)
    sim.step(360)
    place = sim.get("position")[0, parcels, 0]
    assert place[2] == pytest.approx(0.85, abs=0.01) and place.max() < 0.86
    assert place[1] == pytest.approx(0.65, abs=0.02)
    sim.step(360)
    # The gate clears a parcel when it has risen by 0.18 m; the way to the speed v costs v^2 / (2 mu g).
    way = 0.5 * (3.0 - 0.5 * 0.18 / 0.7) - 0.5**2 / (2 * 0.5 * 9.81)
    np.testing.assert_allclose(sim.get("position")[0, parcels[1:], 0] - place[1:], way, rtol=0.01)


def test_a_body_on_a_lift_at_rest_sleeps_and_wakes(device):
    settings = wr.Settings(dt=1 / 60, sleeping=True)
    path = wr.PosePath([0.0, 2.0, 3.0], [(0, 0, 0.05), (0, 0, 0.05), (0, 0, 1.05)])
    sim = wr.Simulator(lift_scene(path), settings=settings, device=device)
    sim.step(110)
    assert sim.get("asleep")[0, 2]
    sim.step(60)
    assert not sim.get("asleep")[0, 2]
    assert sim.get("position")[0, 2, 2] == pytest.approx(0.2 + 50 / 60, rel=0.01)
    sim.step(60)
    assert sim.get("asleep")[0, 2] and not sim.get("linear_velocity")[0, 1].any()


def test_scenes_with_different_paths_are_simulated_together(device):
    """Those without a path, too."""
    other = wr.PosePath(UP.times, UP.positions * [1, 1, 0.5])
    flat = wr.Scene()
    flat.add_static(wr.Plane())
    flat.add_body(wr.Sphere(0.1), position=(0, 0, 0.1))
    sim = wr.Simulator([lift_scene(), flat, lift_scene(other)], num_envs=2, device=device)
    sim.step(240)
    height = sim.get("position")[:, 1, 2]
    np.testing.assert_allclose(height[[0, 2, 3, 5]], [0.55, 0.275, 0.55, 0.275], atol=1e-5)


def test_recordings_and_usd_keep_the_path(device, tmp_path):
    """Written as a film and read again, the lift moves as before."""
    sim = wr.Simulator(lift_scene(), device=device)
    recording = wr.record(sim, frames=120, fps=60)
    wr.export_usd(recording, tmp_path / "lift.usda", profile="scene")
    scene = wr.import_usd(tmp_path / "lift.usda", strict=True)
    read = next(body for body in scene.bodies if body.name == "lift")
    for time in np.linspace(0.0, 2.0, 33):
        np.testing.assert_allclose(read.path.at(time)[0], UP.at(time)[0], atol=0.02)
    again = wr.Simulator(scene, device=device)
    again.step(240)
    assert again.get("position")[0, 2, 2] == pytest.approx(0.7, rel=0.01)


def test_what_the_path_prescribes_is_not_set(device):
    sim = wr.Simulator(lift_scene(), device=device)
    for name in ("position", "linear_velocity", "angular_velocity"):
        with pytest.raises(ValueError, match=f"^{name}: lift follows a path"):
            sim.set(name, (1, 2, 3), bodies=["lift", "box"])
    sim.set("position", sim.get("position"))
    sim.step(240)
    assert sim.get("position")[0, 1, 2] == pytest.approx(0.55, abs=1e-5)


BAD = {
    "times: must be numbers of the shape": ("now", [(0, 0, 0)] * 2),
    "times: must be at least two increasing numbers >= 0": ([0.0], [(0, 0, 0)]),
    "times: must be at least two increasing numbers >= 0 ": ([0.0, 0.0], [(0, 0, 0)] * 2),
    "times: must be at least two increasing numbers >= 0  ": ([-1.0, 0.0], [(0, 0, 0)] * 2),
    "times: must be finite": ([0.0, np.inf], [(0, 0, 0)] * 2),
    "positions: must be numbers of the shape": ([0, 1], [(0, 0, 0)]),
    "positions: must be finite": ([0, 1], [(0, 0, 0), (0, np.nan, 0)]),
    "orientations: must be numbers of the shape": ([0, 1], [(0, 0, 0)] * 2, [(0, 0, 0)] * 2),
    "orientations: must be quaternions": ([0, 1], [(0, 0, 0)] * 2, [(0, 0, 0, 0)] * 2),
    "loop: must be True or False": ([0, 1], [(0, 0, 0)] * 2, None, "yes"),
    "loop: the last pose must be the first": ([0, 1], [(0, 0, 0), (0, 0, 1)], None, True),
    "loop: the last pose must be the first ": ([0, 1], [(0, 0, 0)] * 2, [(0, 0, 0, 1), (0, 0, 1, 0)], True),
}


@pytest.mark.parametrize("message", BAD)
def test_bad_paths_are_refused(message):
    with pytest.raises(ValueError, match=f"^{message.strip()}") as error:
        wr.PosePath(*BAD[message])
    assert "\n" not in str(error.value)


def test_a_path_has_the_pose_and_the_velocity():
    scene = wr.Scene()
    for given in ({"position": (0, 0, 1)}, {"orientation": (1, 0, 0, 0)}, {"linear_velocity": (0, 0, 1)}):
        (name,) = given
        with pytest.raises(ValueError, match=f"^{name}: must not be given together with a path"):
            scene.add_kinematic(wr.Sphere(1), path=UP, **given)
    with pytest.raises(ValueError, match="^path: must be a PosePath"):
        scene.add_kinematic(wr.Sphere(1), path=[(0, 0, 0)])
    body = scene.bodies[scene.add_kinematic(wr.Sphere(1), path=ROUND)]
    assert body.position == (1, 2, 0.5)
    np.testing.assert_allclose(rotations.rotate(body.orientation, (1, 0, 0)), (1, 0, 0), atol=1e-12)
