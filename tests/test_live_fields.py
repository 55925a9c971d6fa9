"""Force fields that are changed while running, bodies that are spawned and returned, and `active` as an axis."""

import numpy as np
import pytest

import warp_rigid as wr

DT = 1 / 240


def ball(*fields, gravity=(0, 0, 0), velocity=(0, 0, 0)):
    scene = wr.Scene(gravity=gravity)
    for field in fields:
        scene.add_force_field(field)
    scene.add_body(wr.Sphere(0.1), position=(0, 0, 1), linear_velocity=velocity, name="ball")
    return scene


def test_fields_differ_between_environments_and_change_while_running(device):
    """Velocities under constant accelerations are their sums."""
    sim = wr.Simulator(ball(wr.UniformField((1, 0, 0)), wr.UniformField((0, 2, 0))), num_envs=3, device=device)
    sim.set("field_acceleration", np.array([[(k, 0, 0), (0, 0, k)] for k in range(3)]))
    sim.step(24)
    expected = 0.1 * np.array([[k, 0, k] for k in range(3)])
    np.testing.assert_allclose(sim.get("linear_velocity")[:, 0], expected, rtol=1e-5)
    sim.set("field_acceleration", (0, -1, 0), envs=[1])
    sim.step(24)
    np.testing.assert_allclose(sim.get("linear_velocity")[1, 0], [0.1, -0.2, 0.1], rtol=1e-5)
    np.testing.assert_allclose(sim.get("linear_velocity")[2, 0], 2.0 * expected[2], rtol=1e-5)
    assert sim.get("field_acceleration").shape == (3, 2, 3)


def test_a_point_that_moves_attracts_where_it_is(device):
    """Acceleration strength / d^2; the potential energy is that of the changed field."""
    sim = wr.Simulator([ball(wr.PointField((0, 0, 0), 4.0)), ball(wr.DragField(0.0))], device=device)
    assert sim.get("field_strength")[0].tolist() == [4.0] and np.isnan(sim.get("field_strength")[1]).all()
    sim.set("field_center", (0, 0, 3.0))
    sim.set("field_strength", 8.0)
    mass = sim.get("mass")[0, 0]
    assert sim.get("potential_energy")[0, 0] == pytest.approx(-8.0 * mass / 2.0, rel=1e-6)
    sim.step(1)
    np.testing.assert_allclose(sim.get("linear_velocity")[0, 0], [0, 0, 8.0 / 4.0 * DT], rtol=1e-5)
    assert (sim.get("linear_velocity")[1, 0] == 0.0).all()


@pytest.mark.filterwarnings("error")
def test_a_body_at_the_attracting_centre_has_a_finite_energy(device):
    """Such as a planet, which is static and has no mass."""
    scene = wr.Scene(gravity=(0, 0, 0))
    scene.add_static(wr.Sphere(1.0), name="planet")
    scene.add_body(wr.Sphere(0.1), position=(2, 0, 0), mass=3.0, name="moon")
    scene.add_force_field(wr.PointField(center=(0, 0, 0), strength=8.0))
    sim = wr.Simulator(scene, device=device)
    np.testing.assert_allclose(sim.get("potential_energy"), [[0.0, -8.0 * 3.0 / 2.0]], rtol=1e-6)


@pytest.mark.parametrize("drag", [0.0, 1e-3, 2.0, 1e4])
def test_drag_has_its_closed_form(device, drag):
    """v = w + (v0 - w) exp(-c t), for any c: the step is exact. In gravity the terminal velocity is g / c."""
    wind = np.array([0.5, 0, 0])
    sim = wr.Simulator(ball(wr.DragField(drag, wind), velocity=(2, 1, 0)), device=device)
    sim.step(48)
    expected = wind + ([2, 1, 0] - wind) * np.exp(-drag * 0.2)
    # Each step rounds a velocity near 2 m/s to float32, by 1.2e-7 m/s at most.
    np.testing.assert_allclose(sim.get("linear_velocity")[0, 0], expected, atol=48 * 1.2e-7)


@pytest.mark.parametrize("drag", [1e-2, 5.0, 60.0, 240.0, 1e4])
def test_terminal_velocity(device, drag):
    """g / c in gravity, for any drag: the medium also resists what gravity adds in the step."""
    wind = (0.5, 0, 0)
    start = (0, 0, -9.81 / drag)
    sim = wr.Simulator(ball(wr.DragField(drag, wind), gravity=(0, 0, -9.81), velocity=start), device=device)
    sim.step(240)
    expected = [0.5 * -np.expm1(-drag), 0, -9.81 / drag]
    np.testing.assert_allclose(sim.get("linear_velocity")[0, 0], expected, rtol=2e-5)


