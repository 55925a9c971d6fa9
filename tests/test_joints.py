"""Joints against closed forms: every kind, limits, drives, friction, breaking, and bad input."""

import numpy as np
import pytest

import warp_rigid as wr
from warp_rigid import rotations

DT = 1.0 / 240.0
G = 9.81


def simulator(scene, device, num_envs=1, **settings):
    return wr.Simulator(scene, num_envs=num_envs, settings=wr.Settings(dt=DT, **settings), device=device)


def anchor_errors(sim, env=0):
    """Distances of the two anchors of each joint [m], from the poses of the bodies."""
    position = sim.get("position")[env].astype(np.float64)
    orientation = sim.get("orientation")[env].astype(np.float64)

    def point(body, frame):
        local = np.array(frame.position)
        return local if body is None else position[body] + rotations.rotate(orientation[body], local)

    joints = sim.scene.joints
    return np.array(
        [np.linalg.norm(point(j.body_a, j.frame_a) - point(j.body_b, j.frame_b)) for j in joints], np.float64
    )


def one_body(joint, gravity=(0, 0, 0), anchor=(0.0, 0.0, 0.0), **more):
    """A box of 2 kg that a joint holds to the world."""
    scene = wr.Scene(gravity=gravity)
    body = scene.add_body(wr.Box((0.2, 0.1, 0.1)), mass=2.0, **more)
    scene.add_joint(joint, body, anchor=anchor)
    return scene


INERTIA = 2.0 / 3.0 * (0.2**2 + 0.1**2)


def test_a_saturated_motor_speeds_up_evenly_and_then_keeps_its_speed(device):
    scene = one_body(wr.RevoluteJoint(axis=(0, 0, 1)))
    scene.add_drive(0, damping=1e6, max_force=0.5, target_velocity=5.0)
    sim = simulator(scene, device)
    sim.step(60)
    assert sim.get("joint_velocity")[0, 0] == pytest.approx(0.5 / INERTIA * 60 * DT, rel=1e-4)
    assert sim.get("joint_force")[0, 0, 5] == pytest.approx(0.5, rel=1e-4)
    sim.step(240)
    assert sim.get("joint_velocity")[0, 0] == pytest.approx(5.0, rel=1e-4)
    assert sim.get("joint_position")[0, 0] > 2.0 * np.pi - 3.0, "angles count full turns"
    sim.set("joint_target_velocity", -1.0)
    sim.step(480)
    assert sim.get("joint_velocity")[0, 0] == pytest.approx(-1.0, rel=1e-4)


@pytest.mark.parametrize("spin", [800.0, -1600.0, 3000.0])
def test_angles_count_turns_of_more_than_half_in_a_step(spin, device):
    """A rotor, and a wheel on it that does not turn in the world. Inactive, they stay where they are."""
    scene = wr.Scene(gravity=(0, 0, 0))
    rotor = scene.add_body(wr.Cylinder(0.1, 0.02), angular_velocity=(0, 0, spin))
    wheel = scene.add_body(wr.Cylinder(0.1, 0.02), position=(0, 0, 0.1))
    scene.add_joint(wr.RevoluteJoint((0, 0, 1)), rotor)
    scene.add_joint(wr.RevoluteJoint((0, 0, 1)), wheel, rotor)
    sim = simulator(scene, device)
    sim.step(240)
    np.testing.assert_allclose(sim.get("joint_position")[0], (spin, -spin), rtol=1e-3)
    sim.set("active", False)
    sim.step(240)
    np.testing.assert_allclose(sim.get("joint_position")[0], (spin, -spin), rtol=1e-3)


def test_friction_of_a_hinge_stops_it(device):
    sim = simulator(one_body(wr.RevoluteJoint((0, 0, 1), friction=0.1), angular_velocity=(0, 0, 4)), device)
    sim.step(120)
    assert sim.get("joint_velocity")[0, 0] == pytest.approx(4.0 - 0.1 / INERTIA * 0.5, rel=1e-4)
    sim.step(400)
    assert sim.get("joint_velocity")[0, 0] == pytest.approx(0.0, abs=1e-15)
    assert sim.get("joint_position")[0, 0] == pytest.approx(16.0 * INERTIA / 0.2, rel=0.01)


