"""Helpers shared by the commands: console, progress bar, messages and one-line errors."""

import contextlib
import importlib
import logging
import os
import shlex
import sys
import tempfile
import time
import warnings
from pathlib import Path
from typing import Any

import warp as wp
from rich.console import Console
from rich.progress import Progress

from warp_rigid import interruption
from warp_rigid.files.atomic import check_replaceable

_LIBRARIES = {
    ".png": ("matplotlib", "PIL"),
    ".gif": ("PIL",),
    ".mp4": ("PIL", "imageio_ffmpeg"),
    ".html": ("viser",),
    ".glb": ("pygltflib",),
}
"""Optional modules required to write a file, by its suffix."""
CAMERA_HELP = (
    'Camera of pictures, such as "position=3,0,2 look_at=0,0,0.5 field_of_view=40", "azimuth=-60 elevation=20", '
    '"follow=ball distance=2", or the name of a camera of a USD file.'
)
_EXTRAS = {
    "PIL": "picture",
    "matplotlib": "picture",
    "imageio_ffmpeg": "picture",
    "viser": "viewer",
    "pygltflib": "gltf",
    "loky": "sweep",
    "pyarrow": "sweep",
    "scipy": "sweep",
    "zarr": "trajectories",
    "distributed": "cluster",
    "optuna": "opt",
}
"""The extra that installs an optional module."""

LINE_PERIOD = 10.0
"""Time between lines of progress if stderr is not a terminal [s]."""
PLAIN_WIDTH = 120
"""Width of tables if the output is not a terminal [characters]."""


def console(stderr: bool = False) -> Console:
    """A console for the terminal, or of fixed width if the output is redirected."""
    found = Console(stderr=stderr)
    return found if found.is_terminal else Console(stderr=stderr, width=PLAIN_WIDTH)


@contextlib.contextmanager
def told_if_interrupted(describe, begun):
    """Print the text that `describe` returns if Ctrl-C, or an error after `begun()`, ends the block."""
    with interruption.keeping():
        try:
            yield
        except KeyboardInterrupt:
            interruption.needs_telling()
            note(f"interrupted: {describe()}")
            raise
        except Exception:
            if begun():
                note(f"stopped: {describe()}")
            raise


def continued(context: Any, flag: str = "--resume") -> str:
    """The command line of a Typer context with a flag, as text for the shell."""
    given = context.obj or []
    return shlex.join([*given, *(() if flag in given else (flag,))])


def note(text: str) -> None:
    """Print a line on stderr."""
    print(text, file=sys.stderr)


def check_writable(path: Any) -> None:
    """Check that a file can be written, without writing it: its folder exists, or can be made.

    Raises:
        OSError: The file cannot be written.
    """
    check_replaceable(path)
    folder = Path(path).parent
    while not folder.exists():
        folder = folder.parent
    try:
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise OSError(error.errno, f"cannot be written: {folder}: {error.strerror}", str(path)) from None


def check_outputs(output: str | None, pictures: dict[str, tuple[str, ...]]) -> None:
    """Check output suffixes, optional modules and that the files can be written, before the simulation runs."""
    if output and not output.endswith((".usdc", ".usda", ".usdz", ".usd", ".glb")):
        raise ValueError(f"-o: must end in .usdc, .usda, .usdz, .usd or .glb, got {output}")
    for path, endings in pictures.items():
        if not path.endswith(endings):
            raise ValueError(f"{path}: must end in {' or '.join(endings)}")
    for path in (output, *pictures) if output else pictures:
        check_writable(path)
        for module in _LIBRARIES.get(Path(path).suffix, ()):
            importlib.import_module(module)


@contextlib.contextmanager
def progress(name: str, total: int):
    """Show the progress on stderr: a bar, or a line every LINE_PERIOD seconds if stderr is not a terminal.

    Yields a function (done, total) that updates it.
    """
    terminal = console(stderr=True)
    if not terminal.is_terminal:
        yield _progress_lines(name, total)
        return
    with Progress(console=terminal, transient=True) as bar:
        task = bar.add_task(name, total=total)
        yield lambda done, total=total: bar.update(task, completed=done, total=total)


def _progress_lines(name: str, total: int):
    start = last = time.monotonic()

    def show(done, total=total):
        nonlocal last
        now = time.monotonic()
        if now - last >= LINE_PERIOD and done < total:
            last = now
            left = (now - start) * (total - done) / done if done else float("inf")
            note(f"{name}: {100.0 * done / total:.0f} % after {now - start:.0f} s, about {left:.0f} s left")

    return show


def start_warp() -> None:
    """Initialise Warp without its banner and without the warning about a missing CUDA driver."""
    wp.config.log_level = wp.LOG_WARNING
    with tempfile.TemporaryFile() as captured:
        sys.stderr.flush()
        kept = os.dup(2)
        os.dup2(captured.fileno(), 2)
        try:
            wp.init()
        except OSError as error:
            advice = f"{error.strerror}; WARP_CACHE_PATH must be a writable folder"
            raise OSError(error.errno, advice, error.filename) from None
        finally:
            os.dup2(kept, 2)
            os.close(kept)
        captured.seek(0)
        for line in captured.read().decode(errors="replace").splitlines():
            if "Could not find or load the NVIDIA CUDA driver" not in line:
                note(line)


def explain(error: Exception) -> str:
    """Describe an error in one line."""
    if isinstance(error, ModuleNotFoundError):
        extra = _EXTRAS.get((error.name or "").partition(".")[0])
        package = f"'warp-rigid[{extra}]'" if extra else "--force-reinstall warp-rigid"
        return f"{error.name} is not installed; install it with: pip install {package}"
    if isinstance(error, OSError) and error.filename:
        return f"{error.filename}: {error.strerror}"
    return " ".join(str(error).split())


def is_device_error(error: RuntimeError) -> bool:
    """Whether Warp raised the error for a device: lost, out of memory, no compiler or no kernel cache."""
    text = str(error).lower()
    return any(word in text for word in ("cuda", "failed to allocate", "warp-clang", "llvm", "kernel cache"))


@contextlib.contextmanager
def messages_on_stderr():
    """Print log messages of the package, and warnings as one line each, on stderr."""
    log = logging.getLogger("warp_rigid")
    handler = logging.StreamHandler(sys.stderr)
    level = log.level
    log.addHandler(handler)
    log.setLevel(logging.INFO)
    with warnings.catch_warnings():
        warnings.showwarning = lambda message, *_, **__: note(f"warning: {message}")
        try:
            yield
        finally:
            log.removeHandler(handler)
            log.setLevel(level)
