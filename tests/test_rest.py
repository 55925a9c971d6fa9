"""Rest: what comes to rest, who falls asleep, who never does, what wakes whom, and that sleep changes nothing else."""

import time

import numpy as np
import pytest
import warp as wp

from tests.oracles import add_uneven_stack, ground_scene, random_quaternion, rotate_about, stages_of
from warp_rigid.engine.settings import Settings
from warp_rigid.engine.simulator import Simulator
from warp_rigid.runs.runner import execute, find_scene, plan_run
from warp_rigid.scene.fields import PointField
from warp_rigid.scene.scene import Scene
from warp_rigid.scene.shapes import Box, Cylinder, Plane, Sphere
from warp_rigid.scenes.builders import meshes, stacks
from warp_rigid.scenes.builders.bodies import add_bodies

STATE = ("position", "orientation", "linear_velocity", "angular_velocity")
HALF, CUBE = 0.1, stacks.CUBE
SLEEPING = Settings(sleeping=True)


def stack_scene(height=3, places=(0.0,), **ground):
    """Stacks of cubes on the ground; the ground is body 0."""
    scene = ground_scene(friction=0.5, **ground)
    for x in places:
        add_bodies(scene, stacks.CUBE, stacks.column(height) + [x, 0.0, 0.0])
    return scene


def sleeping_sim(scene, device, seconds=1.0, **arguments):
    """A simulator with sleeping on, after some time."""
    sim = Simulator(scene, settings=SLEEPING, device=device, **arguments)
    sim.step(round(240 * seconds))
    return sim


def asleep(sim, env=0):
    return np.flatnonzero(sim.get("asleep")[env]).tolist()


def snapshot(sim):
    return [sim.get(name).tobytes() for name in STATE]


def converged(shape, device, falling, seconds):
    """Motion in a second [m, rad] and overlap in 64 environments at one step a frame, after bodies fell however turned.

    The largest displacement or rotation of any body: the speed at one instant would miss what happens between.
    """
    scene, generator = ground_scene(friction=0.5), np.random.default_rng(0)
    rows = [scene.add_body(shape, position=(0, 0, 0.25 + 0.35 * k), friction=0.5) for k in range(falling)]
    sim = Simulator(scene, 64, Settings(dt=1 / 60), device=device)
    turns = np.stack([random_quaternion(generator, 64) for _ in rows], axis=1)
    sim.set("orientation", turns, bodies=rows)
    sim.step(round(60 * seconds))
    position, turn = (sim.get(name)[:, rows] for name in ("position", "orientation"))
    sim.step(60)
    way = np.linalg.norm(sim.get("position")[:, rows] - position, axis=-1).max()
    now = sim.get("orientation")[:, rows]
    angle = 2.0 * np.minimum(*(np.linalg.norm(now - sign * turn, axis=-1) for sign in (1, -1))).max()
    return max(way, angle), float(sim.penetration().max())


def test_bumpy_shapes_come_to_rest(device):
    """They stand on the samples that lie lowest, not on those furthest out, and stay there.

    If the contacts that carry load are not kept, one of 64 moves on by 1 mrad after six seconds.
    """
    motion, overlap = converged(meshes.bunny(0.2), device, 1, 6)
    assert motion < 1.3e-4 and overlap < 3e-5


def test_boxes_on_boxes_come_to_rest(device):
    motion, overlap = converged(CUBE, device, 3, 5)
    assert motion < 2e-5 and overlap < 5e-5


def test_hardly_a_cylinder_stays_in_another(device):
    """Where the side of one is across the rim of another, the balls at the ends of its axis touch; rims may hook."""
    scene, generator = ground_scene(friction=0.5), np.random.default_rng(3)
    shape, loose = Cylinder(0.08, 0.1), {"friction": 0.5, "rolling_friction": 0.01}
    rows = [scene.add_body(shape, position=(0, 0, 0.3 + 0.4 * k), **loose) for k in range(2)]
    sim = Simulator(scene, 256, Settings(dt=1 / 60), device=device)
    sim.set("orientation", np.stack([random_quaternion(generator, 256) for _ in rows], axis=1), bodies=rows)
    sim.step(300)
    overlap = sim.penetration()
    assert (overlap > 1e-3).sum() <= 2 and overlap.max() < 0.02


