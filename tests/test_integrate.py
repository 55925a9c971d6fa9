"""Last stage: exact rotation, and drift of what must not (the free tops of V10 to V12 are in the validation)."""

import numpy as np
import pytest
from scipy.optimize import brentq

from tests.oracles import opened, random_quaternion, rotate_about, rotation_matrix
from warp_rigid.engine.settings import Settings
from warp_rigid.engine.simulator import Simulator
from warp_rigid.scene.scene import Scene
from warp_rigid.scene.shapes import Box, Capsule, Compound, Cylinder, Plane, Sphere

DT = 1 / 240


def free_body(device, inertia, spin, orientation=(0, 0, 0, 1), dt=DT):
    """One body in free space with a given diagonal inertia; spin in its own frame."""
    scene = Scene(gravity=(0, 0, 0))
    turned = rotation_matrix(orientation) @ spin
    scene.add_body(Sphere(1.0), mass=1.0, orientation=orientation, angular_velocity=turned)
    sim, stages = opened(scene, device, settings=Settings(dt=dt))
    stages.model.bodies.inertia.assign(np.diag(inertia).astype(np.float32)[None])
    stages.model.bodies.inverse_inertia.assign(np.diag(1.0 / np.array(inertia)).astype(np.float32)[None])
    return sim


def follow(sim, steps):
    """Rotation matrices (n, 3, 3) and angular velocities (n, 3) of the only body at the start and after each step."""
    turns, spins = [sim.get("orientation")[0, 0]], [sim.get("angular_velocity")[0, 0]]
    for _ in range(steps):
        sim.step()
        turns.append(sim.get("orientation")[0, 0])
        spins.append(sim.get("angular_velocity")[0, 0])
    return rotation_matrix(np.array(turns, np.float64)), np.array(spins, np.float64)


def momentum(turns, spins, inertia):
    body = np.einsum("nji,nj->ni", turns, spins)
    return np.einsum("nij,nj->ni", turns, body * inertia)


def test_momentum_keeps_its_direction(device):
    """A tumbling body's angular momentum turns by no more than rounding, and its quaternion keeps its length."""
    inertia = np.array([1.0, 2.0, 2.5])
    sim = free_body(device, inertia, (3.0, 4.0, 5.0), random_quaternion(np.random.default_rng(2)))
    turns, spins = follow(sim, 2000)
    total = momentum(turns, spins, inertia)
    direction = total / np.linalg.norm(total, axis=1, keepdims=True)
    assert np.linalg.norm(direction - direction[0], axis=1).max() < 1e-5
    assert np.linalg.norm(sim.get("orientation")[0, 0]) == pytest.approx(1.0, abs=1e-6)


def test_steady_spin(device):
    """About a principal axis, up to three radians a step: the angle is that of omega t, to 3e-5."""
    for spin in (0.001, 3.0, 83.0, 720.0):
        sim = free_body(device, (1.0, 2.0, 3.0), (0.0, 0.0, spin))
        sim.step(48)
        x, y, z, w = sim.get("orientation")[0, 0].astype(np.float64)
        error = np.angle(np.exp(1j * (2.0 * np.arctan2(z, w) - spin * 0.2)))
        assert abs(error) < 2e-6 + 3e-5 * spin * 0.2
        assert sim.get("angular_velocity")[0, 0] == pytest.approx([0, 0, spin], rel=1e-6, abs=1e-9)


@pytest.mark.parametrize("half", [(0.1, 0.2, 0.05), (0.5, 0.01, 0.01), (0.3, 0.3, 0.02)])
@pytest.mark.parametrize("spin", [3.0, 30.0, 300.0, 1000.0])
def test_a_free_body_keeps_its_energy_and_momentum(device, half, spin):
    """Up to 4 radians a step, for 10 s: both to rounding, measured 3e-7; twice that is allowed."""
    scene = Scene(gravity=(0, 0, 0))
    scene.add_body(Box(half), angular_velocity=(spin, 0.1 * spin, 0.3 * spin))
    sim, _ = opened(scene, device)

    def conserved():
        turn = rotation_matrix(sim.get("orientation")[0, 0].astype(np.float64))
        inertia = turn @ Box(half).inertia @ turn.T
        omega = sim.get("angular_velocity")[0, 0].astype(np.float64)
        return omega @ inertia @ omega, inertia @ omega

    energy, total = conserved()
    for _ in range(10):
        sim.step(240)
        energy_now, total_now = conserved()
        assert energy_now == pytest.approx(energy, rel=6e-7)
        assert np.linalg.norm(total_now - total) < 6e-7 * np.linalg.norm(total)


