"""Sweeps on worker processes of this machine, each with one device, or with its share of the cores of a CPU."""

import os
import pickle
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import replace
from queue import SimpleQueue
from typing import Any

import warp as wp

from warp_rigid.sweep.batch_run import Batch, failed_batch
from warp_rigid.sweep.design import Run
from warp_rigid.sweep.job import Job
from warp_rigid.sweep.worker import framed, read_framed

__all__ = ["MAX_WORKERS", "WorkerProcesses"]

WORKERS_WITHOUT_GPU = 2

MAX_WORKERS = 4096

TRIES = 3
"""Number of processes that a batch may end before its runs count as failed."""


class WorkerLost(Exception):
    """A worker process ended within a batch."""


class WorkerProcess:
    """A process that runs `worker.main`, which loads the kernels while this process checks the design.

    Args:
        number: of the worker.
        count: of all workers.
    """

    def __init__(self, number: int, count: int) -> None:
        """Start the process; it imports from the same places as this one."""
        path = os.pathsep.join(entry or os.getcwd() for entry in sys.path)
        self.process = subprocess.Popen(
            [sys.executable, "-c", f"from warp_rigid.sweep.worker import main; main({number}, {count})"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=os.environ | {"PYTHONPATH": path},
        )

    def ask(self, message: bytes) -> Any:
        """Send a pickled message and wait for the answer.

        Raises:
            WorkerLost: the process has ended.
            ValueError: it cannot read the message.
        """
        assert self.process.stdin is not None and self.process.stdout is not None
        try:
            self.process.stdin.write(framed(message))
            self.process.stdin.flush()
            answer = pickle.loads(read_framed(self.process.stdout))
        except (EOFError, OSError):
            raise WorkerLost(f"the worker process ended with exit status {self.process.wait()}") from None
        if isinstance(answer, Exception):
            raise ValueError(f"cluster: a worker process cannot read the job ({type(answer).__name__}: {answer})")
        return answer

    def end(self) -> None:
        """End the process, also within a batch."""
        self.process.kill()
        self.process.wait()
        for stream in (self.process.stdin, self.process.stdout):
            if stream is not None:
                stream.close()


class WorkerProcesses:
    """Worker processes of this machine, which end with the context.

    Args:
        count: number of processes; None for one per GPU, or two without a GPU.
    """

    def __init__(self, count: int | None) -> None:
        """Start the processes."""
        self.count = (wp.get_cuda_device_count() or WORKERS_WITHOUT_GPU) if count is None else count
        self._workers = [WorkerProcess(number, self.count) for number in range(self.count)]
        self._idle: SimpleQueue[int] = SimpleQueue()
        self._ended = False
        for number in range(self.count):
            self._idle.put(number)

    def __enter__(self) -> "WorkerProcesses":
        """Use the processes."""
        return self

    def __exit__(self, *_: Any) -> None:
        """End the processes."""
        self._ended = True
        for worker in self._workers:
            worker.end()

    def start(self, job: Job) -> tuple[int, int]:
        """Wait for the processes and send them the job.

        Returns:
            The largest useful batch, and the free memory of a worker's device [bytes].
        """
        self._job = _pickled(replace(job, scenes={}))
        memory, most = [worker.ask(self._job) for worker in self._workers][0]
        return most, memory

    def run(self, parts: list[list[Run]]) -> Iterator[tuple[list[Run], Batch]]:
        """Yield the runs of each batch with their results, in order of completion.

        A batch whose process ends is repeated in a new one. A batch that ends several processes becomes failed rows.
        """
        running: dict[Future, list[Run]] = {}
        with ThreadPoolExecutor(self.count) as threads:
            try:
                # One batch a worker waits, so that none is idle while results are stored, and few are kept.
                for part in parts:
                    running[threads.submit(self._run_batch, part)] = part
                    if len(running) == 2 * self.count:
                        yield from self._finished(running)
                while running:
                    yield from self._finished(running)
            except BaseException:
                self.__exit__()
                threads.shutdown(wait=False, cancel_futures=True)
                raise

    def _finished(self, running: dict[Future, list[Run]]) -> Iterator[tuple[list[Run], Batch]]:
        """Wait for at least one result."""
        for future in wait(running, return_when=FIRST_COMPLETED).done:
            yield running.pop(future), future.result()

    def _run_batch(self, part: list[Run]) -> Batch:
        """Run a batch in an idle process."""
        number = self._idle.get()
        try:
            for tried in range(1, TRIES + 1):
                try:
                    return self._workers[number].ask(_pickled(part))
                except WorkerLost as error:
                    if self._ended or tried == TRIES:
                        return failed_batch(part, error)
                    self._restart(number)
            raise AssertionError
        finally:
            self._idle.put(number)

    def _restart(self, number: int) -> None:
        """Replace a process that has ended."""
        self._workers[number].end()
        self._workers[number] = WorkerProcess(number, self.count)
        self._workers[number].ask(self._job)


def _pickled(value: Any) -> bytes:
    """Any value as bytes, also functions of a script or a notebook."""
    import cloudpickle

    return cloudpickle.dumps(value, protocol=5)
