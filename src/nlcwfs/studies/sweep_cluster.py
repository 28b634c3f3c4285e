"""Where the points of a sweep are computed: processes of this machine, or workers behind a scheduler of dask."""

import logging
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import dask.config
from dask.system import CPU_COUNT
from distributed import Client, LocalCluster
from distributed.comm.addressing import resolve_address
from distributed.utils import silence_logging_cmgr

from nlcwfs.errors import NlcwfsError
from nlcwfs.studies.sweep_worker import SweepWorker

CONNECT_S = 10
"""Patience for a scheduler to answer."""

ON_A_LONG_LEASH = {
    # What JAX holds cannot be put on disk, and a worker that is paused for its memory would never go on.
    "distributed.worker.memory.target": False,
    "distributed.worker.memory.spill": False,
    "distributed.worker.memory.pause": False,
    # A worker that dies takes down what it computes, and no other point that waits there.
    "distributed.scheduler.worker-saturation": 1.0,
    # Compiling takes a minute in which Python does not answer: no reason to warn.
    "distributed.admin.tick.limit": "1 h",
}


class ClusterError(NlcwfsError):
    """There is nobody to compute."""


@contextmanager
def local_cluster(workers: int) -> Iterator[Client]:
    """Processes of this machine, each with one thread; one that dies is started again."""
    with dask.config.set(ON_A_LONG_LEASH), warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Port .* is already in use")
        cluster = LocalCluster(n_workers=workers, threads_per_worker=1, processes=True, silence_logs=logging.CRITICAL)
    with cluster, Client(cluster) as client:
        client.register_plugin(SweepWorker(deaf=True))
        yield client


@contextmanager
def connected(address: str, *, wait_s: float, tell: Callable[[str], None]) -> Iterator[Client]:
    """The workers behind a scheduler.

    Args:
        address: Such as `tcp://host:8786`.
        wait_s: Patience for the first worker.
        tell: Hears what the user should know.

    Raises:
        ClusterError: If the scheduler does not answer, no worker comes, or one cannot import what it needs.
    """
    try:
        resolve_address(address)  # a client would say so twenty seconds later
        client = Client(address, timeout=CONNECT_S)
    except (OSError, ValueError, OverflowError) as error:
        reason = " ".join(str(error).split())[:200]
        raise ClusterError(
            f"--scheduler: must be the address of a running scheduler, got {address}: {reason}"
        ) from None
    with silence_logging_cmgr(logging.CRITICAL), client:
        try:
            client.register_plugin(SweepWorker())
        except Exception as error:  # whatever stops a worker or a scheduler from importing nlcwfs
            raise ClusterError(f"{address}: every worker must have this nlcwfs installed, got {error}") from None
        if not _workers(client):
            tell(f"No worker is at {address} yet; start some: dask worker {address} --nthreads 1 --nworkers auto")
            try:
                client.wait_for_workers(1, timeout=wait_s)
            except TimeoutError:
                raise ClusterError(f"{address}: must have a worker, got none within {wait_s:g} s (--wait)") from None
        threads = max(worker["nthreads"] for worker in _workers(client).values())
        if threads > 1:
            tell(f"A worker has {threads} threads and uses one: start workers with --nthreads 1 --nworkers auto")
        yield client


def cores() -> int:
    """Cores that this process may use.

    Examples:
        >>> cores() >= 1
        True
    """
    return int(CPU_COUNT)


def _workers(client: Client) -> dict:
    return client.scheduler_info()["workers"]
