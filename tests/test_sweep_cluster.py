"""Sweeps on worker processes: the same rows, also when a worker is killed."""

import os
import signal
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
from warp_rigid.sweep.cluster import cluster_of_file

AXES = {"height": [0.1 + 0.05 * i for i in range(12)]}
OPTIONS = {"duration": 1.0, "metrics": ["final_pose", "drift"]}


def test_rows_are_the_same_when_a_worker_is_killed(tmp_path, monkeypatch):
    made, killed = [], []
    monkeypatch.setattr(distributed, "LocalCluster", lambda **options: made.append(LocalCluster(**options)) or made[0])

    def kill_one(done, total):
        if not killed:
            nanny = next(iter(made[0].workers.values()))
            killed.append(nanny.pid)
            os.kill(nanny.pid, signal.SIGKILL)

    result = quick(
        AXES, batch=2, cluster="local", workers=2, on_progress=kill_one, output=tmp_path / "t.parquet",
        trajectories=tmp_path / "t.zarr", **OPTIONS,
    )  # fmt: skip
    assert killed and not result.failed
    alone = values(quick(AXES, **OPTIONS))
    assert [{name: row[name] for name in alone[0]} for row in values(result)] == alone


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
    with pytest.raises(ValueError, match="workers: applies to the local cluster"):
        wr.sweep(ball, AXES, cluster="tcp://127.0.0.1:1", workers=2)
    with pytest.raises(FileNotFoundError):
        cluster_of_file(str(tmp_path / "none.py"))
    (tmp_path / "hook.py").write_text("def cluster():\n    return 'tcp://somewhere:8786'\n")
    assert cluster_of_file(str(tmp_path / "hook.py")) == "tcp://somewhere:8786"
    (tmp_path / "hook.py").write_text("")
    with pytest.raises(ValueError, match="has no function cluster"):
        cluster_of_file(str(tmp_path / "hook.py"))


def test_all_devices_are_a_worker_for_each_gpu(monkeypatch):
    """Here two GPUs are only counted; each worker simulates on the CPU, as it finds none."""
    given = []

    def on_cluster(job, groups, batch, cluster, workers, run=execution.run_on_cluster):
        given.append((cluster, workers, job.device))
        return run(job, groups, batch, cluster, workers)

    monkeypatch.setattr(execution, "run_on_cluster", on_cluster)
    alone = values(quick(AXES, device="all", **OPTIONS))
    assert not given
    monkeypatch.setattr(execution.wp, "get_cuda_device_count", lambda: 2)
    result = quick(AXES, device="all", observe=["peak_impulse[ball]"], series=["energy"], **OPTIONS)
    assert given == [("local", 2, None)] and not result.failed
    assert [{name: row[name] for name in alone[0]} for row in values(result)] == alone
    assert set(result.series()["run"].to_pylist()) == set(range(12))
    with pytest.raises(ValueError, match="^device: all must not be combined with cluster or workers"):
        quick(AXES, device="all", workers=2)
