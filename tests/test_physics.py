"""The engine against closed forms: free fall, impact, friction and rolling. The numbers are validation cases."""

import numpy as np
import pytest

from tests.geometry_oracles import cube
from tests.oracles import GROUND, ground_scene, rotate_about
from warp_rigid.scene import Scene
from warp_rigid.settings import Settings
from warp_rigid.shapes import Box, Capsule, Cylinder, Mesh, Sphere
from warp_rigid.simulator import Simulator

G = 9.81
DT = 1 / 240


def simulate(scene, device, dt=DT):
    return Simulator(scene, settings=Settings(dt=dt), device=device)


def speed(sim):
    """Largest component of the moving body's velocities."""
    return max(np.abs(sim.get(name)[0, -1]).max() for name in ("linear_velocity", "angular_velocity"))


# V14: free motion


@pytest.mark.parametrize("dt", [1 / 60, 1 / 240])
def test_free_fall_is_the_discrete_sum(device, dt):
    """V14: symplectic Euler falls by g dt^2 n (n + 1) / 2, to 1e-5; the rest of the motion is uniform."""
    scene = Scene()
    scene.add_body(Sphere(0.1), position=(0, 0, 10), linear_velocity=(3, -2, 4), angular_velocity=(5, 0, 0))
    sim = simulate(scene, device, dt)
    steps = round(1 / dt)
    sim.step(steps)
    fall = G * dt * dt * steps * (steps + 1) / 2
    assert fall == pytest.approx({60: 4.98675, 240: 4.9254375}[steps], abs=1e-6)
    np.testing.assert_allclose(sim.get("position")[0, 0], [3, -2, 14 - fall], atol=1e-5)
    np.testing.assert_allclose(sim.get("linear_velocity")[0, 0], [3, -2, 4 - G], atol=1e-5)


# V17: bounces


def bounces(device, restitution, dt, duration):
    """Heights above the ground and speeds of a ball dropped from 1 m, at every step."""
    scene = ground_scene(restitution=restitution)
    scene.add_body(Sphere(0.05), position=(0, 0, 1.05), restitution=restitution)
    sim = simulate(scene, device, dt)
    height, velocity = [1.0], [0.0]
    for _ in range(round(duration / dt)):
        sim.step()
        height.append(sim.get("position")[0, 1, 2] - 0.05)
        velocity.append(sim.get("linear_velocity")[0, 1, 2])
    return np.array(height, np.float64), np.array(velocity, np.float64)


def peaks(height, velocity):
    turn = np.flatnonzero((velocity[:-1] > 0.0) & (velocity[1:] <= 0.0))
    return np.maximum(height[turn], height[turn + 1])


@pytest.mark.parametrize(
    ("restitution", "expected"),
    [(1.0, (1.0, 1.0)), (0.8, (0.64, 0.4096, 0.2621)), (0.5, (0.25, 0.0625))],
)
@pytest.mark.parametrize("steps_per_second", [60, 240, 1000])
def test_bounce_heights(device, restitution, expected, steps_per_second):
    """V17: e^(2 n) within 1 % (the impact is centred in time, so that the loss |v| dt of trap 3 is not there)."""
    height, velocity = bounces(device, restitution, 1 / steps_per_second, 2.3)
    found = peaks(height, velocity)[: len(expected)]
    np.testing.assert_allclose(found, expected, rtol=0.01)
    assert height.max() < 1.0 + 1e-4


def contact_times(device, dt):
    """Times of the second to fourth contact at restitution 0.8."""
    _, velocity = bounces(device, 0.8, dt, 2.4)
    return (np.flatnonzero((velocity[:-1] < 0.0) & (velocity[1:] > 0.0)) + 1)[1:4] * dt


def test_bounce_times_converge(device):
    """V17: second to fourth contact at e = 0.8; the error at least halves with dt, and is 2 % at 1/1000."""
    exact = np.array([1.173961, 1.751912, 2.214272])
    errors = [np.abs(contact_times(device, 1 / n) - exact).max() for n in (60, 120, 240, 480)]
    assert all(finer <= 0.6 * coarser for coarser, finer in zip(errors[:-1], errors[1:], strict=True))
    np.testing.assert_allclose(contact_times(device, 1 / 1000), exact, rtol=0.005)


