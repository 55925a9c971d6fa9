"""Ragdolls: mechanisms that only contacts support. Energy, rest and sleep."""

import numpy as np
import pytest

import warp_rigid as wr
from warp_rigid import scenes
from warp_rigid.scenes.builders.jointed import add_ragdoll, anchor_errors

G = 9.81
STANDING = 0.99
"""Height of the hip of a ragdoll that stands on the ground [m]."""


def ragdoll(device, height=STANDING, damping=0.0, count=1, **settings):
    """A ragdoll in each of `count` environments, whose hip is at a height [m]."""
    scene = wr.Scene(gravity=(0, 0, -G))
    scene.add_static(wr.Plane(), friction=0.6)
    add_ragdoll(scene, (0, 0, height), "doll", damping)
    return wr.Simulator(scene, count, wr.Settings(**settings), device=device)


def energy(sim, kinds=("kinetic_energy", "potential_energy")):
    """Energy of each environment, summed in float64 [J]."""
    return sum(sim.get(name).astype(np.float64).sum(axis=1) for name in kinds)


def largest_gains(sim, steps):
    """Largest gain of energy in a step, per environment [J].

    In a step, the discretization of the motion changes the energy by up to 0.3 % of the kinetic energy; twice this is
    not counted.
    """
    gains = []
    for _ in range(steps):
        last, moving = energy(sim), energy(sim, ["kinetic_energy"])
        sim.step(1)
        gains.append(energy(sim) - last - 6e-3 * moving)
    return np.max(gains, axis=0)


@pytest.mark.long
def test_the_energy_of_a_ragdoll_without_damping_does_not_grow(device):
    """It stands, and folds up. The impulses of a contact must not act again in the next step."""
    assert largest_gains(ragdoll(device), 480) < 1e-3


def test_the_energy_of_ragdolls_that_land_hardly_grows(device):
    """Of 240 J, they gain up to 1.7 J in a step in which they fold up; 0.2 J on average over the heights."""
    sim = ragdoll(device, count=20)
    position = sim.get("position")
    position[:, 1:, 2] += np.linspace(0.01, 0.2, 20)[:, None]
    sim.set("position", position)
    gains = largest_gains(sim, 480)
    assert gains.mean() < 0.4 and gains.max() < 3.4


def test_a_ragdoll_comes_to_rest_and_sleeps(device):
    """Its limbs are damped; without damping, they turn about their joints without end."""
    sim = ragdoll(device, STANDING + 0.1, 0.5, sleeping=True)
    sim.step(840)
    assert sim.get("asleep")[0, 1:].all()
    assert anchor_errors(sim).max() < 1e-6 and sim.penetration()[0] < 1e-4


@pytest.mark.long
def test_ragdolls_in_a_pit_come_to_rest(device):
    scene = scenes.get("ragdolls").build(dolls=4)
    sim = wr.Simulator(scene, device=device)
    sim.step(1080)
    assert np.linalg.norm(sim.get("linear_velocity")[0], axis=-1).max() < 0.01
    assert anchor_errors(sim).max() < 1e-6 and sim.penetration()[0] < 2e-4


@pytest.mark.long
def test_ragdolls_in_a_heap_do_not_move_when_others_land(device):
    """Twenty-five in one island: the impulses of those at rest must not depend on an impact somewhere else."""
    scene = scenes.get("ragdolls").build(dolls=25)
    sim = wr.Simulator(scene, device=device)
    sim.step(960)
    assert np.median(np.linalg.norm(sim.get("linear_velocity")[0], axis=-1)) < 0.01
    assert anchor_errors(sim).max() < 1e-6 and sim.penetration()[0] < 0.01


