"""Mechanisms without drives: they gain no energy at any step, follow float64 oracles, and their energy is watched."""

from functools import partial

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import warp_rigid as wr
from warp_rigid.validation import passive_mechanisms as mechanisms
from warp_rigid.validation.articulated import exact_period, pendulum, period_of
from warp_rigid.validation.experiment import Experiment

G = 9.81


def trace_of(scene, device, duration, rate):
    """60 records a second."""
    return Experiment(scene, duration, dt=1.0 / rate, every=rate // 60).run(device)


def rod_pendulum():
    """A rod of 1 m on a hinge, let go at 150 degrees: at 1/60 s it went over the top within 120 s."""
    scene = wr.Scene(gravity=(0, 0, -G))
    middle = 0.5 * np.array([np.sin(np.radians(150.0)), 0.0, -np.cos(np.radians(150.0))])
    half = np.radians(150.0) / -2.0
    rod = scene.add_body(
        wr.Box((0.02, 0.02, 0.5)), position=middle, orientation=(0, np.sin(half), 0, np.cos(half)), mass=1.0
    )
    scene.add_joint(wr.RevoluteJoint((0, 1, 0)), rod, anchor=(0, 0, 0))
    return scene


@pytest.mark.parametrize("rate", [60, 240])
@pytest.mark.parametrize(
    "scene",
    [
        rod_pendulum,
        mechanisms.double_pendulum,
        partial(mechanisms.chain, 5),
        mechanisms.four_bar,
        mechanisms.slider_crank,
    ],
    ids=["rod", "double pendulum", "chain", "four-bar", "slider-crank"],
)
def test_passive_mechanisms_gain_no_energy_and_lose_little(scene, rate, device):
    """In 15 s. The double pendulum had gained 15 m g L at 1/60 s, the chain 2 at 1/240 s, the rod 0.02 at 1/60 s."""
    trace = trace_of(scene, device, 15.0, rate)
    assert mechanisms.largest_gain(trace)[0] < 1e-3
    if rate == 240:
        assert mechanisms.loss(trace)[0] < 0.03


@pytest.mark.long
@pytest.mark.parametrize(("angle", "tolerance"), [(150.0, 1e-3), (178.0, 1e-2)])
def test_a_fast_pendulum_keeps_its_energy_and_period_where_the_parts_change(angle, tolerance, device):
    """In 120 s at 1/60 s, links turn by more than LARGEST_TURN at the lowest point only.

    Energy had changed at each change of the parts: by 1e-3 m g L, and by 26 % of the period from 178 degrees.
    """
    trace = trace_of(partial(pendulum, angle), device, 120.0, 60)
    assert mechanisms.largest_gain(trace)[0] < 5e-4
    assert period_of(trace)[0] == pytest.approx(exact_period(angle), rel=tolerance)


@pytest.mark.parametrize("rate", [60, pytest.param(480, marks=pytest.mark.long)])
def test_a_chain_that_whips_for_long_keeps_its_energy(rate, device):
    """120 s: the chain of five had lost a quarter of m g L at 1/60 s."""
    trace = trace_of(partial(mechanisms.chain, 5), device, 120.0, rate)
    energy = mechanisms.change_of_energy(trace)
    assert energy.max() < 1e-3
    assert energy[-60:].max() > -0.03


def whirling_chain():
    """Four thin links on ball joints, let go in a horizontal line that turns about the vertical, and falls."""
    scene, above, spin = wr.Scene(gravity=(0, 0, -G)), None, np.array([0.0, 0.3, 1.0])
    for k in range(4):
        middle = np.array([0.2 * k + 0.1, 0.0, 0.0])
        link = scene.add_body(
            wr.Box((0.1, 0.01, 0.01)),
            position=middle,
            mass=0.25,
            linear_velocity=np.cross(spin, middle),
            angular_velocity=spin,
        )
        scene.add_joint(wr.SphericalJoint(), link, above, anchor=(0.2 * k, 0, 0))
        above = link
    for a in range(4):
        for b in range(a + 1, 4):
            scene.filter_pair(a, b)
    return scene


@pytest.mark.parametrize("rate", [60, 240])
def test_a_chain_that_whirls_keeps_its_energy(rate, device):
    """Its links turn about all axes within a step. They had gained 134 m g L at 1/60 s, and 0.5 at 1/240 s, in 10 s.

    Velocities are half a step older than poses, which accounts for 0.0018 m g L at 1/60 s.
    """
    trace = trace_of(whirling_chain, device, 10.0, rate)
    assert mechanisms.largest_gain(trace)[0] < 3e-3
    assert mechanisms.loss(trace)[0] < 3e-3


def test_contacts_between_the_parts_give_no_energy(device):
    """A rod passes a post without touching it. A step with contacts is one part; it had become 0.5 % faster in 10 s."""
    scene = wr.Scene(gravity=(0, 0, 0))
    rod = scene.add_body(
        wr.Box((0.5, 0.02, 0.02)),
        position=(0.5, 0, 0),
        mass=1.0,
        linear_velocity=(0, 0, -5),
        angular_velocity=(0, 10, 0),
    )
    scene.add_joint(wr.RevoluteJoint((0, 1, 0)), rod, anchor=(0, 0, 0))
    scene.add_static(wr.Sphere(0.05), position=(0.7, 0.0705, -0.7))
    trace = trace_of(lambda: scene, device, 10.0, 60)
    speed = np.linalg.norm(trace.angular_velocity[1:, 0, 0], axis=-1)
    assert np.median(speed[-60:]) == pytest.approx(np.median(speed[:60]), rel=1e-4)


def test_links_whose_anchor_is_switched_off_keep_their_momentum(device):
    """They are not held, so their velocities are not scaled, which had changed it by 1e-4 of it."""
    scene = mechanisms.chain(4)
    sim = wr.Simulator(scene, device=device, settings=wr.Settings(dt=1.0 / 60.0))
    sim.set("gravity", (0, 0, 0))
    sim.set("active", [[False, True, True, True]])
    sim.set("linear_velocity", (3.0, 0.0, 1.0), bodies=slice(1, 4))
    sim.set("angular_velocity", [[0.0, rate, 0.0] for rate in (-15.0, 15.0, 45.0)], bodies=slice(1, 4))
    for _ in range(60):
        sim.step()
        assert np.abs(sim.get("linear_velocity")[0, 1:].mean(axis=0) - (3.0, 0.0, 1.0)).max() < 5e-6


def test_a_long_chain_whips_without_gain(device):
    """Its end turns by more than a radian in a step of 1/60 s, in eleven steps."""
    trace = trace_of(partial(mechanisms.chain, 20), device, 3.5, 60)
    assert (np.linalg.norm(trace.angular_velocity[:, 0], axis=-1).max(axis=1) > 60.0).sum() > 5
    assert mechanisms.largest_gain(trace)[0] < 1e-3


def with_friction_and_limits():
    """The chain of hinges, with friction, and limits that it meets."""
    scene = wr.Scene(gravity=(0, 0, -G))
    above = None
    for k in range(5):
        link = scene.add_body(wr.Box((0.1, 0.01, 0.01)), position=(0.2 * k + 0.1, 0, 0), mass=0.2)
        joint = wr.RevoluteJoint((0, 1, 0), limits=(-0.5, 0.5) if above is not None else None, friction=0.002)
        scene.add_joint(joint, link, above, anchor=(0.2 * k, 0, 0))
        above = link
    return scene


@pytest.mark.parametrize("rate", [60, 240])
def test_friction_and_limits_only_take_energy(rate, device):
    energy = mechanisms.change_of_energy(trace_of(with_friction_and_limits, device, 10.0, rate))
    assert energy.max() < 1e-3
    assert energy[-60:].max() < -0.1


def shake(steps, dt):
    """Positions of the double pendulum after each step of SHAKE in float64, (steps, 2, 3)."""
    x = np.array([[1.0, 0.0, 0.0], [2.0, 0.0, 0.0]])
    v = np.zeros((2, 3))
    places = []
    for _ in range(steps):
        u = np.array([x[0], x[1] - x[0]])
        rows = np.array([[u[0], np.zeros(3)], [-u[1], u[1]]])
        v = v + dt * np.array([0.0, 0.0, -G])
        for _ in range(20):
            y = x + dt * v
            error = np.array([np.linalg.norm(y[0]), np.linalg.norm(y[1] - y[0])]) - 1.0
            w = np.array([y[0] / np.linalg.norm(y[0]), (y[1] - y[0]) / np.linalg.norm(y[1] - y[0])])
            after = np.array([[w[0], np.zeros(3)], [-w[1], w[1]]])
            impulse = np.linalg.solve(np.einsum("iab,jab->ij", after, rows), -error / dt)
            v = v + np.einsum("i,iab->ab", impulse, rows)
        x = x + dt * v
        places.append(x)
    return np.array(places)


def test_a_fast_end_of_a_mechanism_is_not_held_back(device):
    """Its displacement had been limited to what its own velocity predicts: an error of 9 mm after 40 steps."""
    exact = shake(40, 1.0 / 60.0)
    sim = wr.Simulator(mechanisms.double_pendulum(), settings=wr.Settings(dt=1.0 / 60.0), device=device)
    for places in exact[:30]:
        sim.step()
        assert np.abs(sim.get("position")[0] - places).max() < 2e-5


def five_points(t, y):
    """Point masses of 1 kg on massless rods of 0.2 m: angles from the vertical, and their rates."""
    n = len(y) // 2
    angle, rate = y[:n], y[n:]
    below = n - np.maximum.outer(np.arange(n), np.arange(n))
    apart = angle[:, None] - angle[None, :]
    force = -0.2 * (below * np.sin(apart)) @ rate**2 - G * below.diagonal() * np.sin(angle)
    return np.concatenate([rate, np.linalg.solve(0.2 * below * np.cos(apart), force)])


def test_a_chain_of_five_follows_its_differential_equation(device):
    """1 s from 60 degrees, against DOP853; the error is of second order in the step."""
    start = np.radians(60.0)
    sol = solve_ivp(five_points, (0, 1), [start] * 5 + [0.0] * 5, "DOP853", rtol=1e-12, atol=1e-12, dense_output=True)
    errors = []
    for rate in (480, 960):
        scene, above, at = wr.Scene(gravity=(0, 0, -G)), None, np.zeros(3)
        # Velocities are half a step older than poses.
        swing = 0.5 / rate * five_points(0.0, sol.y[:, 0])[5:]
        for k in range(5):
            place = at + 0.2 * np.array([np.sin(start), 0.0, -np.cos(start)])
            speed = -0.2 * swing[: k + 1].sum() * np.array([np.cos(start), 0.0, np.sin(start)])
            ball = scene.add_body(wr.Sphere(0.01), position=place, mass=1.0, linear_velocity=speed)
            scene.add_joint(wr.DistanceJoint(0.2, 0.2), ball, above, anchor=place, anchor_b=at)
            above, at = ball, place
        sim = wr.Simulator(scene, settings=wr.Settings(dt=1.0 / rate), device=device)
        sim.step(rate)
        angle = sol.sol(1.0)[:5]
        exact = np.cumsum(0.2 * np.stack([np.sin(angle), 0.0 * angle, -np.cos(angle)], axis=-1), axis=0)
        errors.append(np.abs(sim.get("position")[0] - exact).max())
    assert errors[1] < 2e-3
    assert errors[1] < 0.4 * errors[0]


def test_energy_gained_by_a_mechanism_is_reported(device):
    """A ball that is moved away from its hinge is pulled back, and swings on with the speed of that correction."""
    sim = wr.Simulator(mechanisms.double_pendulum(), device=device)
    sim.set("position", [[[1.0, 0.0, 0.0], [2.5, 0.0, 0.0]]])
    sim.step(256)
    assert set(sim.warnings()["warning"]) == {"energy"}


def test_energy_that_a_spring_gives_is_not_reported(device):
    scene = wr.Scene(gravity=(0, 0, 0))
    rod = scene.add_body(wr.Box((0.5, 0.02, 0.02)), mass=1.0)
    joint = scene.add_joint(wr.RevoluteJoint((0, 1, 0)), rod, anchor=(0, 0, 0))
    scene.add_drive(joint, stiffness=50.0, target_position=1.0)
    sim = wr.Simulator(scene, device=device)
    fastest = 0.0
    for _ in range(32):
        sim.step(16)
        fastest = max(fastest, float(np.abs(sim.get("angular_velocity")).max()))
    assert fastest > 5.0 and len(sim.warnings()) == 0