@pytest.mark.parametrize(("restitution", "total"), [(0.5, 1.354571), (0.8, 4.063713)])
def test_bouncing_ends_in_rest(device, restitution, total):
    """V17: it is over after t1 (1 + e) / (1 - e), within 2 % at 1/1000; then the ball is at rest."""
    height, velocity = bounces(device, restitution, 1 / 1000, 1.1 * total)
    last = (np.flatnonzero(np.abs(velocity) > 1e-3)[-1] + 1) / 1000
    assert last == pytest.approx(total, rel=0.02)
    assert np.abs(velocity[-50:]).max() < 1e-3
    assert abs(height[-1]) < 1e-4


@pytest.mark.parametrize("restitution", [0.0, 0.25, 0.5, 0.75, 1.0])
@pytest.mark.parametrize("apart", [1.2, 0.8512])
def test_head_on_collision_of_two_spheres(device, restitution, apart):
    """V17 (Chrono's CorNormal): radius 0.5, 1 kg, +-1 m/s; |e_out - e_in| < 1e-3."""
    assert head_on(device, restitution, apart) == pytest.approx(restitution, abs=1e-3)


@pytest.mark.parametrize("restitution", [0.5, 1.0])
@pytest.mark.parametrize("apart", [0.7, 0.9])
def test_head_on_collision_when_a_step_ends_just_short(device, restitution, apart):
    """The same, where a whole number of steps ends with the spheres not quite touching."""
    assert head_on(device, restitution, apart) == pytest.approx(restitution, abs=1e-3)


def head_on(device, restitution, apart):
    """Speed after the collision of two spheres that start with their centres at +-apart."""
    scene = Scene(gravity=(0, 0, 0))
    for side in (-1, 1):
        scene.add_body(
            Sphere(0.5), mass=1.0, position=(apart * side, 0, 0), linear_velocity=(-side, 0, 0), restitution=restitution
        )
    sim = simulate(scene, device)
    sim.step(240)
    velocity = sim.get("linear_velocity")[0, :, 0]
    assert velocity[0] + velocity[1] == pytest.approx(0.0, abs=1e-6)
    return velocity[1]


# V18: chains of spheres


def chain(device, masses, velocities, restitution, gap):
    """Velocities of a row of balls after a second."""
    scene = Scene(gravity=(0, 0, 0))
    for k, (mass, velocity) in enumerate(zip(masses, velocities, strict=True)):
        scene.add_body(
            Sphere(0.1),
            mass=mass,
            position=(k * (0.2 + gap), 0, 0),
            linear_velocity=(velocity, 0, 0),
            friction=0.0,
            restitution=restitution,
        )
    sim = simulate(scene, device)
    sim.step(240)
    velocity = sim.get("linear_velocity")[0].astype(np.float64)
    np.testing.assert_allclose(velocity[:, 1:], 0.0, atol=1e-6)
    assert np.dot(masses, velocity[:, 0]) == pytest.approx(np.dot(masses, velocities), abs=1e-5)
    return velocity[:, 0]


TOUCHING_OR_NOT = pytest.mark.parametrize("gap", [0.0, 0.001])


@TOUCHING_OR_NOT
@pytest.mark.parametrize(
    ("before", "after"),
    [
        ((1, 0, 0, 0, 0), (0, 0, 0, 0, 1)),
        ((1, 1, 0, 0, 0), (0, 0, 0, 1, 1)),
        ((1, 1, 1, 0, 0), (0, 0, 1, 1, 1)),
        ((1, 0, 0, 0, -1), (-1, 0, 0, 0, 1)),
    ],
)
def test_cradle(device, before, after, gap):
    """V18: as many balls leave as came, with nothing lost."""
    np.testing.assert_allclose(chain(device, [1.0] * 5, before, 1.0, gap), after, atol=1e-3)


