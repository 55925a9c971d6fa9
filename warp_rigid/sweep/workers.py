"""Sweeps on several processes: of this machine, or of several machines through Dask distributed.

Each worker is one process with one device, or with its share of the cores of a CPU.
"""

import os
import signal
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, wait
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from warp_rigid.checks import shown
from warp_rigid.engine.cores import shared_by
from warp_rigid.engine.loading import OVERLAP, STEP, load_kernels
from warp_rigid.engine.teams import WARP
from warp_rigid.runs.user_code import errors_of, module_of_file
from warp_rigid.sweep.batch_run import Batch, failed_batch, run_batch
from warp_rigid.sweep.batch_size import SizedRun, free_memory, max_environments, split_into_batches
from warp_rigid.sweep.design import Run
from warp_rigid.sweep.job import Job
from warp_rigid.warp_start import start_warp

WORKERS_WITHOUT_GPU = 2

MAX_WORKERS = 4096

DONE_PERIOD = 0.25
"""Time between looks at what is done of the running batches [s]."""

TRIES = 2
"""Number of processes that a batch may end before its runs count as failed."""

PARENT_PERIOD = 1.0
"""Time between looks of a worker whether the process that started it still exists [s]."""

# The state of a worker.
_number = 0
_sharers = 1
_job: Any = None
_done: Any = None


class WorkerProcesses:
    """Worker processes, which start at once, load the kernels, and end with the context.

    Args:
        count: number of processes; None for one per GPU, or two without a GPU.

    Attributes:
        count: number of processes.
    """

    def __init__(self, count: int | None) -> None:
        """Start the processes."""
        start_warp()
        self.count = (wp.get_cuda_device_count() or WORKERS_WITHOUT_GPU) if count is None else count
        self._job: Job | None = None
        self._file = tempfile.NamedTemporaryFile()
        self._file.truncate(np.float64().nbytes * self.count)
        self._done = _open_done(self._file.name, self.count)
        self._workers = [self._started(number) for number in range(self.count)]

    def __enter__(self) -> "WorkerProcesses":
        """Use the processes."""
        return self

    def __exit__(self, *_: Any) -> None:
        """End the processes, also within a batch."""
        for executor in self._workers:
            executor.shutdown(kill_workers=True)
        self._file.close()

    def start(self, job: Job) -> tuple[int, int]:
        """Send the job to all processes.

        Returns:
            The largest useful batch, and the free memory of a worker's device [bytes].

        Raises:
            ValueError: The job cannot be sent, or a process cannot begin.
        """
        self._job = replace(job, scenes={})
        accepted = [some.submit(_accept, self._job) for some in self._workers]
        try:
            return [future.result() for future in accepted][0]
        except Exception as error:
            reason = " ".join(f"{type(error).__name__}: {error}".split())
            raise ValueError(f"cluster: the worker processes cannot take the job: {shown(reason)}") from error

    def run(
        self, batches: list[list[Run]], on_done: Callable[[float], object] = lambda done: None
    ) -> Iterator[tuple[list[Run], Batch]]:
        """Yield the runs of each batch with their results, in order of completion.

        A batch whose process ends is repeated in a new one. A batch that ends several processes becomes failed rows.

        Args:
            batches: the runs of each batch.
            on_done: called repeatedly with the finished part of the running batches, as a number of runs.
        """
        left = iter(batches)
        # For each batch that runs, its worker and how often it was started.
        running: dict[Future, tuple[list[Run], int, int]] = {}

        def submit(runs: list[Run] | None, number: int, tries: int = 1) -> None:
            if runs is not None:
                running[self._workers[number].submit(_run, runs)] = runs, number, tries

        for number in range(self.count):
            submit(next(left, None), number)
        while running:
            on_done(float(self._done.sum()))
            for future in wait(running, DONE_PERIOD, FIRST_COMPLETED).done:
                runs, number, tries = running.pop(future)
                self._done[number] = 0.0
                error = future.exception()
                if error is not None:
                    self._restart(number)
                if error is not None and tries < TRIES:
                    submit(runs, number, tries + 1)
                    continue
                submit(next(left, None), number)
                yield runs, future.result() if error is None else failed_batch(runs, error)

    def _started(self, number: int) -> Any:
        """An executor with one process, which begins at once."""
        from loky import ProcessPoolExecutor

        executor = ProcessPoolExecutor(1)
        executor.submit(_begin, number, self.count, self._file.name)
        return executor

    def _restart(self, number: int) -> None:
        """Replace a process that has ended."""
        self._workers[number].shutdown(kill_workers=True)
        self._workers[number] = self._started(number)
        self._workers[number].submit(_accept, self._job)


def _begin(number: int, count: int, done: str) -> None:
    """Load the kernels that every batch needs, as worker `number` of `count`; `done` is the file of _open_done."""
    global _number, _sharers, _done
    _number, _sharers, _done = number, count, _open_done(done, count)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the process that started this one ends it
    threading.Thread(target=_end_with_parent, args=(os.getppid(),), daemon=True).start()
    start_warp()
    with shared_by(count):
        load_kernels(wp.get_device(device_of(None, number)), [*STEP, *OVERLAP], [WARP])


