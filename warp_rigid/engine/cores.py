"""The processor's cores: how many this process may use, and how work is spread over them.

Replaying a recorded step is one call of native code, during which Python lets other threads run: so threads are enough.
What they run must neither record steps nor compile, for both are one thing at a time in a process.
"""

import math
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import TypeVar

Part = TypeVar("Part")
Result = TypeVar("Result")

QUOTA = Path("/sys/fs/cgroup/cpu.max")
"""What a container may use of the processors: "200000 100000" is two cores, "max 100000" all."""

_sharers = 1
"""Processes that share the cores, this one included."""


def usable_cores() -> int:
    """Cores that this process may use: its affinity and its container's quota, its part of them if they are shared."""
    count = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, min(count, _quota(count)) // _sharers)


@contextmanager
def shared_by(processes: int) -> Iterator[None]:
    """Within it the cores are shared by so many processes, this one included."""
    global _sharers
    before, _sharers = _sharers, processes
    try:
        yield
    finally:
        _sharers = before


def _quota(count: int) -> int:
    """Whole cores of the container's quota, `count` where there is none."""
    try:
        quota, period = QUOTA.read_text().split()
        return math.ceil(int(quota) / int(period))
    except (OSError, ValueError, ZeroDivisionError):
        return count


def spread(work: Callable[[Part], Result], parts: Sequence[Part], threads: int) -> list[Result]:
    """Do the work for each part, by as many threads at once, this one among them; a single one waits for no other.

    A thread that is done takes the next part. When this returns, or raises what was raised, no thread is at work.

    Returns:
        What the work returned, in the order of the parts.
    """
    found: list = [None] * len(parts)
    left = iter(enumerate(parts))
    others = min(threads, len(parts)) - 1
    helpers = [_threads().submit(_take, work, left, found) for _ in range(others)]
    try:
        _take(work, left, found)
    finally:
        for _ in left:
            pass
        called = [helper for helper in helpers if not helper.cancel()]
        wait(called)
    for helper in called:
        helper.result()
    return found


def _take(work: Callable[[Part], Result], left: Iterable[tuple[int, Part]], found: list) -> None:
    """Do parts until none is left; Python hands each to one thread only."""
    for index, part in left:
        found[index] = work(part)


@cache
def _threads() -> ThreadPoolExecutor:
    """The threads of this process; each is started when it is first needed."""
    return ThreadPoolExecutor(max_workers=os.cpu_count() or 1, thread_name_prefix="warp_rigid")


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_threads.cache_clear)
