"""Push-out: overlaps shrink at the stated rate, from the ground up, and no velocity comes of it."""

import numpy as np
import pytest

from tests.oracles import GROUND, ground_scene, opened, random_pile, random_quaternion, rotate_about
from warp_rigid.engine.settings import Settings
from warp_rigid.engine.simulator import Simulator
from warp_rigid.kernels.tuning import RECOVERY, SLOP, WEIGHTLESS
from warp_rigid.scene.scene import Scene
from warp_rigid.scene.shapes import Box, Capsule, Compound, Cylinder, Sphere
from warp_rigid.scenes.builders import meshes

DT = 1 / 240


def depths_after(depth, size, steps, dt=DT, gravity=9.81):
    """The overlap after each step: the stated part of what exceeds the slop goes, at the speed of a fall at most."""
    fastest = np.sqrt(2 * gravity * size) * dt if gravity else WEIGHTLESS * size
    series = []
    for _ in range(steps):
        depth -= min(RECOVERY * max(depth - SLOP * size, 0.0), fastest)
        series.append(depth)
    return series


@pytest.mark.parametrize("shape", [Sphere(0.2), Box((0.2, 0.2, 0.2))], ids=["ball", "box"])
@pytest.mark.parametrize("depth", [1e-3, 0.02, 0.1])
@pytest.mark.parametrize("gravity", [0.0, -9.81])
def test_overlap_with_the_ground_shrinks_geometrically(device, shape, depth, gravity):
    scene = Scene(gravity=(0, 0, gravity))
    scene.add_static(GROUND)
    scene.add_body(shape, position=(0.3, 0.1, 0.2 - depth))
    sim, _ = opened(scene, device)
    found = []
    for _ in range(25):
        sim.step()
        found.append(0.2 - sim.get("position")[0, 1, 2])
        np.testing.assert_allclose(sim.get("linear_velocity")[0, 1], 0.0, atol=1e-6)
        np.testing.assert_allclose(sim.get("angular_velocity")[0, 1], 0.0, atol=1e-5)
    np.testing.assert_allclose(found, depths_after(depth, 0.4, 25, gravity=-gravity), atol=2e-6)
    assert sim.get("position")[0, 1, :2] == pytest.approx([0.3, 0.1], abs=1e-6)


def test_overlap_within_the_slop_is_left_alone(device):
    scene = Scene(gravity=(0, 0, 0))
    scene.add_static(GROUND)
    scene.add_body(Sphere(0.2), position=(0, 0, 0.2 - 0.9 * SLOP * 0.4))
    sim, _ = opened(scene, device)
    before = sim.get("position")
    sim.step(20)
    assert sim.get("position").tolist() == before.tolist()


def test_free_bodies_part_by_their_masses(device):
    """Two balls that overlap in free space: the pushes are equal and opposite, and their centre of mass stays."""
    depth, masses = 0.01, (1.0, 3.0)
    scene = Scene(gravity=(0, 0, 0))
    for x, mass in zip((0.0, 0.4 - depth), masses, strict=True):
        scene.add_body(Sphere(0.2), position=(x, 0, 0), mass=mass)
    sim, _ = opened(scene, device)
    start = sim.get("position")[0, :, 0].astype(np.float64)
    sim.step()
    moved = sim.get("position")[0, :, 0] - start
    assert moved @ masses == pytest.approx(0.0, abs=1e-7)
    assert moved[1] - moved[0] == pytest.approx(depth - depths_after(depth, 0.4, 1)[0], abs=1e-6)
    sim.step(30)
    assert sim.get("linear_velocity").tolist() == [[[0, 0, 0], [0, 0, 0]]]


