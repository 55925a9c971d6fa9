"""Sweeps on several machines through Dask distributed. Each worker is one process with one device."""

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from warp_rigid.engine.cores import shared_by
from warp_rigid.runs.user_code import errors_of, module_of_file
from warp_rigid.sweep.batch_run import Batch, failed_batch, run_batch
from warp_rigid.sweep.batch_size import SizedRun, split_into_batches
from warp_rigid.sweep.design import Run
from warp_rigid.sweep.job import Job
from warp_rigid.sweep.worker_processes import capacity_of, device_of
from warp_rigid.warp_start import start_warp


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