@TOUCHING_OR_NOT
def test_cradle_with_losses(device, gap):
    """V18: e = 0.9 leaves the last ball with (1.9 / 2)^4, the others what momentum and energy allow; e = 0 sticks."""
    velocity = chain(device, [1.0] * 5, [1, 0, 0, 0, 0], 0.9, gap)
    sequential = np.array([0.043547, 0.045352, 0.047275, 0.049320, 0.814506])
    assert velocity[-1] == pytest.approx(sequential[-1], abs=1e-3)
    assert (velocity**2).sum() <= (sequential**2).sum() * (1 + 1e-3)
    if gap == 0.0:
        np.testing.assert_allclose(velocity, sequential, atol=1e-3)
    np.testing.assert_allclose(chain(device, [1.0] * 5, [1, 0, 0, 0, 0], 0.0, gap), 0.2, atol=1e-3)


@TOUCHING_OR_NOT
@pytest.mark.parametrize(
    ("restitution", "after"),
    [(1.0, (0.333333, 0.444444, 0.592593, 2.370370)), (0.9, (0.366667, 0.464444, 0.588296, 2.032296))],
)
def test_tapered_chain(device, restitution, after, gap):
    """V18: masses 1, 1/2, 1/4, 1/8."""
    velocity = chain(device, [1, 0.5, 0.25, 0.125], [1, 0, 0, 0], restitution, gap)
    np.testing.assert_allclose(velocity, after, atol=1e-3)


# V19, V20: oblique and eccentric impact


def oblique_impact(device, tangential, spin, normal, restitution, friction):
    """Normal velocity, tangential velocity and spin of a sphere (R = 0.1) after one step on a plane."""
    scene = Scene(gravity=(0, 0, 0))
    scene.add_static(GROUND, friction=friction, restitution=restitution)
    scene.add_body(
        Sphere(0.1),
        position=(0, 0, 0.1),
        linear_velocity=(tangential, 0, normal),
        angular_velocity=(0, spin, 0),
        friction=friction,
        restitution=restitution,
    )
    sim = simulate(scene, device)
    sim.step()
    velocity, turning = sim.get("linear_velocity")[0, 1], sim.get("angular_velocity")[0, 1]
    return velocity[2], velocity[0], turning[1]


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ((2, 0, -3, 0.8, 0.30), (2.4, 1.428571, 14.285714)),
        ((2, 0, -3, 0.8, 0.05), (2.4, 1.730000, 6.750000)),
        ((0, 20, -2, 1.0, 0.50), (2.0, 0.571429, 5.714286)),
    ],
    ids=["stick", "slip", "spin"],
)
def test_superball(device, before, after):
    """V19: 1e-4 relative, in one step."""
    np.testing.assert_allclose(oblique_impact(device, *before), after, rtol=1e-4)


def test_superball_s_boundary_of_sticking(device):
    """V19: it sticks from mu = (2 / 7) s / ((1 + e) |v_n|) = 0.10582 on."""
    for friction, sticks in ((0.1055, False), (0.1061, True)):
        _, velocity, spin = oblique_impact(device, 2, 0, -3, 0.8, friction)
        assert (abs(velocity - 0.1 * spin) < 1e-5) == sticks


def test_eccentric_impact_of_a_rod(device):
    """V20: a thin rod falls at 30 degrees on a frictionless plane, e = 0.5; 0.5 %."""
    scene = Scene(gravity=(0, 0, 0))
    scene.add_static(GROUND, friction=0.0, restitution=0.5)
    scene.add_body(
        Capsule(0.001, 0.499),
        mass=1.0,
        position=(0, 0, 0.253),
        orientation=rotate_about((0, 1, 0), 60),
        linear_velocity=(0, 0, -1),
        friction=0.0,
        restitution=0.5,
    )
    sim = simulate(scene, device, 1 / 1000)
    sim.step(20)
    assert sim.get("linear_velocity")[0, 1, 2] == pytest.approx(-0.538462, rel=5e-3)
    assert abs(sim.get("angular_velocity")[0, 1, 1]) == pytest.approx(2.398224, rel=5e-3)


# V22, V23: blocks that slide

CUBE, SLAB = Box((0.5, 0.5, 0.5)), Box((0.2, 0.2, 0.05))
FLOORS = ("tilted gravity", "tilted mesh")


def tilted(degrees, gravity=G):
    """Gravity on an incline along x."""
    slope = np.radians(degrees)
    return gravity * np.sin(slope), 0.0, -gravity * np.cos(slope)


