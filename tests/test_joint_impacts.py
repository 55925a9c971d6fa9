"""Impacts of mechanisms: the body that hits one meets the mass of all its bodies, whose joints hold."""

import numpy as np
import pytest

import warp_rigid as wr

SPEED, MASS = 3.0, 1.0
HALF, HALF_WIDTH, LINK = 0.4, 0.02, 10.0
INERTIA = LINK / 3 * (HALF**2 + HALF_WIDTH**2)


def arms(count, joint, place, restitution, device):
    """Bars in a row along x from the origin, held to each other and to the world by joints, and a ball that hits one.

    Returns the simulator after the impact, which the ball makes along y, `place` from the origin.
    """
    scene = wr.Scene(gravity=(0, 0, 0))
    surface = {"restitution": restitution, "friction": 0.0}
    before = None
    for k in range(count):
        bar = scene.add_body(wr.Box((HALF, HALF_WIDTH, 1.0)), position=((2 * k + 1) * HALF, 0, 0), mass=LINK, **surface)
        scene.add_joint(joint, bar, before, anchor=(2 * k * HALF, 0, 0))
        before = bar
    ball = {"position": (place, -0.5, 0), "linear_velocity": (0, SPEED, 0), "mass": MASS, **surface}
    scene.add_body(wr.Sphere(0.05), **ball)
    sim = wr.Simulator(scene, device=device)
    sim.step(60)
    return sim


def response(count, place):
    """Inverse mass of a row of hinged bars along y at a place, by M^-1 - M^-1 G^T A^-1 G M^-1 in float64 [1/kg]."""
    inverse = np.diag(np.tile([1 / LINK, 1 / LINK, 1 / INERTIA], count))
    rows = np.zeros((2 * count, 3 * count))
    for k in range(count):
        for axis in range(2):
            rows[2 * k + axis, 3 * k + axis] = 1.0
            if k:
                rows[2 * k + axis, 3 * (k - 1) + axis] = -1.0
        rows[2 * k + 1, 3 * k + 2] = -HALF
        if k:
            rows[2 * k + 1, 3 * (k - 1) + 2] = -HALF
    hit = int(place / (2 * HALF))
    along = np.zeros(3 * count)
    along[3 * hit + 1], along[3 * hit + 2] = 1.0, place - (2 * hit + 1) * HALF
    held = inverse - inverse @ rows.T @ np.linalg.solve(rows @ inverse @ rows.T, rows @ inverse)
    return along @ held @ along


def ball_after(inverse_mass, restitution):
    """Velocity of the ball after its impact on a body with an inverse mass."""
    return SPEED - (1 + restitution) * SPEED / (1 / MASS + inverse_mass) / MASS


@pytest.mark.parametrize("restitution", [0.5, 1.0])
@pytest.mark.parametrize(("count", "place"), [(1, 0.1), (1, 0.3), (1, 0.75), (2, 0.3), (2, 1.0), (2, 1.55), (3, 1.3)])
def test_a_ball_bounces_off_hinged_bars_by_their_mass_where_the_joints_hold(device, count, place, restitution):
    """It left a door near its hinge with 0.58 of its relative speed instead of all."""
    sim = arms(count, wr.RevoluteJoint((0, 0, 1)), place, restitution, device)
    expected = ball_after(response(count, place), restitution)
    assert sim.get("linear_velocity")[0, -1, 1] == pytest.approx(expected, abs=2e-4 * SPEED)
    if restitution == 1.0:
        energy = sim.get("kinetic_energy")[0].sum()
        assert energy == pytest.approx(0.5 * MASS * SPEED**2, rel=1e-4)


def test_a_ball_that_pushes_another_bounces_off_a_door_with_it(device):
    """Impacts of single bodies and of mechanisms follow each other until there are none."""
    scene = wr.Scene(gravity=(0, 0, 0))
    elastic = {"restitution": 1.0, "friction": 0.0}
    door = scene.add_body(wr.Box((HALF, HALF_WIDTH, 1.0)), position=(HALF, 0, 0), mass=LINK, **elastic)
    scene.add_joint(wr.RevoluteJoint((0, 0, 1)), door, anchor=(0, 0, 0))
    still = scene.add_body(wr.Sphere(0.05), position=(0.3, -0.3, 0), mass=MASS, **elastic)
    shot = {"position": (0.3, -0.6, 0), "linear_velocity": (0, SPEED, 0), "mass": MASS}
    moving = scene.add_body(wr.Sphere(0.05), **shot, **elastic)
    sim = wr.Simulator(scene, device=device)
    sim.step(120)
    velocity = sim.get("linear_velocity")[0, :, 1]
    assert velocity[moving] == pytest.approx(ball_after(response(1, 0.3), 1.0), abs=2e-4 * SPEED)
    assert abs(velocity[still]) < 2e-4 * SPEED


@pytest.mark.parametrize("degrees", [0, 30, 60])
def test_a_ball_bounces_off_a_slider_along_its_axis_alone(device, degrees):
    """The axis is inclined to the impact: of the slider's mass, 1 / cos^2 is met."""
    turn = np.radians(degrees)
    axis = (np.sin(turn), np.cos(turn), 0)
    sim = arms(1, wr.PrismaticJoint(axis), HALF, 1.0, device)
    expected = ball_after(np.cos(turn) ** 2 / LINK, 1.0)
    assert sim.get("linear_velocity")[0, -1, 1] == pytest.approx(expected, abs=2e-4 * SPEED)