def test_kinematic_bodies_move_as_told(device):
    """Screw motion at given velocities, unmoved by gravity and by what lands on them; statics do not move at all."""
    scene = Scene()
    turn = rotate_about((1, 2, 3), 50)
    table = scene.add_kinematic(
        Box((1, 1, 0.1)),
        position=(0, 0, 1),
        orientation=turn,
        linear_velocity=(0.1, 0, 0.2),
        angular_velocity=(0, 0, 2),
    )
    block = scene.add_static(Box((1, 1, 0.1)), position=(0, 0, -1), orientation=turn)
    scene.add_body(Sphere(0.1), position=(0, 0, 1.5), mass=1e4)
    sim, _ = opened(scene, device)
    sim.step(120)
    np.testing.assert_allclose(sim.get("position")[0, table], [0.05, 0, 1.1], atol=1e-5)
    expected = rotation_matrix(rotate_about((0, 0, 1), np.degrees(1.0))) @ rotation_matrix(turn)
    np.testing.assert_allclose(rotation_matrix(sim.get("orientation")[0, table]), expected, atol=1e-5)
    assert sim.get("linear_velocity")[0, table] == pytest.approx([0.1, 0, 0.2])
    assert sim.get("position")[0, block].tolist() == [0, 0, -1]
    assert sim.get("orientation")[0, block] == pytest.approx(turn, abs=1e-7)


def test_a_body_turns_about_its_centre_of_mass(device):
    """Its origin, away from the centre of mass, goes round; the centre of mass flies straight."""
    dumbbell = Compound([(Sphere(0.1), (0.5, 0, 0), (0, 0, 0, 1)), (Sphere(0.2), (-0.2, 0.1, 0), (0, 0, 0, 1))])
    scene = Scene(gravity=(0, 0, 0))
    scene.add_body(
        dumbbell, orientation=rotate_about((3, 2, 1), 77), linear_velocity=(1, 2, -1), angular_velocity=(5, 3, 9)
    )
    sim, _ = opened(scene, device)
    start = sim.get("center_of_mass")[0, 0].astype(np.float64)
    origin = sim.get("position")[0, 0].astype(np.float64)
    assert np.linalg.norm(start - origin) > 0.05
    sim.step(240)
    np.testing.assert_allclose(sim.get("center_of_mass")[0, 0], start + [1, 2, -1], atol=1e-5)
    assert np.linalg.norm(sim.get("position")[0, 0] - origin - [1, 2, -1]) > 0.02


def test_held_force_and_torque(device):
    """A constant force and torque on a free body: the discrete sums, until they are changed."""
    scene = Scene(gravity=(0, 0, 0))
    scene.add_body(Sphere(0.5), mass=2.0)
    sim, _ = opened(scene, device)
    sim.set("force", (3.0, 0.0, 0.0))
    sim.set("torque", (0.0, 0.0, 0.4))
    sim.step(100)
    inertia = 0.4 * 2.0 * 0.25
    assert sim.get("linear_velocity")[0, 0] == pytest.approx([3.0 / 2.0 * 100 * DT, 0, 0], rel=1e-5)
    assert sim.get("angular_velocity")[0, 0] == pytest.approx([0, 0, 0.4 / inertia * 100 * DT], rel=1e-5)
    assert sim.get("position")[0, 0, 0] == pytest.approx(1.5 * DT**2 * 100 * 101 / 2, rel=1e-5)
    sim.set("force", 0.0)
    sim.step(10)
    assert sim.get("linear_velocity")[0, 0, 0] == pytest.approx(1.5 * 100 * DT, rel=1e-5)