@pytest.mark.long
def test_ragdolls_that_fall_together_do_not_enter_each_other(device):
    """Four, one above the other, at 20 m/s: 8 cm in a step, as thick as a neck. They stop one after the other."""
    scene = wr.Scene(gravity=(0, 0, -G))
    scene.add_static(wr.Plane(), friction=0.6)
    places = np.random.default_rng(0).uniform(-0.05, 0.05, (3, 2))
    for k, (x, y) in enumerate([(0.0, 0.0), *places]):
        add_ragdoll(scene, (x, y, 1.1 + 1.95 * k), f"doll_{k}")
    sim = wr.Simulator(scene, device=device)
    sim.set("linear_velocity", (0, 0, -20.0), bodies=list(range(1, len(scene.bodies))))
    last = energy(sim)
    for _ in range(240):
        sim.step(1)
        assert sim.penetration()[0] < 0.045 and anchor_errors(sim).max() < 2e-6
        now = energy(sim)
        assert now < last + 0.1
        last = now


def test_the_motion_of_a_heap_that_lands_is_not_slowed(device):
    """Two ragdolls fall side by side at 20 m/s, arm at arm: the arms meet, but both fall on as far as alone."""
    scene = wr.Scene(gravity=(0, 0, 0))
    count = []
    for x in (-0.33, 0.33):
        add_ragdoll(scene, (x, 0, 1), f"doll_{x}")
        count.append(len(scene.bodies))
    sim = wr.Simulator(scene, device=device)
    bodies = np.arange(count[1])
    swing = np.where(bodies < count[0], 6.0, -6.0)
    velocity = np.stack([swing, 0 * swing, 0 * swing - 20.0], axis=1)
    sim.set("linear_velocity", velocity[None])
    start = sim.get("position")[0]
    sim.step(24)
    assert np.ptp(sim.get("position")[0, :, 0]) < np.ptp(start[:, 0]), "they have met"
    mass = sim.get("mass")[0]
    fallen = (mass @ (start - sim.get("position")[0])[:, 2]) / mass.sum()
    assert fallen == pytest.approx(20.0 * 24 / 240, rel=0.02)


def test_an_overlap_of_a_light_foot_of_a_heavy_mechanism_is_pushed_out(device):
    """By a quarter in each step, as one of a single body: 100 kg on a foot of 1 kg that starts 4 mm in the ground."""
    scene = wr.Scene(gravity=(0, 0, 0))
    scene.add_static(wr.Plane())
    foot = scene.add_body(wr.Box((0.1, 0.1, 0.05)), position=(0, 0, 0.046), mass=1.0)
    leg = scene.add_body(wr.Box((0.1, 0.1, 0.4)), position=(0, 0, 0.5), mass=100.0)
    scene.add_joint(wr.SphericalJoint(), leg, foot, anchor=(0, 0, 0.1))
    sim = wr.Simulator(scene, device=device)
    for share in (0.75, 0.75**2, 0.75**3, 0.75**4):
        sim.step(1)
        assert sim.penetration()[0] == pytest.approx(0.004 * share, abs=5e-5)
    assert anchor_errors(sim).max() < 1e-6
    assert np.abs(sim.get("linear_velocity")).max() < 1e-5


def test_rolling_friction_brakes_a_ball_that_is_a_mechanism(device):
    """Two halves welded together: the centre of mass is slowed down as that of one ball, by 5 g c / (7 r)."""
    radius, coefficient, speed = 0.1, 0.004, 1.0
    scene = wr.Scene(gravity=(0, 0, -G))
    scene.add_static(wr.Plane(), friction=0.8, rolling_friction=coefficient)
    for _ in range(2):
        scene.add_body(
            wr.Sphere(radius),
            position=(0, 0, radius),
            mass=0.5,
            linear_velocity=(speed, 0, 0),
            angular_velocity=(0, speed / radius, 0),
            friction=0.8,
            rolling_friction=coefficient,
        )
    scene.add_joint(wr.FixedJoint(), 1, 2, anchor=(0, 0, radius))
    sim = wr.Simulator(scene, device=device)
    sim.step(240)
    braking = 5.0 * G * coefficient / (7.0 * radius)
    assert sim.get("linear_velocity")[0, 1, 0] == pytest.approx(speed - braking, rel=0.01)