def test_without_restitution_a_ball_moves_on_with_the_door(device):
    sim = arms(1, wr.RevoluteJoint((0, 0, 1)), 0.5, 0.0, device)
    mass = 1 / response(1, 0.5)
    assert sim.get("linear_velocity")[0, -1, 1] == pytest.approx(SPEED * MASS / (MASS + mass), rel=0.02)


def scissors(device, hub, heavy, restitution):
    """Two balls on massless bars from the origin, which close like scissors until the balls hit each other.

    The bars hinge on each other, or on a cube at the origin.
    """
    scene = wr.Scene(gravity=(0, 0, 0))
    if hub:
        scene.add_body(wr.Box((0.05, 0.05, 0.05)), mass=2.0)
    balls = []
    for sign in (1, -1):
        place = 0.5 * np.array([np.cos(0.6), sign * np.sin(0.6), 0])
        spin = np.array([0, 0, -2.0 * sign])
        moving = {"linear_velocity": np.cross(spin, place), "angular_velocity": spin, "position": place}
        mass = heavy if sign == 1 else MASS
        balls.append(scene.add_body(wr.Sphere(0.1), mass=mass, restitution=restitution, friction=0.0, **moving))
    hinge = wr.RevoluteJoint((0, 0, 1))
    for ball in balls if hub else balls[:1]:
        scene.add_joint(hinge, ball, 0 if hub else balls[1], anchor=(0, 0, 0), collide=True)
    return wr.Simulator(scene, device=device), balls


@pytest.mark.parametrize("hub", [False, True])
@pytest.mark.parametrize("heavy", [1.0, 3.0])
@pytest.mark.parametrize("restitution", [0.5, 1.0])
def test_bodies_of_one_mechanism_bounce_off_each_other(device, hub, heavy, restitution):
    """They left each other with less than 0.01 of their speed at any restitution."""
    sim, balls = scissors(device, hub, heavy, restitution)
    energy = sim.get("kinetic_energy")[0].sum()
    closing = []
    for _ in range(80):
        sim.step(1)
        place, velocity = sim.get("position")[0, balls], sim.get("linear_velocity")[0, balls]
        closing.append((velocity[0] - velocity[1]) @ (place[1] - place[0]) / np.linalg.norm(place[1] - place[0]))
    hit = int(np.argmin(np.array(closing) > 0.0))
    assert 0 < hit < 79
    assert -closing[hit] == pytest.approx(restitution * closing[hit - 1], rel=0.02)
    if restitution == 1.0:
        assert sim.get("kinetic_energy")[0].sum() == pytest.approx(energy, rel=5e-3)


def test_bodies_that_a_joint_holds_to_each_other_may_touch(device):
    """They have no relative motion, and no mass in the contact."""
    scene = wr.Scene(gravity=(0, 0, 0))
    first = scene.add_body(wr.Sphere(0.1), restitution=1.0)
    second = scene.add_body(wr.Sphere(0.1), position=(0.199, 0, 0), restitution=1.0)
    scene.add_joint(wr.FixedJoint(), first, second, anchor=(0.1, 0, 0), collide=True)
    scene.add_body(wr.Sphere(0.1), position=(-0.5, 0, 0), linear_velocity=(1.0, 0, 0), restitution=1.0)
    sim = wr.Simulator(scene, device=device)
    sim.step(120)
    assert sim.get("linear_velocity")[0, :2, 0] == pytest.approx([2 / 3, 2 / 3], abs=2e-3)
    assert sim.get("linear_velocity")[0, 2, 0] == pytest.approx(-1 / 3, abs=2e-3)


def velocity_after_landing(friction, restitution):
    """Velocity along x and z of a rigid dumbbell that lands on one of its balls, by the impulse at that contact."""
    tilt, mass = 0.3, 2 * MASS
    inertia = 2 * MASS * (0.4 * 0.1**2 + 0.5**2)
    x, z = -0.5 * np.cos(tilt), -0.5 * np.sin(tilt) - 0.1
    inverse = np.array([[1 / mass + z * z / inertia, -x * z / inertia], [-x * z / inertia, 1 / mass + x * x / inertia]])
    stop = 2.0 * (1.0 + restitution)
    impulse = np.linalg.solve(inverse, [-1.0, stop])
    if abs(impulse[0]) > friction * impulse[1]:
        impulse = stop / (inverse[1, 1] - friction * inverse[0, 1]) * np.array([-friction, 1.0])
    return np.array([1.0, -2.0]) + impulse / mass


@pytest.mark.parametrize("restitution", [0.05, 0.5])
@pytest.mark.parametrize("friction", [0.1, 0.3, 1.0])
def test_welded_balls_land_as_a_rigid_dumbbell(device, friction, restitution):
    scene = wr.Scene(gravity=(0, 0, 0))
    scene.add_static(wr.Plane(), friction=friction, restitution=restitution)
    place, apart = np.array([0, 0, 0.3]), 1.0 * np.array([np.cos(0.3), 0, np.sin(0.3)])
    moving = {"linear_velocity": (1, 0, -2), "mass": MASS, "friction": friction, "restitution": restitution}
    first = scene.add_body(wr.Sphere(0.1), position=place, **moving)
    second = scene.add_body(wr.Sphere(0.1), position=place + apart, **moving)
    scene.add_joint(wr.FixedJoint(), first, second, anchor=place + 0.5 * apart)
    sim = wr.Simulator(scene, device=device)
    sim.step(31)
    found = sim.get("linear_velocity")[0, 1:].mean(axis=0)[[0, 2]]
    np.testing.assert_allclose(found, velocity_after_landing(friction, restitution), atol=1e-3)
