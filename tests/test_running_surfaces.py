"""Surfaces that run: conveyor belts and turntables, against closed forms of Coulomb friction."""

import numpy as np
import pytest

import warp_rigid as wr
from tests.oracles import rotate_about, stages_of
from warp_rigid.runs.runner import execute, find_scene, plan_run

G = 9.81
HALF = 0.1
SETTINGS = [
    pytest.param(dt, shock, warm, id=f"{shock}-{'warm' if warm else 'cold'}-{round(1 / dt)}")
    for dt in (1 / 60, 1 / 240)
    for shock in ("off", "one_pass", "two_pass")
    for warm in (True, False)
]


def belt_scene(speed=2.0, friction=0.5, slope=0.0, length=20.0):
    """A parcel at rest on a belt that rises along x."""
    scene = wr.Scene()
    tilt = rotate_about((0, 1, 0), -slope)
    normal = np.array([-np.sin(np.radians(slope)), 0.0, np.cos(np.radians(slope))])
    scene.add_static(
        wr.Box((length, 0.5, 0.1)),
        position=-0.1 * normal,
        orientation=tilt,
        surface_velocity=(speed, 0, 0),
        friction=friction,
        name="belt",
    )
    parcel = wr.Box((HALF,) * 3)
    scene.add_body(parcel, position=HALF * normal, orientation=tilt, friction=friction, name="parcel")
    return scene


def simulated(scene, dt=1 / 240, shock="two_pass", warm=True, device=None, **more):
    settings = wr.Settings(dt=dt, shock_propagation=shock, warm_starting=warm, **more)
    return wr.Simulator(scene, settings=settings, device=device)


def speed_along(sim, body, slope=0.0):
    direction = np.array([np.cos(np.radians(slope)), 0.0, np.sin(np.radians(slope))])
    return sim.get("linear_velocity")[:, body].astype(np.float64) @ direction


@pytest.mark.parametrize(("dt", "shock", "warm"), SETTINGS)
def test_a_parcel_is_taken_along(device, dt, shock, warm):
    """It accelerates with mu g up to the speed of the belt, and keeps that speed and its height."""
    sim = simulated(belt_scene(), dt, shock, warm, device)
    for step in range(1, round(1.0 / dt) + 1):
        sim.step()
        expected = min(2.0, 0.5 * G * step * dt)
        assert speed_along(sim, 1) == pytest.approx(expected, rel=0.01)
    assert sim.get("position")[0, 1, 2] == pytest.approx(HALF, abs=1e-4)
    assert len(sim.warnings()) == 0


@pytest.mark.parametrize(("dt", "shock", "warm"), SETTINGS)
def test_a_parcel_that_leaves_the_belt_stops(device, dt, shock, warm):
    """On a table at rest, v^2 / (2 mu g) beyond the place from which the table carries it.

    While both carry it, the belt pushes and the table brakes. How they share the weight decides whether the way counts
    from where its centre crosses the seam, or from where its rear does.
    """
    half, speed, friction = 0.02, 3.0, 0.5
    scene = wr.Scene()
    scene.add_static(wr.Box((1, 0.5, 0.1)), position=(-1, 0, -0.1), surface_velocity=(speed, 0, 0), name="belt")
    scene.add_static(wr.Box((1, 0.5, 0.1)), position=(1, 0, -0.1), name="table")
    scene.add_body(wr.Box((half,) * 3), position=(-0.5, 0, half), linear_velocity=(speed, 0, 0), name="parcel")
    sim = simulated(scene, dt, shock, warm, device)
    sim.step(round(0.15 / dt))
    assert speed_along(sim, 2) == pytest.approx(speed, rel=0.01)
    sim.step(round(0.85 / dt))
    assert speed_along(sim, 2) == pytest.approx(0.0, abs=1e-4)
    way = sim.get("position")[0, 2, 0]
    assert abs(way - speed**2 / (2.0 * friction * G) - 0.5 * half) < 0.5 * half + 0.5 * speed * dt


@pytest.mark.parametrize(("dt", "shock", "warm"), SETTINGS)
def test_a_steep_belt_carries_up_what_sticks(device, dt, shock, warm):
    """Up with the belt where mu > tan(slope); down with g (sin - mu cos) where mu < tan(slope)."""
    slope = 20.0
    s, c = np.sin(np.radians(slope)), np.cos(np.radians(slope))
    for friction in (0.5, 0.2):
        sim = simulated(belt_scene(1.0, friction, slope), dt, shock, warm, device)
        sim.step(round(1.0 / dt))
        steady = min(1.0, G * (friction * c - s))
        assert speed_along(sim, 1, slope) == pytest.approx(steady, rel=0.01)


