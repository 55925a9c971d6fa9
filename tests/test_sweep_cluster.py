"""Sweeps on worker processes: the same rows, also when a worker is killed."""

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import distributed
import numpy as np
import pytest
from distributed import LocalCluster

import warp_rigid as wr
from tests.test_sweep import ball, quick, values
from warp_rigid.commands import cli
from warp_rigid.engine.cores import usable_cores
from warp_rigid.sweep import execution, read
from warp_rigid.sweep.workers import WorkerProcesses, cluster_of_file

AXES = {"height": [0.1 + 0.05 * i for i in range(12)]}
OPTIONS = {"duration": 1.0, "metrics": ["final_pose", "drift"]}


def like(found, alone):
    """The rows of a result with the columns of others, whose order may differ."""
    return [{name: row[name] for name in alone[0]} for row in values(found)]


@pytest.mark.long
def test_rows_are_the_same_when_a_worker_of_a_cluster_is_killed(tmp_path):
    killed = []
    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address="127.0.0.1:0", memory_limit=0) as made:

        def kill_one(done, total):
            if not killed:
                killed.append(next(iter(made.workers.values())).pid)
                os.kill(killed[0], signal.SIGKILL)

        result = quick(
            AXES, batch=2, cluster=made, on_progress=kill_one, output=tmp_path / "t.parquet",
            trajectories=tmp_path / "t.zarr", **OPTIONS,
        )  # fmt: skip
    assert killed and not result.failed
    alone = values(quick(AXES, **OPTIONS))
    assert like(result, alone) == alone


@pytest.fixture
def started(monkeypatch):
    """The executors of the worker processes that are started."""
    executors = []

    def start(workers, number, start=WorkerProcesses._started):
        executors.append(start(workers, number))
        return executors[-1]

    monkeypatch.setattr(WorkerProcesses, "_started", start)
    return executors


@pytest.mark.long
def test_rows_are_the_same_when_a_worker_process_is_killed(tmp_path, started):
    killed = []

    def kill_one(done, total):
        if not killed:
            killed.extend(started[0]._processes)
            os.kill(killed[0], signal.SIGKILL)

    result = quick(
        AXES, batch=2, cluster="local", workers=2, on_progress=kill_one, output=tmp_path / "t.parquet",
        observe=["peak_impulse[ball]"], series=["energy"], trajectories=tmp_path / "t.zarr", **OPTIONS,
    )  # fmt: skip
    assert len(killed) == 1 and not result.failed and len(started) == 3
    alone = values(quick(AXES, observe=["peak_impulse[ball]"], series=["energy"], **OPTIONS))
    assert like(result, alone) == alone
    assert set(result.series()["run"].to_pylist()) == set(range(12))


@pytest.mark.long
def test_a_batch_that_ends_its_processes_fails_alone():
    def deadly(sim):
        if (sim.get("position")[:, 1, 2] > 0.6).any():
            os._exit(3)
        return sim.get("position")[:, 1, 2]

    found = quick({"height": [0.3, 1.0]}, batch=1, cluster="local", workers=1, duration=0.01, metrics=[deadly])
    assert [row["status"] for row in found.rows] == ["ok", "error"]
    assert found.failed[0]["reason"].startswith("TerminatedWorkerError: A worker process")


@pytest.mark.long
def test_worker_processes_end_when_a_sweep_is_stopped(started):
    processes = []

    def stop(done, total):
        processes.extend(process for some in started for process in some._processes.values())
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        quick(AXES, batch=1, cluster="local", workers=1, on_progress=stop, **OPTIONS)
    assert len(processes) == 1 and not any(process.is_alive() for process in processes)


@pytest.mark.long
def test_worker_processes_end_with_the_process_that_started_them():
    """Although it is killed in the middle of a batch of an hour."""
    program = """
import warp_rigid as wr
from warp_rigid.sweep.workers import WorkerProcesses
with WorkerProcesses(1) as workers:
    import os, signal, time
    print(workers._workers[0].submit(os.getpid).result(), flush=True)
    workers._workers[0].submit(time.sleep, 3600)
    time.sleep(0.2)
    os.kill(os.getpid(), signal.SIGKILL)
"""
    root = str(Path(__file__).resolve().parents[1])
    found = subprocess.run(
        [sys.executable, "-c", program], stdout=subprocess.PIPE, text=True, cwd=root, timeout=60, check=False
    )
    worker = Path("/proc") / found.stdout.strip()
    deadline = time.monotonic() + 20.0
    while worker.exists() and time.monotonic() < deadline:
        time.sleep(0.1)
    assert found.returncode == -signal.SIGKILL and not worker.exists()


