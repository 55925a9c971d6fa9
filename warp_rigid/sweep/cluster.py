"""Sweeps on several devices or machines, through Dask distributed: one worker is one process with one device."""

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import warp as wp

from warp_rigid.checks import whole_in
from warp_rigid.engine.cores import shared_by
from warp_rigid.runs.runner import module_of_file
from warp_rigid.scene.scene import Scene
from warp_rigid.sweep.batch import Batch, failed_batch, run_batch
from warp_rigid.sweep.design import Run
from warp_rigid.sweep.job import Job
from warp_rigid.sweep.memory import memory_at_hand, most_environments, split_into_batches

__all__ = ["cluster_of_file", "run_on_cluster"]

WORKERS_WITHOUT_GPU = 2


def run_on_cluster(
    job: Job, groups: list[tuple[Scene, list[Run]]], batch: int | str, cluster: Any, workers: int | None
) -> Iterator[tuple[list[Run], Batch]]:
    """Runs and what they gave, in the order in which the workers are done.

    A batch whose worker is lost is run again on another. One that takes several workers with it becomes rows with
    that reason.

    Args:
        job: what the runs share.
        groups: runs by what can share a simulator.
        batch: most environments at once, or "auto".
        cluster: "local", a scheduler's address, a Dask cluster or client, or a function that returns one.
        workers: processes of "local".
    """
    from distributed import as_completed

    with _client(cluster, workers) as client:
        client.wait_for_workers(1)
        hosts = _one_task_a_worker(client)
        memory, limits = client.submit(_room, job, [scene for scene, _ in groups], hosts, pure=False).result()
        room = {id(scene): limit for (scene, _), limit in zip(groups, limits, strict=True)}
        parts = split_into_batches(groups, batch, lambda scene: room[id(scene)], memory, hosts.total())
        job = replace(job, scenes={})
        futures = {client.submit(_work, job, part, hosts, pure=False): part for part in parts}
        for future in as_completed(futures):
            part = futures.pop(future)
            error = future.exception()
            yield part, future.result() if error is None else failed_batch(part, error)
            future.release()


def cluster_of_file(path: str) -> Any:
    """What the function cluster() of a .py file returns: a Dask cluster or client, for SLURM, Kubernetes and the like.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It has no function cluster().
    """
    function = getattr(module_of_file(Path(path)), "cluster", None)
    if not callable(function):
        raise ValueError(f"{path}: has no function cluster()")
    return function()


@contextmanager
def _client(cluster: Any, workers: int | None) -> Iterator[Any]:
    """A client of the cluster; what was started here is stopped here."""
    from distributed import Client, LocalCluster

    if workers is not None:
        whole_in("workers", workers, 1, 4096)
        if cluster != "local":
            raise ValueError("workers: is for the local cluster; another one has its own")
    if callable(cluster) and not isinstance(cluster, Client):
        cluster = cluster()
    if isinstance(cluster, Client):
        yield cluster
    elif cluster == "local":
        count = workers or wp.get_cuda_device_count() or WORKERS_WITHOUT_GPU
        with (
            LocalCluster(
                n_workers=count, threads_per_worker=1, processes=True, dashboard_address="127.0.0.1:0", memory_limit=0
            ) as made,
            Client(made) as client,
        ):
            yield client
    else:
        try:
            client = Client(cluster, timeout="30s")
        except OSError as error:
            raise ValueError(f"cluster: {cluster} does not answer ({error})") from None
        with client:
            yield client


def _one_task_a_worker(client: Any) -> Counter[str]:
    """Number of workers on each host, each of which must do one thing at a time.

    Raises:
        ValueError: A worker has several threads.
    """
    workers = client.scheduler_info(n_workers=-1)["workers"]
    if any(worker["nthreads"] != 1 for worker in workers.values()):
        raise ValueError("cluster: every worker must have one thread; start it with --nthreads 1")
    return Counter(worker["host"] for worker in workers.values())


def _here(job: Job) -> Job:
    """The job on this worker's device.

    A worker is given its device by the job, by CUDA_VISIBLE_DEVICES, or else by its number on this machine, as the
    workers of a local cluster have it.
    """
    from distributed import get_worker

    wp.config.log_level = wp.LOG_WARNING
    gpus = wp.get_cuda_device_count()
    name = str(get_worker().name)
    if job.device is None and gpus > 1 and name.isdigit():
        return replace(job, device=f"cuda:{int(name) % gpus}")
    return replace(job, device=job.device or ("cuda:0" if gpus else "cpu"))


def _own_cores(hosts: Counter[str]) -> Any:
    """Within it, the workers of a host share its cores."""
    from distributed import get_worker

    return shared_by(max(1, hosts[get_worker().ip]))


def _room(job: Job, scenes: list[Scene], hosts: Counter[str]) -> tuple[int, list[int]]:
    """Free memory of the worker's device [bytes], and the largest batch of each scene on it."""
    device = _here(job).device
    with _own_cores(hosts):
        return memory_at_hand(device), [most_environments(scene, device) for scene in scenes]


def _work(job: Job, runs: list[Run], hosts: Counter[str]) -> Batch:
    """Run a batch on a worker."""
    with _own_cores(hosts):
        return run_batch(_here(job), runs)