@pytest.mark.parametrize(("dt", "shock", "warm"), SETTINGS)
def test_a_ball_rolls_on_a_belt(device, dt, shock, warm):
    """From rest it ends with 2/7 of the speed of the belt, whatever the friction, and spins backwards."""
    scene = belt_scene(3.5, 0.3)
    scene.add_body(wr.Sphere(HALF), position=(0, 0.3, HALF), friction=0.3, name="ball")
    sim = simulated(scene, dt, shock, warm, device)
    sim.step(round(1.5 / dt))
    assert speed_along(sim, 2) == pytest.approx(1.0, rel=0.01)
    assert sim.get("angular_velocity")[0, 2, 1] == pytest.approx(-2.5 / HALF, rel=0.01)


def test_a_dropped_ball_gets_spin_from_the_belt(device):
    """With a rebound: Coulomb's impulse mu (1 + e) v, as in a bounce on ground at rest with the slip of the belt."""
    scene = wr.Scene()
    scene.add_static(wr.Plane(), surface_velocity=(5, 0, 0), friction=0.2, restitution=0.8)
    scene.add_body(wr.Sphere(HALF), position=(0, 0, 0.6), friction=0.2, restitution=0.8)
    sim = simulated(scene, device=device)
    sim.step(90)
    fall = np.sqrt(2.0 * G * 0.5)
    assert sim.get("linear_velocity")[0, 1, 2] > 0.0
    assert sim.get("linear_velocity")[0, 1, 0] == pytest.approx(0.2 * 1.8 * fall, rel=0.01)
    assert sim.get("angular_velocity")[0, 1, 1] == pytest.approx(-2.5 * 0.2 * 1.8 * fall / HALF, rel=0.01)


def test_belts_run_with_their_own_velocity_in_each_environment(device):
    """Also backwards and sideways, and they are the same bits as alone."""
    velocities = np.array([[1.0, 0, 0], [-1.0, 0, 0], [0, 0.5, 0], [0, 0, 0]])
    sim = wr.Simulator(belt_scene(0.0), num_envs=4, device=device)
    sim.step(10)
    sim.set("surface_velocity", velocities[:, None], bodies=["belt"])
    sim.step(120)
    np.testing.assert_allclose(sim.get("linear_velocity")[:, 1], velocities, atol=1e-4)
    np.testing.assert_allclose(sim.get("surface_velocity")[:, 0], velocities)
    alone = wr.Simulator(belt_scene(0.0), device=device)
    alone.step(10)
    alone.set("surface_velocity", velocities[1], bodies=["belt"])
    alone.step(120)
    assert alone.get("position")[0].tobytes() == sim.get("position")[1].tobytes()


def test_a_turntable_takes_a_parcel_round(device):
    """A ring of the surface turns about the body's origin: the parcel goes round with it, at any angle of the body."""
    scene = wr.Scene()
    table = wr.Cylinder(1.0, 0.05)
    scene.add_static(table, position=(3, 1, -0.05), surface_angular_velocity=(0, 0, 1.0), friction=0.8)
    parcel = wr.Box((0.05,) * 3)
    scene.add_body(
        parcel, position=(3.5, 1, 0.05), linear_velocity=(0, 0.5, 0), angular_velocity=(0, 0, 1), friction=0.8
    )
    sim = simulated(scene, device=device)
    sim.step(240)
    arm = sim.get("position")[0, 1] - (3, 1, 0)
    assert np.hypot(*arm[:2]) == pytest.approx(0.5, rel=0.01)
    assert np.arctan2(arm[1], arm[0]) == pytest.approx(1.0, rel=0.01)
    assert sim.get("angular_velocity")[0, 1, 2] == pytest.approx(1.0, rel=0.01)


