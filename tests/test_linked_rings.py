"""A chain of linked rings that hangs from a fixed one carries a load much heavier than its links."""

import numpy as np
import pytest

import warp_rigid as wr
from warp_rigid.scenes.builders import meshes

RADIUS, TUBE = 0.1, 0.02
"""Radii of a ring and of its tube [m]."""


@pytest.mark.parametrize("load", [1.2, 1000.0])
def test_linked_rings_carry_a_load(device, load):
    """Six rings of 1.2 kg that touch at the start, the last one with the load: none moves by 0.1 mm in 2 s."""
    scene = wr.Scene()
    ring = meshes.torus(RADIUS, TUBE)
    upright, across = (0.5**0.5, 0, 0, 0.5**0.5), (0.5, 0.5, 0.5, 0.5)
    scene.add_static(ring, orientation=upright)
    for k in range(1, 6):
        place = (0, 0, -2 * k * (RADIUS - TUBE))
        scene.add_body(ring, position=place, orientation=across if k % 2 else upright, mass=load if k == 5 else 1.2)
    sim = wr.Simulator(scene, device=device)
    start = sim.get("position")
    for _ in range(24):
        sim.step(20)
        assert np.abs(sim.get("position") - start).max() < 1e-4
    assert sim.penetration()[0] < 1e-5
