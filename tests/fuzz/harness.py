"""What every fuzzed case must keep to: end soon, in a result or a one-line refusal, and do no harm.

A module of this package with a list TARGETS takes part in `test_fuzz.py`; that is all a new format or input needs.
"""

import contextlib
import os
import re
import resource
import sys
import tempfile
import threading
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp
from hypothesis import strategies as st

from warp_rigid.errors import CapacityError

SECONDS = 5.0
"""No case may take longer [s]: by the clock and by the processor, so that a busy machine does not decide."""

BYTES = 2**31
"""No case may take more memory than this [bytes]."""

REFUSALS = (ValueError, OSError, CapacityError)
ONE_LINE = re.compile(r"[^\n:]{1,300}: [^\n]{1,600}")
"""A refusal names the field, the option or the file, then says what is wrong."""

HARMFUL = ("os.system", "os.exec", "os.posix_spawn", "subprocess.Popen", "pickle.find_class", "socket.connect")
"""Events of Python that no input may cause."""


@dataclass(frozen=True)
class Target:
    """Something that takes input from outside.

    Attributes:
        name: of what is tried.
        cases: strategy for the inputs.
        attempt: function(case, folder) that uses a case as a program would; what it writes goes into the folder.
    """

    name: str
    cases: st.SearchStrategy
    attempt: Callable[[Any, Path], None]


wp.init()  # what Warp does at its start, such as asking for the processor's name, is not a case's doing


class MetricRecorder:
    """Notes what the running case does to the system; there is one for the process, since hooks cannot be removed."""

    def __init__(self) -> None:
        self.folder: Path | None = None
        self.thread = 0
        self.harm: list[str] = []
        sys.addaudithook(self)

    def __call__(self, event: str, arguments: tuple) -> None:
        if self.folder is None or threading.get_ident() != self.thread:
            return
        if event in HARMFUL:
            self.harm.append(f"{event} {arguments!r}")
        elif event == "open" and isinstance(arguments[0], str) and self._writes(arguments[1], arguments[2]):
            path = os.path.realpath(arguments[0])
            # A nameless temporary file opens its folder; modules that are imported late may be compiled now.
            allowed = (str(self.folder), os.environ["WARP_RIGID_CACHE"], os.devnull)
            if not (path.startswith(allowed) or path == tempfile.gettempdir() or "__pycache__" in path):
                self.harm.append(f"wrote {path}")

    @staticmethod
    def _writes(mode: Any, flags: int) -> bool:
        return any(c in mode for c in "wax+") if isinstance(mode, str) else bool(flags & (os.O_WRONLY | os.O_RDWR))


WATCH = MetricRecorder()


@contextlib.contextmanager
def little_memory():
    """Let the process take only so much more address space."""
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    before = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (pages * os.sysconf("SC_PAGE_SIZE") + BYTES, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)


def check(target: Target, case: Any, folder: Path) -> None:
    """Try a case; raises AssertionError, or whatever came out, unless it ended as it must."""
    WATCH.harm.clear()
    WATCH.folder, WATCH.thread = folder.resolve(), threading.get_ident()
    start = np.array([time.perf_counter(), time.process_time()])
    try:
        with little_memory(), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            target.attempt(case, folder)
    except REFUSALS as error:
        text = f"{error.filename}: {error.strerror}" if isinstance(error, OSError) and error.filename else str(error)
        assert ONE_LINE.fullmatch(text), f"no line that names what is wrong: {text!r}"
    finally:
        WATCH.folder = None
    assert not WATCH.harm, WATCH.harm
    assert (np.array([time.perf_counter(), time.process_time()]) - start).min() < SECONDS


def damaged(content: bytes) -> st.SearchStrategy:
    """A file with a few bytes changed, cut out, doubled or put in, or cut off."""
    place = st.integers(0, max(0, len(content) - 1))
    edit = st.tuples(place, st.sampled_from(["set", "cut", "insert", "end"]), st.binary(min_size=1, max_size=8))

    def apply(edits: list) -> bytes:
        changed = bytearray(content)
        for at, kind, new in edits:
            at = min(at, len(changed))
            if kind == "end":
                del changed[at:]
            else:
                changed[at : at + (0 if kind == "insert" else len(new))] = b"" if kind == "cut" else new
        return bytes(changed)

    return st.lists(edit, min_size=1, max_size=4).map(apply)


NUMBERS = st.one_of(
    st.floats(-2, 2),
    st.floats(allow_nan=True, allow_infinity=True),
    st.sampled_from(
        [0.0, -0.0, 1e-30, -1.0, 1e30, -1e30, 1e39, 1e308, float("nan"), float("inf"), 2**31, -(2**63), 10**30]
    ),
)
"""Numbers, most of them unwelcome."""

ODDITIES = st.one_of(
    NUMBERS, st.none(), st.booleans(), st.text(max_size=4), st.just([]), st.just({}), st.just(object), st.just([[1.0]])
)
"""What no caller should give."""


def vectors(length: int) -> st.SearchStrategy:
    """Mostly vectors, mostly of this length."""
    right = st.tuples(*[st.floats(-2, 2)] * length)
    wild = st.lists(NUMBERS, min_size=length, max_size=length)
    return st.one_of(right, right, wild, st.lists(NUMBERS, max_size=5), ODDITIES)
