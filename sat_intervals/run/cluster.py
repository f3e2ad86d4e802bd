"""Where tiles are matched: threads or processes of this machine, a dask scheduler, or jobs of a batch system."""

import gc
import logging
import signal
import socket
import threading
import warnings
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from multiprocessing import resource_tracker
from pathlib import Path

from dask.utils import parse_bytes
from distributed import Client, LocalCluster, Worker, WorkerPlugin
from distributed.comm.addressing import resolve_address
from distributed.utils import silence_logging_cmgr

from sat_intervals.config import Cluster, ConfigError
from sat_intervals.errors import RunError, SatIntervalsError
from sat_intervals.machine import usable_cores
from sat_intervals.run.batch_system import LOOPBACK, batch_system

# Seconds for worker processes of this machine to start.
STARTING = 120.0
# Seconds without an answer of a scheduler at which a wait is told of.
_TOLD_AFTER = 3.0
_LOOPBACK_PATIENCE = 5.0

_LOG = logging.getLogger(__name__)


@contextmanager
def connected(settings: Cluster, out: Path) -> Iterator[Client]:
    """A client of the cluster that the settings name; closed, with what it started, at the end.

    Jobs write their logs to ``out/logs`` where their tiles lie in ``out`` too, unless the user's dask configuration
    names another folder.

    Raises
    ------
    SatIntervalsError
        When a scheduler does not answer, or the extra for batch systems is not installed.
    """
    with _forgotten_waits_untold(), _client(settings, out) as client:
        _LOG.info("connected to %s", client)
        is_heard = logging.getLogger("sat_intervals").isEnabledFor(logging.DEBUG)
        is_heard = is_heard and settings.kind not in ("threads", "address")  # in this process, and not ours
        if is_heard or settings.kind == "processes":
            client.register_plugin(_WorkerLog(is_heard))
        for name in ("sat_intervals", "distributed") if is_heard else ():
            client.forward_logging(name)
        yield client
    _LOG.info("disconnected")


class _WorkerLog(WorkerPlugin):
    """Of forgotten waits worker processes say nothing either; of all else everything, if the client hears it."""

    name = "sat-intervals-log"

    def __init__(self, is_heard: bool) -> None:
        self._is_heard = is_heard

    def setup(self, worker: Worker) -> None:
        """Called on every worker as it starts."""
        logging.getLogger("asyncio").addFilter(_is_news)
        if self._is_heard:
            logging.getLogger("sat_intervals").setLevel(logging.DEBUG)


@contextmanager
def _forgotten_waits_untold() -> Iterator[None]:
    """Keep to itself what asyncio says of waits that distributed forgets when it closes."""
    logger = logging.getLogger("asyncio")
    news = partial(_is_news)  # one for each block: several threads may be connected
    logger.addFilter(news)
    try:
        yield
    finally:
        gc.collect(1)  # what was forgotten is told of when it is collected
        logger.removeFilter(news)


def _is_news(record: logging.LogRecord) -> bool:
    error = record.exc_info[1] if record.exc_info else None
    return not (isinstance(error, TimeoutError) and "never retrieved" in record.getMessage())


@contextmanager
def _client(settings: Cluster, out: Path) -> Iterator[Client]:
    if settings.kind == "address":
        with silence_logging_cmgr(logging.CRITICAL), _client_of(str(settings.address)) as client:
            yield client
    elif settings.kind in ("threads", "processes"):
        with ExitStack() as stack:
            with _undisturbed():
                client = stack.enter_context(Client(stack.enter_context(_local(settings))))
            yield client
            with _undisturbed():
                stack.close()
    else:
        with batch_system(settings, out / "logs") as cluster, Client(cluster) as client:
            # Adapting, even between equal bounds, submits a job again that ended before the run did; scaling does not.
            cluster.adapt(minimum_jobs=settings.jobs, maximum_jobs=settings.maximum_jobs or settings.jobs)
            yield client


def _client_of(address: str) -> Client:
    told = threading.Timer(_TOLD_AFTER, _LOG.warning, ["waiting for the dask scheduler at %s", address])
    told.start()
    try:
        resolve_address(address)  # a host that nobody knows: dask would try it again and again
        return Client(address)
    except (OSError, ValueError) as error:
        raise SatIntervalsError(
            f"no dask scheduler answers at {address}: {getattr(error, 'strerror', None) or error}"
        ) from error
    finally:
        told.cancel()


def _local(settings: Cluster) -> LocalCluster:
    workers = settings.workers or usable_cores()
    processes = settings.kind == "processes"
    if processes:
        _check_loopback()
    with warnings.catch_warnings():
        # of a machine without a network, which none of this needs
        warnings.filterwarnings("ignore", "Couldn't detect a suitable IP address", RuntimeWarning)
        try:
            return LocalCluster(
                n_workers=workers if processes else 1,
                threads_per_worker=1 if processes else workers,
                processes=processes,
                host=LOOPBACK if processes else None,
                dashboard_address=f"{LOOPBACK}:0",
                worker_dashboard_address=f"{LOOPBACK}:0",
                silence_logs=logging.CRITICAL,
                **({"death_timeout": STARTING} if processes else {}),
            )
        except Exception as error:  # whatever keeps it from starting, such as a full /dev/shm
            cause: BaseException = error
            while cause.__cause__ is not None:
                cause = cause.__cause__
            why = " ".join(str(cause).split()) or type(cause).__name__
            if not processes:
                raise RunError(
                    f"dask cannot start here: {why}: check its settings, such as DASK_TEMPORARY_DIRECTORY"
                ) from error
            raise RunError(
                f"the {workers} worker processes did not start within {STARTING:.0f} s ({why}): give fewer --workers "
                "or more room in /dev/shm, or use --cluster threads"
            ) from error


def _check_loopback() -> None:
    """Hold that processes of this machine can talk to each other: dask would wait for them without end."""
    try:
        with (
            socket.create_server((LOOPBACK, 0)) as server,
            socket.create_connection(server.getsockname(), timeout=_LOOPBACK_PATIENCE),
        ):
            pass
    except OSError as error:
        raise SatIntervalsError(
            f"processes cannot reach each other at {LOOPBACK}: {error.strerror or error}: bring up the loopback "
            "interface, or use --cluster threads"
        ) from error


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


def parse_memory(text: str) -> int:
    """Bytes of a size such as ``4GB``, ``512 MiB`` or ``3e9``, as dask reads it.

    Raises
    ------
    ConfigError
        When it is no size, or not above zero.
    """
    try:
        size = parse_bytes(text) if any(map(str.isdigit, text)) else 0  # dask takes "GB" for 1 GB
    except (ValueError, OverflowError):
        size = 0
    if size <= 0:
        raise ConfigError(f"memory {text!r}: give a figure with a unit, such as 4GB or 512MiB")
    return size


def tiles_at_once(settings: Cluster) -> int:
    """Tiles in work at once; of a scheduler that is there, as if on this machine."""
    if settings.kind in ("threads", "processes", "address"):
        return settings.workers or usable_cores()
    return (settings.maximum_jobs or settings.jobs) * settings.cores
