"""Differences between devices in motions that are not chaotic; `python -m benchmarks.cross_device`.

Devices round differently, so chaotic motions, such as those of piles, diverge after some time. The motions of these
scenes are not chaotic: if the largest difference of a position over the run reaches LIMIT, the exit status is 1.

`--results cpu/results.json gpu/results.json` compares the verdicts of two runs of `warp-rigid validate -o`, for devices
in different machines; for devices in one machine, `warp-rigid validate` prints the verdicts that differ.
"""

import argparse
import json
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import warp as wp

import warp_rigid as wr
from warp_rigid.scenes.builders import stacks
from warp_rigid.scenes.builders.grounds import level_scene
from warp_rigid.validation import report
from warp_rigid.warp_start import start_warp

LIMIT = 1e-4
"""Largest difference of a position that passes [m]."""

STEPS_BETWEEN = 15
"""Steps between two comparisons."""


def thrown() -> wr.Scene:
    """Boxes with three different edges, thrown with spin; one spins about its middle axis, which is unstable."""
    scene = level_scene()
    for k, spin in enumerate(((3, -5, 7), (0.01, 8, 0.01), (0, 0, 20))):
        scene.add_body(wr.Box((0.05, 0.1, 0.2)), position=(0, k, 2), linear_velocity=(2, 1, 3), angular_velocity=spin)
    return scene


def sliding() -> wr.Scene:
    """Boxes at different angles about z that slide to rest."""
    scene = level_scene(friction=0.4)
    for k in range(6):
        half = np.radians(5 * k)
        turn = (0, 0, np.sin(half), np.cos(half))
        scene.add_body(stacks.CUBE, position=(0, k, 0.1), orientation=turn, linear_velocity=(1 + 0.2 * k, 0, 0))
    return scene


def stack() -> wr.Scene:
    """Five boxes, each rotated by 0.2 rad relative to the one below."""
    scene = level_scene()
    stacks.add_stack(scene, 5, twist=0.2)
    return scene


def slope() -> wr.Scene:
    """Boxes on a slope of 25 degrees: two slide, one just slips and one just sticks."""
    tilt = np.radians(25)
    scene = level_scene(gravity=(9.81 * np.sin(tilt), 0, -9.81 * np.cos(tilt)))
    for k, friction in enumerate((0.1, 0.3, 0.45, 0.48)):
        scene.add_body(stacks.CUBE, position=(0, k, 0.1), friction=friction)
    return scene


def rolling() -> wr.Scene:
    """Balls and a cylinder that first slide and then roll; some roll to a stop."""
    scene = level_scene(friction=0.3)
    for k, resistance in enumerate((0.0, 0.001, 0.005)):
        scene.add_body(wr.Sphere(0.1), position=(0, k, 0.1), linear_velocity=(2, 0, 0), rolling_friction=resistance)
    on_its_side = (np.sqrt(0.5), 0, 0, np.sqrt(0.5))
    scene.add_body(wr.Cylinder(0.1, 0.1), position=(0, 3, 0.1), orientation=on_its_side, linear_velocity=(2, 0, 0))
    return scene


def bouncing() -> wr.Scene:
    """Thrown balls with different restitution that bounce."""
    scene = level_scene(restitution=1.0)
    for k in range(5):
        scene.add_body(
            wr.Sphere(0.1),
            position=(0, k, 1),
            linear_velocity=(1, 0, 0),
            restitution=0.2 * k,
            angular_velocity=(0, 9, 3),
        )
    return scene


SCENES: dict[str, tuple[Callable[[], wr.Scene], int]] = {
    "thrown boxes, until they land": (thrown, 225),
    "boxes that slide to rest": (sliding, 240),
    "stack of 5 boxes": (stack, 480),
    "boxes on a slope of 25 degrees": (slope, 240),
    "balls and a cylinder that slide, then roll": (rolling, 480),
    "balls that bounce": (bouncing, 480),
}
"""Scenes, and the number of steps in which their motion is not chaotic."""


def difference(name: str, devices: tuple[str, str]) -> tuple[float, float]:
    """Largest differences of a position [m] and of an orientation [rad] between two devices during a scene."""
    build, steps = SCENES[name]
    one, other = (wr.Simulator(build(), device=device) for device in devices)
    apart, turned = 0.0, 0.0
    for _ in range(0, steps, STEPS_BETWEEN):
        one.step(STEPS_BETWEEN)
        other.step(STEPS_BETWEEN)
        apart = max(apart, np.linalg.norm(one.get("position") - other.get("position"), axis=-1).max())
        here, there = one.get("orientation"), other.get("orientation")
        chord = np.minimum(np.linalg.norm(here - there, axis=-1), np.linalg.norm(here + there, axis=-1))
        turned = max(turned, 2.0 * chord.max())
    return float(apart), float(turned)


def compare_verdicts(paths: list[Path]) -> int:
    """Print which verdicts of `results.json` files differ; returns the exit status."""
    checks = [check for path in paths for check in json.loads(path.read_text())["checks"]]
    lines = report.agreement(checks)
    print(*lines or ["nothing to compare: the files contain verdicts of one device only"], sep="\n")
    return int(len(lines) != 1)


def compare_positions(devices: tuple[str, str]) -> int:
    """Print the differences of every scene; returns the exit status."""
    print(f"largest differences between {devices[0]} and {devices[1]}: positions [m], limit {LIMIT:g}; angles [rad]")
    found = {name: difference(name, devices) for name in SCENES}
    for name, (apart, turned) in found.items():
        print(f"{apart:9.2g} {turned:9.2g}  {name}")
    return int(max(apart for apart, _ in found.values()) >= LIMIT)


def main() -> int:
    """Compare and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--devices", nargs=2, default=["cpu", "cuda:0"])
    parser.add_argument("--results", nargs="+", type=Path)
    given = parser.parse_args()
    if given.results:
        return compare_verdicts(given.results)
    start_warp()
    known = [str(device) for device in wp.get_devices()]
    for name in given.devices:
        if name not in known:
            parser.error(f"--devices: must be of {', '.join(known)}, got {name}")
    return compare_positions(tuple(given.devices))


if __name__ == "__main__":
    sys.exit(main())
