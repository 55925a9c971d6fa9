"""Bodies that slide together: the momentum of the sweeps must not diverge where friction is at its limit."""

import numpy as np
import pytest

import warp_rigid as wr
from warp_rigid.validation.common import G
from warp_rigid.validation.friction import tray_of_boxes

DT = 1.0 / 240.0


@pytest.mark.parametrize("iterations", [40, 200])
def test_more_iterations_do_not_diverge(device, iterations):
    """A tray of 0.1 kg under nine boxes of 1 kg; with 200 iterations they flew apart at 1e5 m/s."""
    sim = wr.Simulator(tray_of_boxes(3, 0.1)(), settings=wr.Settings(dt=DT), device=device)
    sim.set("contact_iterations", iterations)
    start = sim.get("position")[0, 1:, 0]
    sim.step(96)
    way = sim.get("position")[0, 1:, 0] - start
    assert way == pytest.approx(1.0 / G - 0.5 * DT, rel=0.01)


@pytest.mark.parametrize("side, mass", [(5, 0.1), (12, 1.0)])
def test_heavy_boxes_do_not_brake_a_light_tray(device, side, mass):
    """The friction of its contacts exceeded their share of the load; the tray stopped 15 and 6 % too early."""
    sim = wr.Simulator(tray_of_boxes(side, mass)(), settings=wr.Settings(dt=DT), device=device)
    start = sim.get("position")[0, 1:, 0]
    sim.step(60)
    assert sim.get("position")[0, 1:, 0] - start == pytest.approx(1.0 / G - 0.5 * DT, rel=0.01)


@pytest.mark.long
def test_a_residual_that_stays_large_is_reported(device):
    """A tray of 1 kg under 400 boxes is not solved in time, one of 10 kg under 25 boxes is."""
    sims = [
        wr.Simulator(tray_of_boxes(side, mass, speed=5.0)(), settings=wr.Settings(dt=DT), device=device)
        for side, mass in ((20, 1.0), (5, 10.0))
    ]
    for sim in sims:
        sim.step(192)
    assert [set(sim.warnings()["warning"]) for sim in sims] == [{"residual"}, set()]
    assert np.isfinite(sims[0].get("position")).all()


def test_a_residual_that_counts_as_solved_is_not_reported(device):
    """A stack under a gravity of 1e-4 m/s^2, which adds less to a velocity in a step than sweeps leave."""
    scene = wr.Scene(gravity=(0, 0, -1e-4))
    scene.add_static(wr.Plane())
    for k in range(8):
        scene.add_body(wr.Box((0.1,) * 3), position=(0, 0, 0.1 + 0.2 * k))
    sim = wr.Simulator(scene, settings=wr.Settings(dt=DT), device=device)
    sim.step(256)
    assert len(sim.warnings()) == 0
