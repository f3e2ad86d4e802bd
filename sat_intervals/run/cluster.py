"""Clusters of dask: processes of this machine, a scheduler, or jobs of a batch system; see `workers` for threads."""

import logging
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import dask
from distributed import Client, LocalCluster, Worker, WorkerPlugin
from distributed.utils import silence_logging_cmgr

from sat_intervals.config import Cluster
from sat_intervals.errors import RunError, SatIntervalsError
from sat_intervals.machine import usable_cores
from sat_intervals.run.batch_system import batch_system
from sat_intervals.run.workers import readers, reason

STARTING = 120.0  # seconds for local worker processes to start
DASK = {
    "distributed.scheduler.allowed-failures": 3,  # deaths of workers that a task survives
    "distributed.scheduler.worker-ttl": "5 minutes",  # a stopped worker's tasks then go to others
    # What dask watches of itself, for dashboards. By default it takes 2 % of a core in each process.
    "distributed.admin.tick.interval": "1s",
    "distributed.worker.profile.enabled": False,
}

_LOG = logging.getLogger(__name__)


@contextmanager
def connected(settings: Cluster, out: Path) -> Iterator[Client]:
    """Connect a client to the cluster of the settings; close it, and what it started, at the end."""
    with dask.config.set(DASK), _client(settings, out) as client:
        _LOG.info("connected to %s", client)
        if settings.kind == "processes":
            client.register_plugin(_NoInterrupt())
        if settings.kind != "address" and logging.getLogger("sat_intervals").isEnabledFor(logging.DEBUG):
            client.register_plugin(_DebugLog())
            for name in ("sat_intervals", "distributed"):
                client.forward_logging(name)
        yield client
    _LOG.info("disconnected")


class _NoInterrupt(WorkerPlugin):
    """A terminal sends Ctrl-C to all processes, but only the main one reacts: it closes the others."""

    def setup(self, worker: Worker) -> None:
        signal.signal(signal.SIGINT, signal.SIG_IGN)


class _DebugLog(WorkerPlugin):
    """Workers log everything for ``--debug``."""

    def setup(self, worker: Worker) -> None:
        logging.getLogger("sat_intervals").setLevel(logging.DEBUG)


@contextmanager
def _client(settings: Cluster, out: Path) -> Iterator[Client]:
    if settings.kind == "address":
        with silence_logging_cmgr(logging.CRITICAL), _client_of(str(settings.address)) as client:
            yield client
    elif settings.kind == "processes":
        workers = settings.workers or usable_cores()
        with _local(workers, 1 + readers(settings)) as cluster, Client(cluster) as client:
            cluster.adapt(minimum=workers, maximum=workers)  # replaces those that are killed as they start
            yield client
    else:
        with batch_system(settings, out / "logs") as cluster, Client(cluster) as client:
            # Adapting, unlike scaling, resubmits jobs that end before the run, even between equal bounds.
            cluster.adapt(minimum_jobs=settings.jobs, maximum_jobs=settings.maximum_jobs or settings.jobs)
            yield client


def _client_of(address: str) -> Client:
    try:
        return Client(address)
    except (OSError, ValueError) as error:
        why = getattr(error, "strerror", None) or error
        raise SatIntervalsError(f"no dask scheduler answers at {address}: {why}") from error


def _local(workers: int, threads: int) -> LocalCluster:
    try:
        return LocalCluster(
            n_workers=workers,
            threads_per_worker=threads,
            dashboard_address="127.0.0.1:0",
            worker_dashboard_address="127.0.0.1:0",
            silence_logs=logging.CRITICAL,
            death_timeout=STARTING,
        )
    except Exception as error:  # any error at the start, such as a full /dev/shm
        cause: BaseException = error
        while earlier := cause.__cause__ or cause.__context__:
            cause = earlier
        raise RunError(
            f"the {workers} worker processes did not start ({reason(cause)}): give "
            "fewer --workers, more room in /dev/shm or another DASK_TEMPORARY_DIRECTORY, or use --cluster threads"
        ) from error