@pytest.mark.parametrize("top_first", [False, True], ids=["ground_up", "top_down"])
def test_a_tower_is_set_right_from_the_ground_up(device, top_first):
    """Every joint overlaps; no body is pushed down, however heavy the load, and all overlaps shrink together."""
    depth = 0.01
    scene = ground_scene()
    order = list(range(6))[:: -1 if top_first else 1]
    for k in order:
        scene.add_body(Box((0.1, 0.1, 0.1)), position=(0, 0, 0.1 + 0.2 * k - depth * (k + 1)), mass=5.0**k)
    sim, _ = opened(scene, device)
    series = depths_after(depth, 0.2, 12)
    rows = 1 + np.argsort(order)
    last = sim.get("position")[0, rows, 2]
    for step in range(12):
        sim.step()
        height = sim.get("position")[0, rows, 2]
        assert (height >= last - 1e-6).all()
        joints = 0.2 - np.diff(height, prepend=-0.1)
        np.testing.assert_allclose(joints, series[step], atol=2e-4 * series[0] + 1e-5)
        last = height
    np.testing.assert_allclose(sim.get("linear_velocity"), 0.0, atol=1e-4)


def test_velocity_after_the_step_does_not_know_of_the_push(device):
    """The same pile with and without overlap to push: the velocities of the contact stage alone."""
    scene = random_pile(np.random.default_rng(5))
    sim, stages = opened(scene, device, settings=Settings(warm_starting=False))
    sim.step(120)
    stages.predict(stages.dt)
    stages.find_pairs()
    stages.find_contacts()
    stages.build_graph()
    stages.integrate_velocities(after_impacts=True)
    stages.solve_contacts()
    before = stages.motions.solver_bodies.numpy()
    stages.push_out()
    after = stages.motions.solver_bodies.numpy()
    assert np.linalg.norm(after["push_linear"], axis=1).max() > 1e-4
    assert after["linear"].tolist() == before["linear"].tolist()
    assert after["angular"].tolist() == before["angular"].tolist()


@pytest.mark.parametrize(("share", "degrees"), [(0.7, 60), (0.7, 90), (0.8, 35), (0.8, 45), (0.9, 15), (0.97, 25)])
def test_cubes_that_share_most_of_their_width_part(device, share, degrees):
    """No face of one opposes the other, or faces push against each other: they part, and keep no velocity of it."""
    scene = Scene(gravity=(0, 0, 0))
    scene.add_body(Box((0.1, 0.1, 0.1)))
    turn = rotate_about((1, 2, 3), degrees)
    scene.add_body(Box((0.1, 0.1, 0.1)), position=(0.2 * (1 - share), 0.01, 0.02), orientation=turn)
    sim, _ = opened(scene, device)
    assert sim.penetration()[0] > 0.03
    sim.step(140)
    assert sim.penetration()[0] < 2e-4
    np.testing.assert_allclose(sim.get("linear_velocity"), 0.0, atol=1e-6)


def test_what_lands_on_a_point_and_turns_round_does_not_sink(device):
    """A tetrahedron spins from one corner to the next within a step; the corner that was left comes down again."""
    scene, generator = ground_scene(friction=0.5), np.random.default_rng(5)
    body = scene.add_body(meshes.tetrahedron(sdf_resolution=32), position=(0, 0, 0.3), friction=0.5)
    sim = Simulator(scene, num_envs=128, device=device, settings=Settings(dt=1 / 60))
    sim.set("orientation", random_quaternion(generator, 128)[:, None], bodies=[body])
    lowest = 1.0
    for _ in range(60):
        sim.step()
        lowest = min(lowest, sim.get("position")[:, body, 2].min())
    assert lowest > 0.1 / 3.0 - 0.005


def test_boxes_that_fall_onto_a_corner_do_not_sink(device):
    """At one step a frame a box moves a third of its width in a step, and tumbles from corner to corner as it lands."""
    count, generator = 128, np.random.default_rng(0)
    scene = ground_scene(friction=0.5)
    box = scene.add_body(Box((0.1, 0.1, 0.1)), position=(0, 0, 0.4), linear_velocity=(0, 0, -2), friction=0.5)
    sim = Simulator(scene, num_envs=count, device=device, settings=Settings(dt=1 / 60))
    sim.set("orientation", random_quaternion(generator, count)[:, None], bodies=[box])
    deepest = 0.0
    for _ in range(30):
        sim.step()
        deepest = max(deepest, sim.penetration().max())
    assert np.abs(sim.get("linear_velocity")[:, box]).max() < 2.0
    assert deepest < 1e-4


