"""CONTRIBUTING.md: "Add a kind of constraint", applied to a copy of the checkout."""

import os
import shutil
import subprocess
import sys

import pytest

from tests.test_recipes import COPIED, ROOT, apply

COMMON = """
import sys
import numpy as np
import warp_rigid as wr
from warp_rigid.kernels.constraints.fixed_distance import FixedDistance

DEVICE = sys.argv[1]
G, DT, ORIGIN = 9.81, 1 / 240, (0.0, 0.0, 0.0)
STATE = ("position", "orientation", "linear_velocity", "angular_velocity")


def hang(scene, above, position, length, **more):
    body = scene.add_body(wr.Sphere(0.05), position=position, **more)
    scene.constraints.append(FixedDistance(above, body, ORIGIN, ORIGIN, length))
    return body


def pivot(scene):
    return scene.add_static(wr.Sphere(0.01))


def bits(sim, env=0):
    return b"".join(sim.get(name)[env].tobytes() for name in STATE)


def distances(sim):
    return sim._world.shards._shards[0].stages.constraint_rows.distances


def graph(sim):
    return sim._world.shards._shards[0].pools.graph
"""

PENDULUM = """
length, angle = 1.0, 0.1
start = (length * np.sin(angle), 0.0, -length * np.cos(angle))
for settings in (wr.Settings(dt=DT), wr.Settings(dt=DT, warm_starting=False)):
    scene = wr.Scene(gravity=(0, 0, -G))
    hang(scene, pivot(scene), start, length)
    sim = wr.Simulator(scene, settings=settings, device=DEVICE)
    energy = float((sim.get("kinetic_energy") + sim.get("potential_energy"))[0, 1])
    lift = scene.bodies[1].mass * G * length * (1 - np.cos(angle))
    x, error, change = [], 0.0, 0.0
    for _ in range(2400):
        sim.step()
        place = sim.get("position")[0, 1].astype(float)
        x.append(place[0])
        error = max(error, abs(np.linalg.norm(place) - length))
        now = float((sim.get("kinetic_energy") + sim.get("potential_energy"))[0, 1])
        change = max(change, abs(now - energy) / lift)
    x = np.array(x)
    before = np.flatnonzero((x[:-1] > 0) & (x[1:] <= 0))
    crossings = DT * (1 + before + x[before] / (x[before] - x[before + 1]))
    period = np.diff(crossings).mean()
    # The elliptic integral to fourth order in the angle.
    expected = 2 * np.pi * np.sqrt(length / G) * (1 + angle**2 / 16 + 11 * angle**4 / 3072)
    print("pendulum", len(crossings), period / expected - 1, error, change)
    assert len(crossings) == 5
    assert abs(period / expected - 1) < 1e-4, (period, expected)
    assert error < 1e-4, error
    assert change < 0.02, "the velocity lags the position by half a step: pi dt / period of the energy of the swing"
"""

CHAIN = """
scene = wr.Scene(gravity=(0, 0, -G))
above = pivot(scene)
for k in range(3):
    above = hang(scene, above, (0.0, 0.0, -0.3 * (k + 1)), 0.3, mass=1.0)
sim = wr.Simulator(scene, settings=wr.Settings(dt=DT), device=DEVICE)
sim.step(720)
place = sim.get("position")[0].astype(float)
tension = -distances(sim).impulse.numpy() / DT
print("chain", place[:, 2], tension, np.abs(sim.get("linear_velocity")).max(), sim.get("level")[0])
assert np.abs(np.linalg.norm(np.diff(place, axis=0), axis=1) - 0.3).max() < 1e-4, place
assert np.abs(sim.get("linear_velocity")).max() < 1e-3
assert np.allclose(tension, [3 * G, 2 * G, G], rtol=1e-3), tension
assert sim.get("level")[0].tolist() == [0, 1, 2, 3], "each body hangs from the one above"
assert graph(sim).island.numpy()[1:].tolist() == [1, 1, 1]

# The same chain is let go from the horizontal: all lengths are kept on the way.
scene = wr.Scene(gravity=(0, 0, -G))
above = pivot(scene)
for k in range(3):
    above = hang(scene, above, (0.1 * (k + 1), 0.0, 0.0), 0.1, mass=1.0)
    scene.filter_pair(above, above - 1)
sim = wr.Simulator(scene, settings=wr.Settings(dt=1 / 2000), device=DEVICE)
error = 0.0
for _ in range(100):
    sim.step(40)
    place = sim.get("position")[0].astype(float)
    error = max(error, np.abs(np.linalg.norm(np.diff(place, axis=0), axis=1) - 0.1).max())
print("swinging chain", error)
assert error < 1e-4, error
"""