def test_a_stack_sleeps_within_two_seconds(device):
    """Dropped from a little above, so that it has to come to rest first; the ground is no sleeper."""
    scene = ground_scene(friction=0.5)
    add_bodies(scene, stacks.CUBE, stacks.column(10, gap=0.01))
    sim = sleeping_sim(scene, device, 2.0)
    assert asleep(sim) == list(range(1, 11))
    assert not Simulator(scene, device=device).get("asleep").any()


def test_nothing_sleeps_before_its_time(device):
    """A stack that stands from the start keeps awake for half a second, and all of it falls asleep in the same step."""
    sim = sleeping_sim(stack_scene(5), device, 0.0)
    counts = []
    for _ in range(200):
        sim.step()
        counts.append(len(asleep(sim)))
    assert set(counts) == {0, 5}
    assert counts.index(5) + 1 >= 120


def test_free_fall_and_the_top_of_a_throw_never_sleep(device):
    """Alone, in a touching pair, at rest in free space, and where gravity is so weak that nothing seems to move."""
    scene = Scene()
    scene.add_body(Sphere(0.1), position=(0, 0, 100), linear_velocity=(0, 0, 9.81))
    for x in (5.0, 5.2):
        scene.add_body(CUBE, position=(x, 0, 100), linear_velocity=(0, 0, 9.81))
    scene.add_body(Sphere(0.1), position=(10, 0, 0))
    sim = sleeping_sim(scene, device, 0.0, num_envs=3)
    sim.set("gravity", [(0, 0, -9.81), (0, 0, 0), (0, 0, -1e-4)])
    sim.set("linear_velocity", 0.0, envs=[1, 2])
    for _ in range(50):
        sim.step(10)
        assert not sim.get("asleep").any()


def test_a_ball_at_the_top_of_a_ramp_does_not_sleep(device):
    """It stands still for a moment while it touches the ramp, rolls back, and sleeps only when it has come to rest."""
    scene = Scene()
    slope = np.radians(1.0)
    scene.add_static(Plane((-np.sin(slope), 0, np.cos(slope)), 0.0), friction=0.5)
    ball = scene.add_body(Sphere(0.1), position=(-0.1 * np.sin(slope), 0, 0.1 * np.cos(slope)), friction=0.5)
    sim = sleeping_sim(scene, device, 0.0)
    sim.set("linear_velocity", (0.1, 0, 0), bodies=[ball])
    sim.set("angular_velocity", (0, 1.0, 0), bodies=[ball])
    speeds = []
    for _ in range(100):
        sim.step(6)
        speeds.append(sim.get("linear_velocity")[0, ball, 0])
        assert not sim.get("asleep").any()
    assert min(speeds) < -0.1 and min(np.abs(speeds)) < 5e-3


@pytest.mark.parametrize(("radius", "gravity"), [(0.1, 9.81), (5.0, 9.81), (50.0, 9.81), (0.1, 0.1), (5.0, 0.1)])
def test_a_ball_that_starts_to_roll_slowly_does_not_sleep(device, radius, gravity):
    """On a slope of 2 %, from rest: 5/7 g s t^2 / 2, for large balls and in weak gravity too, where all goes slowly."""
    scene = Scene(gravity=(0.02 * gravity, 0, -gravity))
    scene.add_static(Plane(), friction=0.5)
    ball = scene.add_body(Sphere(radius), position=(0, 0, radius), friction=0.5)
    seconds = float(4.0 * np.sqrt(radius / 0.1 * 9.81 / gravity))
    sim = Simulator(scene, settings=Settings(dt=seconds / 960, sleeping=True), device=device)
    sim.step(960)
    assert not sim.get("asleep").any()
    way = 0.02 * gravity * 5.0 / 7.0 * seconds**2 / 2.0
    assert sim.get("position")[0, ball, 0] == pytest.approx(way, rel=5e-3)


