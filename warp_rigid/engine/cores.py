"""CPU cores: the number that this process may use, and parallel execution on them.

Replaying a recorded step is a single native call that releases the global interpreter lock, so threads are sufficient.
The threads must neither record steps nor compile kernels, as a process can do only one of these at a time.
"""

import math
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import TypeVar

Part = TypeVar("Part")
Result = TypeVar("Result")

QUOTA = Path("/sys/fs/cgroup/cpu.max")
"""CPU quota of a container: "200000 100000" is two cores, "max 100000" all."""

_sharers = 1
"""Number of processes that share the cores, including this one."""


def usable_cores() -> int:
    """Number of cores that this process may use, from its affinity, its container's quota and `shared_by`."""
    count = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, min(count, _quota(count)) // _sharers)


@contextmanager
def shared_by(processes: int) -> Iterator[None]:
    """Context in which the cores are shared by this number of processes, including this one."""
    global _sharers
    before, _sharers = _sharers, processes
    try:
        yield
    finally:
        _sharers = before


def _quota(count: int) -> int:
    """Cores of the container's quota, rounded up; `count` if there is no quota."""
    try:
        quota, period = QUOTA.read_text().split()
        return math.ceil(int(quota) / int(period))
    except (OSError, ValueError, ZeroDivisionError):
        return count


def spread(work: Callable[[Part], Result], parts: Sequence[Part], threads: int) -> list[Result]:
    """Call `work` for each part, on `threads` threads including the current one; with one thread, run it directly.

    A thread that is done takes the next part. When this returns or raises, all threads are idle, also after Ctrl-C.

    Returns:
        The results, in the order of the parts.
    """
    found: list = [None] * len(parts)
    left = iter(enumerate(parts))
    helpers: list[Future] = []
    try:
        for _ in range(min(threads, len(parts)) - 1):
            helpers.append(_threads().submit(_take, work, left, found))
        _take(work, left, found)
    finally:
        _wait_until_idle(left, helpers)
    for helper in helpers:
        if not helper.cancelled():
            helper.result()
    return found


def _wait_until_idle(left: Iterable, helpers: Sequence[Future]) -> None:
    """Drop the parts that are left and wait for those begun.

    Ctrl-C does not cut this short: the parts use memory that the caller frees.
    """
    try:
        for _ in left:
            pass
        wait([helper for helper in helpers if not helper.cancel()])
    except KeyboardInterrupt:
        _wait_until_idle(left, helpers)
        raise


def _take(work: Callable[[Part], Result], left: Iterable[tuple[int, Part]], found: list) -> None:
    """Process parts until none is left; the iterator yields each part to one thread only."""
    for index, part in left:
        found[index] = work(part)


@cache
def _threads() -> ThreadPoolExecutor:
    """Thread pool of this process; threads are started on demand."""
    return ThreadPoolExecutor(max_workers=os.cpu_count() or 1, thread_name_prefix="warp_rigid")


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_threads.cache_clear)