def test_a_turntable_turns_a_ball_by_spinning_friction(device):
    """Its torque over the moment of inertia, then with the turntable; both at the axis and away from it."""
    scene = wr.Scene()
    scene.add_static(wr.Plane(), surface_angular_velocity=(0, 0, 3), friction=1.0, spinning_friction=0.01)
    for x in (0.0, 1.0):
        scene.add_body(wr.Sphere(HALF), position=(x, 0, HALF), friction=1.0, spinning_friction=0.01)
    sim = simulated(scene, device=device)
    sim.step(24)
    np.testing.assert_allclose(sim.get("angular_velocity")[0, 1:, 2], 0.1 * 0.01 * G / (0.4 * HALF**2), rtol=0.01)
    sim.step(96)
    np.testing.assert_allclose(sim.get("angular_velocity")[0, 1:, 2], 3.0, rtol=1e-4)


def test_only_the_part_along_the_surface_counts(device):
    """A belt that "runs" upwards, and one that runs into a wall, neither lift nor sink what is on them."""
    scene = wr.Scene()
    scene.add_static(wr.Plane(), surface_velocity=(0, 0, 3.0), friction=0.5)
    scene.add_body(wr.Box((HALF,) * 3), position=(0, 0, HALF))
    sim = simulated(scene, device=device)
    sim.step(120)
    np.testing.assert_allclose(sim.get("position")[0, 1], (0, 0, HALF), atol=1e-4)


def test_a_tumbling_body_is_not_pushed_out_by_the_belt(device):
    """Galilei: a brick on a fast belt moves as one that is thrown backwards on a floor at rest.

    The push-out must not see the belt. The places grow apart, so that they are rounded differently.
    """
    found = []
    for speed, start in ((8.0, 0.0), (0.0, -8.0)):
        scene = wr.Scene()
        scene.add_static(wr.Plane(), surface_velocity=(speed, 0, 0), friction=0.6)
        turn = rotate_about((1, 2, 3), 40)
        scene.add_body(
            wr.Box((0.1, 0.12, 0.15)),
            position=(0, 0, 0.5),
            orientation=turn,
            linear_velocity=(start, 0, 0),
            friction=0.6,
        )
        sim = simulated(scene, 1 / 120, device=device)
        sim.step(180)
        motion = sim.get("linear_velocity")[0, 1] - [speed, 0, 0]
        found.append([*(sim.get("position")[0, 1] - [speed * 1.5, 0, 0]), *motion])
    np.testing.assert_allclose(found[0], found[1], atol=5e-3)


@pytest.mark.parametrize("held", [False, True])
def test_what_lies_on_a_running_belt_stays_awake(device, held):
    """Also what a wall holds back: it is at rest, but the belt slips below it."""
    scene = belt_scene(0.05)
    if held:
        scene.add_static(wr.Box((0.1, 0.5, 0.5)), position=(HALF + 0.1, 0, 0.3), friction=0.0)
    sim = simulated(scene, 1 / 60, device=device, sleeping=True)
    sim.step(120)
    assert not sim.get("asleep").any()
    sim.set("surface_velocity", 0, bodies=["belt"])
    sim.step(120)
    assert sim.get("asleep")[0, 1]


def test_a_belt_that_starts_wakes_what_sleeps_on_it(device):
    scene = belt_scene(0.0)
    scene.add_body(wr.Box((HALF,) * 3), position=(0, 0, 3 * HALF), name="upper")
    sim = wr.Simulator(scene, num_envs=2, settings=wr.Settings(dt=1 / 60, sleeping=True), device=device)
    sim.step(120)
    assert sim.get("asleep")[:, 1:].all()
    sim.set("surface_velocity", (1, 0, 0), envs=[1], bodies=["belt"])
    sim.step(30)
    np.testing.assert_allclose(sim.get("linear_velocity")[:, 1:, 0], [[0, 0], [1, 1]], atol=1e-3)
    assert sim.get("asleep")[0, 1:].all() and not sim.get("asleep")[1, 1:].any()


def test_the_stack_on_a_belt_rides_along(device):
    """Ten boxes: an island that is at rest on the belt is not stopped as one at rest on the ground."""
    scene = wr.Scene()
    scene.add_static(wr.Box((9, 0.5, 0.1)), position=(0, 0, -0.1), surface_velocity=(0.5, 0, 0), friction=0.5)
    for k in range(10):
        scene.add_body(wr.Box((HALF,) * 3), position=(0, 0, HALF + 2 * HALF * k), linear_velocity=(0.5, 0, 0))
    sim = simulated(scene, 1 / 60, device=device)
    sim.step(240)
    np.testing.assert_allclose(sim.get("position")[0, 1:, 0], 2.0, atol=0.01)
    np.testing.assert_allclose(sim.get("linear_velocity")[0, 1:, 0], 0.5, atol=1e-3)


