"""What a worker process of a sweep does; worker_processes.py starts it and calls these functions in it."""

import os
import signal
import threading
import time
from dataclasses import replace
from typing import Any

import numpy as np
import warp as wp

from warp_rigid.engine.cores import shared_by
from warp_rigid.engine.loading import OVERLAP, STEP, load_kernels
from warp_rigid.engine.teams import WARP
from warp_rigid.sweep.batch_run import Batch, run_batch
from warp_rigid.sweep.batch_size import free_memory, max_environments
from warp_rigid.sweep.design import Run
from warp_rigid.sweep.job import Job
from warp_rigid.warp_start import start_warp

PARENT_PERIOD = 1.0
"""Time between checks whether the process that started this one still exists [s]."""

_number = 0
_sharers = 1
_job: Any = None
_parts: Any = None


def begin(number: int, count: int, parts: str) -> None:
    """Load the kernels that every batch needs, as worker `number` of `count`; `parts` is the file of open_parts."""
    global _number, _sharers, _parts
    _number, _sharers, _parts = number, count, open_parts(parts, count)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the process that started this one ends it
    threading.Thread(target=_end_with_parent, args=(os.getppid(),), daemon=True).start()
    start_warp()
    with shared_by(count):
        load_kernels(wp.get_device(device_of(None, number)), [*STEP, *OVERLAP], [WARP])


def accept(job: Job) -> tuple[int, int]:
    """Keep the job for the batches that follow.

    Returns:
        The largest useful batch, and the free memory of the device [bytes].
    """
    global _job
    _job = replace(job, device=device_of(job.device, _number))
    return capacity_of(_job.device, _sharers)


def run(part: list[Run]) -> Batch:
    """Run a batch of the job."""
    with shared_by(_sharers):
        return run_batch(_job, part, _tell)


def open_parts(path: str, count: int) -> np.memmap:
    """The file in which each worker tells which part of its batch is done, (count,) float64, as a number of runs."""
    return np.memmap(path, np.float64, "r+", shape=(count,))


def _tell(done: float) -> None:
    _parts[_number] = done


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