def test_a_throw_is_the_sum_of_its_steps_in_float32():
    """NumPy's sums of a thousand steps end with the same bits: the error of 0.028 mm is rounding alone.

    On the CPU, where products and sums are rounded one by one.
    """
    scene = Scene()
    scene.add_body(Sphere(0.1), linear_velocity=(3, -2, 4), angular_velocity=(5, 0, 0))
    sim = Simulator(scene, settings=Settings(dt=1 / 1000), device="cpu")
    sim.step(1000)
    dt, gravity = np.float32(1 / 1000), np.array([0, 0, -9.81], np.float32)
    x, v = np.zeros(3, np.float32), np.array([3, -2, 4], np.float32)
    for _ in range(1000):
        v += dt * gravity
        x = (x + np.float64(dt) * v.astype(np.float64)).astype(np.float32)
    exact = np.array([3, -2, 4 - 9.81 * 1001 / 2000])
    assert np.array_equal(sim.get("position")[0, 0], x)
    assert 2.7e-5 < np.linalg.norm(x - exact) < 2.9e-5


def test_a_body_that_hardly_turns_is_not_turned_by_more(device):
    """A plank at rest but for rounding errors: the correction of its energy is no turn of its own."""
    generator = np.random.default_rng(2)
    scene = Scene(gravity=(0, 0, 0))
    plank = scene.add_body(Box((0.058, 0.012, 0.004)))
    sim = Simulator(scene, num_envs=256, device=device)
    yaw = generator.uniform(-np.pi, np.pi, 256)
    start = np.stack([0 * yaw, 0 * yaw, np.sin(yaw / 2), np.cos(yaw / 2)], axis=1).astype(np.float32)
    sim.set("orientation", start[:, None], bodies=[plank])
    spin = generator.normal(size=(256, 3)) * 10.0 ** generator.uniform(-9, -3, (256, 1))
    sim.set("angular_velocity", spin[:, None].astype(np.float32), bodies=[plank])
    sim.step()
    turned = 2 * np.linalg.norm(sim.get("orientation")[:, plank, :3] - start[:, :3], axis=1)
    assert (turned < 1.1 * np.linalg.norm(spin, axis=1) * sim.settings.dt + 1e-6).all()


def test_a_top_precesses_as_steeply_as_it_started(device):
    """A push-out keeps the direction of the angular momentum: a top without friction nutates as its energy permits."""
    tilt, spin, length, tip = 0.3, 100.0, 0.06, 0.006
    scene = Scene(gravity=(0, 0, -9.81), friction_combine="min")
    scene.add_static(Plane(), friction=0.0)
    shape = Compound([(part, (0, 0, 0), (0, 0, 0, 1)) for part in (Cylinder(0.06, 0.01), Capsule(tip, length))])
    place, turn = (0, 0, length * np.cos(tilt) + tip), rotate_about((0, 1, 0), np.degrees(tilt))
    axis = rotation_matrix(turn)[:, 2]
    scene.add_body(shape, position=place, orientation=turn, angular_velocity=spin * axis)
    sim, stages = opened(scene, device, settings=Settings(dt=DT))
    across, _, along = np.diag(stages.model.bodies.inertia.numpy()[-1]).astype(np.float64)
    weight = 9.81 * sim.get("mass")[0, -1] * length

    def barrier(angle):
        """Energy of a heavy symmetric top beyond that at the start; it is 0 at the limits of the nutation [J]."""
        turning = along * spin * (np.cos(tilt) - np.cos(angle))
        return turning**2 / (2 * across * np.sin(angle) ** 2) + weight * (np.cos(angle) - np.cos(tilt))

    lowest = brentq(barrier, tilt + 1e-4, tilt + 0.1)
    tilts = []
    for _ in range(120):
        sim.step(4)
        tilts.append(np.arccos(rotation_matrix(sim.get("orientation")[0, -1])[2, 2]))
    assert tilt - 0.002 < min(tilts) and max(tilts) < lowest + 0.002
