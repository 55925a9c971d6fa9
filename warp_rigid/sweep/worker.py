"""Worker process of a sweep: reads a job and its batches from standard input, and writes the results.

worker_processes.py starts it. What the user's code prints goes to standard error, as standard output carries the
results.
"""

import os
import pickle
import queue
import signal
import threading
from dataclasses import replace
from typing import IO, Any

import warp as wp

from warp_rigid.engine.cores import shared_by
from warp_rigid.engine.loading import OVERLAP, STEP, load_kernels
from warp_rigid.engine.teams import WARP
from warp_rigid.sweep.batch_run import run_batch
from warp_rigid.sweep.batch_size import free_memory, max_environments
from warp_rigid.sweep.job import Job

__all__ = ["framed", "main", "read_framed"]


def main(number: int, count: int) -> None:
    """Answer the job with the free memory and the largest useful batch, and each batch of runs with its result."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the process that started this one ends it
    wp.config.log_level = wp.LOG_WARNING
    inbox, outbox = _private_streams()
    messages: queue.SimpleQueue = queue.SimpleQueue()
    threading.Thread(target=_receive, args=(inbox, messages), daemon=True).start()
    with shared_by(count):
        device = _device_of_worker(None, number)
        load_kernels(wp.get_device(device), [*STEP, *OVERLAP], [WARP])
        answer: Any
        job: Any = None
        while True:
            message = messages.get()
            if isinstance(message, Job):
                job = replace(message, device=_device_of_worker(message.device, number))
                answer = free_memory(job.device), max_environments(job.device)
            elif isinstance(message, Exception):
                answer = message
            else:
                answer = run_batch(job, message)
            outbox.write(framed(pickle.dumps(answer, protocol=5)))
            outbox.flush()


def _device_of_worker(device: Any, number: int) -> Any:
    """The device that was asked for, else one of the CUDA devices in turn, else the CPU."""
    gpus = wp.get_cuda_device_count()
    return device or (f"cuda:{number % gpus}" if gpus else "cpu")


def framed(message: bytes) -> bytes:
    """A message with its length before it."""
    return len(message).to_bytes(8, "little") + message


def read_framed(stream: IO[bytes]) -> bytes:
    """The next message of a stream.

    Raises:
        EOFError: the stream has ended.
    """
    length = stream.read(8)
    message = stream.read(int.from_bytes(length, "little")) if len(length) == 8 else b""
    if not message or len(message) < int.from_bytes(length, "little"):
        raise EOFError
    return message


def _private_streams() -> tuple[IO[bytes], IO[bytes]]:
    """The standard streams, which the user's code no longer sees."""
    inbox, outbox = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb")
    with open(os.devnull, "rb") as nothing:
        os.dup2(nothing.fileno(), 0)
    os.dup2(2, 1)
    return inbox, outbox


def _receive(inbox: IO[bytes], messages: Any) -> None:
    """Pass on the messages. The process ends at once when the other one is gone, also within a batch."""
    while True:
        try:
            message = read_framed(inbox)
        except (EOFError, OSError):
            os._exit(0)
        try:
            messages.put(pickle.loads(message))
        except Exception as error:  # such as a class of the user that cannot be imported here
            messages.put(error)
