"""Helpers shared by the commands: console, messages and one-line errors."""

import contextlib
import logging
import shlex
import sys
import tempfile
import warnings
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from rich.console import Console

from warp_rigid import interruption
from warp_rigid.extras import advice, need_for_file
from warp_rigid.files.atomic import check_replaceable

CAMERA_HELP = (
    'Camera, such as "position=3,0,2 look_at=0,0,0.5 field_of_view=40", "azimuth=-60 elevation=20", '
    '"follow=ball distance=2", or the name of a camera of a USD file.'
)
PLAIN_WIDTH = 120
"""Width of tables if the output is not a terminal [characters]."""


def console() -> Console:
    """A console for the terminal, or of fixed width if the output is redirected."""
    found = Console()
    return found if found.is_terminal else Console(width=PLAIN_WIDTH)


def say(*lines: str) -> None:
    """Print lines on stdout, as they are."""
    out = console()
    for line in lines:
        out.print(line, highlight=False, markup=False)


def say_written(files: Iterable[str]) -> None:
    """Print the paths of written files on stdout."""
    say(*(f"wrote {path}" for path in files))


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


def continued(context: Any) -> str:
    """The command line of a Typer context with --resume, as text for the shell."""
    given = context.obj or []
    return shlex.join([*given, *(() if "--resume" in given else ("--resume",))])


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


def check_outputs(output: str | None, pictures: dict[str | None, tuple[str, ...]]) -> None:
    """Check output suffixes, optional modules and that the files can be written, before the simulation runs."""
    if output and not output.endswith((".usdc", ".usda", ".usdz", ".usd", ".glb")):
        raise ValueError(f"-o: must end in .usdc, .usda, .usdz, .usd or .glb, got {output}")
    for path, endings in pictures.items():
        if path and not path.endswith(endings):
            raise ValueError(f"{path}: must end in {' or '.join(endings)}")
    for path in filter(None, (output, *pictures)):
        check_writable(path)
        need_for_file(path)


def explain(error: Exception) -> str:
    """Describe an error in one line."""
    if isinstance(error, ModuleNotFoundError):
        return advice(error.name or str(error))
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