def test_a_spring_drive_oscillates_and_settles(device):
    """Against the damped oscillator; the drive is implicit, so it damps somewhat more."""
    scene = one_body(wr.PrismaticJoint((0, 1, 0)))
    scene.add_drive(scene.joints[0].name, stiffness=50.0, damping=4.0, target_position=0.3)
    sim = simulator(scene, device)
    omega, ratio = 5.0, 0.2
    damped = omega * np.sqrt(1 - ratio**2)
    for _ in range(3):
        sim.step(60)
        t = sim.time
        wave = np.cos(damped * t) + ratio * omega / damped * np.sin(damped * t)
        assert sim.get("joint_position")[0, 0] == pytest.approx(0.3 * (1 - np.exp(-ratio * omega * t) * wave), abs=6e-3)
    sim.step(2400)
    assert sim.get("joint_position")[0, 0] == pytest.approx(0.3, rel=1e-4)
    assert np.abs(sim.get("position")[0, 0, [0, 2]]).max() < 1e-7


def test_a_limit_holds_a_pendulum(device):
    scene = one_body(wr.RevoluteJoint((0, 1, 0), limits=(-0.2, 0.7)), (0, 0, -G), (-0.5, 0, 0))
    sim = simulator(scene, device)
    sim.step(480)
    assert sim.get("joint_position")[0, 0] == pytest.approx(0.7, abs=1e-6)
    assert abs(sim.get("joint_velocity")[0, 0]) < 1e-6
    force = sim.get("joint_force")[0, 0]
    assert force[2] == pytest.approx(2.0 * G, rel=1e-4)
    assert force[4] == pytest.approx(-2.0 * G * 0.5 * np.cos(0.7), rel=1e-4)


def test_a_slider_with_friction_on_an_incline(device):
    axis = (np.cos(0.5), 0.0, -np.sin(0.5))
    sim = simulator(one_body(wr.PrismaticJoint(axis, friction=4.0), (0, 0, -G)), device)
    sim.step(240)
    acceleration = G * np.sin(0.5) - 2.0
    assert sim.get("joint_velocity")[0, 0] == pytest.approx(acceleration, rel=1e-4)
    assert sim.get("joint_position")[0, 0] == pytest.approx(0.5 * acceleration, rel=0.01)
    stuck = simulator(one_body(wr.PrismaticJoint(axis, friction=10.0), (0, 0, -G)), device)
    stuck.step(240)
    assert abs(stuck.get("joint_position")[0, 0]) < 1e-9


@pytest.mark.parametrize("cone", [None, 3.0])
def test_damping_of_a_ball_joint_acts_on_all_rotations(device, cone):
    """On a ball of inertia I, every component of the angular velocity falls by 1 + c dt / I in a step."""
    scene = wr.Scene(gravity=(0, 0, 0))
    ball = scene.add_body(wr.Sphere(0.5), mass=2.0, angular_velocity=(0.3, -0.5, 0.8))
    scene.add_joint(wr.SphericalJoint(cone, axis=(0.6, 0.0, 0.8)), ball)
    scene.add_drive(0, damping=0.7)
    sim = simulator(scene, device)
    sim.step(60)
    left = (1.0 + 0.7 * DT / 0.2) ** -60.0
    assert sim.get("angular_velocity")[0, 0] == pytest.approx(left * np.array((0.3, -0.5, 0.8)), rel=1e-4)
    torque = sim.get("joint_force")[0, 0, 3:]
    assert torque == pytest.approx(-0.7 * sim.get("angular_velocity")[0, 0], rel=1e-3)
    sim.set("joint_damping", 0.0)
    sim.step(60)
    assert sim.get("angular_velocity")[0, 0] == pytest.approx(left * np.array((0.3, -0.5, 0.8)), rel=1e-4)


def test_a_cone_holds_a_ball_joint(device):
    scene = wr.Scene(gravity=(0, 0, -G))
    body = scene.add_body(wr.Capsule(0.03, 0.2), position=(0, 0, 0.2), orientation=(0.01, 0, 0, 1), mass=1.0)
    scene.add_joint(wr.SphericalJoint(cone_limit=0.6), body, anchor=(0, 0, 0))
    sim = simulator(scene, device)
    sim.step(1200)
    assert sim.get("joint_position")[0, 0] == pytest.approx(0.6, abs=1e-5)
    assert anchor_errors(sim).max() < 1e-6


