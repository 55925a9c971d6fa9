"""Ctrl-C in the commands: it ends them within a second, with at most one line.

While modules are imported, nothing is lost: the process ends at once. Otherwise, KeyboardInterrupt is raised in the
main thread. Libraries may swallow it, as Python does in destructors and callbacks, and no exception is raised while
machine code runs. A thread therefore watches what becomes of it: it is raised again, and after LONGEST the process ends
in any case, unless results are being kept.
"""

import _thread
import contextlib
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from types import FrameType
from typing import Any

STATUS = 130
AGAIN, LONGEST = 0.1, 0.25
"""Time after which an interruption is raised again, and after which the process ends [s]."""

_state = {"watched": False, "told": False, "keeping": 0, "ended": False}
"""Whether a command is watched, a line was printed, how many blocks keep results, and whether the command has ended."""


def is_of_command() -> bool:
    """Whether this process is a command of the package, and not another program, which keeps its handler."""
    name = os.path.basename(sys.argv[0]) if sys.argv else ""
    module = name == "-m" and "warp_rigid" in sys.orig_argv
    return (
        module or name in ("warp-rigid", "warp-rigid.exe")
    ) and threading.current_thread() is threading.main_thread()


def end_at_once() -> None:
    """End at the first Ctrl-C, until `watched`: nothing was done yet."""
    signal.signal(signal.SIGINT, lambda *_: _end())


def needs_telling() -> bool:
    """Whether no line about the interruption was printed yet; the caller prints one next."""
    before, _state["told"] = _state["told"], True
    return not before


@contextlib.contextmanager
def keeping() -> Iterator[None]:
    """Context in which results are kept if it is interrupted, which may take longer."""
    _state["keeping"] += 1
    try:
        yield
    finally:
        _state["keeping"] -= 1


def received() -> int:
    """Status of a command that an interruption has ended.

    A watched process ends here: the interpreter's own end takes longer, and it can be interrupted again.
    """
    end(STATUS)
    _tell()
    return STATUS


def end(status: int) -> None:
    """End a watched process with a status; others go on. The interpreter's own end can take seconds."""
    if not _state["watched"]:
        return
    with contextlib.suppress(OSError):
        sys.stdout.flush()
    if status == STATUS:
        _end()
    os._exit(status)


@contextlib.contextmanager
def watched() -> Iterator[None]:
    """Context of a command that ends soon after Ctrl-C, if this process is one (`end_at_once`)."""
    handler: Any = signal.getsignal(signal.SIGINT)
    if getattr(handler, "__module__", "") != __name__:
        yield
        return
    reading, writing = os.pipe()
    os.set_blocking(writing, False)
    threading.Thread(target=_watch, args=(reading,), daemon=True).start()
    _state["watched"] = True
    sys.unraisablehook = _raise_again
    signal.set_wakeup_fd(writing)
    signal.signal(signal.SIGINT, _interrupt)
    try:
        yield
    finally:
        _state["ended"] = True


def _interrupt(number: int, frame: FrameType | None) -> None:
    """Raise KeyboardInterrupt, or end the process in an import: else a library may stay incomplete."""
    if not _state["keeping"] and any("<frozen importlib" in file for file in _files(frame)):
        _end()
    raise KeyboardInterrupt


def _files(frame: FrameType | None) -> Iterator[str]:
    """Source files of a frame and of its callers."""
    while frame is not None:
        yield frame.f_code.co_filename
        frame = frame.f_back


def _watch(reading: int) -> None:
    """Wait for the first interruption, and end the process if nothing else does."""
    while os.read(reading, 1) != bytes([signal.SIGINT]):
        pass
    begin = time.monotonic()
    while True:
        time.sleep(AGAIN)
        ended, kept = _state["ended"], _state["keeping"] > 0
        if time.monotonic() - begin > LONGEST and (ended or not kept):
            _end()
        if not ended and not kept:
            _raise()


def _raise() -> None:
    """Interrupt the main thread, also where it waits."""
    if hasattr(signal, "pthread_kill") and (ident := threading.main_thread().ident) is not None:
        signal.pthread_kill(ident, signal.SIGINT)
    else:
        _thread.interrupt_main()


def _raise_again(unraisable: Any) -> None:
    """Report what a destructor raised, but for an interruption: it is raised again outside of it."""
    if issubclass(unraisable.exc_type, KeyboardInterrupt):
        threading.Timer(0.01, _raise).start()
    else:
        sys.__unraisablehook__(unraisable)


def _end() -> None:
    """End the process without its cleanup: other threads may be in machine code."""
    _tell()
    os._exit(STATUS)


def _tell() -> None:
    if needs_telling():
        os.write(2, b"warp-rigid: interrupted\n")
