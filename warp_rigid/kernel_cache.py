"""Compiled kernels in Warp's cache: damaged ones are found, reported once, and compiled again.

A checksum is kept beside each file, because a changed byte of machine code is noticed by nothing else. It protects
against damage, not against other users: they must not be able to write to the folder.
"""

import contextlib
import hashlib
import logging
import shutil
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import warp as wp

from warp_rigid.files.atomic import atomic_file

log = logging.getLogger("warp_rigid")

CHECKSUM = ".sha256"

_announcement = threading.Lock()
"""Taken by the first module that is compiled in this process, and never released."""


def load_module(device: Any, name: str, block: int) -> None:
    """Compile the kernels of a module, or load them from Warp's cache.

    Args:
        device: the Warp device.
        name: name of the Python module.
        block: threads per block.
    """
    module = wp.get_module(name)
    folder = Path(str(wp.config.kernel_cache_dir)) / module.get_module_identifier(block)
    code = (".cubin", ".ptx") if device.is_cuda else (".o",)
    if not any(_compiled(folder, code)) and _announcement.acquire(blocking=False):
        log.info("compiling kernels for %s, once on this machine: half a minute on a CPU, a minute on a GPU", device)
    damaged = [file for file in _compiled(folder) if _checksum_of(file) not in (None, _digest(file))]
    if damaged:
        _discard(folder, f"{damaged[0].name} was changed")
    try:
        wp.force_load(device, [module], block)
    except Exception as error:
        if not any(_compiled(folder)):
            raise
        _discard(folder, " ".join(str(error).split()))
        wp.force_load(device, [module], block)
    for file in _compiled(folder):
        if _checksum_of(file) is None:
            with contextlib.suppress(OSError), atomic_file(f"{file}{CHECKSUM}") as temporary:
                temporary.write_text(_digest(file))


def _compiled(folder: Path, suffixes: tuple[str, ...] = (".o", ".cubin", ".ptx", ".meta")) -> Iterator[Path]:
    """Files that Warp loads from the folder of a module."""
    for suffix in suffixes:
        yield from folder.glob(f"[!.]*{suffix}")


def _digest(file: Path) -> str:
    return hashlib.sha256(file.read_bytes()).hexdigest()


def _checksum_of(file: Path) -> str | None:
    """The checksum kept beside a file; None if there is none."""
    try:
        return Path(f"{file}{CHECKSUM}").read_text(errors="replace")
    except OSError:
        return None


def _discard(folder: Path, reason: str) -> None:
    """Remove the folder of a module."""
    log.warning("kernel cache: %s is damaged (%s); its kernels are compiled again", folder, reason)
    shutil.rmtree(folder, ignore_errors=True)
