"""Round bodies roll over flat floors of triangles and of tiles as on a plane, at any cell size and time step."""

from functools import cache

import numpy as np
import pytest

from tests.oracles import rotate_about
from warp_rigid import rotations
from warp_rigid.engine.settings import Settings
from warp_rigid.engine.simulator import Simulator
from warp_rigid.scene.scene import Scene
from warp_rigid.scene.shapes import Box, Capsule, Cylinder, Heightfield, Mesh, Sphere

RADIUS, SPEED, TIME = 0.05, 1.5, 1.5
SIDE = 2.4
"""Of the floors of triangles [m]: the bodies roll from 1.13 m before the middle to 1.12 m behind it."""
LYING = rotate_about((1, 0, 0), 90)
ROLLERS = {
    "ball": (Sphere(RADIUS), (0, 0, 0, 1)),
    "capsule": (Capsule(RADIUS, 0.1), LYING),
    "cylinder": (Cylinder(RADIUS, RADIUS), LYING),
}


def field(cell):
    count = round(SIDE / cell) + 1
    return [(Heightfield(np.zeros((count, count)), (SIDE, SIDE)), (0, 0, 0))]


@cache
def mesh(cell):
    """A slab with the same triangles on its top."""
    axis = np.linspace(-SIDE / 2, SIDE / 2, round(SIDE / cell) + 1)
    count = len(axis)
    x, y = np.meshgrid(axis, axis, indexing="ij")
    top = np.arange(count * count).reshape(count, count)
    a, b, c, d = (part.ravel() for part in (top[:-1, :-1], top[1:, :-1], top[1:, 1:], top[:-1, 1:]))
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    ring = np.concatenate([top[:-1, 0], top[-1, :-1], top[:0:-1, -1], top[0, :0:-1]])
    after, below = np.roll(ring, -1), count * count
    sides = [np.stack([after, ring, ring + below], 1), np.stack([after, ring + below, after + below], 1)]
    upper = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], 1)
    vertices = np.concatenate([upper, upper - [0, 0, 0.3]])
    return [(Mesh(vertices, np.concatenate([faces, faces[:, ::-1] + below, *sides])), (0, 0, 0))]


def tiles(cell):
    return [(Box((cell / 2, 1.2, 0.05)), (cell * (k + 0.5) - 1.2, 0, -0.05)) for k in range(round(2.4 / cell))]


FLOORS = {"field": field, "mesh": mesh, "tiles": tiles}


def roll(floor, roller, dt, friction, degrees, spin=(0, 0, 0)):
    """A body that rolls for 1.5 s over the parts of a floor: speed along its way, and largest error of its height."""
    scene = Scene()
    for shape, position in floor:
        scene.add_static(shape, position=position, friction=friction)
    way = np.array([np.cos(np.radians(degrees)), np.sin(np.radians(degrees)), 0])
    shape, orientation = ROLLERS[roller]
    body = scene.add_body(
        shape,
        position=-1.13 * way + np.array([0, 0.003, RADIUS]),
        orientation=rotations.multiply(np.array(rotate_about((0, 0, 1), degrees)), np.array(orientation)),
        linear_velocity=SPEED * way,
        angular_velocity=np.cross((0, 0, 1), way) * SPEED / RADIUS + spin,
        friction=friction,
    )
    sim = Simulator(scene, settings=Settings(dt=dt), device="cpu")
    jump = 0.0
    for _ in range(round(TIME / dt)):
        sim.step(1)
        jump = max(jump, abs(sim.get("position")[0, body, 2] - RADIUS))
    return sim.get("linear_velocity")[0, body] @ way, jump


@pytest.mark.parametrize("floor", FLOORS)
@pytest.mark.parametrize("roller", ROLLERS)
def test_a_body_rolls_over_a_flat_floor_as_on_a_plane(roller, floor):
    speed, jump = roll(FLOORS[floor](0.1), roller, 1 / 60, 1.0, 0)
    assert speed == pytest.approx(SPEED, rel=1e-3)
    assert jump < 1e-4


@pytest.mark.parametrize("dt", [1 / 60, 1 / 480])
def test_a_capsule_rolls_over_tiles_much_narrower_than_itself(dt):
    """It was stopped by an impact that was not there, and sank where a contact beyond its end replaced that at it."""
    speed, jump = roll(tiles(0.0125), "capsule", dt, 0.0, 0)
    assert speed == pytest.approx(SPEED, rel=1e-3)
    assert jump < 1e-4


@pytest.mark.long
@pytest.mark.parametrize(("dt", "friction"), [(1 / 60, 1.0), (1 / 480, 0.0)])
@pytest.mark.parametrize("cell", [0.2, 0.0125])
@pytest.mark.parametrize("floor", FLOORS)
@pytest.mark.parametrize("roller", ROLLERS)
def test_bodies_roll_over_wide_and_narrow_cells_and_balls_at_all_angles(roller, floor, cell, dt, friction):
    parts = FLOORS[floor](cell)
    for degrees in (0, 17, 45) if roller == "ball" and floor != "tiles" else (0,):
        speed, jump = roll(parts, roller, dt, friction, degrees)
        assert speed == pytest.approx(SPEED, rel=1e-3), degrees
        assert jump < 1e-4, degrees


@pytest.mark.parametrize("floor", [field, mesh])
def test_a_ball_keeps_its_spin_without_friction(floor):
    """It neither rolls nor stands still: it spins about all axes, and slides."""
    scene = Scene()
    for shape, position in floor(0.0125 if floor is field else 0.05):
        scene.add_static(shape, position=position, friction=0.0)
    spin = np.array([11.0, -60.0, 23.0])
    scene.add_body(
        Sphere(RADIUS), position=(-1, 0.003, RADIUS), linear_velocity=(0.7, 0.3, 0), angular_velocity=spin, friction=0.0
    )
    sim = Simulator(scene, device="cpu")
    sim.step(360)
    np.testing.assert_allclose(sim.get("angular_velocity")[0, 1], spin, rtol=1e-5)
    np.testing.assert_allclose(sim.get("linear_velocity")[0, 1], (0.7, 0.3, 0), atol=1e-4)


@pytest.mark.parametrize("half_height", [0.01, 0.1])
@pytest.mark.parametrize("degrees", [5, 20, 40])
def test_a_cylinder_rolls_down_a_slope_without_loss(degrees, half_height):
    """Its lowest points were displaced toward the load, which braked it by 2 % of the acceleration of gravity."""
    slope = np.radians(degrees)
    scene = Scene(gravity=(9.81 * np.sin(slope), 0, -9.81 * np.cos(slope)))
    scene.add_static(Box((10, 1, 0.1)), position=(8, 0, -0.1), friction=2.0)
    body = scene.add_body(Cylinder(0.1, half_height), position=(0, 0, 0.1), orientation=LYING, friction=2.0)
    sim = Simulator(scene, device="cpu")
    sim.step(240)
    assert sim.get("linear_velocity")[0, body, 0] == pytest.approx(9.81 * np.sin(slope) / 1.5, rel=1e-3)
