"""What the commands share: the console, progress, messages and one-line errors."""

import contextlib
import importlib
import logging
import os
import sys
import tempfile
import warnings
from pathlib import Path

import warp as wp
from rich.console import Console
from rich.progress import Progress

_LIBRARIES = {
    ".png": ("matplotlib", "PIL"),
    ".gif": ("PIL",),
    ".mp4": ("PIL", "imageio_ffmpeg"),
    ".html": ("viser",),
    ".glb": ("pygltflib",),
}
"""What writing a file takes beyond the package's own requirements."""
_EXTRAS = {
    "PIL": "picture",
    "matplotlib": "picture",
    "imageio_ffmpeg": "picture",
    "viser": "viewer",
    "pygltflib": "gltf",
    "pyarrow": "sweep",
    "scipy": "sweep",
    "zarr": "trajectories",
    "distributed": "cluster",
    "optuna": "opt",
}
"""Which extra brings a library that is imported only where it is needed."""

PLAIN_WIDTH = 120
"""Width of tables where there is no terminal."""


def console(stderr: bool = False) -> Console:
    """The terminal, or a plain one of fixed width where the output goes elsewhere."""
    found = Console(stderr=stderr)
    return found if found.is_terminal else Console(stderr=stderr, width=PLAIN_WIDTH)


def note(text: str) -> None:
    """A line on stderr."""
    print(text, file=sys.stderr)


def check_outputs(output: str | None, pictures: dict[str, tuple[str, ...]]) -> None:
    """Refuse names and missing libraries before the simulation runs, not after it."""
    if output and not output.endswith((".usdc", ".usda", ".usdz", ".usd", ".glb")):
        raise ValueError(f"-o: must end in .usdc, .usda, .usdz, .usd or .glb, got {output}")
    for path, endings in pictures.items():
        if not path.endswith(endings):
            raise ValueError(f"{path}: must end in {' or '.join(endings)}")
    for path in (output, *pictures) if output else pictures:
        for module in _LIBRARIES.get(Path(path).suffix, ()):
            importlib.import_module(module)


@contextlib.contextmanager
def progress(name: str, total: int):
    """A bar on stderr where that is a terminal; yields the function that moves it, and can set its length anew."""
    terminal = console(stderr=True)
    if not terminal.is_terminal:
        yield None
        return
    with Progress(console=terminal, transient=True) as bar:
        task = bar.add_task(name, total=total)
        yield lambda done, total=total: bar.update(task, completed=done, total=total)


def start_warp() -> None:
    """Start Warp without its greeting; other messages of its native part still come through."""
    wp.config.log_level = wp.LOG_WARNING
    with tempfile.TemporaryFile() as told:
        sys.stderr.flush()
        kept = os.dup(2)
        os.dup2(told.fileno(), 2)
        try:
            wp.init()
        except OSError as error:
            advice = f"{error.strerror}; WARP_CACHE_PATH must name a folder that can be written"
            raise OSError(error.errno, advice, error.filename) from None
        finally:
            os.dup2(kept, 2)
            os.close(kept)
        told.seek(0)
        for line in told.read().decode(errors="replace").splitlines():
            if "Could not find or load the NVIDIA CUDA driver" not in line:
                note(line)


def explain(error: Exception) -> str:
    """One line on what went wrong."""
    if isinstance(error, ModuleNotFoundError):
        extra = _EXTRAS.get((error.name or "").partition(".")[0])
        package = f"'warp-rigid[{extra}]'" if extra else "--force-reinstall warp-rigid"
        return f"{error.name} is not installed; pip install {package} brings it"
    if isinstance(error, OSError) and error.filename:
        return f"{error.filename}: {error.strerror}"
    return " ".join(str(error).split())


def of_device(error: RuntimeError) -> bool:
    """Whether Warp raised it over a device: lost, out of memory, without a compiler or a place for its kernels."""
    text = str(error).lower()
    return any(word in text for word in ("cuda", "failed to allocate", "warp-clang", "llvm", "kernel cache"))


@contextlib.contextmanager
def messages_on_stderr():
    """Show the package's messages, and warnings as one line each."""
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