def test_velocities_without_effect_change_no_bit(device):
    """A step that has the stage of running surfaces gives the bits of one without it, for surfaces that do not run."""
    found = []
    for ever in (False, True):
        sim = wr.Simulator(belt_scene(0.0), device=device)
        if ever:
            sim.set("surface_velocity", (1, 0, 0), bodies=[0])
            sim.set("surface_velocity", (0, 0, 0), bodies=[0])
            assert stages_of(sim).has_surface_velocity
        sim.set("linear_velocity", (1, 0.3, 0), bodies=[1])
        sim.step(60)
        found.append(sim.get("position").tobytes() + sim.get("linear_velocity").tobytes())
    assert found[0] == found[1]


def test_a_kinematic_body_adds_its_own_velocity(device):
    """A sledge that moves at 1 m/s with a belt of -1 m/s on it: the parcel stays at its place in the world."""
    scene = wr.Scene()
    scene.add_kinematic(
        wr.Box((5, 0.5, 0.1)), position=(0, 0, -0.1), linear_velocity=(1, 0, 0), surface_velocity=(-1, 0, 0)
    )
    scene.add_body(wr.Box((HALF,) * 3), position=(0, 0, HALF))
    sim = simulated(scene, device=device)
    sim.step(240)
    np.testing.assert_allclose(sim.get("position")[0, 1], (0, 0, HALF), atol=1e-3)


def test_bad_velocities_are_refused(device):
    scene = belt_scene()
    for value in ((1, 2), "fast", (np.nan, 0, 0), 1.0):
        with pytest.raises(ValueError, match="^surface_velocity: must be 3 finite numbers"):
            scene.add_static(wr.Plane(), surface_velocity=value)
    with pytest.raises(ValueError, match="^surface_velocity: must be of a static or kinematic body"):
        scene.add_body(wr.Sphere(1), surface_velocity=(1, 0, 0))
    sim = wr.Simulator(scene, device=device)
    with pytest.raises(ValueError, match="^surface_velocity: must be 0 for parcel, which is dynamic"):
        sim.set("surface_velocity", (1, 0, 0), bodies=["parcel"])
    with pytest.raises(ValueError, match="^surface_velocity: must be vectors of 3 numbers"):
        sim.set("surface_velocity", 1.0)
    sim.set("surface_velocity", (1, 0, 0))
    assert not sim.get("surface_velocity")[0, 1].any()


def test_a_sweep_and_a_run_vary_the_velocity():
    """With and without a selection: by default of the bodies whose surface runs, not of the ground beside them."""
    quiet = {"duration": 0.5, "device": "cpu"}
    axis = {"surface_velocity": [(0.5, 0, 0), (1.0, 0, 0)]}
    rows = wr.sweep("sorting_line", axis, **quiet).rows
    assert [row["status"] for row in rows] == ["ok", "ok"]
    demo = find_scene("sorting_line")
    plan = plan_run(demo, ["surface_velocity=(0.5,0,0),(1,0,0)"], frames=30, device="cpu")
    recording = execute(plan, [0, 1]).recording
    moved = recording.position[-1] - recording.position[0]
    parcel, ground = recording.names.index("parcel_0_small"), recording.names.index("ground")
    accelerating = np.array([0.5, 1.0]) / (0.5 * G)
    np.testing.assert_allclose(moved[:, parcel, 0], [0.5, 1.0] * (0.5 - 0.5 * accelerating), rtol=0.01)
    assert recording.start["surface_velocity"][:, ground].any() == 0.0
    for text, message in (
        ("surface_velocity[parcel_0_small]=(1,0,0)", "must be 0 for parcel_0_small"),
        ("surface_velocity[nothing]=(1,0,0)", "selects no body"),
    ):
        with pytest.raises(ValueError, match=message):
            execute(plan_run(demo, [text], frames=1, device="cpu"), [0])
        name, _, _ = text.partition("=")
        with pytest.raises(ValueError, match=message):
            wr.sweep("sorting_line", {name: [(1, 0, 0)]}, **quiet)
    with pytest.raises(ValueError, match="selects no body"):
        wr.sweep("box_stack", axis, **quiet)