class Incline:
    """A block on an incline, by tilted gravity over level ground or by a tilted mesh; x runs downhill."""

    def __init__(self, device, floor, block, degrees, friction, start=0.0, restitution=0.0, gravity=G):
        material = {"friction": friction, "restitution": restitution}
        half = block.half_extents[2]
        if floor == "tilted gravity":
            turn = (0, 0, 0, 1)
            scene = Scene(gravity=tilted(degrees, gravity))
            scene.add_static(GROUND, **material)
        else:
            turn = rotate_about((0, 1, 0), degrees)
            scene = Scene(gravity=(0, 0, -gravity))
        slope = 0.0 if floor == "tilted gravity" else np.radians(degrees)
        self.down = np.array([np.cos(slope), 0, -np.sin(slope)])
        self.up = np.array([np.sin(slope), 0, np.cos(slope)])
        if floor == "tilted mesh":
            ramp = Mesh(cube(1.0)[0] * [4, 2, 0.5], cube(1.0)[1], sdf_resolution=32)
            scene.add_static(ramp, position=-0.5 * self.up, orientation=turn, **material)
        self.start = half * self.up - 1.0 * self.down
        scene.add_body(block, position=self.start, orientation=turn, linear_velocity=start * self.down, **material)
        self.sim = simulate(scene, device)

    def travel(self):
        """Distance gone downhill and height gained above the incline [m]."""
        moved = self.sim.get("position")[0, 1] - self.start
        return moved @ self.down, moved @ self.up

    def run_until_rest(self):
        """Time and distance at which the speed falls below 1e-3 m/s."""
        for step in range(1, 1200):
            self.sim.step()
            if np.linalg.norm(self.sim.get("linear_velocity")[0, 1]) < 1e-3:
                return step * DT, self.travel()[0]
        raise AssertionError("does not stop")


BLOCKS = pytest.mark.parametrize("block", [CUBE, SLAB], ids=["cube", "slab"])


@BLOCKS
@pytest.mark.parametrize("floor", FLOORS)
@pytest.mark.parametrize("restitution", [0.0, 1.0])
def test_incline_sticks(device, floor, block, restitution):
    """V22 a and d: 20 degrees, mu 0.5, also at e = 1: less than 1e-4 m down or up in 5 s, |v| < 1e-3."""
    incline = Incline(device, floor, block, 20.0, 0.5, restitution=restitution)
    for _ in range(12):
        incline.sim.step(100)
        assert np.abs(incline.travel()).max() < 1e-4
        assert np.abs(incline.sim.get("linear_velocity")).max() < 1e-3


@BLOCKS
@pytest.mark.parametrize("floor", [FLOORS[0], FLOORS[1]])
def test_incline_slides(device, floor, block):
    """V22 b: 30 degrees, mu 0.3: 1.178144 m in a second, within 0.5 %."""
    incline = Incline(device, floor, block, 30.0, 0.3)
    incline.sim.step(240)
    assert incline.travel()[0] == pytest.approx(1.178144, rel=5e-3)


@BLOCKS
@pytest.mark.parametrize(
    ("floor", "degrees", "friction", "start", "time", "distance"),
    [
        (FLOORS[0], 20.0, 0.5, 2.0, 1.594929, 1.594929),
        (FLOORS[0], 10.0, 0.3, 1.0, 0.836960, 0.418480),
        pytest.param(FLOORS[1], 20.0, 0.5, 2.0, 1.594929, 1.594929),
    ],
)
def test_incline_stops(device, floor, block, degrees, friction, start, time, distance):
    """V22 c: time and distance within 1 %, then it stays."""
    incline = Incline(device, floor, block, degrees, friction, start)
    found = incline.run_until_rest()
    np.testing.assert_allclose(found, (time, distance), rtol=0.01)
    for _ in range(5):
        incline.sim.step(100)
        assert np.abs(incline.sim.get("linear_velocity")).max() < 1e-3
    assert incline.travel()[0] == pytest.approx(found[1], abs=1e-4)


