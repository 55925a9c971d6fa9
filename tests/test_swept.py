"""Swept detection: nothing that moves far in a step passes through anything, and it rebounds as it should."""

import time

import numpy as np
import pytest
import warp as wp

from tests.geometry_oracles import cube
from tests.oracles import (
    find_contacts,
    ground_scene,
    opened,
    pair_list,
    random_pile,
    random_quaternion,
    rotate_about,
    stages_of,
)
from warp_rigid.engine import teams
from warp_rigid.engine.cores import shared_by, usable_cores
from warp_rigid.engine.settings import Settings
from warp_rigid.engine.simulator import Simulator
from warp_rigid.kernels.collide import ccd
from warp_rigid.scene.scene import Scene
from warp_rigid.scene.shapes import Box, Capsule, Cylinder, Heightfield, Mesh, Plane, Sphere
from warp_rigid.scenes.builders import meshes

DT = 1 / 240
THICKNESS = 0.02
SPEED = 10 * THICKNESS / DT
"""Ten times the thickness of the thinnest wall in a step [m/s]."""


def thin_box_mesh():
    """The plate as a mesh with a distance grid, twice as thick."""
    vertices, faces = cube(1.0)
    return Mesh(vertices * [0.5, 0.5, THICKNESS], faces, sdf_resolution=64)


def bumpy_field():
    x = np.linspace(-1, 1, 33)
    return Heightfield(0.05 * np.sin(6 * x)[:, None] * np.cos(5 * x)[None], (2.0, 2.0))


WALLS = {
    "plate": lambda: Box((0.5, 0.5, 0.5 * THICKNESS)),
    "mesh plate": thin_box_mesh,
    "heightfield": bumpy_field,
    "plane": lambda: Plane((0, 0, 1), 0.0),
}
BODIES = {
    "ball": lambda: Sphere(0.05),
    "small ball": lambda: Sphere(0.5 * THICKNESS),
    "box": lambda: Box((0.05, 0.05, 0.05)),
    "brick": lambda: Box((0.06, 0.04, 0.01)),
    "rod": lambda: Box((0.2, 0.01, 0.01)),
    "capsule": lambda: Capsule(0.02, 0.08),
    "cylinder": lambda: Cylinder(0.05, 0.03),
    "bunny": lambda: meshes.bunny(0.1, sdf_resolution=32),
}
DEEPEST = {"plate": 0.5 * THICKNESS, "mesh plate": THICKNESS, "heightfield": 0.06, "plane": 0.1 * THICKNESS}
"""How far below zero a centre may get that is not through the wall [m]."""


def fired(device, wall, body, count=24, speed=SPEED, seed=0):
    """A batch of tumbling bodies, each from its own pose a step or two above the wall, at restitution 0, 0.5 and 1."""
    scene = Scene(gravity=(0, 0, 0))
    scene.add_static(wall, friction=0.3)
    scene.add_body(body, friction=0.3)
    generator = np.random.default_rng(seed)
    sim = Simulator(scene, num_envs=count, settings=Settings(dt=DT), device=device)
    sim.set("restitution", (0.5 * (np.arange(count) % 3))[:, None])
    top = wall.bounds[1][2] if np.isfinite(wall.bounds[1][2]) else 0.0
    reach = np.linalg.norm(np.abs(body.bounds).max(0))
    place = generator.uniform((-0.2, -0.2, 0.05), (0.2, 0.2, 0.4), (count, 3))
    sim.set("position", (place + [0, 0, top + reach])[:, None], bodies=[1])
    sim.set("orientation", random_quaternion(generator, count)[:, None], bodies=[1])
    sim.set("linear_velocity", (0, 0, -speed), bodies=[1])
    sim.set("angular_velocity", generator.normal(scale=20.0, size=(count, 1, 3)), bodies=[1])
    return sim


@pytest.mark.parametrize("wall", WALLS)
@pytest.mark.parametrize("body", BODIES)
def test_nothing_tunnels(device, body, wall):
    """Ten thicknesses a step, at e = 0, 0.5 and 1: no centre ever gets through the wall; no energy is gained.

    A plane has no other side: there no centre may get deeper than a tenth of the thickness.
    """
    sim = fired(device, WALLS[wall](), BODIES[body]())
    energy = sim.get("kinetic_energy")[:, 1]
    bottom = -DEEPEST[wall]
    stopped = np.zeros(sim.num_envs, bool)
    for _ in range(12):
        sim.step()
        center = sim.get("center_of_mass")[:, 1]
        above = np.abs(center[:, :2]).max(1) < 0.45
        assert (center[above, 2] > bottom).all()
        stopped |= sim.get("linear_velocity")[:, 1, 2] > -0.5 * SPEED
    assert stopped.all()
    assert (sim.get("kinetic_energy")[:, 1] < 1.04 * energy).all()