def test_what_cannot_be_sent_to_a_worker_is_named():
    lock = threading.Lock()

    def locked(sim):
        with lock:
            return sim.get("mass")[:, 1]

    with pytest.raises(ValueError, match="^cluster: the worker processes cannot take the job: .*Pickl"):
        quick({"height": [0.3]}, cluster="local", workers=1, metrics=[locked])


def test_the_example_of_a_cluster_gives_the_same_rows(tmp_path, monkeypatch):
    made = []

    def in_threads(**options):
        made.append(LocalCluster(**options | {"processes": False, "n_workers": 1}))
        return made[-1]

    monkeypatch.setattr(distributed, "LocalCluster", in_threads)
    example, table = Path(__file__).resolve().parents[1] / "examples" / "local_cluster.py", tmp_path / "t.parquet"
    command = ["sweep", "leaning_tower", "--vary", "offset=0.05:0.45:4", "--duration", "0.1", "--metrics", "drift"]
    assert cli.main([*command, "--cluster", str(example), "-o", str(table)]) == 0
    made[0].close()
    alone = wr.sweep("leaning_tower", {"offset": np.linspace(0.05, 0.45, 4)}, duration=0.1, metrics=["drift"])
    assert [row["drift"] for row in read(table).rows] == [row["drift"] for row in alone.rows]


def test_what_fails_on_a_worker_is_a_row_with_its_reason():
    def cluster():
        return LocalCluster(n_workers=1, threads_per_worker=1, processes=False, dashboard_address="127.0.0.1:0")

    failed = quick({"height": [1.0]}, cluster=cluster, metrics=[lambda sim: [1, 2, 3]])
    assert "must return (1,)" in failed.rows[0]["reason"]


def test_workers_of_one_host_share_its_cores(monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(8)), raising=False)
    with LocalCluster(n_workers=3, threads_per_worker=1, processes=False, dashboard_address="127.0.0.1:0") as made:
        found = quick({"height": [1.0]}, cluster=made, metrics=[lambda sim: [usable_cores()]])
    assert [row["<lambda>"] for row in values(found)] == [2] and usable_cores() == 8


def test_workers_with_several_threads_are_refused():
    with (
        LocalCluster(n_workers=1, threads_per_worker=2, processes=False, dashboard_address="127.0.0.1:0") as made,
        pytest.raises(ValueError, match="every worker must have one thread"),
    ):
        quick(AXES, cluster=made)


def test_mistakes_are_named(tmp_path):
    with pytest.raises(ValueError, match="workers: applies to cluster local only"):
        wr.sweep(ball, AXES, cluster="tcp://127.0.0.1:1", workers=2)
    with pytest.raises(ValueError, match="^cluster: locl does not answer"):
        wr.sweep(ball, AXES, cluster="locl")
    with pytest.raises(FileNotFoundError):
        cluster_of_file(str(tmp_path / "none.py"))
    (tmp_path / "hook.py").write_text("def cluster():\n    return 'tcp://somewhere:8786'\n")
    assert cluster_of_file(str(tmp_path / "hook.py")) == "tcp://somewhere:8786"
    (tmp_path / "hook.py").write_text("")
    with pytest.raises(ValueError, match="has no function cluster"):
        cluster_of_file(str(tmp_path / "hook.py"))


@pytest.mark.long
def test_all_devices_are_a_worker_for_each_gpu(monkeypatch):
    """Here two GPUs are only counted; each worker simulates on the CPU, as it finds none."""
    counts = []

    def start(workers, count, start=WorkerProcesses.__init__):
        counts.append(count)
        start(workers, count)

    monkeypatch.setattr(WorkerProcesses, "__init__", start)
    alone = values(quick(AXES, device="all", **OPTIONS))
    assert not counts
    monkeypatch.setattr(execution.wp, "get_cuda_device_count", lambda: 2)
    result = quick(AXES, device="all", **OPTIONS)
    assert counts == [2] and not result.failed and like(result, alone) == alone
    with pytest.raises(ValueError, match="^device: all must not be combined with cluster or workers"):
        quick(AXES, device="all", workers=2)
