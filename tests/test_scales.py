"""Bodies of any mass and size move as ordinary ones do: the equations of rigid bodies have no unit of their own."""

import numpy as np
import pytest

import warp_rigid as wr


def tumbling(mass, device):
    """Boxes, balls and a capsule that fall onto a slope, slide and roll there."""
    rng = np.random.default_rng(0)
    scene = wr.Scene()
    scene.add_static(wr.Plane(normal=(0.2, 0.0, 1.0)))
    shapes = [wr.Box((0.1, 0.07, 0.05)), wr.Sphere(0.08), wr.Capsule(0.05, 0.1)]
    for i in range(6):
        place = (*rng.uniform(-0.1, 0.1, 2), 0.2 + 0.15 * i)
        scene.add_body(shapes[i % 3], position=place, orientation=rng.normal(size=4), mass=mass * (1 + i))
    return wr.Simulator(scene, device=device)


@pytest.mark.parametrize(("exponent", "tolerance"), [(-46, 1e-6), (20, 0.0), (44, 1e-3)])
def test_motion_does_not_depend_on_the_unit_of_mass(device, exponent, tolerance):
    """Powers of two are exact; the tolerance is for chaotic growth where roots of tiny numbers are rounded."""
    usual, scaled = tumbling(1.0, device), tumbling(2.0**exponent, device)
    for sim in (usual, scaled):
        sim.step(100)
    np.testing.assert_allclose(scaled.get("position"), usual.get("position"), rtol=0, atol=tolerance)
    np.testing.assert_allclose(scaled.penetration(), usual.penetration(), rtol=0, atol=1e-5)


@pytest.mark.parametrize("radius", [5e-6, 0.05, 3000.0])
def test_grains_and_mountains_are_slowed_by_rolling_friction(device, radius):
    """A ball with v = R w decelerates by 5/7 g c / R, with the coefficient c of rolling friction.

    The time step is chosen so that all radii are similar. The torque of a step is known only after it, hence 1 %.
    """
    second = np.sqrt(radius / 0.05)
    speed = radius / 0.05 / second
    scene = wr.Scene()
    scene.add_static(wr.Plane(), rolling_friction=1e9)
    start = {"position": (0, 0, radius), "linear_velocity": (speed, 0, 0), "angular_velocity": (0, speed / radius, 0)}
    scene.add_body(wr.Sphere(radius), **start, rolling_friction=0.05 * radius)
    sim = wr.Simulator(scene, settings=wr.Settings(dt=second / 256), device=device)
    sim.step(256)
    expected = speed - 5.0 / 7.0 * 9.81 * 0.05 * second
    assert sim.get("linear_velocity")[0, 1, 0] == pytest.approx(expected, rel=0.01)


@pytest.mark.parametrize("mass", [1e-18, 1e16])
def test_masses_whose_squares_leave_single_precision_are_refused(device, mass):
    scene = wr.Scene()
    with pytest.raises(ValueError, match=r"^mass: must be a number from 1e-17 to 1e\+15, got "):
        scene.add_body(wr.Sphere(0.1), mass=mass)
    scene.add_body(wr.Sphere(0.1), mass=1.0)
    sim = wr.Simulator(scene, device=device)
    with pytest.raises(ValueError, match=r"^mass: must be a number from 1e-17 to 1e\+15, got "):
        sim.set("mass", mass)
    assert sim.get("mass")[0, 0] == 1.0