@pytest.mark.parametrize("restitution", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("wall", ["plate", "plane", "mesh plate"])
def test_a_fast_ball_rebounds_with_its_restitution(device, wall, restitution):
    """From 50 m/s: e times the speed within 1 %; at e = 0 it stops at the wall, within 2 % of its size."""
    shape = WALLS[wall]()
    top = shape.bounds[1][2] if np.isfinite(shape.bounds[1][2]) else 0.0
    scene = Scene(gravity=(0, 0, 0))
    scene.add_static(shape)
    scene.add_body(Sphere(0.05))
    count = 9
    sim = Simulator(scene, num_envs=count, settings=Settings(dt=DT), device=device)
    sim.set("restitution", restitution)
    sim.set("position", [[(0.01, 0.02, top + 0.05 + gap)] for gap in np.linspace(0.01, 0.4, count)], bodies=[1])
    sim.set("linear_velocity", (0, 0, -50.0), bodies=[1])
    lowest = np.full(count, np.inf)
    for _ in range(8):
        sim.step()
        lowest = np.minimum(lowest, sim.get("position")[:, 1, 2] - top - 0.05)
    np.testing.assert_allclose(sim.get("linear_velocity")[:, 1, 2], 50.0 * restitution, atol=0.5)
    assert lowest.min() > -0.02 * 0.1
    if restitution == 0.0:
        assert np.abs(sim.get("position")[:, 1, 2] - top - 0.05).max() < 0.02 * 0.1


def test_energy_of_a_fast_bouncing_ball_in_gravity(device):
    """In steps that are cut short gravity works along the way that is gone: 20 bounces of 3 radii a step keep 2 %."""
    scene = ground_scene(restitution=1.0)
    scene.add_static(Plane((0, 0, -1), -1.0), restitution=1.0)
    scene.add_body(Sphere(0.05), position=(0, 0, 0.5), linear_velocity=(0, 0, -36.0), restitution=1.0)
    sim = Simulator(scene, settings=Settings(dt=DT), device=device)
    start = sim.get("kinetic_energy")[0, 2] + sim.get("potential_energy")[0, 2]
    sim.step(160)
    assert abs(sim.get("linear_velocity")[0, 2, 2]) > 30
    assert sim.get("kinetic_energy")[0, 2] + sim.get("potential_energy")[0, 2] == pytest.approx(start, rel=0.02)


PAIRS = {
    "balls": (Sphere(0.02), Sphere(0.02)),
    "boxes": (Box((0.02, 0.02, 0.02)), Box((0.02, 0.02, 0.02))),
    "box and ball": (Box((0.02, 0.03, 0.02)), Sphere(0.03)),
    "crossed rods": (Box((0.2, 0.01, 0.01)), Box((0.01, 0.2, 0.01))),
    "mesh and box": (Mesh(*cube(0.03), sdf_resolution=24), Box((0.03, 0.03, 0.03))),
}


@pytest.mark.parametrize("pair", PAIRS)
def test_bodies_do_not_pass_through_each_other(device, pair):
    """Head-on at ten sizes a step: momentum is kept, the order along the line too, at e = 0, 0.5 and 1."""
    scene = Scene(gravity=(0, 0, 0))
    for shape, z, speed in zip(PAIRS[pair], (0.0, 0.3), (1.0, -1.0), strict=True):
        scene.add_body(shape, position=(0, 0, z), linear_velocity=(0, 0, speed * 0.5 * SPEED), mass=1.0, friction=0.0)
    count = 12
    sim = Simulator(scene, num_envs=count, settings=Settings(dt=DT), device=device)
    sim.set("restitution", (0.5 * (np.arange(count) % 3))[:, None])
    generator = np.random.default_rng(0)
    apart = np.zeros((count, 2, 3))
    apart[:, 1, 2] = generator.uniform(0.2, 0.5, count)
    sim.set("position", apart)
    for _ in range(12):
        sim.step()
        z = sim.get("position")[..., 2]
        assert (z[:, 1] > z[:, 0]).all()
    velocity = sim.get("linear_velocity")[..., 2]
    assert np.abs(velocity.sum(1)).max() < 1e-3 * SPEED
    assert (velocity[:, 1] - velocity[:, 0] > -1e-3 * SPEED).all()


RODS = {"bar": Box((0.01, 0.01, 1.0)), "capsule": Capsule(0.01, 1.0), "cylinder": Cylinder(0.01, 1.0)}


@pytest.mark.parametrize("kind", ["static", "free"])
@pytest.mark.parametrize("pair", [("bar", "bar"), ("capsule", "bar"), ("cylinder", "capsule")], ids="-".join)
def test_rods_that_cross_anywhere_meet(device, kind, pair):
    """Rods 2 m long and 0.02 m thick at 60 m/s, crossed at any angle, each at any place of its length."""
    count, speed = 48, 60.0
    below, above = (RODS[name] for name in pair)
    scene = Scene(gravity=(0, 0, 0))
    add = scene.add_static if kind == "static" else scene.add_body
    add(below, orientation=rotate_about((0, 1, 0), 90))
    scene.add_body(above, linear_velocity=(0, 0, -speed))
    generator = np.random.default_rng(0)
    angle = generator.uniform(0.5, np.pi - 0.5, count)
    along = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    across = np.stack([-np.sin(angle), np.cos(angle), 0 * angle], axis=1)
    place, share = generator.uniform(-0.8, 0.8, (2, count, 1))
    start = place * [1, 0, 0] + share * along + generator.uniform(0.3, 0.6, (count, 1)) * [0, 0, 1]
    sim = Simulator(scene, num_envs=count, settings=Settings(dt=DT), device=device)
    sim.set("position", start[:, None], bodies=[1])
    sim.set("orientation", [[rotate_about(axis, 90)] for axis in across], bodies=[1])
    sim.step(4)
    assert (sim.get("linear_velocity")[:, 1, 2] > -0.999 * speed).all()


def test_the_tip_of_a_spinning_rod_is_stopped(device):
    """A rod turns about its middle, its tip by a quarter of a metre a step, against a post: it bounces off."""
    scene = Scene(gravity=(0, 0, 0))
    scene.add_static(Box((THICKNESS / 2, 0.2, 0.5)), position=(0.3, 0.35, 0.0))
    scene.add_body(Box((0.5, 0.01, 0.01)), friction=0.0)
    spins = np.linspace(20, 120, 6)
    sim = Simulator(scene, num_envs=18, settings=Settings(dt=DT), device=device)
    sim.set("restitution", (0.5 * (np.arange(18) % 3))[:, None])
    sim.set("angular_velocity", [[(0, 0, spin)] for spin in np.repeat(spins, 3)], bodies=[1])
    energy = sim.get("kinetic_energy")[:, 1]
    turned = np.zeros(18)
    for _ in range(40):
        before = sim.get("angular_velocity")[:, 1, 2]
        sim.step()
        turned = np.maximum(turned, np.where(before > 0.9 * np.repeat(spins, 3), sim.time * before, turned))
    angle = np.arctan2(0.15, 0.29)
    assert (turned < angle + 2 * DT * np.repeat(spins, 3)).all()
    assert (sim.get("kinetic_energy")[:, 1] < 1.02 * energy).all()


def test_a_fast_slide_is_not_held_up(device):
    """Along the ground at 40 m/s without friction: 3 sizes a step, not a millimetre is lost."""
    scene = ground_scene(friction=0.0)
    scene.add_body(Box((0.03, 0.03, 0.03)), position=(0, 0, 0.03), linear_velocity=(40.0, 0, 0), friction=0.0)
    sim = Simulator(scene, device=device)
    sim.step(120)
    assert sim.get("position")[0, 1, 0] == pytest.approx(20.0, rel=1e-5)
    assert sim.get("linear_velocity")[0, 1, 0] == pytest.approx(40.0, rel=1e-5)


def test_who_flies_past_is_not_held_up(device):
    """By a wall's edge and by another body, a tenth of a size away: the course stays as it was, bit for bit."""
    scene = Scene(gravity=(0, 0, 0))
    scene.add_static(Box((0.5, 0.5, 0.01)))
    scene.add_body(Sphere(0.05), position=(0.56, 0, 0.5), linear_velocity=(0, 0, -SPEED))
    scene.add_body(Sphere(0.05), position=(0.67, 0, -0.5), linear_velocity=(0, 0, SPEED))
    sim = Simulator(scene, device=device)
    sim.step(8)
    np.testing.assert_allclose(sim.get("position")[0, 1:, 2], [0.5 - 8 * 0.2, -0.5 + 8 * 0.2], atol=1e-5)
    assert sim.get("linear_velocity")[0, 1:].tolist() == [[0, 0, -np.float32(SPEED)], [0, 0, np.float32(SPEED)]]


def test_rods_gain_no_energy_in_free_flight(device):
    """A thin rod hit off its middle: its rotation is stiff, its energy stays within 2 % for a second."""
    scene = Scene(gravity=(0, 0, 0))
    scene.add_body(Box((0.3, 0.01, 0.01)), mass=0.24)
    sim = Simulator(scene, num_envs=3, device=device)
    sim.set("angular_velocity", [[(80, 200, -90)], [(-320, 40, 120)], [(2000, 100, 0)]])
    sim.set("orientation", rotate_about((1, 2, 3), 70))
    start = sim.get("kinetic_energy")[:, 0]
    for _ in range(24):
        sim.step(10)
        np.testing.assert_allclose(sim.get("kinetic_energy")[:, 0], start, rtol=0.02)


def test_fast_bodies_repeat_bit_for_bit(device):
    """Twice the same, and the same in steps of one."""
    runs = []
    for chunk in (12, 12, 1):
        sim = fired(device, WALLS["plate"](), BODIES["box"]())
        for _ in range(12 // chunk):
            sim.step(chunk)
        runs.append([sim.get(name).tobytes() for name in ("position", "orientation", "angular_velocity")])
    assert runs[0] == runs[1] == runs[2]


def traced_pairs(stages):
    """Pairs of bodies that the coming step's first round traces, as sets of indices."""
    pairs = stages.pools.pairs
    pairs.fast.fill_(-1)
    find_contacts(stages)
    stages.detect_continuous_collisions()
    listed = pairs.fast.numpy()
    return [frozenset(pair) for pair in pair_list(stages)[listed[listed >= 0]].tolist()]


def test_only_bodies_that_can_meet_in_the_step_are_traced(device):
    """Boxes fall side by side by 1.7 sizes a step: none is traced but the lowest, against the ground."""
    scene = ground_scene()
    for k in range(12):
        height = 2.0 if k else 0.3
        scene.add_body(Box((0.1, 0.1, 0.1)), position=(0.21 * k, 0, height), linear_velocity=(0, 0, -20.0))
    _, stages = opened(scene, device, settings=Settings(dt=1 / 60))
    assert traced_pairs(stages) == [frozenset((0, 1))]
    assert len(pair_list(stages)) > 20


@pytest.mark.quiet
def test_slow_scenes_pay_nearly_nothing(device):
    """Less than 2 % of a step of a pile that settles, in which no pair is traced."""
    with shared_by(usable_cores()):  # one core, so one shard
        sim = Simulator(random_pile(np.random.default_rng(0)), num_envs=4, device=device)
    sim.step(80)
    stages = stages_of(sim)

    def best(work):
        with wp.ScopedCapture(sim.device, force_module_load=False) as capture:
            work()
        times = []
        for _ in range(7):
            start = time.perf_counter()
            for _ in range(10):
                wp.capture_launch(capture.graph)
            wp.synchronize_device(sim.device)
            times.append(time.perf_counter() - start)
        return min(times)

    if not sim.device.is_cuda:
        assert best(stages.detect_continuous_collisions) < 0.02 * best(stages.step)


def test_a_body_that_is_hit_does_not_enter_its_neighbour(device):
    """Two balls 5 mm apart whose boxes overlap: when the first is hit by a third, they have no contact.

    It moves 30 mm in the step, less than a quarter of its size.
    """
    along = np.array([1, 1, 0]) / 2**0.5
    scene = Scene(gravity=(0, 0, 0))
    scene.add_body(Sphere(0.2), linear_velocity=20 * along, mass=10.0, restitution=0.0)
    for k in range(2):
        scene.add_body(Sphere(0.2), position=(0.45 + 0.405 * k) * along, mass=1.0, restitution=0.0)
    sim = Simulator(scene, device=device)
    for _ in range(24):
        sim.step()
        assert sim.penetration().max() < 0.025 * 0.4
    np.testing.assert_allclose(sim.get("linear_velocity")[0] @ along, 200 / 12, rtol=1e-3)


@pytest.mark.parametrize("name", ["brick", "cylinder", "bunny"])
def test_the_number_of_lanes_does_not_matter(device, name, monkeypatch):
    """The first impacts of tumbling bodies and a wall are the same, bit for bit, and in a repeated trace."""
    sim = fired(device, WALLS["mesh plate"](), BODIES[name]())
    sim.step(1)
    stages = stages_of(sim)
    found = []
    for trace, look in ((32, 8), (32, 8), (8, 32), (16, 1)):
        monkeypatch.setattr(teams, "TRACE_LANES", trace)
        monkeypatch.setattr(teams, "LOOK_LANES", look)
        stages.open_iteration(is_first=1)
        stages._trace_fast_pairs()
        found.append((stages.motions.first_impact.numpy(), stages.motions.next_time_of_impact.numpy()))
    assert (found[0][0] < int(ccd.NEVER)).any()
    for impact, time_of_impact in found[1:]:
        np.testing.assert_array_equal(impact, found[0][0])
        np.testing.assert_array_equal(time_of_impact, found[0][1])
