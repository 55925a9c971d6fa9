"""Bodies in rotating drums with thin walls, which move by more than their thickness in a step of 1/60 s."""

import math

import numpy as np
import pytest

import warp_rigid as wr
from warp_rigid import rotations

PLATES, RADIUS, THICKNESS, HALF = 12, 1.0, 0.01, 0.06
ANGLES = 2 * math.pi / PLATES * np.arange(PLATES)
NORMALS = np.stack([0 * ANGLES, np.cos(ANGLES), np.sin(ANGLES)], axis=-1)
CORNERS = HALF * np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])


def drum():
    """A drum of twelve plates about x, open at both ends."""
    width = RADIUS * math.tan(math.pi / PLATES) + THICKNESS / 2
    plate = wr.Box((0.6, THICKNESS / 2, width))
    turns = [(math.sin(a / 2), 0, 0, math.cos(a / 2)) for a in ANGLES]
    return wr.Compound([(plate, n * (RADIUS + THICKNESS / 2), q) for n, q in zip(NORMALS, turns, strict=True)])


def spin_drum(boxes, spin, device, num_envs, seed):
    """A simulator of boxes in a drum at 60 steps per second; their positions differ by up to 2 cm."""
    scene = wr.Scene()
    scene.add_kinematic(drum(), friction=0.6)
    for place in boxes:
        scene.add_body(wr.Box((HALF,) * 3), position=place, friction=0.6)
    sim = wr.Simulator(scene, num_envs=num_envs, device=device, settings=wr.Settings(dt=1 / 60))
    position, angular = sim.get("position"), sim.get("angular_velocity")
    position[:, 1:] += np.random.default_rng(seed).uniform(-0.02, 0.02, position[:, 1:].shape)
    angular[:, 0] = (spin, 0, 0)
    sim.set("position", position)
    sim.set("angular_velocity", angular)
    return sim


def depths(sim):
    """Depth of each box below the inner faces of the drum, (envs, boxes) [m]; negative inside."""
    position, orientation = sim.get("position"), sim.get("orientation")
    corners = position[:, 1:, None] + rotations.rotate(orientation[:, 1:, None], CORNERS)
    local = rotations.rotate(rotations.inverse(orientation[:, :1, None]), corners)
    return (local @ NORMALS.T - RADIUS).max(axis=(-1, -2))


def test_a_box_that_lands_on_a_rotating_wall_stays_inside(device):
    """It slides and rolls while the wall moves by ten times its thickness in a step."""
    sim = spin_drum([(-0.4, 0.4, -0.125)], 6.0, device, num_envs=8, seed=0)
    deepest = []
    for _ in range(90):
        sim.step(1)
        deepest.append(depths(sim).max())
    assert max(deepest) < 3e-3


@pytest.mark.long
def test_a_wall_carries_a_box_that_others_hit(device):
    """Boxes that fall onto those which a wall lifts do not press them through the wall."""
    layers = [(0.2 * i - 0.4, 0.2 * j - 0.4, 0.25 * k - 0.125) for k in range(2) for j in range(5) for i in range(5)]
    sim = spin_drum(layers, 12.0, device, num_envs=2, seed=2)
    sim.step(60)
    away = np.linalg.norm(sim.get("position")[:, 1:, 1:], axis=-1)
    along = np.abs(sim.get("position")[:, 1:, 0])
    assert np.count_nonzero((away > 1.1) & (along < 0.5)) == 0