def test_a_string_is_slack_and_then_taut(device):
    scene = wr.Scene(gravity=(0, 0, -G))
    body = scene.add_body(wr.Sphere(0.05), position=(0, 0, -0.3), mass=1.0)
    scene.add_joint(wr.DistanceJoint(maximum=1.0), body, anchor=(0, 0, -0.3), anchor_b=(0, 0, 0))
    sim = simulator(scene, device)
    sim.step(80)
    assert sim.get("joint_velocity")[0, 0] == pytest.approx(G * sim.time, rel=1e-4)
    assert np.abs(sim.get("joint_force")).max() == 0.0
    sim.step(240)
    assert sim.get("joint_position")[0, 0] == pytest.approx(1.0, abs=1e-6)
    assert sim.get("joint_force")[0, 0, 2] == pytest.approx(G, rel=1e-3)


def test_a_chain_under_a_thousandfold_load_stays_closed(device):
    """100 links of 0.1 kg and 100 kg at the end, let go with a lateral speed, for a second."""
    links, length = 100, 0.1
    scene = wr.Scene(gravity=(0, 0, -G))
    above = None
    for k in range(links):
        body = scene.add_body(
            wr.Capsule(0.02, 0.03),
            position=(0, 0, -length * (k + 0.5)),
            linear_velocity=((k + 0.5) / links, 0, 0),
            mass=0.1,
        )
        scene.add_joint(wr.SphericalJoint(), body, above, anchor=(0, 0, -length * k))
        above = body
    ball = scene.add_body(wr.Sphere(0.05), position=(0, 0, -length * links), linear_velocity=(1, 0, 0), mass=100.0)
    scene.add_joint(wr.SphericalJoint(), ball, above, anchor=(0, 0, -length * links))
    sim = simulator(scene, device)
    for _ in range(4):
        sim.step(60)
        assert anchor_errors(sim).max() < 2e-6
    assert np.linalg.norm(sim.get("joint_force")[0, 0, :3]) == pytest.approx(110.0 * G, rel=0.05)


def pendulum_period(angle, device):
    """Period of a small sphere on a rod of 1 m, from its crossings of the vertical."""
    scene = wr.Scene(gravity=(0, 0, -G))
    start = (np.sin(angle), 0.0, -np.cos(angle))
    body = scene.add_body(wr.Sphere(0.05), position=start)
    scene.add_joint(wr.DistanceJoint(1.0, 1.0), body, anchor=start, anchor_b=(0, 0, 0))
    sim = simulator(scene, device)
    x = []
    for _ in range(1100):
        sim.step()
        x.append(float(sim.get("position")[0, 0, 0]))
    x = np.array(x)
    before = np.flatnonzero((x[:-1] > 0) & (x[1:] <= 0))
    return DT * np.diff(before + x[before] / (x[before] - x[before + 1])).mean()


@pytest.mark.parametrize("degrees", [5.0, 90.0])
def test_periods_of_a_pendulum(degrees, device):
    """Against the arithmetic-geometric mean."""
    angle = np.radians(degrees)
    a, b = 1.0, np.cos(angle / 2.0)
    for _ in range(8):
        a, b = (a + b) / 2.0, np.sqrt(a * b)
    assert pendulum_period(angle, device) == pytest.approx(2.0 * np.pi / np.sqrt(G) / a, rel=2e-4)


def tumbling():
    """Two boxes in a fixed joint without gravity, and a third on a ball joint."""
    scene = wr.Scene(gravity=(0, 0, 0))
    a = scene.add_body(wr.Box((0.1, 0.2, 0.3)), linear_velocity=(0.5, 0.2, 0), angular_velocity=(1, 2, 0.5))
    b = scene.add_body(wr.Box((0.2, 0.1, 0.1)), position=(0.3, 0, 0.1), angular_velocity=(-2, 0, 1))
    c = scene.add_body(wr.Box((0.1, 0.1, 0.1)), position=(0.6, 0, 0.1), angular_velocity=(0, 0, 3))
    scene.add_joint(wr.FixedJoint(), a, b, anchor=(0.1, 0, 0.1))
    scene.add_joint(wr.SphericalJoint(), c, b, anchor=(0.5, 0, 0.1))
    return scene


