"""Load distribution: a sliding pair with redundant contacts carries its load as on an elastic ground."""

import numpy as np
import pytest

import warp_rigid as wr
from tests.oracles import ground_scene, rotate_about

G = 9.81


def ring(count, radius=0.5, foot=0.005):
    """Small balls on a circle."""
    angle = 2.0 * np.pi * np.arange(count) / count
    places = np.stack([radius * np.cos(angle), radius * np.sin(angle), 0.0 * angle], axis=1)
    return wr.Compound([(wr.Sphere(foot), place, (0, 0, 0, 1)) for place in places]), foot


def slid(shape, height, device, friction, steps=5, orientation=(0, 0, 0, 1), velocity=(2, 0.3, 0), spin=2.0):
    """A simulator after some steps of a body that slides and spins."""
    scene = ground_scene(friction=friction)
    scene.add_body(
        shape,
        position=(0, 0, height),
        orientation=orientation,
        linear_velocity=velocity,
        angular_velocity=(0, 0, spin),
        friction=friction,
    )
    sim = wr.Simulator(scene, device=device)
    sim.step(steps)
    return sim


def loads(sim):
    """Positions about the body (n, 3) [m] and normal impulses [N s] of all contacts, in float64."""
    contacts = sim.contacts()
    normal = np.einsum("ni,ni->n", contacts["normal"].astype(np.float64), contacts["impulse"])
    return contacts["position"].astype(np.float64) - sim.get("position")[0, 1], np.abs(normal)


def smallest_loads(place, normal):
    """The loads with the same sum and torque and the smallest sum of squares: projection onto linear functions."""
    basis = np.concatenate([np.ones((len(place), 1)), place[:, :2]], axis=1)
    return basis @ np.linalg.lstsq(basis, normal, rcond=None)[0]


@pytest.mark.parametrize("friction", [0.3, 0.6])
@pytest.mark.parametrize("made", ["ring of 12", "ring of 24", "box", "turned box", "cylinder"])
def test_a_sliding_body_carries_its_load_evenly(device, made, friction):
    """To 0.5 %: within a step the load follows the direction of friction, which turns, in the order of the sweeps."""
    shape, height = {
        "ring of 12": ring(12),
        "ring of 24": ring(24),
        "box": (wr.Box((0.3, 0.2, 0.1)), 0.1),
        "turned box": (wr.Box((0.3, 0.2, 0.1)), 0.1),
        "cylinder": (wr.Cylinder(0.3, 0.05), 0.05),
    }[made]
    turn = rotate_about((0, 0, 1), 25.0) if made == "turned box" else (0, 0, 0, 1)
    place, normal = loads(slid(shape, height, device, friction, orientation=turn))
    assert len(place) > 3
    assert np.linalg.norm(normal - smallest_loads(place, normal)) < 5e-3 * np.linalg.norm(normal)


def test_no_contact_pulls(device):
    """A short cylinder whose load is close to its rim: a linear load would pull at the far side."""
    sim = slid(wr.Cylinder(0.3, 0.25), 0.25, device, friction=0.7, steps=20, velocity=(4, 0, 0), spin=0.0)
    place, normal = loads(sim)
    assert smallest_loads(place, normal).min() < 0.0
    assert normal.min() >= 0.0
    assert normal.sum() == pytest.approx(sim.get("mass")[0, 1] * G / 240.0, rel=1e-4)


def test_a_distribution_does_not_change_the_motion_of_a_block(device):
    """A block without spin: its deceleration is mu g whatever the loads of its contacts."""
    sim = slid(wr.Box((0.3, 0.2, 0.1)), 0.1, device, friction=0.4, steps=24, velocity=(2, 0, 0), spin=0.0)
    velocity = sim.get("linear_velocity")[0, 1]
    assert velocity[0] == pytest.approx(2.0 - 0.4 * G * 24 / 240.0, rel=1e-5)
    assert np.abs([*velocity[1:], *sim.get("angular_velocity")[0, 1]]).max() < 1e-5
