"""Progress on stderr: a bar in a terminal or notebook, lines of a command whose stderr is redirected, else nothing."""

import contextlib
import sys
import time
import warnings
from collections.abc import Iterator
from contextvars import ContextVar
from typing import Any, Protocol

LINE_PERIOD = 10.0
"""Time between lines [s]."""
DELAY = 0.5
"""Time after which a bar appears [s]."""

_lines: ContextVar[bool] = ContextVar("lines", default=False)


class Advance(Protocol):
    """Function that shows how much is done."""

    def __call__(self, done: float, total: float = ...) -> None:
        """Show `done` of `total`, which may change."""


@contextlib.contextmanager
def lines_if_redirected() -> Iterator[None]:
    """Print lines in the block if stderr is neither a terminal nor in a notebook."""
    before = _lines.set(True)
    try:
        yield
    finally:
        _lines.reset(before)


@contextlib.contextmanager
def progress(name: str, total: float, wanted: bool = True) -> Iterator[Advance]:
    """Show the progress of the block.

    Args:
        name: what is being done.
        total: the amount that is to be done.
        wanted: False shows nothing.

    Yields:
        The function that updates it.
    """
    if wanted and (in_notebook() or (sys.stderr is not None and sys.stderr.isatty())):
        with _bar(name, total) as bar:

            def advance(done: float, total: float = total) -> None:
                bar.total = total
                bar.update(done - bar.n)

            yield advance
    else:
        yield _printed_lines(name, total) if wanted and _lines.get() else lambda done, total=total: None


def in_notebook() -> bool:
    """Whether the process is the kernel of a notebook."""
    ipython = sys.modules.get("IPython")
    return ipython is not None and getattr(ipython.get_ipython(), "kernel", None) is not None


def _bar(name: str, total: float) -> Any:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a notebook without ipywidgets has a bar of text
        from tqdm.auto import tqdm

    # The thread that tqdm starts to watch its bars is not needed.
    kind = type("Bar", (tqdm,), {"monitor_interval": 0})
    form = "{desc}: {percentage:3.0f}% |{bar}| {elapsed}, {remaining} left"
    return kind(desc=name, total=total, leave=False, delay=DELAY, file=sys.stderr, bar_format=form)


def _printed_lines(name: str, total: float) -> Advance:
    start = last = time.monotonic()

    def advance(done: float, total: float = total) -> None:
        nonlocal last
        now = time.monotonic()
        if now - last >= LINE_PERIOD and done < total:
            last = now
            left = (now - start) * (total - done) / done if done else float("inf")
            text = f"{name}: {100.0 * done / total:.0f} % after {now - start:.0f} s, about {left:.0f} s left"
            print(text, file=sys.stderr)

    return advance
