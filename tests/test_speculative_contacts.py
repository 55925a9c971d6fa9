"""Contacts of bodies that another body may push together within the step, and which samples represent them."""

import numpy as np
import pytest

from tests.oracles import contact_list, find_contacts, ground_scene, opened
from warp_rigid import Box, Scene, Settings, Simulator, Sphere
from warp_rigid.bench.cases import find_case

DT = 1 / 240


@pytest.mark.parametrize("shape", [Sphere(0.1), Box((0.1, 0.1, 0.1))], ids=["spheres", "boxes"])
def test_what_falls_together_does_not_overlap_when_the_lowest_body_is_stopped(device, shape):
    """No body approaches the next one before the step. Without speculative contacts they overlap by 4 mm."""
    scene = ground_scene()
    for k in range(4):
        scene.add_body(shape, position=(0, 0, 0.104 + 0.202 * k), linear_velocity=(0, 0, -2))
    sim = Simulator(scene, settings=Settings(dt=DT), device=device)
    deepest = 0.0
    for _ in range(24):
        sim.step()
        deepest = max(deepest, sim.penetration()[0])
    assert deepest < 1e-4


def test_what_flies_past_a_sleeping_body_does_not_wake_it(device):
    """It passes at 10 to 20 mm, and moves by 62 mm in a step."""
    scene = ground_scene()
    sleeper = scene.add_body(Box((0.1, 0.1, 0.1)), position=(0, 0, 0.1))
    passing = scene.add_body(Sphere(0.05), position=(5.0, 0, 0.255))
    sim = Simulator(scene, settings=Settings(dt=DT, sleeping=True), device=device)
    sim.step(240)
    assert sim.get("asleep")[0, sleeper]
    sim.set("position", (-0.6, 0, 0.26), bodies=[passing])
    sim.set("linear_velocity", (15.0, 0, 0.5), bodies=[passing])
    sim.step(20)
    assert sim.get("position")[0, passing, 0] > 0.2 and sim.get("asleep")[0, sleeper]


def test_the_sample_that_will_be_deepest_is_a_contact(device):
    """Of a torus that falls onto another one at an angle: 16 mm in the step, from a gap of 6 mm."""
    case = find_case("pile_torus:16")
    (torus,) = {body.shape for body in case.build().bodies if type(body.shape).__name__ == "Mesh"}
    scene = Scene(gravity=(0, 0, 0))
    scene.add_static(torus)
    turn = np.array([0.35, 0.2, 0.1, 0.0])
    turn[3] = np.sqrt(1.0 - turn @ turn)
    above = scene.add_body(torus, position=(0.05, 0, 0.5), orientation=turn, linear_velocity=(0, 0, -4.0))
    sim, stages = opened(scene, device, settings=Settings(dt=DT))
    height = 0.5 - lowest_gap(sim, above) + 0.006
    sim.set("position", (0.05, 0, height), bodies=[above])
    find_contacts(stages)
    assert contact_list(stages)["gap"].min() < 0.0065


def lowest_gap(sim, body):
    """How far a body can move down until it touches [m], by bisection."""
    position = sim.get("position")[0, body].copy()
    low, high = 0.0, 0.5
    for _ in range(30):
        way = 0.5 * (low + high)
        sim.set("position", position - (0, 0, way), bodies=[body])
        low, high = (low, way) if sim.penetration()[0] > 0.0 else (way, high)
    return low


@pytest.mark.parametrize("case", ["pile_torus:16", pytest.param("pile_bunny:16", marks=pytest.mark.long)])
def test_nonconvex_bodies_that_land_hardly_overlap(device, case):
    """Mean of the deepest overlaps of eight piles in 1.2 s at four steps per frame: 0.4 to 0.7 mm.

    Without speculative contacts, 2.6 mm in tori and 1.6 mm in bunnies.
    """
    case = find_case(case)
    sim = Simulator(case.build(), num_envs=8, settings=Settings(dt=DT), device=device)
    case.scatter(sim)
    deepest = np.zeros(8)
    for _ in range(72):
        sim.step(4)
        deepest = np.maximum(deepest, sim.penetration())
    assert deepest.mean() < 1.2e-3
