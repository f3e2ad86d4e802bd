"""Where tiles are matched: threads or processes of this machine, a dask scheduler, or jobs of a batch system."""

import gc
import logging
import os
import signal
import socket
import threading
import time
import warnings
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from multiprocessing import resource_tracker
from pathlib import Path
from typing import Any

import dask
from dask.utils import parse_bytes
from distributed import Client, LocalCluster, Status, Worker, WorkerPlugin
from distributed.comm.addressing import resolve_address
from distributed.utils import silence_logging_cmgr

from sat_intervals.config import Cluster, ConfigError
from sat_intervals.errors import RunError, SatIntervalsError
from sat_intervals.machine import usable_cores

# Seconds without any worker of a batch system, after there were some, at which a run ends.
WORKERS_GONE = 300.0
# Seconds for worker processes of this machine to start.
STARTING = 120.0
# Seconds without an answer of a scheduler at which a wait is told of.
_TOLD_AFTER = 3.0
# Seconds from one word on the first worker, for which a run waits, to the next.
_TOLD_EVERY = 60.0

# Batch systems that know projects and no accounts.
_CHARGE_PROJECTS = "lsf", "sge"

_LOOPBACK = "127.0.0.1"
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
        with _batch_system(settings, out / "logs") as cluster, Client(cluster) as client:
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
                host=_LOOPBACK if processes else None,
                dashboard_address=f"{_LOOPBACK}:0",
                worker_dashboard_address=f"{_LOOPBACK}:0",
                silence_logs=logging.CRITICAL,
                **({"death_timeout": STARTING} if processes else {}),
            )
        except Exception as error:  # whatever keeps processes from starting, such as a full /dev/shm
            if not processes:
                raise
            cause: BaseException = error
            while cause.__cause__ is not None:
                cause = cause.__cause__
            why = " ".join(str(cause).split()) or type(cause).__name__
            raise RunError(
                f"the {workers} worker processes did not start within {STARTING:.0f} s ({why}): give fewer --workers "
                "or more room in /dev/shm, or use --cluster threads"
            ) from error


def _check_loopback() -> None:
    """Hold that processes of this machine can talk to each other: dask would wait for them without end."""
    try:
        with (
            socket.create_server((_LOOPBACK, 0)) as server,
            socket.create_connection(server.getsockname(), timeout=_LOOPBACK_PATIENCE),
        ):
            pass
    except OSError as error:
        raise SatIntervalsError(
            f"processes cannot reach each other at {_LOOPBACK}: {error.strerror or error}: bring up the loopback "
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


def _batch_system(settings: Cluster, logs: Path) -> Any:
    """The dask-jobqueue cluster of SLURM, PBS, LSF or SGE; what is not set comes from the user's dask configuration."""
    try:
        import dask_jobqueue
    except ImportError as error:
        raise SatIntervalsError(
            f"cluster {settings.kind} needs dask-jobqueue: pip install sat-intervals[cluster]"
        ) from error
    base: Any = getattr(dask_jobqueue, f"{settings.kind.upper()}Cluster")
    options = {
        "queue": settings.queue,
        "project" if settings.kind in _CHARGE_PROJECTS else "account": settings.account,
        "cores": settings.cores,
        "processes": 1,
        "memory": settings.memory,
        "walltime": _without_seconds(settings.walltime) if settings.kind == "lsf" else settings.walltime,
        "job_extra_directives": settings.directives,
    }
    if settings.memory is None and dask.config.get(f"jobqueue.{settings.kind}.memory", None) is None:
        raise SatIntervalsError(
            f"cluster {settings.kind} needs the memory of a job: set cluster.memory, such as 4GB, or "
            f"jobqueue.{settings.kind}.memory of dask's configuration"
        )
    given: dict[str, Any] = {name: value for name, value in options.items() if value not in (None, [])}
    if not dask.config.get(f"jobqueue.{settings.kind}.scheduler-options", {}):
        given["scheduler_options"] = {"dashboard_address": f"{_LOOPBACK}:0"}
    own_logs = dask.config.get(f"jobqueue.{settings.kind}.log-directory", None)
    # Jobs may not see the folder of a run whose tiles lie elsewhere, and their scripts take no spaces.
    if own_logs is None and settings.store is None and not any(map(str.isspace, str(logs.absolute()))):
        given["log_directory"] = str(logs.absolute())
    submitted: set[str] = set()
    refusals: list[str] = []

    class Job(base.job_cls):  # type: ignore[misc]
        async def start(self) -> None:
            try:
                await super().start()
            except RuntimeError as error:  # which dask keeps to itself
                refusals.append(str(error).rpartition("stderr:")[2])
                self.status = Status.failed  # else it could not be closed
                raise
            submitted.add(self.job_id)

        async def close(self) -> None:
            await super().close()
            self.status = Status.closed  # dask asserts it of every job that is not garbage by then

    logged = given.get("log_directory") or own_logs or os.getcwd()
    own = {"job_cls": Job, "submitted": submitted, "refusals": refusals, "logged": logged}
    own |= {"seen": None, "told": time.monotonic()}  # of `workers_there`: when a worker was, when the wait was told of
    batch_system = type(base.__name__, (base,), own)
    try:
        return batch_system(**given, silence_logs=logging.CRITICAL)
    except ValueError as error:  # of settings that neither the section nor dask's own configuration gives
        raise SatIntervalsError(f"cluster {settings.kind}: {' '.join(str(error).split())}") from error


def _without_seconds(walltime: str | None) -> str | None:
    """Hours and minutes, as LSF wants them."""
    return ":".join(walltime.split(":")[:2]) if walltime else None


def job_script(settings: Cluster, out: Path) -> str:
    """The script of one job of a batch system, as it would be submitted.

    Raises
    ------
    SatIntervalsError
        For a cluster that submits no jobs.
    """
    if settings.kind in ("threads", "processes", "address"):
        raise SatIntervalsError(f"cluster {settings.kind} submits no jobs: name slurm, pbs, lsf or sge")
    new = [folder for folder in (out / "logs", out) if not folder.exists()]  # dask-jobqueue makes them
    with _batch_system(settings, out / "logs") as cluster:
        script = str(cluster.job_script())
    for folder in new:
        with suppress(OSError):
            folder.rmdir()
    return script


def workers_there(client: Client) -> dict[str, int]:
    """Addresses and cores of the workers that a client has. Called every few seconds, it ends a wait that is in vain.

    For the first worker of a batch system it waits without limit, and says so once a minute.

    Raises
    ------
    SatIntervalsError
        When the batch system took no job.
    RunError
        When its last worker has gone, and none has come since for WORKERS_GONE seconds.
    """
    cores: dict[str, int] = client.nthreads()
    cluster: Any = client.cluster
    if not hasattr(cluster, "refusals"):
        return cores
    now = time.monotonic()
    if cores:
        cluster.seen = now
    elif cluster.refusals and not cluster.submitted:
        raise SatIntervalsError(
            f"the batch system refuses the job: {' '.join(cluster.refusals[0].split())}: check the section cluster"
        )
    elif cluster.seen is None and now - cluster.told >= _TOLD_EVERY:
        cluster.told = now
        _LOG.warning(
            "no worker has come yet: jobs wait in the queue of the batch system, or ended before, of which their logs "
            "in %s tell",
            cluster.logged,
        )
    elif cluster.seen is not None and now - cluster.seen > WORKERS_GONE:
        raise RunError(
            f"the last worker has gone and none has come for {WORKERS_GONE:.0f} s: of the jobs their logs in "
            f"{cluster.logged} tell; the same command goes on from the tiles that are done"
        )
    return cores
