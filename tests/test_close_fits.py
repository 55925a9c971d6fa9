"""Bodies that fit closely into hollow ones, which they touch on opposite sides."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from warp_rigid.engine.settings import Settings
from warp_rigid.engine.simulator import Simulator
from warp_rigid.scene.scene import Scene
from warp_rigid.scene.shapes import Box, Compound, Plane

INNER, WALL = 0.05, 0.01


def case():
    """A hollow cube of six plates that overlap at their edges."""
    plates = []
    for axis in range(3):
        for side in (-1, 1):
            half = np.full(3, INNER + WALL)
            half[axis] = WALL / 2
            plates.append((Box(half), side * (INNER + WALL / 2) * np.eye(3)[axis], (0, 0, 0, 1)))
    return Compound(plates)


@pytest.mark.parametrize("dt", [1 / 60, 1 / 240])
@pytest.mark.parametrize("play", [0.0005, 0.002])
def test_a_box_stays_in_a_case_that_falls(play, dt, device):
    """Both tumble onto a floor from 0.2 to 1.5 m. The box enters a wall by less than half of its thickness."""
    rng, falls = np.random.default_rng(0), 64
    scene = Scene()
    scene.add_static(Plane())
    scene.add_body(case())
    scene.add_body(Box((INNER - play,) * 3))
    sim = Simulator(scene, num_envs=falls, settings=Settings(dt=dt), device=device)
    for name, start in (
        ("linear_velocity", rng.normal(size=(falls, 1, 3))),
        ("angular_velocity", 3 * rng.normal(size=(falls, 1, 3))),
        ("position", (0, 0, 0.1) + rng.uniform(0.2, 1.5, (falls, 1, 1)) * (0, 0, 1)),
    ):
        values = sim.get(name)
        values[:, 1:] = start
        sim.set(name, values)
    for _ in range(round(1.2 / dt)):
        sim.step()
        position, turn = sim.get("position"), Rotation.from_quat(sim.get("orientation")[:, 1])
        assert np.abs(turn.inv().apply(position[:, 2] - position[:, 1])).max() < play + WALL / 2