def test_large_bodies_sleep_later(device):
    """Once their weight would have moved them by six of their sizes: a cube of 10 m after 3.5 s."""
    scene = ground_scene(friction=0.5)
    scene.add_body(Box((5.0, 5.0, 5.0)), position=(0, 0, 5.0))
    sim = sleeping_sim(scene, device, 3.4)
    assert asleep(sim) == []
    sim.step(48)
    assert asleep(sim) == [1]


def test_sleepers_keep_their_state_bit_for_bit(device):
    """Pose, energy, contacts and levels; the velocity is zero."""
    sim = sleeping_sim(stack_scene(4, places=(0.0, 1.0)), device)
    assert len(asleep(sim)) == 8

    def searched():
        return [
            *snapshot(sim),
            sim.contacts().tobytes(),
            sim.get("level").tobytes(),
            sim.get("potential_energy").tobytes(),
        ]

    before = searched()
    sim.step(100)
    assert searched() == before
    assert (sim.get("linear_velocity") == 0).all() and (sim.get("kinetic_energy") == 0).all()
    assert len(sim.contacts()) == 32 and sim.penetration()[0] < 1e-4
    assert sim.get("level")[0].tolist() == [0, 1, 2, 3, 4, 1, 2, 3, 4]
    impulse_of = 240 * np.abs(sim.contacts()["impulse"][:, 2]).sum()
    assert impulse_of == pytest.approx(2 * (1 + 2 + 3 + 4) * 8 * 9.81, rel=1e-3)


def test_waking_does_not_depend_on_how_long_one_slept(device):
    """Woken at once or much later: the same contacts, warm-started alike, the same motion, and no jolt."""
    ends = []
    for wait in (1, 100):
        sim = sleeping_sim(stack_scene(5), device)
        start = sim.get("position")
        assert len(asleep(sim)) == 5
        sim.step(wait)
        sim.set("linear_velocity", 0.0, bodies=[3])
        assert asleep(sim) == []
        sim.step(20)
        assert np.abs(sim.get("position") - start).max() < 1e-6
        assert np.abs(sim.get("linear_velocity")).max() < 1e-4
        ends.append((snapshot(sim), sim.contacts().tobytes()))
    assert ends[0] == ends[1]


def tell(name, value):
    return lambda sim: sim.set(name, value, bodies=[2])


def push(sim):
    sim.apply_impulse((10.0, 0, 0), (0, 0, 0.3), 2)


def write_live(sim):
    """Through the device array, past every check."""
    force = sim.array("force")
    rows = force.numpy().copy()
    rows[2] = (0.0, 0.0, 0.5)
    force.assign(rows)


WAYS = {
    "impulse": push,
    "velocity": tell("linear_velocity", (1e-3, 0, 0)),
    "spin": tell("angular_velocity", (0, 0, 1e-3)),
    "force": tell("force", (0.0, 0.0, 0.1)),
    "pose": tell("position", (0.001, 0, 0.3)),
    "mass": tell("mass", 9.0),
    "friction": tell("friction", 0.1),
    "gravity": lambda sim: sim.set("gravity", (0, 0, -9.8)),
    "array": write_live,
    "setting": lambda sim: sim.set("sleeping", False),
    "removed top": lambda sim: sim.set("active", False, bodies=[3]),
}


@pytest.mark.parametrize("way", WAYS)
def test_what_is_done_to_one_wakes_its_island_in_the_same_step(device, way):
    """The whole stack, not the one beside it unless it is told too."""
    sim = sleeping_sim(stack_scene(3, places=(0.0, 1.0)), device)
    assert asleep(sim) == [1, 2, 3, 4, 5, 6]
    WAYS[way](sim)
    sim.step()
    assert asleep(sim) == ([] if way in ("gravity", "setting") else [4, 5, 6])
    if way == "impulse":
        assert sim.get("linear_velocity")[0, 2, 0] > 0.0


