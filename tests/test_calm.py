"""Further sweeps: arches stand, and towers that topple gain no energy."""

import numpy as np
import pytest
import trimesh

from tests.oracles import ground_scene
from warp_rigid.engine.settings import Settings
from warp_rigid.engine.simulator import Simulator
from warp_rigid.kernels.tuning import CALM_CONVERGED, MOST_IN_MOTION
from warp_rigid.kernels.update.predict import LARGEST_UNIT
from warp_rigid.scene.shapes import Box, Cylinder, Mesh
from warp_rigid.scenes.builders import stacks
from warp_rigid.scenes.builders.bodies import add_bodies
from warp_rigid.validation import towers

RADIUS = 5.0


def arch(device, stones, ratio, rate, **settings):
    """A simulator with a semicircular arch, and the index of its middle stone."""
    scene = ground_scene(friction=0.8)
    add_bodies(scene, *stacks.arch(stones, RADIUS, ratio * RADIUS), friction=0.8)
    return Simulator(scene, settings=Settings(dt=1.0 / rate, **settings), device=device), 1 + stones // 2


@pytest.mark.parametrize(("stones", "ratio"), [(15, 0.1115), (27, 0.112)])
@pytest.mark.parametrize("rate", [60, 240])
def test_arches_stand_from_five_percent_above_their_least_thickness(device, stones, ratio, rate):
    """Linear programming gives 0.1061 radii for 15 stones and 0.1067 for 27."""
    sim, middle = arch(device, stones, ratio, rate)
    start = sim.get("position")[0, middle, 2]
    moved = []
    for _ in range(10):
        sim.step(rate // 10)
        moved.append(abs(sim.get("position")[0, middle, 2] - start))
    assert max(moved) < 5e-5
    assert sim.stats()["residual"][0] <= CALM_CONVERGED * LARGEST_UNIT


def pointed_arch(radius=5.0, thickness=1.0, depth=1.0, side=8):
    """Stones of a pointed arch of two arcs of 60 degrees, each about the foot of the other: meshes and places."""
    top = [np.arccos(0.5 * radius / (radius + s * 0.5 * thickness)) for s in (-1, 1)]
    for sign in (1, -1):
        for k in range(side):
            corners = []
            for joint in (k, k + 1):
                for s, highest in zip((-0.5, 0.5), top, strict=True):
                    angle = highest if joint == side else joint * np.pi / 3 / side
                    x, z = (radius + s * thickness) * np.array([np.cos(angle), np.sin(angle)]) - [0.5 * radius, 0]
                    corners += [(sign * x, y, z) for y in (-0.5 * depth, 0.5 * depth)]
            stone = trimesh.convex.convex_hull(corners)
            center = stone.center_mass
            stone.apply_translation(-center)
            yield Mesh.from_trimesh(stone), center


def test_a_pointed_arch_stands(device):
    """Its feet are squares on the ground, which the largest ball in the stone touches, too: all corners carry."""
    scene = ground_scene(friction=0.8)
    for stone, center in pointed_arch():
        scene.add_body(stone, position=center, friction=0.8)
    sim = Simulator(scene, settings=Settings(dt=1.0 / 60), device=device)
    start = sim.get("position")[0]
    sim.step(1)
    feet = [(sim.contacts()["body_a"] == b) | (sim.contacts()["body_b"] == b) for b in (1, 9)]
    assert [np.count_nonzero(rows & (sim.contacts()["position"][:, 2] < 0.1)) for rows in feet] == [4, 4]
    sim.step(59)
    assert np.linalg.norm(sim.get("position")[0] - start, axis=1).max() < 2e-5


def test_a_thinner_arch_falls(device):
    sim, middle = arch(device, 15, 0.1005, 60)
    sim.step(120)
    assert sim.get("position")[0, middle, 2] < 0.75 * RADIUS


def test_an_island_in_motion_is_swept_further_only_far_from_its_solution(device):
    sim, _ = arch(device, 15, 0.125, 60)
    sim.step(1)
    assert sim.stats()["sweeps"][0] > 50
    moving, _ = arch(device, 15, 0.125, 60)
    moving.set("linear_velocity", (0.0, 0.5, 0.0), bodies=list(range(1, 16)))
    iterations = moving.settings.contact_iterations
    moving.step(1)  # from no impulses: far from its solution
    assert moving.stats()["sweeps"][0] > 2 * MOST_IN_MOTION * iterations
    moving.step(5)
    assert iterations < moving.stats()["sweeps"][0] <= (1 + MOST_IN_MOTION) * iterations + 1


def test_a_single_body_in_motion_is_not_swept_further(device):
    scene = ground_scene(friction=0.5)
    scene.add_body(Box((0.1, 0.1, 0.1)), position=(0, 0, 0.1), linear_velocity=(2, 0, 0))
    sim = Simulator(scene, device=device)
    sim.step(10)
    assert sim.stats()["sweeps"][0] <= sim.settings.contact_iterations


def test_impulses_add_no_energy_to_towers_that_topple(device):
    """Relative to the potential energy; unless impulses are scaled to the minimum of the energy, one gains 2e-7."""
    offsets = np.random.default_rng(3).uniform(0.145, 0.155, 61)
    trace = towers.leaning(offsets.tolist(), ["default"] * len(offsets), 1.0).run(str(device))
    assert (trace.linear_velocity[-1].max(axis=(1, 2)) > 0.1).all()
    assert towers.gained(lambda t: t.work_free_energy)(trace).max() < 5e-8


def test_a_calm_island_is_swept_further_beside_a_moving_one(device):
    """The arch stands while boxes beside it tumble; the residual is that of the boxes."""
    scene = ground_scene(friction=0.8)
    stones = add_bodies(scene, *stacks.arch(15, RADIUS, 0.125 * RADIUS), friction=0.8)
    for k in range(6):
        scene.add_body(Box((0.2, 0.3, 0.1)), position=(0, 3 + 0.5 * k, 0.5), orientation=(0.1 * k, 0.2, 0.3, 1))
    sim = Simulator(scene, settings=Settings(dt=1.0 / 60), device=device)
    start = sim.get("position")[0, stones]
    sim.step(60)
    assert np.abs(sim.get("position")[0, stones] - start).max() < 1e-4


@pytest.mark.parametrize("iterations", [5, 10, 20, 40])
@pytest.mark.parametrize("rate", [60, 240])
def test_a_tall_cylinder_that_slid_to_a_stop_rests(device, iterations, rate):
    """Ten times as high as wide; the rest does not depend on the number of iterations.

    The median of 16 initial speeds: when the last rocking ends depends on rounding.
    """
    scene = ground_scene(friction=0.05)
    scene.add_body(Cylinder(0.05, 0.5), position=(0, 0, 0.5), friction=0.05)
    sim = Simulator(scene, 16, Settings(dt=1.0 / rate, contact_iterations=iterations), device=device)
    velocity = sim.get("linear_velocity")
    velocity[:, 1, 0] = np.linspace(0.28, 0.31, 16)
    sim.set("linear_velocity", velocity)
    sim.step(4 * rate)
    assert (sim.get("position")[:, 1, 0] > 0.05).all()
    rate_of_turn = np.abs(sim.get("angular_velocity")).max(axis=(1, 2))
    assert np.median(rate_of_turn) < 1e-4
    assert rate_of_turn.max() < 0.05