BOXES = """
scene = wr.Scene(gravity=(0, 0, -G))
scene.add_static(wr.Plane())
half = 0.1
for x, z in ((-0.3, 0.2), (0.3, 0.4), (2.0, 0.2)):
    scene.add_body(wr.Box((half, half, half)), position=(x, 0, z), orientation=(0.05, 0.02, 0, 1), friction=0.5)
length = float(np.hypot(0.6, 0.2))
scene.constraints.append(FixedDistance(1, 2, ORIGIN, ORIGIN, length))
try:
    wr.Simulator(scene, device=DEVICE).save("boxes.ckpt")
    raise SystemExit("a checkpoint leaves the constraints out")
except ValueError as error:
    assert str(error) == "scene.constraints: must be empty to save the scene, got 1", error


def simulate(envs=1, steps=600, **more):
    sim = wr.Simulator(scene, num_envs=envs, device=DEVICE, **more)
    sim.set("linear_velocity", [[[0.0, 0.1 * (env % 3), 0.0]] for env in range(envs)], bodies=[2])
    sim.step(steps)
    return sim


falling = simulate(steps=20)
assert graph(falling).island.numpy()[1:].tolist() == [1, 1, 3], "joined in the air"
sim = simulate()
apart = np.linalg.norm(np.diff(sim.get("position")[0, 1:3].astype(float), axis=0))
print("boxes", apart - length, sim.get("position")[0, 1:, 2], np.abs(sim.get("linear_velocity")).max())
assert abs(apart - length) < 1e-4, apart
assert np.allclose(sim.get("position")[0, 1:, 2], half, atol=2e-4)
assert np.abs(sim.get("linear_velocity")).max() < 1e-3
assert graph(sim).island.numpy()[1:].tolist() == [1, 1, 3]
assert sim.get("level")[0].tolist() == [0, 1, 1, 1]
assert sim.counts()["contacts"] >= 9

for settings in (wr.Settings(), wr.Settings(sleeping=True), wr.Settings(warm_starting=False)):
    alone = simulate(settings=settings)
    end = bits(alone)
    many = simulate(envs=40, settings=settings)
    assert all(bits(many, env) == end for env in range(0, 40, 3)), settings
    assert bits(many, 1) != end
    many.reset([1])
    many.step(600)
    assert bits(many, 1) == end, "a reset of one environment, which starts with the velocity of the scene"
    assert bits(simulate(settings=settings, capacity={"pairs": 1, "contacts": 1})) == end, "growth of the pools"
    alone.reset()
    assert distances(alone).impulse.numpy().tolist() == [0.0]
    alone.step(600)
    assert bits(alone) == end, "after a reset"

sleeping = simulate(settings=wr.Settings(sleeping=True), steps=900)
assert sleeping.get("asleep")[0, 1:].all()
sleeping.set("active", False, bodies=[1])
sleeping.step()
sleeping.step()
print("asleep", sleeping.get("asleep")[0])
assert sleeping.get("asleep")[0].tolist() == [False, False, False, True], "joined bodies wake together"
"""

TUMBLING = """
# Without gravity: points off the centres of mass, so that the impulses turn the bodies.
scene = wr.Scene(gravity=(0, 0, 0))
scene.add_body(wr.Box((0.1, 0.2, 0.3)), linear_velocity=(0.5, 0.2, 0), angular_velocity=(1, 2, 0.5))
scene.add_body(wr.Box((0.2, 0.1, 0.1)), position=(1.2, 0.2, 0.1), angular_velocity=(-2, 0, 1))
anchors = np.array([[0.1, 0.2, -0.3], [-0.2, 0.1, 0.1]])
length = float(np.linalg.norm([1.2 - 0.2 - 0.1, 0.2 + 0.1 - 0.2, 0.1 + 0.1 + 0.3]))
scene.constraints.append(FixedDistance(0, 1, tuple(anchors[0]), tuple(anchors[1]), length))
mass = np.array([body.mass for body in scene.bodies])
sim = wr.Simulator(scene, settings=wr.Settings(dt=DT), device=DEVICE)


def momenta():
    place, v, w = (sim.get(name)[0].astype(float) for name in ("position", "linear_velocity", "angular_velocity"))
    spin = np.einsum("bij,bj->bi", sim.get("inertia")[0].astype(float), w)
    p = mass[:, None] * v
    return p.sum(axis=0), (np.cross(place, p) + spin).sum(axis=0)


def point(body):
    q = sim.get("orientation")[0, body].astype(float)
    turned = anchors[body] + 2 * np.cross(q[:3], np.cross(q[:3], anchors[body]) + q[3] * anchors[body])
    return sim.get("position")[0, body] + turned


linear, angular = momenta()
error, lost = 0.0, 0.0
for _ in range(480):
    sim.step()
    error = max(error, abs(np.linalg.norm(point(0) - point(1)) - length))
    now = momenta()
    lost = max(lost, np.abs(now[0] - linear).max() / np.abs(linear).max(),
               np.abs(now[1] - angular).max() / np.abs(angular).max())
print("tumbling", error, lost, distances(sim).impulse.numpy())
assert error < 1e-4, error
assert lost < 1e-4, lost
"""