def test_a_blow_wakes_the_island_in_its_step(device):
    """A ball hits the first of three sleeping cubes in a row: what it does is what it would do to cubes awake.

    Those awake have come to lie half a micrometre elsewhere; closing that within a step is a tenth of a millimetre a
    second.
    """
    scene = ground_scene(friction=0.0)
    for x in (0.0, 0.2, 0.4):
        scene.add_body(CUBE, position=(x, 0, HALF), mass=1.0, friction=0.0)
    ball = scene.add_body(Sphere(0.1), position=(-1.0, 0, HALF), mass=1.0, friction=0.0, linear_velocity=(0, 0, 0))
    sim = sleeping_sim(scene, device)
    awake = Simulator(scene, device=device)
    awake.step(240)
    assert asleep(sim) == [1, 2, 3, 4]
    for each in (sim, awake):
        each.set("linear_velocity", (2.0, 0, 0), bodies=[ball])
    assert asleep(sim) == [1, 2, 3]
    apart = np.abs(sim.get("position") - awake.get("position")).max()
    assert apart < 1e-6
    while asleep(sim):
        assert sim.time < 2.0
        assert sim.get("linear_velocity")[0, ball, 0] == pytest.approx(2.0, rel=1e-5)
        sim.step()
        awake.step()
    for _ in range(4):
        velocity = sim.get("linear_velocity")[0, 1:, 0]
        assert velocity.sum() == pytest.approx(2.0, rel=1e-5)
        np.testing.assert_allclose(velocity, awake.get("linear_velocity")[0, 1:, 0], atol=2.0 * 240 * apart)
        sim.step()
        awake.step()
    assert velocity.min() > 0.3


@pytest.mark.parametrize("how", ["lowest cube", "table switched off", "table moved", "table driven"])
def test_a_support_that_goes_wakes_all_above(device, how):
    scene = Scene()
    table = scene.add_kinematic(Box((1, 1, 0.05)), position=(0, 0, -0.05), friction=0.5)
    add_bodies(scene, stacks.CUBE, stacks.column(4))
    sim = sleeping_sim(scene, device)
    assert asleep(sim) == [1, 2, 3, 4]
    if how == "lowest cube":
        sim.set("position", (3.0, 0, HALF), bodies=[1])
    elif how == "table switched off":
        sim.set("active", False, bodies=[table])
    elif how == "table moved":
        sim.set("position", (0, 0, -1.0), bodies=[table])
    else:
        sim.set("linear_velocity", (0, 0, -0.2), bodies=[table])
    sim.step(30)
    assert asleep(sim) == []
    fallen = 0.5 * 9.81 * (30 / 240) ** 2 if how != "table driven" else 0.2 * 30 / 240
    np.testing.assert_allclose(sim.get("position")[0, 2:, 2], HALF + 2 * HALF * np.arange(1, 4) - fallen, atol=4e-3)


def test_on_a_moving_kinematic_nothing_sleeps(device):
    """A turntable keeps its load awake; when it stops they sleep, and when it turns again they wake."""
    scene = Scene()
    table = scene.add_kinematic(Box((1, 1, 0.05)), position=(0, 0, -0.05), angular_velocity=(0, 0, 1e-3), friction=0.5)
    scene.add_body(CUBE, position=(0.3, 0, HALF))
    sim = sleeping_sim(scene, device, 2.0)
    assert asleep(sim) == []
    sim.set("angular_velocity", 0.0, bodies=[table])
    sim.step(240)
    assert asleep(sim) == [1]
    sim.set("angular_velocity", (0, 0, 1.0), bodies=[table])
    sim.step(2)
    assert asleep(sim) == []
    assert sim.get("linear_velocity")[0, 1, 1] > 0.01


def test_a_fixed_body_that_is_put_onto_a_sleeper_wakes_it(device):
    scene = stack_scene(1)
    wall = scene.add_static(Box((0.05, 1, 1)), position=(2, 0, 1))
    sim = sleeping_sim(scene, device)
    assert asleep(sim) == [1]
    sim.set("position", (0.12, 0, 1), bodies=[wall])
    sim.step(60)
    assert sim.get("position")[0, 1, 0] < -0.02


