"""Clusters of dask, and tasks on them, a bounded number at a time; dask repeats these and replaces lost workers."""

import asyncio
import logging
import signal
import time
import uuid
from collections.abc import Iterator, Sequence
from concurrent.futures import CancelledError, Future
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import dask
from distributed import Client, LocalCluster
from distributed import Future as DaskFuture
from distributed.client import ClosedClientError
from distributed.utils import silence_logging_cmgr

from sat_intervals.config import Cluster
from sat_intervals.errors import RunError, SatIntervalsError
from sat_intervals.machine import usable_cores
from sat_intervals.run.batch_system import batch_system
from sat_intervals.run.workers import CHECK_EVERY, Outcome, Task, called, in_flight, readers, reason

STARTING = 120.0  # seconds for local worker processes to start
DASK = {
    "distributed.scheduler.allowed-failures": 3,  # deaths of workers that a task survives
    "distributed.scheduler.worker-ttl": "5 minutes",  # a stopped worker's tasks then go to others
    # What dask watches of itself, for dashboards. By default it takes 2 % of a core in each process.
    "distributed.admin.tick.interval": "1s",
    "distributed.worker.profile.enabled": False,
    # Its nannies let workers give memory back after each array: the system then takes a fourth of the time.
    # With one pool a process has 80 MB less.
    "distributed.nanny.pre-spawn-environ.MALLOC_TRIM_THRESHOLD_": 1 << 29,
    "distributed.nanny.pre-spawn-environ.MALLOC_MMAP_THRESHOLD_": 1 << 29,
    "distributed.nanny.pre-spawn-environ.MALLOC_ARENA_MAX": 1,
}
WORKERS_GONE = 300.0  # seconds after the last worker left, at which a run ends
_WARN_EVERY = 60.0  # seconds between warnings while there is no worker

_LOG = logging.getLogger(__name__)


class DaskWorkers:
    """Workers of a dask cluster; see `Workers`."""

    def __init__(self, client: Client) -> None:
        self._client = client
        self._cores: dict[str, int] = {}
        self._checked = float("-inf")
        self._seen: float | None = None  # time of the last worker
        self._warned = time.monotonic()

    def outcomes(self, tasks: Iterator[Task | None]) -> Iterator[Outcome | None]:
        """See `Workers`."""
        self._seen = self._seen and time.monotonic()  # nobody looked between two phases of a run
        return in_flight(tasks, self._submit, self._limit)

    def _limit(self) -> int:
        """Return two per core of the workers there are, counted every few seconds."""
        now = time.monotonic()
        if now - self._checked > CHECK_EVERY:
            self._checked = now
            with _scheduler_errors():
                cores = self._client.nthreads()
            for worker in sorted(cores.keys() ^ self._cores.keys()):
                _LOG.info("worker %s %s", worker, "joined" if worker in cores else "left")
            self._cores = cores
            if cores:
                self._seen = self._warned = now
            else:
                self._check_wait(now)
        return 2 * max(1, sum(self._cores.values()))

    def _check_wait(self, now: float) -> None:
        """Raise if no worker will come; otherwise warn every minute. Nothing limits the wait for the first one."""
        system: Any = self._client.cluster
        where = ""
        if hasattr(system, "logged"):  # see `batch_system`
            where = f": see the queue, and the logs of the jobs in {system.logged}"
            if system.refusals and not system.submitted:
                refusal = " ".join(system.refusals[0].split())
                raise SatIntervalsError(f"the batch system refuses the job: {refusal}: check the section cluster")
        if self._seen is not None and now - self._seen > WORKERS_GONE:
            raise RunError(
                f"the last worker ended and none has started for {WORKERS_GONE:.0f} s{where}; rerun the same command: "
                "it resumes"
            )
        if now - self._warned >= _WARN_EVERY:
            self._warned = now
            _LOG.warning("there is no worker yet%s", where)

    def _submit(self, task: Task) -> Future[Outcome]:
        key = f"{task.function.__name__}-{uuid.uuid4().hex}"  # unique, since a scheduler may serve several runs
        with _scheduler_errors():
            future = self._client.submit(
                called, task.function, *task.arguments, key=key, retries=task.retries, pure=False
            )
        loop: Any = self._client.loop
        return asyncio.run_coroutine_threadsafe(_outcome(task.label, future), loop.asyncio_loop)


async def _outcome(label: Any, future: DaskFuture[Any]) -> Outcome:
    """Return the outcome of a task; what dask raises of itself is an error of the scheduler."""
    try:
        with _scheduler_errors():
            try:
                return Outcome(label, await future, None)
            except Exception as error:
                if future.status != "error":
                    raise
                return Outcome(label, None, error)
    finally:
        future.release()


@contextmanager
def _scheduler_errors() -> Iterator[None]:
    """Turn the loss of the scheduler into a RunError."""
    try:
        yield
    except (OSError, ClosedClientError, CancelledError) as error:
        raise RunError("the dask scheduler is gone; rerun the same command: it resumes") from error


# ---- Clusters ----------------------------------------------------------------------------------------------
@contextmanager
def connected(settings: Cluster, out: Path) -> Iterator[Client]:
    """Connect a client to the cluster of the settings; close it, and what it started, at the end."""
    logs_all = logging.getLogger("sat_intervals").isEnabledFor(logging.DEBUG)
    quiet = () if logs_all else ("distributed", "distributed.client")
    with _silenced(quiet), dask.config.set(DASK), _client(settings, out) as client:
        _LOG.info("connected to %s", client)
        if settings.kind == "processes":
            client.register_worker_callbacks(_ignore_interrupts)
        if settings.kind != "address" and logs_all:
            client.register_worker_callbacks(_log_all)
            for name in ("sat_intervals", "distributed"):
                client.forward_logging(name)
        yield client
    _LOG.info("disconnected")


@contextmanager
def _silenced(names: Sequence[str]) -> Iterator[None]:
    """Keep lines of loggers away: after shareloc the root logger would print them."""
    with ExitStack() as levels:
        for logger in map(logging.getLogger, names):
            levels.callback(logger.setLevel, logger.level)
            logger.setLevel(logging.CRITICAL)
        yield


def _ignore_interrupts() -> None:
    """Leave Ctrl-C, which a terminal sends to all processes, to the main one: it closes the others."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _log_all() -> None:
    """Log everything on a worker, for ``--debug``."""
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
