"""Checks of the installation and the devices of a machine, with advice for each failure."""

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
from warp_rigid.kernels.tuning import thresholds
from warp_rigid.scene.shapes import distance_grid
from warp_rigid.version import __version__

LIBRARIES = {
    "warp-lang": "warp-rigid", "numpy": "warp-rigid", "trimesh": "warp-rigid", "usd-core": "warp-rigid",
    "typer": "warp-rigid", "rich": "warp-rigid", "matplotlib": "warp-rigid[picture]", "pillow": "warp-rigid[picture]",
    "imageio-ffmpeg": "warp-rigid[picture]", "viser": "warp-rigid[viewer]",
}  # fmt: skip
"""Libraries, and the package or extra that installs each."""
ROOT = Path(__file__).resolve().parents[2]
"""Folder of the package: the source checkout, if there is one."""

COMPILE_SECONDS, TEST_SECONDS = 300, 30
"""Time limits of the first compilation and of the self-test [s]."""
ENOUGH_DISK = 500_000_000
"""Minimum free disk space, for the kernels and grids of a few scenes [bytes]."""


@dataclass(frozen=True)
class MachineCheck:
    """Result of one check.

    Attributes:
        name: name of the check.
        passed: whether the check passed.
        found: observed result.
        advice: suggested fix; may be empty if the check passed.
    """

    name: str
    passed: bool
    found: str
    advice: str = ""


def examine(devices: list[str] | None = None) -> dict[str, Any]:
    """Check versions, devices, caches and memory, and test each device in a separate process.

    Args:
        devices: names of Warp devices; None tests all.

    Returns:
        Plain data: "versions", "devices", "caches", "checks", "thresholds" and "ok".
    """
    names = [str(device) for device in wp.get_devices()] if devices is None else devices
    checks = [*_libraries(), _cuda(), *_caches(), *(_device(name) for name in names)]
    return {
        "versions": versions(),
        "devices": [_describe(wp.get_device(name)) for name in names],
        "caches": {"kernels": str(wp.config.kernel_cache_dir), "distance grids": str(distance_grid.cache_folder())},
        "checks": [asdict(check) for check in checks],
        "thresholds": {name: threshold._asdict() for name, threshold in thresholds().items()},
        "ok": all(check.passed for check in checks),
    }


def git(*arguments: str) -> str:
    """What git prints about the source checkout; "" for an installed package."""
    if not (ROOT / ".git").exists():
        return ""
    try:
        done = subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, text=True, timeout=30)
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return done.stdout.strip()


def versions() -> dict[str, str]:
    """Versions of the package, of Python, of the system and of the libraries; "" for a missing library."""
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


def _libraries() -> list[MachineCheck]:
    """Check the libraries; those of extras may be missing."""
    checks = []
    for library, package in LIBRARIES.items():
        version = _version(library)
        if not version:
            extra = "[" in package
            checks.append(MachineCheck(library, extra, "not installed", f"pip install '{package}'"))
    return checks


def _cuda() -> MachineCheck:
    """Check CUDA; a machine without an NVIDIA driver passes."""
    if wp.is_cuda_available():
        driver = ".".join(str(part) for part in wp.get_cuda_driver_version() or ())
        found = f"{wp.get_cuda_device_count()} device(s), driver for CUDA {driver}"
        usable = wp.is_conditional_graph_supported()
        return MachineCheck(
            "cuda", usable, found, "" if usable else "update the NVIDIA driver: CUDA 12.4 is the oldest"
        )
    if not (shutil.which("nvidia-smi") or Path("/proc/driver/nvidia").exists()):
        return MachineCheck("cuda", True, "no NVIDIA driver; simulations run on the CPU")
    advice = "update the NVIDIA driver, or give the container access to the GPU; `nvidia-smi` must list a GPU"
    return MachineCheck("cuda", False, "an NVIDIA driver is installed, but Warp finds no device", advice)


def _caches() -> list[MachineCheck]:
    """Check the cache folders; without them every process compiles kernels and computes grids again."""
    folders = {
        "kernel cache": (Path(str(wp.config.kernel_cache_dir)), "set WARP_CACHE_PATH to a writable folder"),
        "grid cache": (distance_grid.cache_folder(), "set WARP_RIGID_CACHE to a writable folder"),
        "temporary files": (Path(tempfile.gettempdir()), "set TMPDIR to a writable folder"),
    }
    return [_folder(name, folder, advice) for name, (folder, advice) in folders.items()]


def _folder(name: str, folder: Path, advice: str) -> MachineCheck:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(b"x")
        free = shutil.disk_usage(folder).free
    except OSError as error:
        return MachineCheck(name, False, f"{folder}: {error.strerror}", advice)
    found = f"{folder}, {free / 1e9:.3g} GB free"
    if free < ENOUGH_DISK:
        return MachineCheck(name, False, found, "free space on this disk, or " + advice)
    return MachineCheck(name, True, found)


def _device(name: str) -> MachineCheck:
    """Run the self-test in a separate process, so that a crash of the device driver can be reported."""
    title = f"self-test on {name}"
    command = [sys.executable, "-m", "warp_rigid.diagnostics.selftest", name]
    places = [str(ROOT), os.environ.get("PYTHONPATH", "")]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(place for place in places if place)}
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, timeout=COMPILE_SECONDS + TEST_SECONDS, env=environment
        )
    except subprocess.TimeoutExpired:
        advice = "run `warp-rigid warmup` first; if that hangs too, restart the machine or its driver"
        return MachineCheck(title, False, f"not finished after {COMPILE_SECONDS + TEST_SECONDS} s", advice)
    try:
        result = json.loads(done.stdout.splitlines()[-1])
    except (ValueError, IndexError):
        return _crashed(title, name, done)
    wrong = [text for text, holds in result["checks"].items() if not holds]
    if wrong:
        advice = "the device or its driver computes wrong results: update the driver and report the `doctor --json`"
        return MachineCheck(title, False, "failed: " + "; ".join(wrong), advice)
    speed = f"{result['steps_per_second']:.0f} steps/s of 3 small environments"
    return MachineCheck(title, True, f"bitwise reproducible, {speed}, ready after {result['compile_seconds']:.2g} s")


def _crashed(title: str, name: str, done: subprocess.CompletedProcess) -> MachineCheck:
    lines = done.stderr.strip().splitlines()
    found = lines[-1][:200] if lines else f"ended with status {done.returncode}"
    if name == "cpu":
        advice = "reinstall warp-lang; it needs glibc 2.28 or newer"
    else:
        advice = "update the NVIDIA driver, restart the machine if the device was lost, or use --device cpu"
    return MachineCheck(title, False, found, advice)