def _accept(job: Job) -> tuple[int, int]:
    """Keep the job for the batches that follow.

    Returns:
        The largest useful batch, and the free memory of the device [bytes].
    """
    global _job
    _job = replace(job, device=device_of(job.device, _number))
    return capacity_of(_job.device, _sharers)


def _run(runs: list[Run]) -> Batch:
    """Run a batch of the job."""
    with shared_by(_sharers):
        return run_batch(_job, runs, _tell)


def _open_done(path: str, count: int) -> np.memmap:
    """The file in which each worker tells how much of its batch is done, (count,) float64, as a number of runs."""
    return np.memmap(path, np.float64, "r+", shape=(count,))


def _tell(done: float) -> None:
    _done[_number] = done


def capacity_of(device: Any, sharers: int) -> tuple[int, int]:
    """The largest useful batch, and the free memory [bytes] of a device; `sharers` processes share the cores."""
    with shared_by(sharers):
        return max_environments(device), free_memory(device)


def device_of(given: Any, number: int) -> Any:
    """The device that was asked for, else one of the CUDA devices by the number of the worker, else the CPU."""
    gpus = wp.get_cuda_device_count()
    return given or (f"cuda:{number % gpus}" if gpus else "cpu")


def _end_with_parent(parent: int) -> None:
    """End this process when the one that started it is gone, also within a batch."""
    while os.getppid() == parent:
        time.sleep(PARENT_PERIOD)
    os._exit(1)


def run_on_cluster(
    job: Job, groups: list[list[SizedRun]], batch: int | str, cluster: Any
) -> Iterator[tuple[list[Run], Batch]]:
    """Yield the runs of each batch with their results, in order of completion.

    A batch whose worker dies is retried on another worker. A batch that kills several workers becomes failed rows.

    Args:
        job: data shared by all runs.
        groups: runs grouped by time step, from group_runs.
        batch: maximum number of environments per batch, or "auto".
        cluster: the address of a scheduler, a Dask cluster or client, or a function that returns one.
    """
    from distributed import as_completed

    with _client(cluster) as client:
        client.wait_for_workers(1)
        hosts = _one_task_a_worker(client)
        most, memory = client.submit(_worker_capacity, job, hosts, pure=False).result()
        batches = split_into_batches(groups, batch, most, memory, hosts.total())
        job = replace(job, scenes={})
        futures = {client.submit(_run_on_worker, job, runs, hosts, pure=False): runs for runs in batches}
        for future in as_completed(futures):
            runs = futures.pop(future)
            error = future.exception()
            yield runs, future.result() if error is None else failed_batch(runs, error)
            future.release()


def cluster_of_file(path: str) -> Any:
    """Call the function cluster() of a .py file, which returns a Dask cluster or client (SLURM, Kubernetes, ...).

    Raises:
        FileNotFoundError: The file does not exist.
        ValueError: It has no function cluster().
    """
    function = getattr(module_of_file(Path(path)), "cluster", None)
    if not callable(function):
        raise ValueError(f"{path}: has no function cluster()")
    with errors_of(function):
        return function()


@contextmanager
def _client(cluster: Any) -> Iterator[Any]:
    """Connect to the cluster."""
    from distributed import Client

    if callable(cluster) and not isinstance(cluster, Client):
        cluster = cluster()
    if isinstance(cluster, Client):
        yield cluster
    else:
        try:
            client = Client(cluster, timeout="30s")
        except (OSError, ValueError) as error:
            raise ValueError(f"cluster: {cluster} does not answer ({error})") from None
        with client:
            yield client


def _one_task_a_worker(client: Any) -> Counter[str]:
    """Count the workers per host and check that each has one thread.

    Raises:
        ValueError: A worker has several threads.
    """
    workers = client.scheduler_info(n_workers=-1)["workers"]
    if any(worker["nthreads"] != 1 for worker in workers.values()):
        raise ValueError("cluster: every worker must have one thread; start it with --nthreads 1")
    return Counter(worker["host"] for worker in workers.values())


def _here(job: Job, hosts: Counter[str]) -> tuple[Job, int]:
    """The job with the device of this worker, and the number of workers that share the cores of its host.

    The device is that of the job if set. Otherwise worker number i of a cluster on one host uses CUDA device i modulo
    their count, and any other worker the first visible CUDA device or the CPU.
    """
    from distributed import get_worker

    start_warp()
    worker = get_worker()
    number = int(worker.name) if str(worker.name).isdigit() else 0
    return replace(job, device=device_of(job.device, number)), max(1, hosts[worker.ip])


def _worker_capacity(job: Job, hosts: Counter[str]) -> tuple[int, int]:
    """Maximum number of environments of a batch, and free memory of the worker's device [bytes]."""
    job, sharers = _here(job, hosts)
    return capacity_of(job.device, sharers)


def _run_on_worker(job: Job, runs: list[Run], hosts: Counter[str]) -> Batch:
    """Run a batch on a worker."""
    job, sharers = _here(job, hosts)
    with shared_by(sharers):
        return run_batch(job, runs)
