"""Mechanisms against closed forms and a float64 integrator: closed loops, redundant rows, welded bodies, pendulums."""

from functools import partial

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import warp_rigid as wr
from tests.test_joints import DT, G, anchor_errors, simulator
from warp_rigid import rotations
from warp_rigid.validation.experiment import Experiment
from warp_rigid.validation.passive_mechanisms import energy_at_pose

Z = (0.0, 0.0, 1.0)


def bar(scene, p, q):
    """A bar between two points of the plane z = 0."""
    length, angle = np.hypot(*(q - p)), np.arctan2(*(q - p)[::-1])
    turn = (0, 0, np.sin(angle / 2), np.cos(angle / 2))
    return scene.add_body(wr.Box((length / 2, 0.02, 0.02)), position=(*(p + q) / 2, 0), orientation=turn)


def hinge(scene, a, b, point):
    return scene.add_joint(wr.RevoluteJoint(Z), a, b, anchor=(*point, 0))


def third_corner(b, d, to_b, to_d):
    """Intersection of two circles around b and d, on the left of the line from b to d."""
    line, distance = d - b, np.hypot(*(d - b))
    along = (to_b**2 - to_d**2 + distance**2) / (2 * distance)
    return b + (along * line + np.sqrt(to_b**2 - along**2) * np.array([-line[1], line[0]])) / distance


def test_a_four_bar_linkage_follows_its_coupler_curve(device):
    """In the plane 3 of its 20 rows are redundant. The crank turns twice."""
    scene = wr.Scene(gravity=(0, 0, 0))
    crank, coupler, rocker = 0.3, 0.9, 0.7
    a, d = np.zeros(2), np.array([1.0, 0.0])
    b = crank * np.array([np.cos(1.0), np.sin(1.0)])
    c = third_corner(b, d, coupler, rocker)
    first, middle, last = bar(scene, a, b), bar(scene, b, c), bar(scene, d, c)
    scene.add_drive(hinge(scene, first, None, a), damping=1e4, target_velocity=2.0)
    hinge(scene, first, middle, b)
    hinge(scene, middle, last, c)
    hinge(scene, last, None, d)
    sim = simulator(scene, device)
    error = 0.0
    for _ in range(1500):
        sim.step()
        turn = sim.get("orientation")[0, first].astype(np.float64)
        place = sim.get("position")[0, middle].astype(np.float64)
        b = crank * rotations.rotate(turn, (1, 0, 0))[:2]
        expected = (b + third_corner(b, d, coupler, rocker)) / 2
        error = max(error, np.abs(place - (*expected, 0)).max())
    assert sim.get("joint_position")[0, 0] == pytest.approx(2.0 * 1500 * DT, rel=1e-3)
    assert error < 2e-7


def test_a_slider_crank_follows_its_closed_form(device):
    scene = wr.Scene(gravity=(0, 0, 0))
    crank, rod = 0.3, 0.8
    b, c = np.array([0.0, crank]), np.array([np.sqrt(rod**2 - crank**2), 0.0])
    first, middle = bar(scene, np.zeros(2), b), bar(scene, b, c)
    slider = scene.add_body(wr.Box((0.05, 0.05, 0.05)), position=(*c, 0))
    scene.add_drive(hinge(scene, first, None, np.zeros(2)), damping=1e4, target_velocity=3.0)
    hinge(scene, first, middle, b)
    hinge(scene, middle, slider, c)
    scene.add_joint(wr.PrismaticJoint((1, 0, 0)), slider, anchor=(*c, 0))
    sim = simulator(scene, device)
    error = 0.0
    for _ in range(1000):
        sim.step()
        x, y = crank * rotations.rotate(sim.get("orientation")[0, first].astype(np.float64), (1, 0, 0))[:2]
        place = sim.get("position")[0, slider].astype(np.float64)
        error = max(error, np.abs(place - (x + np.sqrt(rod**2 - y**2), 0, 0)).max())
    assert error < 3e-7


def link(angle, twist, length):
    """Transformation along a link, after Denavit and Hartenberg."""
    c, s, ct, st = np.cos(angle), np.sin(angle), np.cos(twist), np.sin(twist)
    return np.array([[c, -s * ct, s * st, length * c], [s, c * ct, -c * st, length * s], [0, st, ct, 0], [0, 0, 0, 1]])