def test_bodies_sleep_all_around_a_planet(device):
    """Rest knows no "up"."""
    scene = Scene(gravity=(0, 0, 0))
    scene.add_static(Sphere(1.0), friction=0.8)
    scene.add_force_field(PointField(center=(0, 0, 0), strength=10.0))
    for direction in np.vstack([np.eye(3), -np.eye(3)]):
        turn = rotate_about((0.3, 0.5, 0.8), 0) if direction[2] else rotate_about((direction[1], direction[0], 0), 90)
        scene.add_body(Box((0.1, 0.1, 0.1)), position=1.11 * direction, orientation=turn, friction=0.8)
    sim = sleeping_sim(scene, device, 3.0)
    assert asleep(sim) == [1, 2, 3, 4, 5, 6]


def test_sleep_that_is_switched_on_counts_from_then(device):
    """Whether others in the batch sleep, or have ever slept, does not tell when a stack falls asleep."""
    batch = sleeping_sim(stack_scene(3), device, 0.0, num_envs=2)
    alone = Simulator(stack_scene(3), device=device)
    batch.set("sleeping", False, envs=[1])
    for sim, env in ((batch, 1), (alone, 0)):
        sim.step(100)
        sim.set("sleeping", True, envs=[env])
        sim.step(100)
        assert asleep(sim, env) == []
        sim.step(21)
        assert asleep(sim, env) == [1, 2, 3]


def test_sleep_that_is_switched_off_leaves_no_trace(device):
    """Boxes that stood still are pushed: they slide as if no environment had ever been allowed to sleep."""
    never, once = (Simulator(stack_scene(1, (0.0, 1.0, 2.0)), num_envs=2, device=device) for _ in range(2))
    once.set("sleeping", True, envs=[0])
    for sim in (never, once):
        sim.step(8)
    once.set("sleeping", False, envs=[0])
    for sim in (never, once):
        sim.set("linear_velocity", (0, 2, 0), bodies=[1, 2, 3])
        sim.step(60)
    assert snapshot(once) == snapshot(never)
    assert once.penetration().max() < 1e-6
    np.testing.assert_allclose(once.get("linear_velocity")[:, 1:, 1], 2 - 0.5 * 9.81 * 0.25, rtol=0.01)


def test_box_stack_ends_alike_with_and_without_sleep(device):
    """The demo's verdicts, in one batch without and with sleep: the stack sleeps, until it is hit."""
    slept = []
    plan = plan_run(find_scene("box_stack"), ["sleeping=false,true"], device=device)
    verdicts = execute(plan, on_frame=lambda _: slept.append(plan.sim.get("asleep").sum(1))).verdicts
    for verdict in verdicts:
        assert verdict.passed.all()
    slept = np.array(slept)
    assert (slept[:, 0] == 0).all() and slept[299, 1] == 11 and slept[299:, 1].min() == 0


def work(sim):
    """Candidate pairs that are searched and contacts that are solved in the last step."""
    pairs = stages_of(sim).pools.pairs
    count = int(pairs.start.numpy()[-1])
    return int((pairs.dormant.numpy()[:count] == 0).sum()), int(pairs.contact_start.numpy()[-1])


def seconds(sim, steps):
    """Processor time of some steps [s]."""
    wp.synchronize_device(sim.device)
    start = time.process_time()
    for _ in range(steps):
        stages_of(sim).replay()
    wp.synchronize_device(sim.device)
    return time.process_time() - start


@pytest.mark.quiet
def test_a_sleeping_pile_costs_less_than_a_tenth(device):
    """No pair is searched and no contact solved; a step costs under a tenth of one in which the pile settles.

    Measured 0.054 to 0.063. With few bodies, the fixed cost of a step weighs more: 0.14 for 96 of them.
    """
    scene = ground_scene(friction=0.5)
    for x in np.arange(48.0) * 0.5:
        add_uneven_stack(scene, 8, x=x, gap=0.01, twist=np.radians(7))
    sim = sleeping_sim(scene, device, 0.02)
    awake = seconds(sim, 60)
    searched, solved = work(sim)
    assert searched >= 384 and solved >= 1200
    sim.step(360)
    assert len(asleep(sim)) == 384
    resting = min(seconds(sim, 60) for _ in range(3))
    assert work(sim) == (0, 0)
    if not wp.get_device(device).is_cuda:
        assert resting < 0.1 * awake