def momenta(sim):
    place, v, w = (sim.get(n)[0].astype(float) for n in ("center_of_mass", "linear_velocity", "angular_velocity"))
    p = sim.get("mass")[0][:, None] * v
    spin = np.einsum("bij,bj->bi", sim.get("inertia")[0].astype(float), w)
    return np.array([p.sum(0), (np.cross(place, p) + spin).sum(0)])


def test_momenta_are_kept(device):
    sim = simulator(tumbling(), device)
    before = momenta(sim)
    sim.step(480)
    assert anchor_errors(sim).max() < 1e-6
    assert np.abs(momenta(sim) - before).max() < 2e-3 * np.abs(before).max()


def bits(sim, env=0):
    names = ("position", "orientation", "linear_velocity", "angular_velocity", "joint_force", "joint_broken")
    return b"".join(sim.get(name)[env].tobytes() for name in names)


def test_a_weld_breaks_at_its_limit(device):
    """A box hangs from a weld; its weight grows slowly until the weld breaks, and it falls freely then."""
    scene = wr.Scene(gravity=(0, 0, 0))
    body = scene.add_body(wr.Box((0.1, 0.1, 0.1)), mass=2.0)
    scene.add_joint(wr.FixedJoint(), body, anchor=(0, 0, 0.1), break_force=100.0)
    sim = simulator(scene, device)
    for load in np.arange(99.0, 102.0, 0.1):
        sim.set("force", (0, 0, -load))
        sim.step(2)
        if sim.get("joint_broken")[0, 0]:
            break
    assert load == pytest.approx(100.0, rel=0.01)
    sim.set("force", (0, 0, -20.0))
    before = sim.get("linear_velocity")[0, 0, 2]
    sim.step(24)
    assert sim.get("linear_velocity")[0, 0, 2] - before == pytest.approx(-10.0 * 24 * DT, rel=1e-4)
    sim.reset()
    assert not sim.get("joint_broken").any()


def test_jointed_bodies_do_not_collide_unless_told(device):
    scene = wr.Scene()
    a, b = (scene.add_body(wr.Sphere(0.1), position=(x, 0, 0)) for x in (0.0, 0.1))
    scene.add_joint(wr.SphericalJoint(), a, b, anchor=(0.05, 0, 0))
    assert scene.filtered_pairs == {(a, b)}
    other = wr.Scene()
    a, b = (other.add_body(wr.Sphere(0.1), position=(x, 0, 0)) for x in (0.0, 0.3))
    other.add_joint(wr.SphericalJoint(), a, b, anchor=(0.15, 0, 0), collide=True)
    assert other.filtered_pairs == set()


def add(joint=None, a=1, b=None, **more):
    """Add a joint to a scene of a static and two dynamic bodies."""
    scene = wr.Scene()
    scene.add_static(wr.Plane())
    for x in (0.0, 1.0):
        scene.add_body(wr.Box((0.1, 0.1, 0.1)), position=(x, 0, 1))
    return scene, scene.add_joint(joint or wr.FixedJoint(), a, b, **more)


def join_two_statics():
    """Add a joint between the two static bodies of a scene."""
    scene = wr.Scene()
    for x in (0.0, 0.2):
        scene.add_static(wr.Box((0.1, 0.1, 0.1)), position=(x, 0, 0))
    scene.add_joint(wr.FixedJoint(), 0, 1)


