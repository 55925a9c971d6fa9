"""What this machine offers a simulation, what fails on it, and what to do about it."""

import importlib.metadata
import importlib.util
import json
import os
import platform
import shutil
import subprocess
import sys
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import warp as wp

from warp_rigid.engine import memory
from warp_rigid.scene.shapes import distance_grid
from warp_rigid.version import __version__

LIBRARIES = {
    "warp-lang": "warp-rigid", "numpy": "warp-rigid", "trimesh": "warp-rigid", "usd-core": "warp-rigid",
    "typer": "warp-rigid", "rich": "warp-rigid", "matplotlib": "warp-rigid[picture]", "pillow": "warp-rigid[picture]",
    "imageio-ffmpeg": "warp-rigid[picture]", "viser": "warp-rigid[viewer]",
}  # fmt: skip
"""What is used, and what to install for it."""

COMPILE_SECONDS, TEST_SECONDS = 300, 30
"""How long the first compilation and the self-test may take before they count as hanging [s]."""
ENOUGH_DISK = 500_000_000
"""Kernels and grids of a few scenes [bytes]."""


@dataclass(frozen=True)
class Check:
    """One thing that was looked at.

    Attributes:
        name: what.
        passed: whether it is as it should be.
        found: what was found.
        advice: what to do; empty if it passed and there is nothing to add.
    """

    name: str
    passed: bool
    found: str
    advice: str = ""


def examine(devices: list[str] | None = None) -> dict[str, Any]:
    """Look at versions, devices, caches and memory, and test each device in a process of its own.

    Args:
        devices: names of Warp devices; None takes all.

    Returns:
        Plain data: "versions", "devices", "caches", "checks" and "ok".
    """
    names = [str(device) for device in wp.get_devices()] if devices is None else devices
    checks = [*_libraries(), _cuda(), *_caches(), *(_device(name) for name in names)]
    return {
        "versions": versions(),
        "devices": [_describe(wp.get_device(name)) for name in names],
        "caches": {"kernels": str(wp.config.kernel_cache_dir), "distance grids": str(distance_grid.cache_folder())},
        "checks": [asdict(check) for check in checks],
        "ok": all(check.passed for check in checks),
    }


def versions() -> dict[str, str]:
    """Versions of the package, of Python, of the system and of the libraries; "" for one that is missing."""
    found = {"warp_rigid": __version__, "python": platform.python_version(), "system": platform.platform()}
    return found | {name: _version(name) for name in LIBRARIES}


def _version(library: str) -> str:
    try:
        return importlib.metadata.version(library)
    except importlib.metadata.PackageNotFoundError:
        return ""


def _describe(device: Any) -> dict[str, Any]:
    total, free = memory.device_memory(device)
    return {"name": str(device), "model": device.name, "memory": total, "free": free}


def _libraries() -> list[Check]:
    """A library that an extra brings may be missing: only what needs it does not work."""
    checks = []
    for library, package in LIBRARIES.items():
        version = _version(library)
        if not version:
            extra = "[" in package
            checks.append(Check(library, extra, "not installed", f"pip install '{package}'"))
    return checks


def _cuda() -> Check:
    """No CUDA device is no fault; one that Warp cannot use is."""
    if wp.is_cuda_available():
        driver = ".".join(str(part) for part in wp.get_cuda_driver_version() or ())
        return Check("cuda", True, f"{wp.get_cuda_device_count()} device(s), driver for CUDA {driver}")
    if not (shutil.which("nvidia-smi") or Path("/proc/driver/nvidia").exists()):
        return Check("cuda", True, "no NVIDIA driver; simulations run on the CPU")
    advice = "update the NVIDIA driver, or give the container its devices; `nvidia-smi` must list a GPU"
    return Check("cuda", False, "an NVIDIA driver is here, but Warp finds no device", advice)


def _caches() -> list[Check]:
    """Folders that are written to; without them all works, but every process compiles and computes anew."""
    folders = {
        "kernel cache": (Path(str(wp.config.kernel_cache_dir)), "set WARP_CACHE_PATH to a folder that can be written"),
        "grid cache": (distance_grid.cache_folder(), "set WARP_RIGID_CACHE to a folder that can be written"),
        "temporary files": (Path(tempfile.gettempdir()), "set TMPDIR to a folder that can be written"),
    }
    return [_folder(name, folder, advice) for name, (folder, advice) in folders.items()]


def _folder(name: str, folder: Path, advice: str) -> Check:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(b"x")
        free = shutil.disk_usage(folder).free
    except OSError as error:
        return Check(name, False, f"{folder}: {error.strerror}", advice)
    found = f"{folder}, {free / 1e9:.3g} GB free"
    if free < ENOUGH_DISK:
        return Check(name, False, found, "make room on this disk, or " + advice)
    return Check(name, True, found)


def _device(name: str) -> Check:
    """The self-test in a process of its own: whatever a device does to it, this one goes on."""
    title = f"self-test on {name}"
    command = [sys.executable, "-m", "warp_rigid.diagnostics.selftest", name]
    places = [str(Path(__file__).resolve().parents[1]), os.environ.get("PYTHONPATH", "")]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(place for place in places if place)}
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, timeout=COMPILE_SECONDS + TEST_SECONDS, env=environment
        )
    except subprocess.TimeoutExpired:
        advice = "run `warp-rigid warmup` first; if that hangs too, restart the machine or its driver"
        return Check(title, False, f"not done after {COMPILE_SECONDS + TEST_SECONDS} s", advice)
    try:
        result = json.loads(done.stdout.splitlines()[-1])
    except (ValueError, IndexError):
        return _crashed(title, name, done)
    wrong = [text for text, holds in result["checks"].items() if not holds]
    if wrong:
        advice = "the device or its driver computes wrongly: update the driver, and report this with `doctor --json`"
        return Check(title, False, "not so: " + "; ".join(wrong), advice)
    speed = f"{result['steps_per_second']:.0f} steps/s of 3 small environments"
    return Check(title, True, f"right to the last bit, {speed}, ready after {result['compile_seconds']:.2g} s")


def _crashed(title: str, name: str, done: subprocess.CompletedProcess) -> Check:
    lines = done.stderr.strip().splitlines()
    told = lines[-1][:200] if lines else f"ended with status {done.returncode}"
    if name == "cpu":
        advice = "reinstall warp-lang; it needs glibc 2.28 or newer"
    else:
        advice = "update the NVIDIA driver, restart the machine if the device was lost, or use --device cpu"
    return Check(title, False, told, advice)
