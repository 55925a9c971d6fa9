"""Impacts of several pairs at the same time: the result is as symmetric as the scene, and does not depend on seams."""

import numpy as np
import pytest

import warp_rigid as wr


def dropped(device, tiles, half, restitution, shape, own=None):
    """Velocity and angular velocity of a body after its bounce on floor tiles of a half width at these places.

    `own`: the restitution of the body, if it is not that of the tiles.
    """
    scene = wr.Scene(restitution_combine="max")
    for x in tiles:
        scene.add_static(wr.Box((half, 1, 0.2)), position=(x, 0, -0.2), restitution=restitution)
    body = scene.add_body(shape, position=(0, 0, 0.4), mass=1.0, restitution=restitution if own is None else own)
    sim = wr.Simulator(scene, device=device)
    for _ in range(100):
        sim.step()
        if sim.get("linear_velocity")[0, body, 2] > 0:
            break
    return np.concatenate([sim.get("linear_velocity")[0, body], sim.get("angular_velocity")[0, body]])


@pytest.mark.parametrize("restitution", [0.3, 0.8])
@pytest.mark.parametrize("shape", [wr.Box((0.2, 0.2, 0.1)), wr.Cylinder(0.2, 0.1)], ids=["box", "cylinder"])
@pytest.mark.parametrize("seam", [0.0, 0.15])
def test_a_body_bounces_on_a_seam_as_on_one_tile(device, seam, shape, restitution):
    """On two tiles it rotated by up to 9 rad/s."""
    whole = dropped(device, [0.0], 2.0, restitution, shape)
    halves = dropped(device, [seam - 1.0, seam + 1.0], 1.0, restitution, shape)
    assert whole[2] > 0.5 and np.abs(np.delete(whole, 2)).max() < 1e-3
    np.testing.assert_allclose(halves, whole, atol=1e-3)


def test_the_restitution_may_be_that_of_the_tiles_alone(device):
    box = wr.Box((0.2, 0.2, 0.1))
    expected = dropped(device, [0.0], 2.0, 0.8, box)
    np.testing.assert_allclose(dropped(device, [-1.0, 1.0], 1.0, 0.8, box, own=0.0), expected, atol=1e-3)


def test_a_ball_that_hits_two_leaves_symmetrically(device):
    """Frictionless and elastic: with the impulse J of both along their normals n, 2 n.v0 = (4 + 2 cos 2a) J."""
    scene = wr.Scene(gravity=(0, 0, 0))
    elastic = {"mass": 1.0, "friction": 0.0, "restitution": 1.0}
    scene.add_body(wr.Sphere(0.1), position=(0, 0, 0.5), linear_velocity=(0, 0, -2), **elastic)
    for x in (-0.1, 0.1):
        scene.add_body(wr.Sphere(0.1), position=(x, 0, 0), **elastic)
    sim = wr.Simulator(scene, device=device)
    sim.step(96)
    velocity = sim.get("linear_velocity")[0]
    np.testing.assert_allclose(velocity[1] * (-1, 1, 1), velocity[2], atol=1e-5)
    # The normals are inclined by 30 degrees: the two share the impulse of a ball that hits one of 2 cos^2(30).
    across, along = 0.5, np.sqrt(0.75)
    impulse = 2.0 * 2.0 * along / (1.0 + 2.0 * along**2)
    expected = [(0, 0, -2.0 + 2.0 * impulse * along), (-impulse * across, 0, -impulse * along)]
    np.testing.assert_allclose(velocity[:2], expected, atol=0.01)
    assert sim.get("kinetic_energy").sum() == pytest.approx(2.0, rel=1e-3)


@pytest.mark.parametrize("count", [3, 8])
def test_an_impact_passes_through_a_row(device, count):
    """Each sphere of a row stops, and the last one leaves with the speed of the first."""
    scene = wr.Scene(gravity=(0, 0, 0))
    for k in range(count):
        speed = 2.0 if k == 0 else 0.0
        place = (0.2 * k - (0.3 if k == 0 else 0.0), 0, 0)
        scene.add_body(
            wr.Sphere(0.1), position=place, linear_velocity=(speed, 0, 0), mass=1.0, friction=0.0, restitution=1.0
        )
    sim = wr.Simulator(scene, device=device)
    sim.step(60)
    np.testing.assert_allclose(sim.get("linear_velocity")[0, :, 0], [0.0] * (count - 1) + [2.0], atol=2e-3)


def test_several_impacts_with_friction_add_no_energy(device):
    """Boxes that fly into a corner of three walls, rotating."""
    rng = np.random.default_rng(5)
    scene = wr.Scene(gravity=(0, 0, 0))
    for axis in range(3):
        half, place = np.full(3, 2.0), np.full(3, 1.0)
        half[axis], place[axis] = 0.5, -0.5
        scene.add_static(wr.Box(half), position=place, friction=0.8, restitution=1.0)
    box = scene.add_body(wr.Box((0.2, 0.15, 0.1)), position=(0.5, 0.5, 0.5), friction=0.8, restitution=1.0)
    sim = wr.Simulator(scene, num_envs=64, device=device)
    sim.set("linear_velocity", rng.uniform(-3, -2, (64, 1, 3)), bodies=[box])
    sim.set("angular_velocity", rng.uniform(-5, 5, (64, 1, 3)), bodies=[box])
    energy = sim.get("kinetic_energy")[:, box]
    for _ in range(60):
        sim.step()
        now = sim.get("kinetic_energy")[:, box]
        assert (now <= energy * (1 + 1e-5)).all()
        energy = now
    assert (sim.get("linear_velocity")[:, box] > 0).all(axis=1).mean() > 0.5
