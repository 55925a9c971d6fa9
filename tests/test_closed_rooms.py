"""Closed rooms hold what moves in them at large time steps, however bodies hit each other on their way."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from warp_rigid.engine.settings import Settings
from warp_rigid.engine.simulator import Simulator
from warp_rigid.scene.scene import Scene
from warp_rigid.scene.shapes import Box, Capsule, Cylinder, Sphere


def random_room(seed, most):
    """A room with walls of 1 to 50 cm and up to `most` bodies of up to 40 m/s: scene, half widths, thickness."""
    draw = np.random.default_rng(seed)
    half, wall = draw.uniform(0.6, 2.0, 3), np.exp(draw.uniform(np.log(0.01), np.log(0.5)))
    restitution = draw.choice([0, 0.5, 1.0]) if draw.random() < 0.6 else draw.uniform(0, 1)
    material = {"restitution": restitution, "friction": draw.choice([0, 0.3, 0.8])}
    scene = Scene()
    for axis in range(3):
        for sign in (-1, 1):
            extents, place = half + 2 * wall, np.zeros(3)
            extents[axis], place[axis] = wall / 2, sign * (half[axis] + wall / 2)
            scene.add_static(Box(extents), position=place, **material)
    count = int(draw.integers(1, most + 1))
    across = int(np.ceil(count ** (1 / 3)))
    cells = [(i, j, k) for i in range(across) for j in range(across) for k in range(across)]
    draw.shuffle(cells)
    spacing = 2 * half / across
    largest = min(0.25 * min(0.7, (np.prod(half) * 0.96 / count) ** (1 / 3)), 0.3 * spacing.min())
    fastest = draw.uniform(1, 40)
    for cell in cells[:count]:
        size = largest * draw.uniform(0.4, 1)
        extents = tuple(size * draw.uniform(0.2, 0.6, 3))
        kinds = [Box(extents), Sphere(size * 0.6), Capsule(size * 0.3, size * 0.5), Cylinder(size * 0.5, size * 0.4)]
        shape, velocity = kinds[draw.integers(4)], draw.normal(size=3)
        velocity *= fastest * draw.uniform(0.2, 1) / np.linalg.norm(velocity)
        turned = Rotation.random(random_state=int(draw.integers(1 << 30))).as_quat()
        spin = 5 * draw.normal(size=3)
        place = spacing * (np.array(cell) + 0.5) - half
        motion = {"linear_velocity": velocity, "angular_velocity": spin}
        scene.add_body(shape, position=place, orientation=turned, **motion, **material)
    return scene, half, wall


def leaks(seed, most, dt, time=2.0):
    """Whether a body of a room is outside at the end of a step, without a warning of its environment."""
    scene, half, wall = random_room(seed, most)
    sim = Simulator(scene, settings=Settings(dt=dt), device="cpu")
    for _ in range(round(time / dt)):
        sim.step(1)
        if not (np.abs(sim.get("position")[0, 6:]) <= half + wall).all():
            return len(sim.warnings()) == 0
    return False


@pytest.mark.parametrize("seed", [9, 16])
def test_a_body_that_is_hit_on_its_way_stays_in_its_room(seed):
    """Pushes and impacts after the last round took bodies through the walls of these rooms."""
    assert not leaks(seed, 12, 0.1)


@pytest.mark.long
@pytest.mark.parametrize("dt", [1 / 60, 1 / 30, 0.1])
def test_sixty_random_rooms_hold(dt):
    assert [seed for seed in range(20) if leaks(seed, 40, dt)] == []
