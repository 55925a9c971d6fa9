"""Opening USD files, after their examination in a child process with limits on memory and time."""

import atexit
import contextlib
import json
import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from pxr import Sdf, Tf, Usd

from warp_rigid.checks import number_in
from warp_rigid.usd import examination
from warp_rigid.usd.examination import UNREADABLE, reason_of

LIMITS = {"seconds": ("WARP_RIGID_USD_SECONDS", 2.0, 1.0), "bytes": ("WARP_RIGID_USD_GIGABYTES", 1.5, 2.0**30)}
"""Limits of the examination: environment variable, default, and unit. They grow with the size of the files."""


def open_stage(path: Path) -> Usd.Stage:
    """Open a file.

    Raises:
        FileNotFoundError: It does not exist.
        ValueError: It is not a USD file, it is too large or nested too deeply to be composed, or its examination
            exceeded the limits.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    refusal = _EXAMINER.refusal(path)
    if refusal:
        raise ValueError(refusal)
    try:
        stage = Usd.Stage.Open(Sdf.Layer.FindOrOpen(str(path)))
        # Layers that are open already are shared, and may be older than their files; unsaved changes are kept.
        Sdf.Layer.ReloadLayers([layer for layer in stage.GetUsedLayers() if layer.realPath and not layer.dirty])
        return stage
    except (Tf.ErrorException, UnicodeError) as error:
        raise ValueError(f"{path}: not a readable USD file: {reason_of(error)}") from None


@contextlib.contextmanager
def convert_errors(path: Any) -> Iterator[None]:
    """Convert the exceptions of unexpected or damaged values to a ValueError of one line that names the file."""
    try:
        yield
    except UNREADABLE as error:
        raise ValueError(f"{path}: cannot be read: {reason_of(error)}") from error
    except ValueError as error:
        raise error if str(path) in str(error) else ValueError(f"{path}: {error}") from error


class _Examiner:
    """The child process that examines files; it is started when needed, and again if it has ended."""

    def __init__(self) -> None:
        """Start nothing yet."""
        self._lock = threading.Lock()
        self._process: subprocess.Popen | None = None
        self._owner = 0
        atexit.register(self._stop)

    def refusal(self, path: Path) -> str:
        """Why a file must not be opened; empty if it can be."""
        limits = {name: _limit(*given) for name, given in LIMITS.items()}
        if not hasattr(os, "fork"):
            return examination.refusal(str(path))
        request = json.dumps({"path": os.path.abspath(path), **limits}).encode()
        with self._lock:
            for _ in range(2):
                with contextlib.suppress(OSError, ValueError):
                    self.start()
                    assert self._process is not None and self._process.stdin and self._process.stdout
                    self._process.stdin.write(request + b"\n")
                    self._process.stdin.flush()
                    return json.loads(self._process.stdout.readline()).replace(os.path.abspath(path), str(path))
                self._stop()
        raise OSError(f"{path}: the process that examines USD files does not start: {sys.executable}")

    def start(self) -> None:
        """Start the process, unless it runs. A fork of the caller needs a process of its own."""
        if self._process is not None and self._owner == os.getpid() and self._process.poll() is None:
            return
        self._owner = os.getpid()
        self._process = subprocess.Popen(
            [sys.executable, "-P", examination.__file__],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
            env={**os.environ, "PXR_WORK_THREAD_LIMIT": "1"},
        )

    def _stop(self) -> None:
        """End the process."""
        if self._process is not None and self._owner == os.getpid():
            self._process.kill()
            self._process.wait()
        self._process = None


_EXAMINER = _Examiner()


def _limit(variable: str, default: float, unit: float) -> float:
    """A limit from the environment, in seconds or bytes."""
    text = os.environ.get(variable, str(default))
    try:
        return number_in(variable, float(text), above=0.0) * unit
    except ValueError:
        raise ValueError(f"{variable}: must be a number > 0, got {text!r}") from None
