"""Clusters of dask: processes of this machine, a scheduler, or jobs of a batch system; see `workers` for threads."""

import gc
import logging
import signal
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from multiprocessing import resource_tracker
from pathlib import Path

import dask
from distributed import Client, LocalCluster, Nanny, Status, Worker, WorkerPlugin
from distributed.comm.addressing import resolve_address
from distributed.utils import silence_logging_cmgr

from sat_intervals.config import Cluster
from sat_intervals.errors import RunError, SatIntervalsError
from sat_intervals.machine import usable_cores
from sat_intervals.run.batch_system import LOOPBACK, batch_system
from sat_intervals.run.workers import readers

# Seconds for local worker processes to start.
STARTING = 120.0
# Seconds without an answer of a scheduler before a warning.
_WARN_AFTER = 3.0
_LOOPBACK_TIMEOUT = 5.0
# What dask watches of itself, for dashboards. By default it takes 2 % of a core in each process.
_WATCHING = {"distributed.admin.tick.interval": "1s", "distributed.worker.profile.enabled": False}

_LOG = logging.getLogger(__name__)


@contextmanager
def connected(settings: Cluster, out: Path) -> Iterator[Client]:
    """Connect a client to the cluster of the settings; close it, and what it started, at the end.

    Jobs write their logs to ``out/logs`` if their tiles are in ``out`` too, unless the user's dask configuration names
    another folder.

    Raises
    ------
    SatIntervalsError
        A scheduler does not answer, or the extra for batch systems is not installed.
    """
    with dask.config.set(_WATCHING), _asyncio_timeouts_hidden(), _client(settings, out) as client:
        _LOG.info("connected to %s", client)
        is_debug = logging.getLogger("sat_intervals").isEnabledFor(logging.DEBUG)
        is_debug = is_debug and settings.kind != "address"  # the user's own workers
        if is_debug or settings.kind == "processes":
            client.register_plugin(_WorkerLog(is_debug))
        for name in ("sat_intervals", "distributed") if is_debug else ():
            client.forward_logging(name)
        yield client
    _LOG.info("disconnected")


class _WorkerLog(WorkerPlugin):
    """Set up logging on workers: hide asyncio's timeouts, and log everything for ``--debug``."""

    name = "sat-intervals-log"

    def __init__(self, is_debug: bool) -> None:
        self._is_debug = is_debug

    def setup(self, worker: Worker) -> None:
        """Set up a worker as it starts."""
        logging.getLogger("asyncio").addFilter(_is_relevant)
        if self._is_debug:
            logging.getLogger("sat_intervals").setLevel(logging.DEBUG)


@contextmanager
def _asyncio_timeouts_hidden() -> Iterator[None]:
    """Hide asyncio's messages about timeouts that distributed never retrieves when it closes."""
    logger = logging.getLogger("asyncio")
    relevant = partial(_is_relevant)  # one per block, since several threads may be connected
    logger.addFilter(relevant)
    try:
        yield
    finally:
        gc.collect(1)  # asyncio logs them on garbage collection
        logger.removeFilter(relevant)


def _is_relevant(record: logging.LogRecord) -> bool:
    error = record.exc_info[1] if record.exc_info else None
    return not (isinstance(error, TimeoutError) and "never retrieved" in record.getMessage())


@contextmanager
def _client(settings: Cluster, out: Path) -> Iterator[Client]:
    if settings.kind == "address":
        with silence_logging_cmgr(logging.CRITICAL), _client_of(str(settings.address)) as client:
            yield client
    elif settings.kind == "processes":
        with ExitStack() as stack:
            with _signals_blocked():
                client = stack.enter_context(Client(stack.enter_context(_local(settings))))
            yield client
            with _signals_blocked():
                stack.close()
    else:
        with batch_system(settings, out / "logs") as cluster, Client(cluster) as client:
            # Adapting, unlike scaling, resubmits jobs that end before the run, even between equal bounds.
            cluster.adapt(minimum_jobs=settings.jobs, maximum_jobs=settings.maximum_jobs or settings.jobs)
            yield client


def _client_of(address: str) -> Client:
    warning = threading.Timer(_WARN_AFTER, _LOG.warning, ["waiting for the dask scheduler at %s", address])
    warning.start()
    try:
        resolve_address(address)  # fails at once for an unknown host, which dask would keep trying
        return Client(address)
    except (OSError, ValueError) as error:
        raise SatIntervalsError(
            f"no dask scheduler answers at {address}: {getattr(error, 'strerror', None) or error}"
        ) from error
    finally:
        warning.cancel()


class _Nanny(Nanny):
    """Starts a worker process, and says how it ended if it never worked."""

    _ended: int | None = None

    def _on_worker_exit_sync(self, exitcode: int) -> None:
        self._ended = exitcode
        super()._on_worker_exit_sync(exitcode)  # type: ignore[no-untyped-call]

    async def instantiate(self) -> Status:
        status = await super().instantiate()
        if status != Status.running and self._ended is not None:
            raise RuntimeError(f"a worker process ended at once, with exit status {self._ended}")
        return status


def _local(settings: Cluster) -> LocalCluster:
    workers, start = settings.workers or usable_cores(), time.monotonic()
    _check_loopback()
    try:
        return LocalCluster(
            n_workers=workers,
            threads_per_worker=1 + readers(settings),
            worker_class=_Nanny,
            host=LOOPBACK,
            dashboard_address=f"{LOOPBACK}:0",
            worker_dashboard_address=f"{LOOPBACK}:0",
            silence_logs=logging.CRITICAL,
            death_timeout=STARTING,
        )
    except Exception as error:  # any error at the start, such as a full /dev/shm
        cause: BaseException = error
        while earlier := cause.__cause__ or (None if cause.__suppress_context__ else cause.__context__):
            cause = earlier  # dask may fail again as it cleans up
        late = f"not within {STARTING:.0f} s" if time.monotonic() - start > STARTING else ""
        why = late or " ".join(str(cause).split()) or type(cause).__name__
        raise RunError(
            f"the {workers} worker processes did not start ({why}): give fewer --workers, more room in "
            "/dev/shm or another DASK_TEMPORARY_DIRECTORY, or use --cluster threads"
        ) from error


def _check_loopback() -> None:
    """Raise if local processes cannot connect to each other: dask would wait for them forever."""
    try:
        with (
            socket.create_server((LOOPBACK, 0)) as server,
            socket.create_connection(server.getsockname(), timeout=_LOOPBACK_TIMEOUT),
        ):
            pass
    except OSError as error:
        raise SatIntervalsError(
            f"processes cannot reach each other at {LOOPBACK}: {error.strerror or error}: enable the loopback "
            "interface, or use --cluster threads"
        ) from error


@contextmanager
def _signals_blocked() -> Iterator[None]:
    """Block SIGINT and SIGTERM while a cluster starts or stops; threads and processes started then never get them.

    A terminal sends Ctrl-C to all processes, but only the main one must react. And a cluster that is only half started
    cannot be closed cleanly. Pending signals are raised at the end.
    """
    pending: list[int] = []
    signals = (signal.SIGINT, signal.SIGTERM)
    resource_tracker.ensure_running()  # it would start with the first process and unblock the signals
    handlers = {}
    if threading.current_thread() is threading.main_thread():  # it handles signals sent to other threads too
        handlers = {number: signal.signal(number, lambda number, _: pending.append(number)) for number in signals}
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, signals)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        for number, handler in handlers.items():
            signal.signal(number, handler or signal.SIG_DFL)
        for late in pending:
            signal.raise_signal(late)
