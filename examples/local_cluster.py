"""A Dask cluster for `warp-rigid sweep --cluster examples/local_cluster.py`: one worker process per core.

On several machines return a cluster of theirs instead, such as a `SLURMCluster` of dask-jobqueue or a `KubeCluster` of
dask-kubernetes, with one worker of one thread per GPU, or per machine without GPUs.
"""

import distributed

from warp_rigid.engine.cores import usable_cores


def cluster():
    """Start the workers; they share the cores of this machine."""
    return distributed.LocalCluster(n_workers=usable_cores(), threads_per_worker=1, dashboard_address="127.0.0.1:0")
