"""The example that compares robots with MuJoCo, for three robots of the table in docs/robots.md."""

import importlib.util
import shutil
from pathlib import Path

import pytest

from warp_rigid.usd.robots import search_path

EXAMPLE = Path(__file__).parents[1] / "examples" / "robots.py"


@pytest.fixture(scope="module")
def example():
    spec = importlib.util.spec_from_file_location("robots", EXAMPLE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    if not module.data_folder().is_dir():
        pytest.skip("example-robot-data is not installed")
    if shutil.which("mujoco_usd_converter", path=search_path()) is None:
        pytest.skip("the converters of robots' files are not installed")
    return module


@pytest.mark.parametrize(
    ("name", "angle", "position"),
    [("Panda, arm and gripper", 6.4e-3, 5.2), ("Go2, quadruped", 2.0e-3, 0.44), ("Bolt, biped", 1.9e-2, 1.3)],
)
def test_a_robot_moves_as_in_mujoco(example, name, angle, position):
    """Within twice the differences of the page, in radians and millimetres; masses to float32."""
    row = example.compare(name, example.data_folder() / example.ROBOTS[name])
    assert row["mass_difference"] < 1e-5 * row["mass"]
    assert row["angle"] < angle and row["position"] < position
    mimics = [reason for reason in row["left_out"] if reason.startswith("mimic joints: ")]
    assert mimics == (["mimic joints: panda_finger_joint2"] if name.startswith("Panda") else [])