def test_a_bennett_linkage_turns_all_the_way(device):
    """Four skew hinges that only turn because of their proportions: 20 rows for 18 motions, one of which is free."""
    a, b, alpha = 1.0, 0.8, np.radians(60)
    beta = np.arcsin(b / a * np.sin(alpha))
    first = 1.0
    ratio = np.sin((beta - alpha) / 2) / np.sin((alpha + beta) / 2)

    def places(second):
        frames = [np.eye(4)]
        for angle, twist, length in ((first, alpha, a), (second, beta, b), (-first, alpha, a), (-second, beta, b)):
            frames.append(frames[-1] @ link(angle, twist, length))
        return frames

    angles = [2 * np.arctan2(x, np.tan(first / 2)) for r in (ratio, 1 / ratio) for x in (r, -r)]
    frames = min((places(angle) for angle in angles), key=lambda f: np.abs(f[-1] - np.eye(4)).max())
    assert np.abs(frames[-1] - np.eye(4)).max() < 1e-12
    points, axes = [f[:3, 3] for f in frames], [f[:3, 2] for f in frames]
    scene = wr.Scene(gravity=(0, 0, 0))
    links = [scene.add_body(wr.Box((0.1, 0.05, 0.05)), position=(points[k] + points[k + 1]) / 2) for k in range(3)]
    links.append(None)
    for k in range(4):
        body, other = (links[k], links[k - 1]) if k < 3 else (links[2], None)
        scene.add_joint(wr.RevoluteJoint(axes[k]), body, other, anchor=points[k])
    scene.add_drive(0, damping=1e3, target_velocity=1.0)
    sim = simulator(scene, device)
    error = 0.0
    for _ in range(32):
        sim.step(50)
        angle = first + float(sim.get("joint_position")[0, 0])
        second = 2 * np.arctan2(np.tan(second_half(frames, first)) * np.tan(first / 2), np.tan(angle / 2))
        expected = float(sim.get("joint_position")[0, 1])
        start = 2 * second_half(frames, first)
        error = max(error, abs(np.angle(np.exp(1j * (second - start - expected)))))
        assert anchor_errors(sim).max() < 1e-6
    assert sim.get("joint_position")[0, 0] == pytest.approx(1600 * DT, rel=1e-3)
    assert error < 1e-4


def second_half(frames, first):
    """Half of the second angle of the linkage at the start, from its frames."""
    step = np.linalg.inv(frames[1]) @ frames[2]
    return np.arctan2(step[1, 0], step[0, 0]) / 2


@pytest.mark.long
def test_welded_boxes_keep_their_shape(device):
    """Twelve boxes welded to a pallet with closed loops, dropped, for two seconds."""
    scene = wr.Scene(gravity=(0, 0, -G))
    scene.add_static(wr.Plane(), friction=0.5)
    cells = [(x, y, z) for x in range(3) for y in range(2) for z in range(2)]
    at = {cell: 0.2 * np.array(cell) + (0, 0, 0.6) for cell in cells}
    body = {cell: scene.add_body(wr.Box((0.1,) * 3), position=at[cell], friction=0.5) for cell in cells}
    for cell in cells:
        for axis in np.eye(3, dtype=int):
            other = tuple((cell + axis).tolist())
            if other in body:
                scene.add_joint(wr.FixedJoint(), body[cell], body[other], anchor=(at[cell] + at[other]) / 2)
    sim = simulator(scene, device)
    start = np.array([at[cell] for cell in cells])
    for _ in range(4):
        sim.step(120)
        place, turn = sim.get("position")[0, 1:].astype(float), sim.get("orientation")[0, 1].astype(float)
        own = rotations.rotate(rotations.inverse(turn), place - place[0])
        assert np.abs(own - (start - start[0])).max() < 2e-7
    assert np.abs(sim.get("linear_velocity")).max() < 1e-5
    assert sim.get("position")[0, 1, 2] == pytest.approx(0.1, abs=5e-5)


def double_pendulum(t, y):
    """Point masses of 1 kg on massless rods of 1 m: angles and their rates."""
    a, b, u, w = y
    mass = np.array([[2.0, np.cos(a - b)], [np.cos(a - b), 1.0]])
    force = [-np.sin(a - b) * w * w - 2 * G * np.sin(a), np.sin(a - b) * u * u - G * np.sin(b)]
    return [u, w, *np.linalg.solve(mass, force)]