@pytest.mark.parametrize("drag", [0.1, 120.0, 1e4])
def test_several_media_resist_together(device, drag):
    """Three media of the same drag are one of the threefold drag with their mean velocity; none overshoots it."""
    winds = ((0.3, 0, 0), (0, 0.6, 0), (0, 0, 0.9))
    sim = wr.Simulator(ball(*(wr.DragField(drag, wind) for wind in winds), velocity=(2, 1, 0)), device=device)
    mean = np.array([0.1, 0.2, 0.3])
    for step in range(1, 25):
        sim.step(1)
        expected = mean + ([2, 1, 0] - mean) * np.exp(-3.0 * drag * step * DT)
        np.testing.assert_allclose(sim.get("linear_velocity")[0, 0], expected, atol=step * 2.4e-7)


@pytest.mark.parametrize("drag", [0.0, 10.0, 240.0])
def test_a_medium_does_not_carry_what_lies_in_it(device, drag):
    """At rest, the ground carries m g and a torque; in wind, a box slides with v = w - mu g / c."""
    scene = wr.Scene()
    scene.add_force_field(wr.DragField(drag))
    scene.add_static(wr.Plane(), name="ground")
    scene.add_body(wr.Box((0.1, 0.1, 0.1)), position=(0, 0, 0.1), mass=2.0, name="box")
    sim = wr.Simulator(scene, device=device)
    # Up to m g a = 1.96 N m the box does not tip.
    sim.set("torque", (0, 1.9, 0), bodies=["box"])
    sim.watch(["box"])
    sim.step(120)
    assert np.abs(sim.get("angular_velocity")[0, 1]).max() < 1e-4
    assert sim.watched()["summed_impulse"][0, 0] == pytest.approx(2.0 * 9.81 * sim.time, rel=1e-4)
    contacts = sim.contacts()
    assert abs(contacts["impulse"][:, 2].sum()) == pytest.approx(2.0 * 9.81 * DT, rel=1e-4)
    if drag > 0.0:
        sim.set("torque", 0)
        sim.set("field_velocity", (4.0, 0, 0))
        sim.step(480)
        assert sim.get("linear_velocity")[0, 1, 0] == pytest.approx(4.0 - 0.5 * 9.81 / drag, rel=1e-4)


@pytest.mark.parametrize("drag", [1.0, 10.0, 60.0])
def test_a_medium_resists_a_body_after_its_impact(device, drag):
    """Two balls of 1 and 3 kg, e = 1: drag slows both alike, so v = (-1/2, 1/2) v0 exp(-c t) whenever they meet.

    The error of a step with an impact is one of second order in the drag times the step.
    """
    scene = wr.Scene(gravity=(0, 0, 0))
    scene.add_force_field(wr.DragField(drag))
    for mass, x, speed in ((1.0, 0.0, 20.0), (3.0, 0.25, 0.0)):
        scene.add_body(wr.Sphere(0.1), mass=mass, position=(x, 0, 0), linear_velocity=(speed, 0, 0), restitution=1.0)
    sim = wr.Simulator(scene, device=device)
    sim.step(24)
    expected = np.array([-0.5, 0.5]) * 20.0 * np.exp(-0.1 * drag)
    np.testing.assert_allclose(sim.get("linear_velocity")[0, :, 0], expected, rtol=1e-5 + (drag * DT) ** 2)


def test_changed_fields_wake_sleeping_bodies_and_survive_a_checkpoint(device, tmp_path):
    scene = wr.Scene()
    scene.add_static(wr.Plane())
    scene.add_force_field(wr.UniformField((0, 0, 0)))
    scene.add_body(wr.Box((0.1, 0.1, 0.1)), position=(0, 0, 0.1))
    sim = wr.Simulator(scene, settings=wr.Settings(sleeping=True), device=device)
    sim.step(240)
    assert sim.get("asleep")[0, 1]
    sim.set("field_acceleration", (0, 0, 20.0))
    assert not sim.get("asleep")[0, 1]
    sim.save(tmp_path / "field.ckpt")
    again = wr.Simulator.load(tmp_path / "field.ckpt", device)
    for some in (sim, again):
        some.step(24)
    assert sim.get("linear_velocity")[0, 1, 2] > 0.9
    np.testing.assert_array_equal(sim.get("position"), again.get("position"))


@pytest.mark.parametrize(
    ("act", "message"),
    [
        (lambda sim: sim.set("field_strength", 1.0), "field_strength: no force field of the scene has a strength"),
        (lambda sim: sim.set("field_drag", -1.0), "field_drag: must be a finite number >= 0, got -1.0"),
        (lambda sim: sim.set("field_drag", np.nan), "field_drag: must be finite numbers"),
        (lambda sim: sim.set("field_drag", 1.0, bodies=[0]), "bodies: must not be given for field_drag"),
        (lambda sim: sim.set("field_drag", [1.0, 2.0]), "field_drag: must be numbers that broadcast to (1, 1)"),
        (lambda sim: sim.set("field_acceleration", 1.0), "field_acceleration: must be vectors of 3 numbers, got 1.0"),
        (lambda sim: sim.spawn("pellet", (0, 0, 1)), "pool: scene 0 has no bodies named pellet_0, pellet_1, ..."),
        (lambda sim: wr.DragField(-1.0), "drag: must be a finite number >= 0, got -1.0"),
    ],
)
def test_errors_name_the_field(act, message):
    sim = wr.Simulator(ball(wr.DragField(1.0)), device="cpu")
    with pytest.raises(ValueError) as error:
        act(sim)
    assert str(error.value).startswith(message) and "\n" not in str(error.value)


