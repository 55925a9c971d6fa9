"""Robots of real files move as in MuJoCo, and again as before when they come back from our files."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest

import warp_rigid as wr
from tests.robot_tools import FILES, moved_by_mujoco, robot_files
from warp_rigid.scene.scene import Motion
from warp_rigid.scenes.builders.jointed import anchor_errors

SECONDS, DT = 0.5, 1e-3
FALL = 0.5 * 9.81 * SECONDS * DT
"""Error of a fall by steps in which the velocity changes before the position [m]."""
SERIES = 0.01
"""Relative error allowed for bodies between joints in series, which take 0.1 % each of a mass."""


@pytest.fixture(scope="module")
def robots():
    return robot_files()


def freely_moving(path, told):
    """A robot without contacts, limits and friction of joints, with the velocities of MuJoCo's bodies."""
    with pytest.warns(UserWarning, match="left out"):
        scene = wr.import_robot(path)
    scene.filtered_pairs.update(combinations(range(len(scene.bodies)), 2))
    for k, entry in enumerate(scene.joints):
        if hasattr(entry.joint, "limits"):
            scene.joints[k] = replace(entry, joint=replace(entry.joint, limits=None, friction=0.0))
    for k, body in enumerate(scene.bodies):
        if body.name in told and body.motion == Motion.DYNAMIC:
            start = told[body.name]
            linear, angular = tuple(start["linear"]), tuple(start["angular"])
            scene.bodies[k] = replace(body, linear_velocity=linear, angular_velocity=angular)
    return scene


def moved(scene):
    """A simulator after the time, and the coordinates of its joints by their names."""
    sim = wr.Simulator(scene, device="cpu", settings=wr.Settings(dt=DT))
    sim.step(round(SECONDS / DT))
    return sim, dict(zip([entry.name for entry in scene.joints], sim.get("joint_position")[0].tolist(), strict=True))


@pytest.mark.long
@pytest.mark.parametrize("name", [name for name in FILES if name != "humanoid.xml"])
def test_a_robot_has_the_masses_and_the_motion_of_mujoco(robots, name, tmp_path):
    oracle = moved_by_mujoco(robots[name], SECONDS)
    told = oracle["bodies"]
    scene = freely_moving(robots[name], told)
    sim = wr.Simulator(scene, device="cpu")
    rows = {body.name: k for k, body in enumerate(scene.bodies) if body.motion == Motion.DYNAMIC}
    assert told.keys() <= rows.keys()
    for label, body in told.items():
        assert sim.get("mass")[0, rows[label]] == pytest.approx(body["mass"], rel=SERIES)
        assert sim.get("center_of_mass")[0, rows[label]] == pytest.approx(body["center"], abs=1e-3)
        assert sim.get("inertia")[0, rows[label]] == pytest.approx(
            np.array(body["inertia"]), abs=SERIES * np.abs(body["inertia"]).max()
        )
    sim, angle = moved(scene)
    span = max(abs(value) for value in oracle["joints"].values())
    for label, value in oracle["joints"].items():
        assert angle[label] == pytest.approx(value, abs=0.01 * span + FALL)
    assert anchor_errors(sim).max() < 1e-5
    film = tmp_path / "robot.usdc"
    wr.export_usd(wr.record(wr.Simulator(scene, device="cpu"), frames=1), film)
    _, again = moved(wr.import_usd(film))
    assert again == pytest.approx(angle, abs=2e-3 * span)


@pytest.mark.long
def test_a_humanoid_has_all_its_hinges(robots):
    """Up to three hinges between two bodies move independently; the masses add up to those of MuJoCo."""
    told = moved_by_mujoco(robots["humanoid.xml"], 0.0)
    with pytest.warns(UserWarning, match="left out"):
        scene = wr.import_robot(robots["humanoid.xml"])
    names = [entry.name for entry in scene.joints]
    assert set(told["joints"]) <= set(names)
    total = sum(body["mass"] for body in told["bodies"].values())
    assert sum(body.mass for body in scene.bodies) == pytest.approx(total, rel=1e-5)
    sim = wr.Simulator(scene, device="cpu")
    sim.step(240)
    angles = dict(zip(names, sim.get("joint_position")[0].tolist(), strict=True))
    assert sim.status()["status"][0] == "ok" and anchor_errors(sim).max() < 1e-4
    assert min(abs(angles[f"right_hip_{axis}"]) for axis in "xyz") > 1e-3, "none is locked by the others"
