"""Exclusion of threads: a step is recorded while no other thread of the process uses a device.

Warp records all work of a process into the graph that is being recorded, whichever thread it comes from. Work of
another thread would be missing where it belongs, and be repeated with every step. On a GPU the current stream is a
property of the device for all threads, so there all work is exclusive.
"""

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import warp as wp

from warp_rigid.warp_start import start_warp


class _Gate:
    """Any number of threads may share the devices, or one has them alone. Both can be nested."""

    def __init__(self) -> None:
        """Open the gate."""
        self._changed = threading.Condition()
        self._sharing = 0
        self._owner: int | None = None
        self._waiting = 0
        self._own = threading.local()

    @property
    def _held(self) -> int:
        """How often this thread has entered."""
        return getattr(self._own, "held", 0)

    @contextmanager
    def shared(self) -> Iterator[None]:
        """Use the devices together with other threads."""
        if self._owner == threading.get_ident() or self._held:
            yield
            return
        with self._changed:
            self._changed.wait_for(lambda: self._owner is None and not self._waiting)
            self._sharing += 1
        self._own.held = 1
        try:
            yield
        finally:
            self._own.held = 0
            self._add(-1)

    @contextmanager
    def exclusive(self) -> Iterator[None]:
        """Use the devices alone. A thread that shares them lets others finish first, and shares them again after."""
        if self._owner == threading.get_ident():
            yield
            return
        held = self._held
        with self._changed:
            self._waiting += 1
            self._sharing -= held
            self._changed.notify_all()
            try:
                self._changed.wait_for(lambda: self._owner is None and self._sharing == 0)
                self._owner = threading.get_ident()
            except BaseException:
                self._sharing += held
                raise
            finally:
                self._waiting -= 1
        try:
            yield
        finally:
            with self._changed:
                self._owner = None
                self._sharing += held
                self._changed.notify_all()

    def _add(self, count: int) -> None:
        with self._changed:
            self._sharing += count
            self._changed.notify_all()


_gate = _Gate()


def _open_again() -> None:
    """In a child process no other thread exists."""
    global _gate
    _gate = _Gate()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_open_again)


@contextmanager
def exclusive() -> Iterator[None]:
    """Context in which no other thread uses a device through this package; required for recording and compiling.

    As a decorator, `@exclusive()`, it holds for each call.
    """
    start_warp()
    with _gate.exclusive():
        yield


@contextmanager
def on_stream(device: Any, stream: Any) -> Iterator[None]:
    """Context for work on a device in which a stream is the current one, in order with the stream that was before.

    No other thread records during it.

    Args:
        device: the Warp device.
        stream: a stream of the device; None for the CPU.
    """
    with _gate.exclusive() if device.is_cuda else _gate.shared():
        if stream is None or wp.get_stream(device) is stream:
            yield
        else:
            with wp.ScopedStream(stream, sync_enter=True, sync_exit=True):
                yield