@pytest.mark.parametrize(
    ("call", "text"),
    [
        (lambda: wr.RevoluteJoint((0, 0, 0)), "axis: must be a vector of length > 0, got (0, 0, 0)"),
        (lambda: wr.RevoluteJoint((0, 0, 1), (1, -1)), "limits: lower must be at most upper, got (1, -1)"),
        (lambda: wr.PrismaticJoint((0, 0, 0)), "axis: must be a vector of length > 0, got (0, 0, 0)"),
        (lambda: wr.PrismaticJoint((0, 0, 1), (0.2, 0.1)), "limits: lower must be at most upper, got (0.2, 0.1)"),
        (lambda: wr.PrismaticJoint((0, 0, 1), 3), "limits: must be (lower, upper) or None, got 3"),
        (lambda: wr.RevoluteJoint((0, 0, 1), friction=-1), "friction: must be a finite number >= 0, got -1"),
        (lambda: wr.SphericalJoint(4.0), "cone_limit: must be a number with 0 < number <= 3.14159, got 4.0"),
        (lambda: wr.DistanceJoint(2.0, 1.0), "maximum: must be at least the minimum 2, got 1"),
        (lambda: add(a=1, b=1), "body_b: must be another body than body_a, got 1 for both"),
        (lambda: add(a=7), "body_a: must be a whole number from 0 to 2, got 7"),
        (lambda: add(a=0), "body_b: one of the two bodies must be dynamic, got static and the world"),
        (join_two_statics, "body_b: one of the two bodies must be dynamic, got static and static"),
        (lambda: add(joint="glue"), "joint: must be a DistanceJoint, FixedJoint, PrismaticJoint, "
         "RevoluteJoint, SphericalJoint, got 'glue'"),
        (lambda: add(b=2, anchor=(0, 0, 1), anchor_b=(0, 0, 1.1)), "anchor: the anchors must be at most 0.02 m apart, "
         "a tenth of the smaller body's size, got 0.1 m"),
        (lambda: add(break_force=0), "break_force: must be a finite number > 0, got 0"),
        (lambda: add(collide=1), "collide: must be True or False, got 1"),
        (lambda: add()[0].add_drive(0), "joint: a drive needs a RevoluteJoint or a PrismaticJoint, got a FixedJoint"),
        (lambda: add(wr.RevoluteJoint((1, 0, 0)))[0].add_drive(0, stiffness=-1),
         "stiffness: must be a finite number >= 0, got -1"),
        (lambda: add(wr.SphericalJoint())[0].add_drive(0, stiffness=1.0),
         "joint: a SphericalJoint can be damped, but not driven: only damping can be given"),
        (lambda: add()[0].add_drive(1), "joint: must be a whole number from 0 to 0, got 1"),
        (lambda: add()[0].add_drive("knee"), "joint: must be the index or name of a joint, got 'knee'; "
         "all names: fixedjoint_0"),
        (lambda: wr.Scene().add_drive(0), "joint: must be the index or name of a joint, got 0"),
    ],
)  # fmt: skip
def test_bad_input_is_rejected_in_one_line(call, text):
    with pytest.raises(ValueError) as caught:
        call()
    assert str(caught.value) == text


def test_bad_values_are_rejected_and_change_nothing(device):
    sim = simulator(add(wr.RevoluteJoint((1, 0, 0), (-1, 1)))[0], device)
    for name, value, text in (
        ("joint_position", 1.0, "name: must be a quantity that can be set, got 'joint_position'; did you mean "),
        ("joint_lower", 2.0, "joint_lower: the lower limit must be at most the upper one"),
        ("joint_lower", np.inf, "joint_lower: must be finite numbers or -inf, got inf"),
        ("joint_upper", -np.inf, "joint_upper: must be finite numbers or inf, got -inf"),
        ("joint_damping", -1.0, "joint_damping: must be finite numbers >= 0"),
        ("joint_target_position", np.inf, "joint_target_position: must be finite numbers"),
        ("joint_broken", 1, "joint_broken: must be True or False, got 1"),
        ("joint_stiffness", [1, 2, 3], "joint_stiffness: must be numbers that broadcast to (1, 1), got shape (3,)"),
    ):
        before = [sim.get(key).tobytes() for key in ("joint_lower", "joint_damping", "joint_broken")]
        with pytest.raises(ValueError) as caught:
            sim.set(name, value)
        assert str(caught.value).startswith(text)
        assert [sim.get(key).tobytes() for key in ("joint_lower", "joint_damping", "joint_broken")] == before


LACKED = [
    (wr.FixedJoint(), "joint_stiffness", 0, "joint_break_force, joint_break_torque, joint_broken"),
    (wr.SphericalJoint(), "joint_armature", 0,
     "joint_upper, joint_damping, joint_break_force, joint_break_torque, joint_broken"),
    (wr.SphericalJoint(), "joint_max_force", np.inf,
     "joint_upper, joint_damping, joint_break_force, joint_break_torque, joint_broken"),
    (wr.DistanceJoint(0.0, 1.0), "joint_friction", 0.0,
     "joint_lower, joint_upper, joint_break_force, joint_break_torque, joint_broken"),
]  # fmt: skip


