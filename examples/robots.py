"""Five robots of the package example-robot-data, released from their zero pose without motors, here and in MuJoCo.

    python examples/robots.py [FOLDER]

FOLDER is the folder `robots` of the package, by default that of this Python environment. The first link is fixed, and
gravity is inclined by 30 degrees. Contacts, limits and friction of joints are off on both sides, damping is the file's.
"""

import json
import os
import shutil
import subprocess
import sys
import sysconfig
import warnings
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np

import warp_rigid as wr

ROBOTS = {
    "Panda, arm and gripper": "panda_description/urdf/panda.urdf",
    "Go2, quadruped": "go2_description/urdf/go2.urdf",
    "Talos, humanoid": "talos_data/robots/talos_reduced.urdf",
    "UR5, arm with gripper": "ur_description/urdf/ur5_gripper.urdf",
    "Bolt, biped": "bolt_description/robots/bolt.urdf",
}
HUNG = ("Panda, arm and gripper",)
"""Hangs from a ceiling: from upright, its differences are larger (0.07 rad, without inclined gravity)."""
SECONDS, DT = 1.0, 5e-4
HEADER = "robot | joints | mass [kg] | difference of mass [kg] | of angle [rad] | of last link [mm] | growth | left out"


def data_folder():
    """The folder of the robots: of ROBOT_DATA, or of the package in this environment."""
    installed = Path(sysconfig.get_path("purelib")) / "cmeel.prefix/share/example-robot-data/robots"
    return Path(os.environ.get("ROBOT_DATA", installed))


def moved_by_mujoco(path, gravity):
    """What `robots_mujoco.py` prints."""
    search = os.pathsep.join([os.path.dirname(sys.executable), os.environ.get("PATH", "")])
    python = Path(shutil.which("mujoco_usd_converter", path=search)).resolve().parent / "python"
    program = Path(__file__).with_name("robots_mujoco.py")
    command = [str(python), "-I", str(program), str(path), str(SECONDS), *map(str, gravity)]
    return json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines()[-1])


def released(path, gravity):
    """The robot with its first link fixed, without contacts, limits and friction of joints."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        scene = wr.import_robot(path, sdf_resolution=8)
    scene.filtered_pairs.update(combinations(range(len(scene.bodies)), 2))
    for k, entry in enumerate(scene.joints):
        if hasattr(entry.joint, "limits"):
            scene.joints[k] = replace(entry, joint=replace(entry.joint, limits=None, friction=0.0))
    scene.gravity = gravity
    return scene


def turn(angle):
    """An angle between -pi and pi."""
    return (angle + np.pi) % (2.0 * np.pi) - np.pi


def compare(name, path):
    """One row of the table, as numbers."""
    gravity = (4.905, 0.0, 8.496 if name in HUNG else -8.496)
    scene, oracle = released(path, gravity), moved_by_mujoco(path, gravity)
    sim = wr.Simulator(scene, device="cpu", settings=wr.Settings(dt=DT))
    rows = {body.name: k for k, body in enumerate(scene.bodies)}
    sim.step(round(SECONDS / DT))
    angles = dict(zip([entry.name for entry in scene.joints], sim.get("joint_position")[0], strict=True))
    mass, told = sim.get("mass")[0], oracle["masses"]
    ours = sum(mass[rows[label]] for label in told if label in rows)
    angle = max(abs(turn(angles[joint] - value)) for joint, value in oracle["angles"].items())
    away = sim.get("center_of_mass")[0, rows[oracle["last"]]] - oracle["centers"][oracle["last"]]
    left_out = [finding.reason.partition(" for geometry")[0] for finding in scene.import_report.left_out]
    return {
        "robot": name,
        "joints": len(oracle["angles"]),
        "mass": sum(told.values()),
        "mass_difference": float(abs(ours - sum(told.values()))),
        "angle": float(angle),
        "position": 1e3 * float(np.linalg.norm(away)),
        "growth": oracle["growth"],
        "left_out": sorted(set(left_out)),
    }


def main():
    """Print the table."""
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else data_folder()
    print(f"| {HEADER} |\n" + "|---" * len(HEADER.split("|")) + "|")
    for name, file in ROBOTS.items():
        row = compare(name, folder / file)
        figures = [f"{row[key]:.2g}" for key in ("mass_difference", "angle", "position", "growth")]
        cells = [name, str(row["joints"]), f"{row['mass']:.2f}", *figures, "; ".join(row["left_out"]) or "nothing"]
        print("| " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
