"""What runs tasks, behind one small interface: threads of this process, or a dask cluster, imported if needed."""

import errno
import logging
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from queue import Empty, SimpleQueue
from threading import BoundedSemaphore
from typing import Any, NamedTuple, Protocol, Self

from sat_intervals.config import Cluster, ConfigError
from sat_intervals.errors import RunError, SatIntervalsError
from sat_intervals.machine import usable_cores
from sat_intervals.store.folder import folder_at

# Seconds after which the caller is asked for more tasks, if no task has ended.
CHECK_EVERY = 2.0
_FULL_DISK = errno.ENOSPC, errno.EDQUOT

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class Task:
    """A call that any worker may make, and may repeat.

    Attributes
    ----------
    label
        Identifies the task in its `Outcome`.
    function, arguments
        The call.
    retries
        How often it is tried again if it raises.
    """

    label: Any
    function: Callable[..., Any]
    arguments: tuple[Any, ...]
    retries: int


class Outcome(NamedTuple):
    """Result or error of a task."""

    label: Any
    result: Any
    error: BaseException | None


class Workers(Protocol):
    """Interface of what runs tasks: threads of this process or a dask cluster."""

    def outcomes(self, tasks: Iterator[Task | None]) -> Iterator[Outcome | None]:
        """Run tasks with two in flight per core; yield their outcomes, and None every few seconds without one.

        None among the tasks means that more are ready once others have ended.
        """


def readers(settings: Cluster) -> int:
    """Return how many threads of a process read and write while the others compute: one if tiles are in a bucket.

    With 0.3 s for each tile read or written, this shortens the tiles of one worker from 43 s to 28 s. On a local disk
    it saves nothing. The threads of an existing scheduler's workers are the user's.
    """
    return int(settings.kind != "address" and is_remote(settings))


def is_remote(settings: Cluster) -> bool:
    """Return whether tiles are in a bucket or the like."""
    return settings.store is not None and not folder_at(settings.store).is_local


def computing(settings: Cluster) -> AbstractContextManager[Any]:
    """Return a context for the kernels of a tile or strip: no more threads are in it at once than without `readers`."""
    return _turns(cores_of_process(settings)) if readers(settings) else nullcontext()


@cache
def _turns(count: int) -> BoundedSemaphore:
    return BoundedSemaphore(count)


def cores_of_process(settings: Cluster) -> int:
    """Return how many tiles a process matches at once."""
    if settings.kind == "threads":
        return settings.workers or usable_cores()
    return 1 if settings.kind in ("processes", "address") else settings.cores


class Threads:
    """Threads of this process; kernels and GDAL release Python's lock."""

    def __init__(self, count: int, more: int = 0) -> None:
        """``more``: see `readers`."""
        self._count, self._pool = count, ThreadPoolExecutor(count + more, "sat-intervals")

    def outcomes(self, tasks: Iterator[Task | None]) -> Iterator[Outcome | None]:
        """See `Workers`."""
        ended: SimpleQueue[tuple[Task, Future[Any]]] = SimpleQueue()
        in_flight: set[Future[Any]] = set()

        def fill() -> None:
            while len(in_flight) < 2 * self._count and (task := next(tasks, None)) is not None:
                future = self._pool.submit(_tried, task)
                in_flight.add(future)
                future.add_done_callback(lambda future, task=task: ended.put((task, future)))  # type: ignore[misc]

        try:
            fill()
            while in_flight:
                try:
                    task, future = ended.get(timeout=CHECK_EVERY)
                except Empty:
                    fill()
                    yield None
                    continue
                in_flight.discard(future)
                error = future.exception()
                yield Outcome(task.label, None if error else future.result(), error)
                fill()
        finally:
            for future in in_flight:
                future.cancel()

    def close(self) -> None:
        """Wait for the tasks under way; those that have not begun are dropped."""
        self._pool.shutdown(cancel_futures=True)


def _tried(task: Task) -> Any:
    for _ in range(task.retries):
        try:
            return task.function(*task.arguments)
        except Exception:
            _LOG.debug("%s of %s is tried again", task.function.__name__, task.label)
    return task.function(*task.arguments)


@contextmanager
def connected(settings: Cluster, out: Path) -> Iterator[Workers]:
    """Start or connect to the workers of the settings; close what was started at the end; see `cluster.connected`."""
    if settings.kind == "threads":
        threads = Threads(cores_of_process(settings), readers(settings))
        try:
            yield threads
        finally:
            threads.close()
    else:
        from sat_intervals.run import cluster
        from sat_intervals.run.submit import DaskWorkers

        with cluster.connected(settings, out) as client:
            yield DaskWorkers(client)


class Connection:
    """Workers that are started or connected when they are first needed; see `connected`. A context manager."""

    def __init__(self, settings: Cluster, out: Path) -> None:
        self._settings, self._out = settings, out
        self._stack = ExitStack()
        self._workers: Workers | None = None

    def client(self) -> Workers:
        """Return the workers."""
        if self._workers is None:
            self._workers = self._stack.enter_context(connected(self._settings, self._out))
        return self._workers

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: Any) -> None:
        """Close the workers; `client` connects again."""
        self._workers = None
        self._stack.__exit__(*error)


def parse_memory(text: str) -> int:
    """Parse a memory size such as ``4GB``, ``512 MiB`` or ``3e9`` with dask; return bytes.

    Raises
    ------
    ConfigError
        It is not a size, or less than a megabyte: a unit is missing.
    """
    from dask.utils import parse_bytes

    try:
        size = parse_bytes(text) if any(map(str.isdigit, text)) else 0  # dask reads "GB" as 1 GB
    except (ValueError, OverflowError):
        size = 0
    if size < 1_000_000:
        raise ConfigError(f"memory {text!r}: give a figure with a unit, such as 4GB or 512MiB")
    return size


def tiles_at_once(settings: Cluster) -> int:
    """Return the number of tiles at once; for an existing scheduler, that of this machine."""
    if settings.kind in ("threads", "processes", "address"):
        return settings.workers or usable_cores()
    return (settings.maximum_jobs or settings.jobs) * settings.cores


def check_not_full(error: BaseException, place: object) -> None:
    """Raise if a task failed because the disk is full: all others would fail too."""
    if isinstance(error, OSError) and error.errno in _FULL_DISK:
        raise RunError(
            f"{error.filename or place}: {error.strerror}: free disk space and rerun the same command: it resumes"
        ) from error


@contextmanager
def picklable_errors() -> Iterator[None]:
    """Drop the causes of our errors: those of GDAL cannot be sent from a worker."""
    try:
        yield
    except SatIntervalsError as error:
        error.__cause__ = error.__context__ = None
        raise


def reason(error: BaseException) -> str:
    """Return why a task failed, in one line."""
    if hasattr(error, "last_worker"):  # KilledWorker of dask, which is not imported for threads
        return (
            f"every worker that matched it died, the last at {error.last_worker.address}, probably out of memory: give "
            "workers more memory, or choose smaller tiles"
        )
    if isinstance(error, OSError) and error.filename and error.strerror:
        return f"{error.filename2 or error.filename}: {error.strerror}"
    return " ".join(str(error).split()) or type(error).__name__