@pytest.mark.parametrize(("joint", "name", "none", "known"), LACKED)
def test_a_joint_refuses_a_value_that_its_kind_cannot_have(joint, name, none, known):
    """A call for all joints changes those that can have the value, and is refused where none can."""
    scene, _ = add(joint, name="first")
    told = f"{name}: must be {none:g} for first: a {type(joint).__name__} can have {known}"
    for more in ({"joints": ["first"]}, {}):
        with pytest.raises(ValueError) as error:
            simulator(scene, "cpu").set(name, 2.0, **more)
        assert str(error.value) == told
    scene.add_joint(wr.RevoluteJoint((1, 0, 0)), 2, anchor=(1, 0, 1), name="hinge")
    sim = simulator(scene, "cpu")
    sim.set(name, 2.0)
    sim.set(name, none, joints="first")
    assert sim.get(name)[0].tolist() == [none, 2.0]
    result = wr.sweep(scene, {name: [3.0]}, duration=0.01, metrics=[], device="cpu")
    assert result.rows[0]["status"] == "ok"
    with pytest.raises(ValueError, match=f"{name}: must be {none:g} for first"):
        wr.sweep(scene, {f"{name}[first]": [3.0]}, duration=0.01, metrics=[], device="cpu")


@pytest.mark.parametrize(
    ("joint", "name"),
    [(wr.SphericalJoint(1.0), "joint_upper"), (wr.DistanceJoint(0.0, 1.0), "joint_lower")],
)
def test_a_limit_of_an_angle_between_axes_or_of_a_distance_is_not_negative(joint, name):
    sim = simulator(add(joint, name="first")[0], "cpu")
    with pytest.raises(ValueError, match=f"^{name}: must be >= 0 for first, a {type(joint).__name__}, got -0.5$"):
        sim.set(name, -0.5)
    sim.set("joint_lower", -np.inf)
    sim.set(name, 0.5)
    assert sim.get(name)[0, 0] == 0.5


def test_a_saved_simulation_continues_bit_for_bit(device, tmp_path):
    scene = tumbling()
    lever = scene.add_body(wr.Box((0.2, 0.05, 0.05)), position=(0, 3, 0), angular_velocity=(0, 0, 1))
    hinge = scene.add_joint(
        wr.RevoluteJoint((0, 0, 1), limits=(-4.0, 9.0), friction=0.1), lever, anchor=(-0.2, 3, 0), break_torque=1e4
    )
    scene.add_drive(hinge, stiffness=3.0, damping=1.0, max_force=2.0, target_position=8.0)
    sim = simulator(scene, device, num_envs=2)
    sim.set("joint_target_position", 2.0, envs=[1], joints=[hinge])
    sim.set("joint_broken", True, envs=[1], joints=[0])
    sim.step(100)
    sim.save(tmp_path / "joints.ckpt")
    loaded = wr.Simulator.load(tmp_path / "joints.ckpt", device)
    assert loaded.scene.joints == scene.joints
    for name in ("joint_position", "joint_velocity", "joint_force", "joint_target_position", "joint_broken"):
        assert loaded.get(name).tobytes() == sim.get(name).tobytes()
    sim.step(100)
    loaded.step(100)
    assert [bits(loaded, env) for env in (0, 1)] == [bits(sim, env) for env in (0, 1)]
    assert bits(sim, 0) != bits(sim, 1)


def test_hanging_bodies_sleep_and_wake_as_one(device):
    """Two boxes hang from the world by a chain; a push of the lower one wakes both."""
    scene = wr.Scene(gravity=(0, 0, -G))
    upper = scene.add_body(wr.Box((0.1, 0.1, 0.1)), position=(0, 0, -0.2))
    lower = scene.add_body(wr.Box((0.1, 0.1, 0.1)), position=(0, 0, -0.6))
    scene.add_joint(wr.SphericalJoint(), upper, anchor=(0, 0, 0))
    scene.add_joint(wr.SphericalJoint(), lower, upper, anchor=(0, 0, -0.4))
    sim = simulator(scene, device, sleeping=True)
    sim.step(180)
    assert sim.get("asleep").all()
    sim.apply_impulse((0.1, 0, 0), (0, 0, -0.6), lower)
    sim.step()
    assert not sim.get("asleep").any()
    assert anchor_errors(sim).max() < 1e-6


