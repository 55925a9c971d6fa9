"""Ctrl-C ends a command within a second, with one line and status 130; the viewer with none and status 0."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
VALIDATE = [sys.executable, "-m", "warp_rigid", "validate", "--quick", "--device", "cpu"]

SWALLOWING = """
import os
import sys
sys.argv[0] = "warp-rigid"
import time
from warp_rigid import interruption

class Slow:
    def __del__(self):
        time.sleep(5.0)

with interruption.watched():
    print("ready", flush=True)
    for _ in range(20):
        try:
            {act}
        except BaseException:
            {answer}
"""


def started(command):
    """A process that Ctrl-C reaches, also where this one ignores it."""
    default = lambda: signal.signal(signal.SIGINT, signal.default_int_handler)  # noqa: E731
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return subprocess.Popen(command, cwd=ROOT, env=os.environ, preexec_fn=default, **pipes)


def interrupted(process):
    """The status, what was told, and the time that it took [s]."""
    begin = time.monotonic()
    process.send_signal(signal.SIGINT)
    told = process.communicate(timeout=60)[1]
    return process.returncode, told, time.monotonic() - begin


@pytest.mark.quiet
@pytest.mark.parametrize(
    "after", [0.4, 1.6, 3.1, *(pytest.param(after, marks=pytest.mark.long) for after in (0.8, 2.3, 5.0))]
)
def test_validate_ends_with_one_line(after):
    """While the package is imported, kernels are loaded, and cases run."""
    process = started(VALIDATE)
    time.sleep(after)
    status, told, seconds = interrupted(process)
    assert (status, told) == (130, "warp-rigid: interrupted\n")
    assert seconds < 1.2


@pytest.mark.quiet
def test_the_viewer_ends_with_status_0():
    process = started([sys.executable, "-m", "warp_rigid", "view", "incline", "--device", "cpu", "--port", "8960"])
    while "Ctrl-C" not in process.stderr.readline():
        assert process.poll() is None
    time.sleep(0.5)
    status, told, seconds = interrupted(process)
    assert (status, told) == (0, "")
    assert seconds < 1.2


@pytest.mark.long
@pytest.mark.parametrize(
    ("act", "answer", "expected"),
    [
        ("Slow(); time.sleep(1.0)", "os._exit(7)", (7, "")),
        ("time.sleep(5.0)", "pass", (130, "warp-rigid: interrupted\n")),
    ],
    ids=["in a destructor", "by the code that runs"],
)
def test_an_interruption_that_is_swallowed_is_raised_again_or_ends_the_process(act, answer, expected):
    process = started([sys.executable, "-c", SWALLOWING.format(act=act, answer=answer)])
    assert process.stdout.readline() == "ready\n"
    time.sleep(0.3)
    status, told, seconds = interrupted(process)
    assert (status, told) == expected and seconds < 3.0


@pytest.mark.long
def test_other_programs_keep_their_handler():
    program = "import signal; import warp_rigid; print(signal.getsignal(signal.SIGINT) is signal.default_int_handler)"
    assert started([sys.executable, "-c", program]).communicate()[0] == "True\n"