def pellets(count=3):
    scene = wr.Scene()
    scene.add_static(wr.Plane(), friction=0.5, name="ground")
    scene.add_pool(wr.Sphere(0.1), count, "pellet", mass=2.0)
    return scene


@pytest.mark.parametrize("sleeping", [False, True])
def test_a_spawned_body_moves_as_if_it_had_always_been_there(device, sleeping):
    """It has the bits of a body that starts at that moment; those of a second life are those of the first."""
    settings = wr.Settings(sleeping=sleeping)
    fresh = wr.Scene()
    fresh.add_static(wr.Plane(), friction=0.5)
    fresh.add_body(wr.Sphere(0.1), position=(0.3, 0, 0.15), linear_velocity=(1, 0, 0), mass=2.0)
    alone = wr.Simulator(fresh, settings=settings, device=device)
    alone.step(120)
    sim = wr.Simulator(pellets(), num_envs=2, settings=settings, device=device)
    sim.step(7)
    start = {"position": (0.3, 0, 0.15), "linear_velocity": (1, 0, 0)}
    for _ in range(2):
        assert sim.spawn("pellet", **start, envs=[1]).tolist() == [1]
        sim.step(120)
        for name in ("position", "orientation", "linear_velocity", "angular_velocity"):
            np.testing.assert_array_equal(sim.get(name)[1, 1], alone.get(name)[0, 1])
        assert sim.get("active")[:, 1:].tolist() == [[False] * 3, [True, False, False]]
        sim.despawn("pellet_0", envs=[1])
    sim.step(1)
    assert not sim.get("active")[:, 1:].any() and not len(sim.contacts())


def test_a_pool_that_is_used_up_says_so(device):
    sim = wr.Simulator(pellets(2), num_envs=2, device=device)
    places = np.array([[0.0, 0, 1], [1.0, 0, 1]])
    assert sim.spawn("pellet", places).tolist() == [1, 1]
    assert sim.spawn("pellet", (0, 0, 2), envs=[0]).tolist() == [2]
    before = sim.get("position")
    assert sim.spawn("pellet", (0, 0, 3)).tolist() == [-1, 2]
    np.testing.assert_array_equal(sim.get("position")[0], before[0])
    np.testing.assert_array_equal(sim.get("position")[:, 1], places.astype(np.float32))
    assert sim.get("position")[1, 2].tolist() == [0, 0, 3]


def test_fields_and_active_are_axes():
    """The distance fallen under an acceleration, and not at all by a body that is switched off."""

    def scene():
        return ball(wr.UniformField((0, 0, -1)))

    axes = {"field_acceleration": [(0, 0, -2.0), (0, 0, -4.0)], "active": [True, False]}
    rows = wr.sweep(scene, axes, duration=0.1, metrics=["drift"], device="cpu").rows
    fallen = [row["drift"] for row in rows]
    steps = 24
    expected = DT * DT * steps * (steps + 1) / 2
    assert fallen == pytest.approx([2 * expected, 0, 4 * expected, 0], rel=1e-4)
    for name, value, message in (
        ("active", 2, "active: must be True or False, got 2"),
        ("field_drag", 1.0, "field_drag: no force field of the scene has a drag"),
        ("field_acceleration", 1.0, "field_acceleration: must be three numbers, got 1.0"),
    ):
        with pytest.raises(ValueError, match=message):
            wr.sweep(scene, {name: [value]}, duration=0.1, device="cpu")


def test_a_body_that_is_spawned_again_gains_no_energy(device):
    """Its former life took energy: the sum over all lives must not rise when a new one begins."""
    scene = wr.Scene(gravity=(0, 0, 0))
    scene.add_static(wr.Plane(normal=(-1, 0, 0), offset=-1.0), friction=0.5)
    scene.add_pool(wr.Sphere(0.1), 1, "ball", mass=1.0)
    scene.add_body(wr.Sphere(0.1), position=(-3, 0, 0), mass=1.0)
    sim = wr.Simulator(scene, device=device)
    for _ in range(3):
        sim.spawn("ball", (0, 0, 0), linear_velocity=(1, 0, 0))
        sim.step(256)  # it hits the wall after 216 steps, and stops
        assert np.abs(sim.get("linear_velocity")).max() < 1e-6
        sim.despawn("ball_0")
        sim.step(64)
    assert not len(sim.warnings())
