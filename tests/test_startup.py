"""What starting costs: processor time, which other programs on the machine stretch by little."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import warp as wp

from warp_rigid import Simulator, scenes
from warp_rigid.bench.startup import KERNELS, first_frame, start_up
from warp_rigid.engine import world
from warp_rigid.engine.loading import JOINTS, STEP, units_of

ROOT = Path(__file__).resolve().parents[1]

WARM_IMPORTS = 5.0
"""A warm start may cost as much processor time as so many processes that only import Warp, each 0.4 s on an idle
machine: 3.8 to 4.3 of them now. Most of it is reading kernels.
"""

COLD_KERNELS = 15.0
"""A cold start may cost as much processor time as so many processes that compile one small kernel, each 2.4 s on an
idle machine: 8.7 to 9.5 of them now, and up to 12.7 where other programs share the cores. The number of modules tells
whether kernels are compiled that are not needed.
"""

IMPORT = """
import time
import warp as wp
wp.init()
print(time.process_time())
"""

ONE_KERNEL = """
import time
import warp as wp
from warp_rigid.kernels.common import (capacity)
wp.force_load("cpu", [wp.get_module(capacity.__name__)])
print(time.process_time())
"""

ON_DEMAND = """
import json, sys
from tests.oracles import ground_scene
from warp_rigid import Box, Simulator
from warp_rigid.kernels.collide import (overlap)
from warp_rigid.kernels.update import (sleep)

def loaded():
    return [bool(kernel.module.execs) for kernel in (overlap.deepest_overlap, sleep.put_islands_to_sleep)]

scene = ground_scene()
scene.add_body(Box((0.1, 0.1, 0.1)), position=(0, 0, 0.0999))
sim = Simulator(scene, device=sys.argv[1])
sim.step(1)
told = [loaded()]
sim.set("sleeping", True)
sim.step(240)
told.append(loaded())
told.append([float(sim.penetration()[0]), bool(sim.get("asleep")[0, 1])])
print(json.dumps([*told, loaded()]))
"""


SILENT = {
    "simulator": "wr.record(wr.Simulator(wr.scenes.load('incline'), device='cpu'), frames=2)",
    "mesh": "wr.Mesh([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)], [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)])"
    ".signed_distance([(0.0, 0.0, 0.0)])",
    "sweep": "wr.sweep('incline', {'friction': [0.2, 0.3]}, duration=0.1, device='all')",
    "workers": "wr.sweep('incline', {'friction': [0.2, 0.3]}, duration=0.1, cluster='local', workers=1)",
    "films": "recording = wr.record(wr.Simulator(wr.scenes.load('incline'), device='cpu'), frames=1)\n"
    "recording.to_gif('a.gif', width=32)\nrecording.to_html()\nrecording._repr_html_()",
    "scene": "wr.scenes.load('incline')._repr_html_()",
}
"""Programs by what starts Warp in them."""


def processor_seconds(program, variables=None):
    """What a process costs [s], which prints it."""
    command = [sys.executable, "-W", "ignore", "-c", program]
    environment = {**os.environ, **(variables or {})}
    done = subprocess.run(command, capture_output=True, text=True, check=True, env=environment)
    return float(done.stdout.splitlines()[-1])


@pytest.mark.quiet
def test_a_warm_start_is_quick(device):
    first_frame("stack:8", device)
    costs = [first_frame("stack:8", device) for _ in range(3)]
    one = min(processor_seconds(IMPORT) for _ in range(3))
    assert min(cost["processor_seconds"] for cost in costs) < WARM_IMPORTS * one
    used = wp.get_device(device)
    assert {cost["modules"] for cost in costs} == {len({name for module in STEP for name in units_of(module, used)})}


@pytest.mark.long
@pytest.mark.quiet
def test_a_cold_start_keeps_its_budget(tmp_path):
    one = processor_seconds(ONE_KERNEL, {KERNELS: str(tmp_path)})
    cost = start_up("stack:8", "cpu")
    assert cost["cold"]["modules"] == len(STEP)
    assert cost["warm"]["processor_seconds"] < cost["cold"]["processor_seconds"] < COLD_KERNELS * one


@pytest.mark.long
def test_kernels_that_are_needed_rarely_are_loaded_when_they_are_needed(device):
    """In a process of its own: others may have loaded them already."""
    command = [sys.executable, "-W", "ignore", "-c", ON_DEMAND, str(device)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    at_first, with_sleep, (depth, asleep), at_last = json.loads(done.stdout.splitlines()[-1])
    assert at_first == [False, False] and with_sleep == [False, True] and at_last == [True, True]
    assert 0.0 <= depth < 2e-4 and asleep


def test_kernels_of_joints_are_compiled_beside_the_others(monkeypatch):
    """They take longest, so they come first. In a second call they would wait for all others."""
    calls = []
    monkeypatch.setattr(world, "load_kernels", lambda device, modules, lanes: calls.append(list(modules)))
    Simulator(scenes.load("chain"), device="cpu")
    assert [call[0].__name__ for call in calls] == [JOINTS]
    assert set(STEP) < set(calls[0])


EACH = """
import json, os, sys
import warp_rigid as wr
for name, program in json.loads(sys.argv[1]).items():
    if os.fork() == 0:
        for stream in (1, 2):
            os.dup2(os.open(f"{name}.{stream}", os.O_CREAT | os.O_WRONLY), stream)
        exec(program)
        print("said")
        break
    if os.wait()[1]:
        sys.exit(f"{name} failed")
"""


def test_a_program_prints_only_what_it_says(tmp_path):
    """No line about a missing GPU, and no bar where stderr is a file: each entrance starts Warp in its own process."""
    command = [sys.executable, "-c", EACH, json.dumps(SILENT)]
    done = subprocess.run(command, cwd=tmp_path, env={**os.environ, "PYTHONPATH": str(ROOT)}, capture_output=True)
    printed = {name: [(tmp_path / f"{name}.{stream}").read_text() for stream in (1, 2)] for name in SILENT}
    assert (done.returncode, done.stdout, done.stderr) == (0, b"", b"")
    assert printed == dict.fromkeys(SILENT, ["said\n", ""])