KINEMATIC = """
# A box at rest is drawn along by a kinematic body that begins to move, and wakes up by that.
scene = wr.Scene(gravity=(0, 0, -G))
scene.add_static(wr.Plane(), friction=0.3)
scene.add_kinematic(wr.Sphere(0.05), position=(1.0, 0, 0.1))
scene.add_body(wr.Box((0.1, 0.1, 0.1)), position=(0, 0, 0.1), friction=0.3, mass=2.0)
scene.constraints.append(FixedDistance(1, 2, ORIGIN, ORIGIN, 1.0))
sim = wr.Simulator(scene, settings=wr.Settings(dt=DT, sleeping=True), device=DEVICE)
sim.step(300)
assert sim.get("asleep")[0, 2]
sim.set("linear_velocity", (0.5, 0.0, 0.0), bodies=[1])
sim.step(240)
assert not sim.get("asleep")[0, 2]
place = sim.get("position")[0].astype(float)
pull = -distances(sim).impulse.numpy()[0] / DT
print("drawn", place[2], pull)
assert abs(np.linalg.norm(place[1] - place[2]) - 1.0) < 1e-4
assert abs(pull / (0.3 * 2.0 * G) - 1) < 1e-2, "the friction of the box"
"""

REJECTED = """
scene = wr.Scene()
scene.add_body(wr.Sphere(0.1), position=(0, 0, 1))
sim = wr.Simulator(scene, num_envs=2, device=DEVICE)
sim.step(10)
sim.reset()
for constraint, text in (
    ("glue", "scene.constraints: number 0 is of no known kind, got 'glue'"),
    (FixedDistance(0, 1, ORIGIN, ORIGIN, 1.0), "body_b: must be a whole number from 0 to 0, got 1"),
):
    scene.constraints[:] = [constraint]
    try:
        wr.Simulator(scene, device=DEVICE)
        raise SystemExit("it was accepted")
    except ValueError as error:
        assert str(error) == text, error
"""


@pytest.fixture(scope="module")
def changed(tmp_path_factory):
    """A copy of the checkout with the recipe applied, which compiles the kernels once, and the files touched."""
    checkout = tmp_path_factory.mktemp("constraints")
    for folder in COPIED:
        shutil.copytree(ROOT / folder, checkout / folder, symlinks=True, ignore=shutil.ignore_patterns("__pycache__"))
    return checkout, apply("Add a kind of constraint", checkout)


def run(program, checkout, folder, device):
    """Run a program against the copy."""
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", COMMON + program, device],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(checkout), os.environ.get("PYTHONPATH", "")])},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout + done.stderr


def test_a_kind_of_constraint_takes_two_files(changed):
    assert changed[1] == ["kernels/constraints/fixed_distance.py", "kernels/constraints/rows.py"]


def test_a_pendulum_keeps_its_length_period_and_energy(changed, tmp_path, device):
    """Against the period in closed form; with and without warm starting."""
    run(PENDULUM, changed[0], tmp_path, device)


def test_a_chain_hangs_and_swings(changed, tmp_path, device):
    """The tension of each link is the weight below it."""
    run(CHAIN, changed[0], tmp_path, device)


def test_momenta_of_tumbling_bodies_are_kept(changed, tmp_path, device):
    run(TUMBLING, changed[0], tmp_path, device)


def test_joined_boxes_land_and_rest(changed, tmp_path, device):
    """With contacts in the same island; the same bits in a batch, in growing pools and after a reset."""
    run(BOXES, changed[0], tmp_path, device)


def test_a_moving_body_wakes_what_is_joined_to_it(changed, tmp_path, device):
    run(KINEMATIC, changed[0], tmp_path, device)


def test_what_is_no_constraint_of_the_scene_is_rejected(changed, tmp_path, device):
    """Scenes without constraints run."""
    run(REJECTED, changed[0], tmp_path, device)