def test_a_double_pendulum_follows_its_differential_equation(device):
    """3 s at 1/960 s. The velocities are half a step earlier than the positions, so they start with -dt/2 times g."""
    dt, start = 1.0 / 960.0, [1.5, 2.0, 0.0, 0.0]

    def point(angle):
        return np.array([np.sin(angle), 0.0, -np.cos(angle)])

    first, second = point(start[0]), point(start[0]) + point(start[1])
    scene = wr.Scene(gravity=(0, 0, -G))
    a, b = (scene.add_body(wr.Sphere(0.05), position=p, mass=1.0) for p in (first, second))
    scene.add_joint(wr.DistanceJoint(1.0, 1.0), a, anchor=first, anchor_b=(0, 0, 0))
    scene.add_joint(wr.DistanceJoint(1.0, 1.0), b, a, anchor=second, anchor_b=first)
    sim = wr.Simulator(scene, settings=wr.Settings(dt=dt), device=device)
    alpha = double_pendulum(0.0, start)[2:]
    turned = [np.array([np.cos(angle), 0.0, np.sin(angle)]) for angle in start[:2]]
    speed = -0.5 * dt * alpha[0] * turned[0]
    sim.set("linear_velocity", [[speed, speed - 0.5 * dt * alpha[1] * turned[1]]])
    exact = solve_ivp(double_pendulum, (0, 3), start, rtol=1e-11, atol=1e-12, dense_output=True).sol
    error = 0.0
    for _ in range(30):
        sim.step(96)
        y = exact(sim.time)
        error = max(error, np.abs(sim.get("position")[0] - [point(y[0]), point(y[0]) + point(y[1])]).max())
    assert error < 3e-4


def test_newtons_cradle_on_strings(device):
    """One ball in, one ball out, and the others stay."""
    radius, length, angle = 0.05, 0.5, 0.5
    scene = wr.Scene(gravity=(0, 0, -G))
    for k in range(5):
        lean = angle if k == 0 else 0.0
        place = np.array([2 * radius * k - length * np.sin(lean), 0, -length * np.cos(lean)])
        ball = scene.add_body(wr.Sphere(radius), position=place, restitution=1.0, friction=0.0)
        for y in (-0.2, 0.2):
            string = wr.DistanceJoint(maximum=np.hypot(length, y))
            scene.add_joint(string, ball, anchor=place, anchor_b=(2 * radius * k, y, 0))
    sim = simulator(scene, device)
    sim.step(86)
    speeds = sim.get("linear_velocity")[0, :, 0] / np.sqrt(2 * G * length * (1 - np.cos(angle)))
    assert speeds == pytest.approx([0, 0, 0, 0, 1], abs=0.01)


def zigzag(links, ratio):
    """A slack chain of light links, folded to zigzag, and a heavy ball that falls until the chain is taut."""
    scene = wr.Scene(gravity=(0, 0, -G))
    above, at, length = None, np.zeros(3), 0.1
    for k in range(links):
        lean = np.radians(60.0 if k % 2 else -60.0)
        along = np.array([np.sin(lean), 0.0, -np.cos(lean)])
        turn = (0, -np.sin(lean / 2), 0, np.cos(lean / 2))
        body = scene.add_body(
            wr.Capsule(0.015, 0.03), position=at + 0.5 * length * along, orientation=turn, mass=1.0 / ratio
        )
        scene.add_joint(wr.SphericalJoint(), body, above, anchor=at)
        above, at = body, at + length * along
    ball = scene.add_body(wr.Sphere(0.08), position=at - (0, 0, 0.1), mass=1.0, linear_velocity=(1.0, 0, 0))
    scene.add_joint(wr.SphericalJoint(), ball, above, anchor=at)
    for a in range(links + 1):
        for b in range(a + 2, links + 1):
            scene.filter_pair(a, b)
    return scene


@pytest.mark.long
def test_a_slack_chain_that_snaps_taut_stays_closed_and_gains_no_energy(device):
    """The links straighten at 70 rad/s within a few steps. With the rows of the start alone, the chain exploded."""
    sim = simulator(zigzag(20, 1000.0), device)
    opened = 0.0
    for _ in range(150):
        sim.step()
        opened = max(opened, anchor_errors(sim).max())
    assert opened < 1.5e-3
    assert np.abs(sim.get("linear_velocity")).max() < 10.0
    trace = Experiment(partial(zigzag, 20, 1000.0), 150.0 * DT).run(device)
    energy = np.minimum(energy_at_pose(trace, 0.0), energy_at_pose(trace, 0.5 * DT))
    assert energy.max() < energy[1] + 0.01