def test_a_gyroscope_keeps_its_spin(device):
    """A disc that turns by a quarter of a radian per step, on an axle from its middle to a joint.

    Neither the joint nor gravity has a torque about the axle, so that the spin about it is constant.
    """
    scene = wr.Scene(gravity=(0, 0, -G))
    along_x = (0.0, np.sqrt(0.5), 0.0, np.sqrt(0.5))
    disc = scene.add_body(
        wr.Cylinder(0.1, 0.01), position=(0.2, 0, 0), orientation=along_x, angular_velocity=(60, 0, 0), mass=1.0
    )
    scene.add_joint(wr.SphericalJoint(), disc, anchor=(0, 0, 0))
    sim = simulator(scene, device)
    for _ in range(8):
        sim.step(60)
        turn = sim.get("orientation")[0, disc]
        spin = rotations.rotate(rotations.inverse(turn), sim.get("angular_velocity")[0, disc])
        assert spin[2] == pytest.approx(60.0, rel=1e-4)
    assert anchor_errors(sim).max() < 1e-6


def test_a_joint_that_holds_nothing_has_no_force(device):
    """After it has broken, and while one of its bodies is inactive."""
    scene = wr.Scene()
    broken = scene.add_body(wr.Sphere(0.05), mass=1.0)
    scene.add_joint(wr.FixedJoint(), broken, break_force=9.0)
    held = scene.add_body(wr.Sphere(0.05), position=(1, 0, 0), mass=1.0)
    scene.add_joint(wr.FixedJoint(), held, anchor=(1, 0, 0))
    sim = wr.Simulator(scene, device=device)
    sim.step(10)
    assert sim.get("joint_broken")[0].tolist() == [True, False]
    np.testing.assert_allclose(sim.get("joint_force")[0, :, 2], [0.0, G], rtol=1e-4)
    sim.set("active", False, bodies=[held])
    sim.step(1)
    assert np.abs(sim.get("joint_force")).max() == 0.0


def test_a_slow_motor_does_not_fall_asleep(device):
    """It is slower than the bodies that sleep."""
    scene = wr.Scene()
    scene.add_static(wr.Plane())
    box = scene.add_body(wr.Box((0.1, 0.1, 0.1)), position=(0, 0, 0.1), mass=1.0)
    slide = scene.add_joint(wr.PrismaticJoint((1, 0, 0)), box, anchor=(0, 0, 0.1))
    scene.add_drive(slide, damping=1000.0, target_velocity=0.005)
    sim = wr.Simulator(scene, device=device, settings=wr.Settings(sleeping=True))
    sim.step(960)
    assert sim.get("position")[0, box, 0] == pytest.approx(0.02, rel=2e-3)


def test_an_orientation_that_is_set_forgets_the_turns_of_a_hinge():
    """The drive holds the body where it was placed; it made one more turn back."""
    scene = one_body(wr.RevoluteJoint((0, 0, 1)))
    scene.add_drive(0, stiffness=50.0, damping=5.0)
    sim = simulator(scene, "cpu", num_envs=2)
    sim.set("angular_velocity", (0, 0, 8.0))
    sim.set("joint_stiffness", 0.0)
    sim.set("joint_damping", 0.0)
    sim.step(240)
    turned = sim.get("joint_position")[:, 0]
    assert (turned > 2.0 * np.pi).all()
    sim.set("orientation", sim.get("orientation"))
    np.testing.assert_allclose(sim.get("joint_position")[:, 0], turned, atol=1e-5)
    sim.set("orientation", (0, 0, 0, 1), envs=[0])
    sim.set("angular_velocity", 0.0)
    np.testing.assert_allclose(sim.get("joint_position")[:, 0], (0.0, turned[1]), atol=1e-5)
    sim.set("joint_stiffness", 50.0)
    sim.step(10)
    assert abs(sim.get("angular_velocity")[0]).max() < 1e-5
