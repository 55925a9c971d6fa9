"""Scenes of many bodies are built in a time per body that does not grow with them."""

import time

import numpy as np
import pytest

import warp_rigid as wr
from tests.oracles import ground_scene
from warp_rigid.engine.hints import hints_on
from warp_rigid.engine.layout import layout_of
from warp_rigid.engine.model import build_model, initial_state
from warp_rigid.engine.precision import check_precision

BODIES = 20_000

SCENE_COST, MODEL_COST = 700.0, 260.0
"""Processor time per body, in additions of Python: twice what was measured. NumPy calls for each body take
1800 and 970."""


def processor_seconds(function, repetitions=3):
    """Shortest processor time of some calls."""
    found = []
    for _ in range(repetitions):
        start = time.process_time()
        function()
        found.append(time.process_time() - start)
    return min(found)


def addition():
    """Processor time of an addition in a loop of Python [s], which tells how fast this machine is."""

    def add():
        total = 0
        for k in range(1_000_000):
            total += k

    return processor_seconds(add) / 1e6


def boxes():
    """Boxes of two sizes, far apart, at positions in NumPy arrays."""
    scene = ground_scene()
    shapes = wr.Box((0.1,) * 3), wr.Box((0.1, 0.1, 0.2))
    k = np.arange(BODIES)
    for index, position in enumerate(np.stack([k % 200, k // 200, 0 * k + 1], axis=1) * 0.5):
        scene.add_body(shapes[index % 2], position=position, friction=0.4)
    return scene


def model(scene):
    """What the host computes of a scene; the pools, which are memory alone, are left out."""
    layout = layout_of(scene, 1)
    check_precision(scene)
    hints_on([scene], 0.01)
    build_model(layout, "cpu")
    initial_state(layout, "cpu")


@pytest.mark.quiet
def test_a_large_scene_is_built_quickly():
    unit = addition()
    assert processor_seconds(boxes) / BODIES < SCENE_COST * unit
    scene = boxes()
    model(scene)
    assert processor_seconds(lambda: model(scene)) / BODIES < MODEL_COST * unit
