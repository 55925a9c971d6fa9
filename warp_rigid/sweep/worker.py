"""What a worker process of a sweep does; worker_processes.py starts it and calls these functions in it."""

import os
import signal
import threading
import time
from dataclasses import replace
from typing import Any

import warp as wp

from warp_rigid.engine.cores import shared_by
from warp_rigid.engine.loading import OVERLAP, STEP, load_kernels
from warp_rigid.engine.teams import WARP
from warp_rigid.sweep.batch_run import Batch, run_batch
from warp_rigid.sweep.batch_size import free_memory, max_environments
from warp_rigid.sweep.design import Run
from warp_rigid.sweep.job import Job

__all__ = ["accept", "begin", "run"]

PARENT_PERIOD = 1.0
"""Time between checks whether the process that started this one still exists [s]."""

_number = 0
_sharers = 1
_job: Any = None


def begin(number: int, count: int) -> None:
    """Load the kernels that every batch needs, as worker `number` of `count`."""
    global _number, _sharers
    _number, _sharers = number, count
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the process that started this one ends it
    threading.Thread(target=_end_with_parent, args=(os.getppid(),), daemon=True).start()
    wp.config.log_level = wp.LOG_WARNING
    with shared_by(count):
        load_kernels(wp.get_device(_device(None)), [*STEP, *OVERLAP], [WARP])


def accept(job: Job) -> tuple[int, int]:
    """Keep the job for the batches that follow.

    Returns:
        The largest useful batch, and the free memory of the device [bytes].
    """
    global _job
    _job = replace(job, device=_device(job.device))
    with shared_by(_sharers):
        return max_environments(_job.device), free_memory(_job.device)


def run(part: list[Run]) -> Batch:
    """Run a batch of the job."""
    with shared_by(_sharers):
        return run_batch(_job, part)


def _device(given: Any) -> Any:
    """The device that was asked for, else one of the CUDA devices in turn, else the CPU."""
    gpus = wp.get_cuda_device_count()
    return given or (f"cuda:{_number % gpus}" if gpus else "cpu")


def _end_with_parent(parent: int) -> None:
    """End this process when the one that started it is gone, also within a batch."""
    while os.getppid() == parent:
        time.sleep(PARENT_PERIOD)
    os._exit(1)
