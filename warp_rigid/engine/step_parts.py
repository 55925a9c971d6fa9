"""The recorded step as a sequence of parts: one thread executes a part, or the cores of a CPU share its rows.

A shared part is a graph that several threads replay at the same time. Its kernels give each row to one of them
(kernels/common/sharing.py). As the result of a kernel does not depend on the order of its rows, no bit depends on the
number of threads, nor on whether they start in time.
"""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

import warp as wp

from warp_rigid.engine.cores import spread
from warp_rigid.kernels import declare
from warp_rigid.kernels.common import sharing

CHUNKS_A_WORKER = 16
"""Chunks of rows per worker; many, because rows take different times."""

MOST_WORKERS = 16
"""Maximum number of workers; more of them would contend for the chunks of a round."""

BODIES_A_WORKER = 128
"""Minimum number of bodies per worker: 1000 boxes are slower on 15 cores than on 8, 4096 boxes are faster."""

WORTH_SHARING = 1.0e-4
"""Duration above which a part is shared [s]: handing it to other threads takes up to half as long."""


def useful_workers(cores: int, bodies: int) -> int:
    """Number of workers for an environment of so many bodies."""
    return min(cores, MOST_WORKERS, max(1, bodies // BODIES_A_WORKER))


class SharedPart:
    """A part of the step that several threads replay at the same time.

    Args:
        graph: its launches.
        is_open: whether work is left.
        workers: number of threads.
    """

    def __init__(self, graph: Any, is_open: Callable[[], bool], workers: int) -> None:
        """Share it when it is executed for the first time."""
        self._graph, self._is_open, self._workers = graph, is_open, workers
        self._seconds = WORTH_SHARING

    def __call__(self) -> None:
        """Execute the part; on the current thread alone if it took a short time in the last step."""
        begin = time.perf_counter()
        if self._is_open():
            workers = self._workers if self._seconds >= WORTH_SHARING else 1
            spread(self._work, range(workers), workers)
        self._seconds = time.perf_counter() - begin

    def _work(self, _worker: int) -> None:
        """Replay the graph until no work is left; yield the core to threads that have not finished theirs."""
        wp.capture_launch(self._graph)
        while self._is_open():
            time.sleep(0.0)
            wp.capture_launch(self._graph)


class StepParts:
    """Records the parts of the step, and executes them.

    Args:
        device: the Warp device.
        workers: number of threads that execute a shared part; with one of them, and on a GPU, nothing is shared.

    Attributes:
        in_shared_part: whether the launches are those of a shared part.
    """

    def __init__(self, device: Any, workers: int) -> None:
        """Record nothing yet."""
        self._device, self._workers = device, 1 if device.is_cuda else workers
        self._chunks = 1 if self._workers == 1 else self._workers * CHUNKS_A_WORKER
        self._tickets: Any = declare.allocate(sharing.Tickets, {}, device)
        self._launches = 0
        self._parts: list[Callable[[], None]] = []
        self._recording = self.in_shared_part = False

    def replay(self) -> None:
        """Execute all parts in their order."""
        for part in self._parts:
            part()

    @contextmanager
    def recorded(self) -> Iterator[None]:
        """Context in which launches are recorded instead of executed."""
        self._begin()
        try:
            yield
        finally:
            graph = self._end()
        self._parts.append(partial(wp.capture_launch, graph))

    @contextmanager
    def shared(self, again: wp.array | None = None) -> Iterator[None]:
        """Context of launches whose rows workers share.

        Args:
            again: is 1 until all work is done; without it, each launch is executed once.
        """
        self._launches = 0
        if self._workers > 1 or (again is not None and not self._device.is_cuda):
            self._tickets.claimed.zero_()
            self._tickets.finished.zero_()
        alone = self._workers == 1 or not self._recording
        if not alone:
            self._parts.append(partial(wp.capture_launch, self._end()))
            self._begin()
        self.in_shared_part = True
        yield
        self.in_shared_part = False
        if alone:
            return
        self._parts.append(SharedPart(self._end(), self._is_open(again), self._workers))
        self._begin()

    def sharing(self, threads: int) -> Any:
        """How the rows of the next launch in a shared part are shared: by so many threads or teams of a GPU."""
        assert self._device.is_cuda or self._launches < sharing.MOST_LAUNCHES
        made: Any = sharing.Sharing()
        made.count, made.launch = threads if self._device.is_cuda else self._chunks, self._launches
        made.tickets = self._tickets
        self._launches += 1
        return made

    def _is_open(self, again: wp.array | None) -> Callable[[], bool]:
        """Return a function that reads whether work is left in a part; the arrays share their memory with NumPy."""
        if again is not None:
            flag = again.numpy()
            return lambda: bool(flag[0])
        finished, last, chunks = self._tickets.finished.numpy(), self._launches - 1, self._chunks
        return lambda: bool(finished[last] < chunks)

    def _begin(self) -> None:
        wp.capture_begin(self._device, force_module_load=False)
        self._recording = True

    def _end(self) -> Any:
        self._recording = False
        return wp.capture_end(self._device)
