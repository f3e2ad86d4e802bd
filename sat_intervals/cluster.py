"""Where tiles are matched: threads or processes of this machine, a dask scheduler, or jobs of a batch system."""

import logging
import os
import signal
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from multiprocessing import resource_tracker
from typing import Any

import dask
from distributed import Client, LocalCluster
from distributed.utils import silence_logging_cmgr

from sat_intervals.config import Cluster
from sat_intervals.errors import SatIntervalsError

_LOOPBACK = "127.0.0.1"


def _is_news(record: logging.LogRecord) -> bool:
    """A wait that distributed forgets when it closes is none, and asyncio tells it on stderr."""
    error = record.exc_info[1] if record.exc_info else None
    return not (isinstance(error, TimeoutError) and "never retrieved" in record.getMessage())


logging.getLogger("asyncio").addFilter(_is_news)


@contextmanager
def connected(settings: Cluster) -> Iterator[Client]:
    """A client of the cluster that the settings name; closed, with what it started, at the end.

    Raises
    ------
    SatIntervalsError
        When a scheduler does not answer, or the extra for batch systems is not installed.
    """
    if settings.kind == "address":
        with silence_logging_cmgr(logging.CRITICAL), _client_of(settings.address) as client:
            yield client
    elif settings.kind in ("threads", "processes"):
        with ExitStack() as stack:
            with _undisturbed():
                client = stack.enter_context(Client(stack.enter_context(_local(settings))))
            yield client
            with _undisturbed():
                stack.close()
    else:
        with _batch_system(settings) as cluster, Client(cluster) as client:
            # Adapting, even between equal bounds, submits a job again that ended before the run did; scaling does not.
            cluster.adapt(minimum_jobs=settings.jobs, maximum_jobs=settings.maximum_jobs or settings.jobs)
            yield client


def _client_of(address: str | None) -> Client:
    try:
        return Client(address)
    except (OSError, ValueError) as error:
        raise SatIntervalsError(f"no dask scheduler answers at {address}: {error}") from error


def available_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _local(settings: Cluster) -> LocalCluster:
    workers = settings.workers or available_cores()
    processes = settings.kind == "processes"
    return LocalCluster(
        n_workers=workers if processes else 1,
        threads_per_worker=1 if processes else workers,
        processes=processes,
        host=_LOOPBACK if processes else None,
        dashboard_address=f"{_LOOPBACK}:0",
        worker_dashboard_address=f"{_LOOPBACK}:0",
        silence_logs=logging.CRITICAL,
    )


@contextmanager
def _undisturbed() -> Iterator[None]:
    """Keep signals waiting for the end of the block, and for ever from the threads and processes it begins.

    A terminal sends Ctrl-C to all processes: workers must not answer by themselves. And half a cluster cannot be
    closed in good order.
    """
    came: list[int] = []
    signals = (signal.SIGINT, signal.SIGTERM)
    resource_tracker.ensure_running()  # else begun with the first process, when it lets signals pass again
    handlers = {}
    if threading.current_thread() is threading.main_thread():  # which answers those that other threads are given
        handlers = {number: signal.signal(number, lambda number, _: came.append(number)) for number in signals}
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, signals)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        for number, handler in handlers.items():
            signal.signal(number, handler or signal.SIG_DFL)
        for late in came:
            signal.raise_signal(late)


def _batch_system(settings: Cluster) -> Any:
    """The dask-jobqueue cluster of SLURM, PBS, LSF or SGE; what is not set comes from the user's dask configuration."""
    try:
        import dask_jobqueue
    except ImportError as error:
        raise SatIntervalsError(
            f"cluster {settings.kind} needs dask-jobqueue: pip install sat-intervals[cluster]"
        ) from error
    options = {
        "queue": settings.queue,
        "account": settings.account,
        "cores": settings.cores,
        "processes": 1,
        "memory": settings.memory,
        "walltime": settings.walltime,
        "job_extra_directives": settings.directives,
    }
    given: dict[str, Any] = {name: value for name, value in options.items() if value not in (None, [])}
    if not dask.config.get(f"jobqueue.{settings.kind}.scheduler-options", {}):
        given["scheduler_options"] = {"dashboard_address": f"{_LOOPBACK}:0"}
    try:
        return getattr(dask_jobqueue, f"{settings.kind.upper()}Cluster")(**given, silence_logs=logging.CRITICAL)
    except ValueError as error:  # of settings that neither the section nor dask's own configuration gives
        raise SatIntervalsError(f"cluster {settings.kind}: {' '.join(str(error).split())}") from error


def job_script(settings: Cluster) -> str:
    """The script of one job of a batch system, as it would be submitted.

    Raises
    ------
    SatIntervalsError
        For a cluster that submits no jobs.
    """
    if settings.kind in ("threads", "processes", "address"):
        raise SatIntervalsError(f"cluster {settings.kind} submits no jobs: name slurm, pbs, lsf or sge")
    with _batch_system(settings) as cluster:
        return str(cluster.job_script())
