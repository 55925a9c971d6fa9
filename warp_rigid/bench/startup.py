"""Cost of the first frame of a new process; `python -m warp_rigid.bench.startup stack:8 cpu` prints it as JSON."""

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

KERNELS, GRIDS = "WARP_CACHE_PATH", "WARP_RIGID_CACHE"
"""Environment variables for the folders of compiled kernels and of distance grids."""


def start_up(case: str, device: str) -> dict[str, dict[str, Any]]:
    """Cost of the first frame with empty caches ("cold"), and again with the caches filled by that run ("warm")."""
    with tempfile.TemporaryDirectory() as folder:
        caches = {KERNELS: str(Path(folder) / "kernels"), GRIDS: str(Path(folder) / "grids")}
        return {name: first_frame(case, device, caches) for name in ("cold", "warm")}


def first_frame(case: str, device: str, variables: dict[str, str] | None = None) -> dict[str, Any]:
    """Start a process that simulates one frame.

    Args:
        case: such as "stack:8".
        device: name of a Warp device.
        variables: environment variables, in addition to those of this process.

    Returns:
        "seconds" from the start of the process to the end of the frame, "processor_seconds" of the process and its
        compilers, and "modules", the number of kernel modules that it loaded.

    Raises:
        RuntimeError: The process failed.
    """
    root = Path(__file__).resolve().parents[2]
    places = [str(root), os.environ.get("PYTHONPATH", "")]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(place for place in places if place), **(variables or {})}
    begin = time.perf_counter()
    command = [sys.executable, "-m", "warp_rigid.bench.startup", case, device]
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    seconds = time.perf_counter() - begin
    if done.returncode:
        raise RuntimeError((done.stderr.strip().splitlines() or ["the process of the first frame failed"])[-1])
    return {"seconds": seconds, **json.loads(done.stdout.splitlines()[-1])}


def _main(case: str, device: str) -> None:
    import warp as wp

    wp.config.log_level = wp.LOG_WARNING
    from warp_rigid.bench.cases import find_case
    from warp_rigid.engine.loading import units_of
    from warp_rigid.engine.settings import Settings
    from warp_rigid.engine.simulator import Simulator
    from warp_rigid.engine.teams import sizes_of_teams

    sim = Simulator(find_case(case).build(), settings=Settings(), device=device)
    sim.step(4)
    wp.synchronize_device(sim.device)
    used = wp.get_device(device)
    kernels = [module for name, module in sys.modules.items() if name.startswith("warp_rigid.kernels.")]
    units = {unit for module in kernels for lanes in sizes_of_teams(used) for unit in units_of(module, used, lanes)}
    loaded = [unit for unit in units if wp.get_module(unit).execs]
    print(json.dumps({"processor_seconds": time.process_time(), "modules": len(loaded)}))


if __name__ == "__main__":
    _main(*sys.argv[1:])
