"""Heavy bodies that rest on much lighter bodies of mechanisms."""

import numpy as np
import pytest

import warp_rigid as wr
from warp_rigid.scenes import bridge
from warp_rigid.scenes.builders.jointed import ROLLING, add_ragdoll, anchor_errors

G = 9.81


def shelf(ratio):
    """Two boards welded to each other, on a hinge at the wall that is at its limit, with a box on the seam."""
    scene = wr.Scene(gravity=(0, 0, -G))
    board = wr.Box((0.3, 0.2, 0.02))
    inner, outer = (scene.add_body(board, position=(x, 0, 1), mass=1.0) for x in (0.3, 0.9))
    scene.add_joint(wr.RevoluteJoint((0, 1, 0), limits=(-1, 0)), inner, anchor=(0, 0, 1), name="hinge")
    scene.add_joint(wr.FixedJoint(), outer, inner, anchor=(0.6, 0, 1))
    scene.add_body(wr.Box((0.1,) * 3), position=(0.6, 0, 1.12), mass=ratio, name="load")
    return scene


def bridge_with_box(ratio, planks=10):
    """A rope bridge with a box on its middle."""
    scene = wr.Scene(gravity=(0, 0, -G))
    corners, above = bridge._arc(planks), None
    for first, second in zip(corners, corners[1:], strict=False):
        lean = -0.5 * np.arctan2(second[2] - first[2], second[0] - first[0])
        turn = (0, np.sin(lean), 0, np.cos(lean))
        plank = scene.add_body(wr.Box(bridge.PLANK), position=0.5 * (first + second), orientation=turn, mass=1.0)
        bridge._hinge(scene, plank, above, first, 20.0)
        above = plank
    bridge._hinge(scene, above, None, corners[-1], 20.0)
    place = corners[planks // 2] + (0, 0, 0.131)
    scene.add_body(wr.Box((0.25, 0.25, 0.1)), position=place, mass=ratio, name="load")
    return scene


def test_a_bridge_carries_a_box_of_a_thousand_times_the_mass_of_a_plank(device):
    """It swings with the bridge, whose hinges damp it, and comes to rest."""
    sim = wr.Simulator(bridge_with_box(1000.0), device=device)
    start = sim.get("position")[0, -1, 2]
    for limit in (0.016, 0.008, 0.004, 0.0022):
        for _ in range(10):
            sim.step(24)
            assert anchor_errors(sim).max() < 2e-6 and sim.penetration()[0] < 6e-5
            assert np.linalg.norm(sim.get("linear_velocity")[0, -1]) < limit
    assert sim.get("position")[0, -1, 2] == pytest.approx(start, abs=0.005)


@pytest.mark.parametrize("ratio", [10.0, 1000.0])
def test_a_shelf_carries_a_load(device, ratio):
    """The box stays where it is, and the hinge's limit holds the moment of all weights about the hinge."""
    sim = wr.Simulator(shelf(ratio), device=device)
    sim.step(120)
    assert sim.get("position")[0, 2] == pytest.approx((0.6, 0, 1.12), abs=2e-5)
    assert np.abs(sim.get("linear_velocity")[0]).max() < 1e-4
    assert anchor_errors(sim).max() < 1e-6 and sim.penetration()[0] < 4e-5
    force = sim.get("joint_force")[0, 0]
    assert force[2] == pytest.approx((ratio + 2.0) * G, rel=1e-3)
    assert abs(force[4]) == pytest.approx(0.6 * (ratio + 2.0) * G, rel=2e-3)


def test_a_bridge_carries_a_box_of_a_hundred_times_the_mass_of_a_plank(device):
    """It sags, and comes to rest; the anchors at both ends carry all weights."""
    scene = bridge_with_box(100.0)
    sim = wr.Simulator(scene, device=device)
    sim.step(300)
    assert np.linalg.norm(sim.get("linear_velocity")[0], axis=-1).max() < 2e-3
    assert anchor_errors(sim).max() < 1e-6 and sim.penetration()[0] < 1e-4
    force = sim.get("joint_force")[0]
    ends = abs(force[0, 2]) + abs(force[-1, 2])
    assert ends == pytest.approx(110.0 * G, rel=5e-3)


@pytest.mark.long
def test_ragdolls_under_a_heavy_plate_come_to_rest(device):
    """A plate of 100 kg falls on the head of a standing ragdoll, which folds up under it, from eight heights.

    How it folds up depends on rounding. A head or an arm that hangs freely swings until its joints have damped it.
    Without rolling friction, a head on the ground rolls at 1 cm/s for many seconds.
    """
    scene = wr.Scene(gravity=(0, 0, -G))
    rough = {"friction": 0.6, "rolling_friction": ROLLING}
    scene.add_static(wr.Plane(), **rough)
    add_ragdoll(scene, (0, 0, 0.99), "doll", damping=0.25)
    scene.add_body(wr.Box((0.5, 0.5, 0.05)), position=(0, 0, 1.95), mass=100.0, **rough)
    sim = wr.Simulator(scene, 8, device=device)
    place = sim.get("position")
    place[:, -1, 2] += 0.005 * np.arange(8)
    sim.set("position", place)
    for _ in range(165):
        sim.step(8)
        assert anchor_errors(sim).max() < 2e-6 and sim.penetration().max() < 0.012
    assert sim.get("position")[:, -1, 2].min() > 0.1, "the plates lie on the ragdolls"
    fastest = np.linalg.norm(sim.get("linear_velocity"), axis=-1)
    assert np.sum(fastest[:, -1] < 1e-4) >= 7, "the plates rest; one of 64 still sinks, at 3 cm/s"
    assert np.sum(fastest.max(1) < 1e-3) >= 4, "most ragdolls rest, too"
    assert sim.get("kinetic_energy").sum(1).max() < 0.4, "of 1800 J"
    assert np.median(sim.penetration()) < 1e-4


@pytest.mark.parametrize("height", [1.97, 2.1])
def test_a_plate_of_a_thousand_kilograms_on_a_ragdoll_adds_no_energy(device, height):
    """The ragdoll is crushed: limits of its joints are reached while contacts converge slowly.

    An overlap of a few millimetres that is pushed out lifts the plate: that is the only gain, of up to 40 J in a step.
    """
    scene = wr.Scene(gravity=(0, 0, -G))
    scene.add_static(wr.Plane(), friction=0.6)
    add_ragdoll(scene, (0, 0, 0.99), "doll")
    scene.add_body(wr.Box((0.5, 0.5, 0.05)), position=(0, 0, height), mass=1000.0, friction=0.6)
    sim = wr.Simulator(scene, device=device)
    last = np.inf
    for _ in range(300):
        sim.step(1)
        names = ("kinetic_energy", "potential_energy")
        now = sum(sim.get(name)[0].astype(np.float64).sum() for name in names)
        assert now < last + 80.0
        last = now
    assert anchor_errors(sim).max() < 2e-6


@pytest.mark.parametrize("speed", [14.0, 20.0])
def test_ragdolls_that_fall_onto_each_other_at_high_speed_stay_in_one_piece(device, speed):
    """Two ragdolls meet: no energy is gained, and the joints hold, also where bodies stop within a step."""
    scene = wr.Scene(gravity=(0, 0, -G))
    add_ragdoll(scene, (0, 0, 1), "still")
    count = len(scene.bodies)
    add_ragdoll(scene, (0.05, 0.02, 3), "falling")
    sim = wr.Simulator(scene, device=device)
    sim.set("linear_velocity", (0, 0, -speed), bodies=list(range(count, 2 * count)))
    for _ in range(40):
        sim.step(2)
        assert np.linalg.norm(sim.get("linear_velocity")[0], axis=-1).max() < 2.5 * speed
        assert anchor_errors(sim).max() < 2e-6


def energy(sim):
    """Kinetic and potential energy of all bodies, (envs,) [J]."""
    return np.sum([sim.get(kind).sum(axis=1) for kind in ("kinetic_energy", "potential_energy")], axis=0)


def bin_with_joined_boxes(seed, ratio=50.0):
    """48 boxes that fall into a bin: every tenth is `ratio` times as heavy, every eighth hangs on the next one."""
    generator = np.random.default_rng(seed)
    scene, half, boxes, places = wr.Scene(gravity=(0, 0, -G)), 0.55, [], []
    scene.add_static(wr.Plane())
    for side in (-1, 1):
        scene.add_static(wr.Box((0.05, 0.65, 2.0)), position=(side * (half + 0.05), 0, 2))
        scene.add_static(wr.Box((0.65, 0.05, 2.0)), position=(0, side * (half + 0.05), 2))
    for i in range(48):
        place = 0.26 * np.array((i % 4 - 1.5, i // 4 % 4 - 1.5, 0)) + (0, 0, 0.2 + 0.3 * (i // 16))
        turn = generator.normal(size=4)
        density = 1000.0 * (ratio if i % 10 == 3 else 1.0)
        boxes.append(scene.add_body(wr.Box((0.07,) * 3), position=place, orientation=turn, density=density))
        places.append(place)
    for i in range(0, 47, 8):
        scene.add_joint(wr.SphericalJoint(), boxes[i], boxes[i + 1], anchor=0.5 * (places[i] + places[i + 1]))
    return scene


def test_an_uneven_pile_with_joints_gains_no_energy(device):
    """Poses are predicted without the initial impulses of contacts: with them, a frame adds nine times the energy."""
    scenes = [bin_with_joined_boxes(seed) for seed in range(4)]
    sim = wr.Simulator(scenes, settings=wr.Settings(dt=1 / 60), device=device)
    energies = [energy(sim)]
    for _ in range(45):
        sim.step()
        energies.append(energy(sim))
    assert (np.diff(energies, axis=0) / energies[0]).max() < 2e-3