def test_the_authors_incline(device):
    """V22 (0): 20 degrees, g = 9.8, e = 1: block 1 stops at 0.99785 s after 0.62365 m, block 2 slides 2.0991 m; 1 %."""
    block = Box((0.05, 0.05, 0.05))
    first = Incline(device, "tilted gravity", block, 20.0, 0.5, start=1.25, restitution=1.0, gravity=9.8)
    time, distance = first.run_until_rest()
    assert time == pytest.approx(0.99785, rel=0.01)
    assert distance == pytest.approx(0.62365, rel=0.01)
    first.sim.step(480)
    assert first.travel()[0] == pytest.approx(distance, abs=1e-4)
    second = Incline(device, "tilted gravity", block, 20.0, 0.25, restitution=1.0, gravity=9.8)
    second.sim.step(480)
    assert second.travel()[0] == pytest.approx(2.0991, rel=0.01)


def test_incline_grid(device):
    """V22 e: every cell of the grid, and 2 degrees to either side of the friction angle, in one batch."""
    cells = [(mu, degrees) for mu in (0.1, 0.3, 0.5, 0.7, 1.0) for degrees in (3, 10, 20, 30, 40)]
    cells += [(mu, np.degrees(np.arctan(mu)) + side) for mu in (0.1, 0.3, 0.5, 0.7, 1.0) for side in (-2, 2)]
    friction, degrees = np.array(cells).T
    scene = ground_scene()
    scene.add_body(SLAB, position=(0, 0, 0.05))
    sim = Simulator(scene, num_envs=len(cells), device=device)
    sim.set("friction", friction[:, None])
    sim.set("gravity", [tilted(angle) for angle in degrees])
    sim.step(240)
    slope = np.radians(degrees)
    pull = np.maximum(G * (np.sin(slope) - friction * np.cos(slope)), 0.0)
    np.testing.assert_allclose(sim.get("position")[:, 1, 0], 0.5 * pull, rtol=5e-3, atol=1e-5)


COARSE = pytest.mark.xfail(
    strict=True, reason="1.43 % short at dt = 1/240: the start loses v0 dt / 2, and halves with dt (0.71 % at 1/480)"
)


@pytest.mark.parametrize(
    ("start", "friction", "distance", "bound", "steps_per_second"),
    [
        (2.0, 0.2, 1.019368, 0.01, 240),
        (2.0, 0.4, 0.509684, 0.01, 240),
        pytest.param(2.0, 0.7, 0.291248, 0.01, 240, marks=COARSE),
        (2.0, 0.7, 0.291248, 0.01, 480),
        (5.0, 0.5, 2.548420, 0.005, 240),
    ],
)
def test_stopping_distance(device, start, friction, distance, bound, steps_per_second):
    """V23: v0^2 / (2 mu g)."""
    scene = ground_scene(friction=friction)
    scene.add_body(Box((0.25, 0.25, 0.25)), position=(0, 0, 0.25), linear_velocity=(start, 0, 0), friction=friction)
    sim = simulate(scene, device, 1 / steps_per_second)
    sim.step(2 * steps_per_second)
    assert sim.get("position")[0, 1, 0] == pytest.approx(distance, rel=bound)
    assert speed(sim) < 1e-3


# V24, V25, V29, V30: rolling


def rolling_ball(device, velocity, spin, friction=0.2, radius=0.1, **material):
    scene = ground_scene(friction=friction, **material)
    scene.add_body(
        Sphere(radius),
        position=(0, 0, radius),
        linear_velocity=(velocity, 0, 0),
        angular_velocity=spin,
        friction=friction,
        **material,
    )
    return simulate(scene, device)


def test_slide_to_roll(device):
    """V24: rolls at 0.728120 s after 3.120514 m with 25/7 m/s, and goes on so; 0.5 %."""
    sim = rolling_ball(device, 5.0, (0, 0, 0))
    velocity, spin = 5.0, 0.0
    while abs(velocity - 0.1 * spin) > 1e-4 and sim.time < 2.0:
        sim.step()
        velocity, spin = sim.get("linear_velocity")[0, 1, 0], sim.get("angular_velocity")[0, 1, 1]
    assert sim.time == pytest.approx(0.728120, rel=5e-3)
    assert sim.get("position")[0, 1, 0] == pytest.approx(3.120514, rel=5e-3)
    assert velocity == pytest.approx(25 / 7, rel=5e-3)
    sim.step(240)
    assert sim.get("linear_velocity")[0, 1, 0] == pytest.approx(25 / 7, rel=5e-3)


