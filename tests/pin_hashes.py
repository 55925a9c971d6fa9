"""Pinned ends of ten scenes on the CPU; `python -m tests.pin_hashes` computes them anew and writes them.

A hash that changes means that results change. That is fine where it is meant: renew the hashes with this command, and
say in the change log what changed. Warp's compiler for the CPU never joins a product and a sum into one rounding, so
that the bits do not depend on the instruction set: the command runs everything a second time for the oldest x86-64
processor, and writes nothing if that ends differently.
"""

import hashlib
import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np

import warp_rigid as wr
from tests.oracles import ground_scene, random_pile, rotate_about

FILE = Path(__file__).with_name("pinned_hashes.json")
STEPS = 100
PLAIN = {
    "NPY_DISABLE_CPU_FEATURES": "X86_V3 X86_V4 AVX512_ICL AVX512_SPR",
    "OPENBLAS_CORETYPE": "Prescott",
    "PYTHONWARNINGS": "ignore",
}
"""Meshes and masses come from NumPy, whose sines and products round differently on processors with AVX-512."""
STATE = ("position", "orientation", "linear_velocity", "angular_velocity")


def hail() -> wr.Scene:
    """So many boxes that they meet through the hash grid."""
    scene = ground_scene(friction=0.5)
    for k in range(300):
        place = (0.24 * (k % 7), 0.24 * (k // 7 % 7), 0.15 + 0.24 * (k // 49))
        scene.add_body(wr.Box((0.1, 0.1, 0.1)), position=place, orientation=rotate_about((1, 2, 3), 7 * k))
    return scene


def rollers() -> wr.Scene:
    """Round bodies with every kind of friction on a turning table and a hilly ground."""
    scene = wr.Scene(friction_combine="average", restitution_combine="max")
    hills = 0.05 * np.sin(np.arange(64.0).reshape(8, 8))
    scene.add_static(wr.Heightfield(hills, (4.0, 4.0)), friction=0.8)
    scene.add_kinematic(wr.Cylinder(0.5, 0.05), position=(0, 0, 0.2), angular_velocity=(0, 0, 2))
    for k, shape in enumerate((wr.Sphere(0.1), wr.Capsule(0.08, 0.1), wr.Cylinder(0.1, 0.1)) * 3):
        scene.add_body(
            shape,
            position=(0.3 * (k % 3) - 0.3, 0.3 * (k // 3) - 0.3, 0.5 + 0.1 * k),
            orientation=rotate_about((1, 0, 1), 40 * k),
            angular_velocity=(k, 0, 3),
            restitution=0.1 * k,
            rolling_friction=0.01,
            spinning_friction=0.02,
        )
    scene.add_force_field(wr.PointField((0, 0, -2), 3.0))
    return scene


SCENES: dict[str, Callable[[], wr.Scene]] = {
    **{
        name: lambda name=name: wr.scenes.load(name)
        for name in (
            "box_stack",
            "leaning_tower",
            "incline",
            "plank_launch",
            "seesaw",
            "skull_and_brain",
            "bunny_pile",
        )
    },
    "random_pile": lambda: random_pile(np.random.default_rng(0)),
    "hail": hail,
    "rollers": rollers,
}


def end_of(name: str) -> str:
    """Hash of the state and the contacts of a scene after STEPS steps, bodies closer to each other at first."""
    sim = wr.Simulator(SCENES[name](), device="cpu")
    movers = [index for index, body in enumerate(sim.scene.bodies) if body.motion == wr.Motion.DYNAMIC]
    inward = sim.get("position")[:, movers] * [-0.2, -0.2, -0.5]
    sim.set("linear_velocity", sim.get("linear_velocity")[:, movers] + inward, bodies=movers)
    sim.step(STEPS)
    digest = hashlib.sha256(b"".join(sim.get(key).tobytes() for key in STATE))
    digest.update(sim.contacts().tobytes())
    return digest.hexdigest()


def ends(*flags: str) -> dict[str, str]:
    """Ends of all scenes, from a process in which NumPy uses nothing that only some processors have."""
    command = [sys.executable, "-m", "tests.pin_hashes", "--print", *flags]
    done = subprocess.run(command, cwd=FILE.parents[1], env=os.environ | PLAIN, capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(done.stderr)
    return json.loads(done.stdout.splitlines()[-1])


def main() -> None:
    """Write the hashes, if a build for the oldest processor gives the same."""
    import warp as wp

    wp.config.log_level = wp.LOG_WARNING
    if "--oldest" in sys.argv:
        wp.config.cpu_compiler_flags = ""
    if "--print" in sys.argv:
        print(json.dumps({name: end_of(name) for name in SCENES}))
        return
    here, oldest = ends(), ends("--oldest")
    different = [name for name in SCENES if here[name] != oldest[name]]
    if different:
        sys.exit(f"not written: the instruction set decides the end of {', '.join(different)}")
    before = json.loads(FILE.read_text())
    FILE.write_text(json.dumps(here, indent=2) + "\n")
    print(f"changed: {', '.join(name for name in SCENES if before.get(name) != here[name]) or 'nothing'}")


if __name__ == "__main__":
    main()
