"""Start of Warp without its line about a missing CUDA driver, which is no fault of a machine without a GPU."""

import contextlib
import os
import sys
import tempfile
import threading
from collections.abc import Iterator

import warp as wp

NO_DRIVER = b"Could not find or load the NVIDIA CUDA driver"

_lock = threading.Lock()
_started = False


def start_warp() -> None:
    """Initialise Warp, once. What it prints on stderr is passed on, except for the missing driver.

    Raises:
        OSError: the folder of the compiled kernels cannot be written.
    """
    global _started
    if _started:
        return
    with _lock, _without_driver_line():
        try:
            wp.init()
        except OSError as error:
            advice = f"{error.strerror}; WARP_CACHE_PATH must be a writable folder"
            raise OSError(error.errno, advice, error.filename) from None
        _started = True


@contextlib.contextmanager
def _without_driver_line() -> Iterator[None]:
    """Capture what native code prints on stderr in the block, then print it without that line."""
    try:
        kept = os.dup(2)
    except OSError:  # the process has no stderr
        yield
        return
    with tempfile.TemporaryFile() as captured:
        if sys.stderr is not None:
            sys.stderr.flush()
        os.dup2(captured.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(kept, 2)
            os.close(kept)
            captured.seek(0)
            for line in captured:
                if NO_DRIVER not in line:
                    os.write(2, line)
