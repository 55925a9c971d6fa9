"""Armature: the inertia that the rotor of a motor adds to the coordinate of a hinge or slider."""

import math

import numpy as np
import pytest

import warp_rigid as wr
from warp_rigid.scene.serialization import scenes_from_data, scenes_to_data

DT = 1e-3


def simulator(scene):
    return wr.Simulator(scene, device="cpu", settings=wr.Settings(dt=DT))


def test_a_damped_lever_slows_down_with_the_inertia_of_its_rotor():
    """Its speed is exp(-c t / (I + A)); without damping it is constant."""
    inertia, armature = (1.0 + 0.01) / 12.0 + 0.25, 2.0
    for damping in (0.0, 1.0):
        scene = wr.Scene(gravity=(0, 0, 0))
        lever = scene.add_body(
            wr.Box((0.5, 0.05, 0.05)),
            position=(0.5, 0, 1),
            mass=1.0,
            linear_velocity=(0, 0, -0.5),
            angular_velocity=(0, 1, 0),
        )
        hinge = scene.add_joint(wr.RevoluteJoint((0, 1, 0)), lever, anchor=(0, 0, 1), armature=armature)
        scene.add_drive(hinge, damping=damping)
        sim = simulator(scene)
        sim.step(1000)
        speed = math.exp(-damping / (inertia + armature))
        assert sim.get("joint_velocity")[0, 0] == pytest.approx(speed, rel=5e-4)


def test_a_falling_lever_has_the_energy_of_its_rotor():
    """m g l = (I + A) w^2 / 2 at the lowest point."""
    inertia, armature = (1.0 + 0.01) / 12.0 + 0.25, 0.5
    scene = wr.Scene()
    lever = scene.add_body(wr.Box((0.5, 0.05, 0.05)), position=(0.5, 0, 1), mass=1.0)
    scene.add_joint(wr.RevoluteJoint((0, 1, 0)), lever, anchor=(0, 0, 1), armature=armature)
    sim = simulator(scene)
    fastest = 0.0
    for _ in range(100):
        sim.step(10)
        fastest = max(fastest, float(sim.get("joint_velocity")[0, 0]))
    assert fastest == pytest.approx(math.sqrt(2.0 * 9.81 * 0.5 / (inertia + armature)), rel=2e-3)


def test_a_bead_on_a_turning_rod_moves_outward_with_the_inertia_of_its_rotor():
    """(m + A) r'' = m w^2 r, so r = r0 cosh(w t sqrt(m / (m + A)))."""
    scene = wr.Scene(gravity=(0, 0, 0))
    rod = scene.add_kinematic(wr.Box((1.0, 0.02, 0.02)), angular_velocity=(0, 0, 2))
    bead = scene.add_body(wr.Sphere(0.05), position=(0.2, 0, 0), mass=0.5, linear_velocity=(0, 0.4, 0))
    scene.add_joint(wr.PrismaticJoint((1, 0, 0)), bead, rod, anchor=(0.2, 0, 0), armature=1.5)
    sim = simulator(scene)
    sim.step(1000)
    radius = 0.2 * math.cosh(2.0 * math.sqrt(0.5 / 2.0))
    assert np.linalg.norm(sim.get("position")[0, bead]) == pytest.approx(radius, rel=2e-3)


def test_an_armature_is_checked_saved_and_set_per_environment():
    scene = wr.Scene()
    ball = scene.add_body(wr.Sphere(0.1), mass=1.0)
    with pytest.raises(ValueError, match="armature: needs a RevoluteJoint or a PrismaticJoint, got a SphericalJoint"):
        scene.add_joint(wr.SphericalJoint(), ball, armature=1.0)
    with pytest.raises(ValueError, match="armature: must be"):
        scene.add_joint(wr.RevoluteJoint((0, 1, 0)), ball, armature=-1.0)
    scene.add_joint(wr.RevoluteJoint((0, 1, 0)), ball, armature=0.25)
    assert scenes_from_data(*scenes_to_data([scene]))[0].joints[0].armature == 0.25
    sim = wr.Simulator(scene, num_envs=2, device="cpu")
    sim.set("joint_armature", [[0.25], [0.5]])
    assert sim.get("joint_armature").ravel().tolist() == [0.25, 0.5]


@pytest.mark.parametrize("first", [True, False])
@pytest.mark.parametrize("restitution", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("armature", [0.5, 2.0])
def test_an_impact_meets_the_inertia_of_the_rotor(armature, restitution, first):
    """The speed of a slider after an elastic impact was too low by the factor m / (m + A)."""
    scene = wr.Scene(gravity=(0, 0, 0))
    struck = scene.add_body(wr.Sphere(0.1), mass=1.0, restitution=restitution)
    scene.add_joint(wr.PrismaticJoint((1, 0, 0)), struck, armature=armature)
    shot = {"position": (-0.5, 0, 0), "linear_velocity": (2, 0, 0), "mass": 1.0, "restitution": restitution}
    ball = scene.add_body(wr.Sphere(0.1), **shot)
    sim = wr.Simulator(scene, device="cpu", settings=wr.Settings(collision_first=first))
    sim.step(96)
    change = 2.0 * (1.0 + restitution) / (2.0 + armature)
    expected = {struck: change, ball: 2.0 - (1.0 + armature) * change}
    for body, speed in expected.items():
        assert sim.get("linear_velocity")[0, body, 0] == pytest.approx(speed, abs=1e-4)


def test_a_slider_with_a_rotor_bounces_off_the_ground():
    """It falls with g m / (m + A), and rises to e^2 of its height."""
    scene = wr.Scene()
    scene.add_static(wr.Plane(), position=(0, 0, -0.6), restitution=0.5)
    slider = scene.add_body(wr.Sphere(0.1), mass=1.0, restitution=0.5)
    scene.add_joint(wr.PrismaticJoint((0, 0, 1)), slider, armature=2.0)
    sim = wr.Simulator(scene, device="cpu")
    sim.step(130)
    speeds = []
    for _ in range(60):
        sim.step()
        speeds.append(sim.get("linear_velocity")[0, slider, 2])
    assert max(speeds) == pytest.approx(0.5 * math.sqrt(2.0 * 9.81 / 3.0 * 0.5), rel=0.01)