def test_what_is_caught_between_lower_bodies_pushes_them_apart(device):
    """A box on a pedestal overlaps a wall and, on its other side, a taller box, which is of a lower level.

    Frozen, that one and the wall hold the box from both sides.
    """
    depth = 0.005
    scene = ground_scene()
    scene.add_static(Box((0.1, 1.0, 1.0)), position=(-0.2 + depth, 0, 1.0))
    scene.add_body(Box((0.08, 0.1, 0.1)), position=(0.0, 0, 0.1))
    scene.add_body(Box((0.1, 0.1, 0.1)), position=(0.0, 0, 0.3), mass=1.0)
    scene.add_body(Box((0.1, 0.1, 0.2)), position=(0.2 - depth, 0, 0.2), mass=1.0)
    sim, _ = opened(scene, device)
    assert sim.penetration()[0] == pytest.approx(depth, rel=1e-3)
    sim.step(60)
    assert sim.get("level")[0].tolist() == [0, 0, 1, 2, 1]
    assert sim.penetration()[0] < 0.1 * depth


@pytest.mark.parametrize("speed", [0.0, 0.2, 2.0], ids=["at_rest", "slow", "fast"])
@pytest.mark.parametrize("shape", [Sphere(0.05), Cylinder(0.05, 0.1), Capsule(0.05, 0.1)], ids=str)
@pytest.mark.parametrize("dt", [1 / 60, DT], ids=["60_hz", "240_hz"])
def test_overlap_of_a_rolling_body_shrinks_as_that_of_one_at_rest(device, shape, speed, dt):
    """A step turns the fast one by 38 degrees. Its lowest point rises, its surface does not."""
    depth = 1e-3
    scene = Scene()
    scene.add_static(GROUND)
    scene.add_body(
        shape,
        position=(0, 0, 0.05 - depth),
        orientation=rotate_about((1, 0, 0), 90.0),
        linear_velocity=(speed, 0, 0),
        angular_velocity=(0, speed / 0.05, 0),
    )
    sim, _ = opened(scene, device, settings=Settings(dt=dt))
    found = []
    for _ in range(25):
        sim.step()
        found.append(0.05 - sim.get("position")[0, 1, 2])
    np.testing.assert_allclose(found, depths_after(depth, 0.1, 25, dt), atol=2e-6)


@pytest.mark.parametrize("shape", [Sphere(0.05), Cylinder(0.05, 0.2), Capsule(0.05, 0.2)], ids=str)
def test_a_spinning_body_does_not_push_the_ball_that_touches_it(device, shape):
    """A flat surface would turn into the ball by a hundredth of a metre in a step."""
    scene = Scene(gravity=(0, 0, 0))
    scene.add_kinematic(shape, angular_velocity=(0, 0, 40.0), friction=0.0)
    scene.add_body(Sphere(0.05), position=(0.1, 0, 0), friction=0.0)
    sim, _ = opened(scene, device, settings=Settings(dt=1 / 60))
    sim.step(60)
    # The surface moves at 2 m/s, and rounding errors of this speed push, too.
    assert sim.get("position")[0, 1] == pytest.approx([0.1, 0, 0], abs=2e-5)


def test_a_ball_with_its_weight_off_its_center_does_not_sink_as_it_turns(device):
    """Its surface does move: the middle circles around the centre of mass, and pushes it up where it comes below."""
    weighted = Compound([(Sphere(0.05), (0, 0, 0), (0, 0, 0, 1))], (0, 0, 0.02), 1e-3 * np.eye(3))
    scene = Scene(gravity=(0, 0, 0))
    scene.add_static(GROUND, friction=0.0)
    scene.add_body(weighted, position=(0, 0, 0.05), angular_velocity=(0, 20.0, 0), friction=0.0)
    sim, _ = opened(scene, device, settings=Settings(dt=1 / 60))
    lowest = []
    for _ in range(30):
        sim.step()
        lowest.append(sim.get("position")[0, 1, 2] - 0.05)
    assert min(lowest) >= -1.5 * SLOP * 0.1
    assert max(lowest) > 0.01
