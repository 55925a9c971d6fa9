"""Sweeps on several machines through Dask distributed. Each worker is one process with one device."""

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import warp as wp

from warp_rigid.engine.cores import shared_by
from warp_rigid.runs.user_code import errors_of, module_of_file
from warp_rigid.sweep.batch_run import Batch, failed_batch, run_batch
from warp_rigid.sweep.batch_size import SizedRun, free_memory, max_environments, split_into_batches
from warp_rigid.sweep.design import Run
from warp_rigid.sweep.job import Job
from warp_rigid.warp_start import start_warp

__all__ = ["cluster_of_file", "run_on_cluster"]


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
        memory, most = client.submit(_worker_capacity, job, hosts, pure=False).result()
        parts = split_into_batches(groups, batch, most, memory, hosts.total())
        job = replace(job, scenes={})
        futures = {client.submit(_run_on_worker, job, part, hosts, pure=False): part for part in parts}
        for future in as_completed(futures):
            part = futures.pop(future)
            error = future.exception()
            yield part, future.result() if error is None else failed_batch(part, error)
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
        except OSError as error:
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


def _on_this_worker(job: Job) -> Job:
    """The job with the device of this worker.

    The device is that of the job if set. Otherwise worker number i of a cluster on one host uses CUDA device i modulo
    their count, and any other worker the first visible CUDA device or the CPU.
    """
    from distributed import get_worker

    start_warp()
    gpus = wp.get_cuda_device_count()
    name = str(get_worker().name)
    if job.device is None and gpus > 1 and name.isdigit():
        return replace(job, device=f"cuda:{int(name) % gpus}")
    return replace(job, device=job.device or ("cuda:0" if gpus else "cpu"))


def _shared_cores(hosts: Counter[str]) -> Any:
    """Context in which the workers of a host share its cores."""
    from distributed import get_worker

    return shared_by(max(1, hosts[get_worker().ip]))


def _worker_capacity(job: Job, hosts: Counter[str]) -> tuple[int, int]:
    """Free memory of the worker's device [bytes], and the maximum number of environments of a batch."""
    device = _on_this_worker(job).device
    with _shared_cores(hosts):
        return free_memory(device), max_environments(device)


def _run_on_worker(job: Job, runs: list[Run], hosts: Counter[str]) -> Batch:
    """Run a batch on a worker."""
    with _shared_cores(hosts):
        return run_batch(_on_this_worker(job), runs)
