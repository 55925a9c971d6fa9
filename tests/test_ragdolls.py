"""Ragdolls: mechanisms that only contacts support. Energy, rest and sleep."""

import numpy as np
import pytest

import warp_rigid as wr
from warp_rigid import scenes
from warp_rigid.scenes.builders.jointed import add_ragdoll, anchor_errors

G = 9.81
STANDING = 0.99
"""Height of the hip of a ragdoll that stands on the ground [m]."""


def ragdoll(device, height=STANDING, damping=0.0, **settings):
    """A ragdoll whose hip is at a height [m]."""
    scene = wr.Scene(gravity=(0, 0, -G))
    scene.add_static(wr.Plane(), friction=0.6)
    add_ragdoll(scene, (0, 0, height), "doll", damping)
    return wr.Simulator(scene, settings=wr.Settings(**settings), device=device)


def energy(sim):
    """Kinetic and potential energy [J], summed in float64."""
    return sum(sim.get(name)[0].astype(np.float64).sum() for name in ("kinetic_energy", "potential_energy"))


@pytest.mark.parametrize("drop", [0.0, 0.1])
def test_the_energy_of_a_ragdoll_without_damping_does_not_grow(device, drop):
    """It lands on its feet, and folds up. The impulses of a landing must not act again in the next step.

    In a step, the discretization of the motion changes the energy by up to 0.3 % of the kinetic energy.
    """
    sim = ragdoll(device, STANDING + drop)
    last = energy(sim)
    for _ in range(480):
        moving = sim.get("kinetic_energy")[0].sum()
        sim.step(1)
        now = energy(sim)
        assert now < last + 1e-3 + 6e-3 * moving
        last = now


def test_a_ragdoll_comes_to_rest_and_sleeps(device):
    """Its limbs are damped; without damping, they turn about their joints without end."""
    sim = ragdoll(device, STANDING + 0.1, 0.5, sleeping=True)
    sim.step(720)
    assert sim.get("asleep")[0, 1:].all()
    assert anchor_errors(sim).max() < 1e-6 and sim.penetration()[0] < 1e-4


def test_ragdolls_in_a_pit_come_to_rest(device):
    scene = scenes.get("ragdolls").build(dolls=4)
    sim = wr.Simulator(scene, device=device)
    sim.step(1080)
    assert np.linalg.norm(sim.get("linear_velocity")[0], axis=-1).max() < 0.01
    assert anchor_errors(sim).max() < 1e-6 and sim.penetration()[0] < 2e-4


@pytest.mark.long
def test_ragdolls_in_a_heap_do_not_move_when_others_land(device):
    """Forty in one island: the impulses of those at rest must not depend on an impact somewhere else."""
    scene = scenes.get("ragdolls").build(dolls=40)
    sim = wr.Simulator(scene, device=device)
    sim.step(960)
    assert np.median(np.linalg.norm(sim.get("linear_velocity")[0], axis=-1)) < 0.01
    assert anchor_errors(sim).max() < 1e-6 and sim.penetration()[0] < 0.01


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