def test_backspin_stops_dead(device):
    """V24: v0 = 2, omega R = -5: it stands still after 1.019368 s and 1.019368 m; 0.5 %."""
    sim = rolling_ball(device, 2.0, (0, -50, 0))
    while speed(sim) > 1e-3 and sim.time < 2.0:
        sim.step()
    assert sim.time == pytest.approx(1.019368, rel=5e-3)
    sim.step(100)
    assert sim.get("position")[0, 1, 0] == pytest.approx(1.019368, rel=5e-3)
    assert speed(sim) < 1e-3


@pytest.mark.parametrize(
    ("shape", "inertia"),
    [(Sphere(0.1), 0.4), (Cylinder(0.1, 0.3), 0.5)],
    ids=["sphere", "cylinder"],
)
@pytest.mark.parametrize("share", [1.25, 3.0])
def test_rolling_race(device, shape, inertia, share):
    """V25: without slip down 30 degrees, a = g sin / (1 + k); 1 %. `share`: of the friction that rolling needs."""
    friction = share * np.tan(np.radians(30)) * inertia / (1 + inertia)
    assert race(device, shape, friction) == pytest.approx(0.25 * G / (1 + inertia), rel=0.01)


@pytest.mark.parametrize(
    ("shape", "inertia"), [(Sphere(0.1), 0.4), (Cylinder(0.1, 0.3), 0.5)], ids=["sphere", "cylinder"]
)
def test_slipping_race(device, shape, inertia):
    """V25: at 0.8 of the friction that rolling needs, a = g (sin - mu cos); 1 %."""
    friction = 0.8 * np.tan(np.radians(30)) * inertia / (1 + inertia)
    expected = 0.5 * G * (np.sin(np.radians(30)) - friction * np.cos(np.radians(30)))
    assert race(device, shape, friction) == pytest.approx(expected, rel=0.01)


def race(device, shape, friction):
    """Distance gone in a second down 30 degrees from rest."""
    scene = Scene(gravity=tilted(30.0))
    scene.add_static(GROUND, friction=friction)
    scene.add_body(shape, position=(0, 0, 0.1), orientation=rotate_about((1, 0, 0), 90), friction=friction)
    sim = simulate(scene, device)
    sim.step(240)
    return sim.get("position")[0, 1, 0]


def test_rolling_friction(device):
    """V29: R = 0.5, c = 0.01 m, from 1 m/s: stops after 3.567788 m and 7.135576 s, and stays; 2 %."""
    sim = rolling_ball(device, 1.0, (0, 2, 0), friction=0.5, radius=0.5, rolling_friction=0.01)
    while speed(sim) > 1e-3 and sim.time < 10.0:
        sim.step()
    assert sim.time == pytest.approx(7.135576, rel=0.02)
    place = sim.get("position")[0, 1, 0]
    assert place == pytest.approx(3.567788, rel=0.02)
    sim.step(240)
    assert sim.get("position")[0, 1, 0] == pytest.approx(place, abs=1e-5)


def test_rolling_friction_holds_on_a_slope(device):
    """V29: below tan = c / R the ball does not start; above it does."""
    for share, rolls in ((0.9, False), (1.1, True)):
        scene = Scene(gravity=tilted(np.degrees(np.arctan(share * 0.01 / 0.5))))
        scene.add_static(GROUND, friction=0.5, rolling_friction=0.01)
        scene.add_body(Sphere(0.5), position=(0, 0, 0.5), friction=0.5, rolling_friction=0.01)
        sim = simulate(scene, device)
        sim.step(480)
        assert (sim.get("position")[0, 1, 0] > 1e-3) == rolls


def test_spinning_friction(device):
    """V30: R = 0.5, c = 0.01 m, from 10 rad/s about the vertical: stops after 10.193680 s; 2 %."""
    sim = rolling_ball(device, 0.0, (0, 0, 10), friction=0.5, radius=0.5, spinning_friction=0.01)
    while speed(sim) > 1e-3 and sim.time < 12.0:
        sim.step()
    assert sim.time == pytest.approx(10.193680, rel=0.02)
    np.testing.assert_allclose(sim.get("position")[0, 1], [0, 0, 0.5], atol=1e-4)
