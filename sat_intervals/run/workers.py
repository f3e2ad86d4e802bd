"""What runs tasks, behind one small interface: threads of this process, or the workers of a dask cluster."""

import errno
import logging
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from functools import cache
from queue import Empty, SimpleQueue
from threading import BoundedSemaphore
from typing import Any, NamedTuple, Protocol

from sat_intervals.config import Cluster, ConfigError
from sat_intervals.errors import RunError, SatIntervalsError
from sat_intervals.machine import usable_cores
from sat_intervals.store.tiles import DamagedTilesError

CHECK_EVERY = 2.0  # seconds after which the caller is asked for more tasks, if no task has ended
_FULL_DISK = errno.ENOSPC, errno.EDQUOT

_LOG = logging.getLogger(__name__)
_turns = cache(BoundedSemaphore)  # one for each number


@dataclass(frozen=True)
class Task:
    """A call that any worker may make, and may repeat."""

    label: Any  # identifies it in its outcome
    function: Callable[..., Any]
    arguments: tuple[Any, ...]
    retries: int  # how often it is tried again if it raises


class Outcome(NamedTuple):
    """Result or error of a task."""

    label: Any
    result: Any
    error: BaseException | None


class Workers(Protocol):
    """Interface of what runs tasks."""

    def outcomes(self, tasks: Iterator[Task | None]) -> Iterator[Outcome | None]:
        """Run tasks, a bounded number at once; yield outcomes, and None regularly. A task None waits for others."""


def results(
    workers: Workers,
    tasks: Iterator[Task | None],
    failed: Callable[[Any], str],
    look: Callable[[int], None],
) -> Iterator[tuple[Any, Any]]:
    """Yield label and result of each task; ``failed`` says which one failed, ``look`` is given the number done.

    Where files are damaged the other tasks are done before the error.
    """
    done, damaged = 0, list[DamagedTilesError]()
    for outcome in workers.outcomes(tasks):
        if outcome is not None:
            if isinstance(error := outcome.error, DamagedTilesError):
                damaged.append(error.with_traceback(None))  # its frames hold arrays of a strip
                continue
            if error is not None:
                if isinstance(error, SatIntervalsError):  # names files and the way out
                    raise error
                check_not_full(error, what := failed(outcome.label))
                raise RunError(f"{what}: {reason(error)}; rerun the same command") from error
            done += 1
            yield outcome.label, outcome.result
        look(done)
    if damaged:
        raise damaged[0]


def readers(settings: Cluster) -> int:
    """Return how many threads of a process read and write while others compute: one if tiles are in a bucket."""
    return int(settings.kind != "address" and is_remote(settings))


def is_remote(settings: Cluster) -> bool:
    """Return whether tiles are in a bucket or the like."""
    return settings.store is not None and "://" in settings.store and not settings.store.startswith("file://")


def computing(settings: Cluster) -> AbstractContextManager[Any]:
    """Return a context for the kernels of a tile or strip: no more threads are in it at once than without `readers`."""
    return _turns(cores_of_process(settings)) if readers(settings) else nullcontext()


def cores_of_process(settings: Cluster) -> int:
    """Return how many tiles a process matches at once."""
    if settings.kind == "threads":
        return settings.workers or usable_cores()
    return 1 if settings.kind in ("processes", "address") else settings.cores


def in_flight(
    tasks: Iterator[Task | None], submit: Callable[[Task], Future[Outcome]], limit: Callable[[], int]
) -> Iterator[Outcome | None]:
    """Submit tasks, ``limit()`` at once; yield their outcomes, and None every few seconds without one."""
    ended: SimpleQueue[Future[Outcome]] = SimpleQueue()
    futures: set[Future[Outcome]] = set()

    def fill() -> None:
        while len(futures) < limit() and (task := next(tasks, None)) is not None:
            future = submit(task)
            futures.add(future)
            future.add_done_callback(ended.put)

    try:
        fill()
        while futures:
            try:
                future = ended.get(timeout=CHECK_EVERY)
            except Empty:
                yield None
            else:
                futures.remove(future)
                yield future.result()  # before the next tasks, since it may make others ready
            fill()
    finally:
        for future in futures:
            future.cancel()


class Threads:
    """Threads of this process; kernels and GDAL release Python's lock."""

    def __init__(self, count: int, more: int = 0) -> None:
        """``more``: see `readers`."""
        self._count, self._pool = count, ThreadPoolExecutor(count + more, "sat-intervals")

    def outcomes(self, tasks: Iterator[Task | None]) -> Iterator[Outcome | None]:
        """See `Workers`."""
        return in_flight(tasks, lambda task: self._pool.submit(_tried, task), lambda: 2 * self._count)

    def close(self) -> None:
        """Wait for the tasks under way; those that have not begun are dropped."""
        self._pool.shutdown(cancel_futures=True)


def _tried(task: Task) -> Outcome:
    tries = 0
    while True:
        try:
            return Outcome(task.label, called(task.function, *task.arguments), None)
        except Exception as error:
            tries += 1
            if tries > task.retries or isinstance(error, DamagedTilesError):  # which are deleted
                return Outcome(task.label, None, error)
            _LOG.debug("%s of %s is tried again", task.function.__name__, task.label)


def parse_memory(text: str) -> int:
    """Return the bytes of a memory size such as ``4GB``, ``512 MiB`` or ``3e9``."""
    from dask.utils import parse_bytes

    try:
        size = parse_bytes(text) if any(map(str.isdigit, text)) else 0  # dask reads "GB" as 1 GB
    except (ValueError, OverflowError):
        size = 0
    if size < 1_000_000:  # a unit is missing
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
            f"{error.filename or place}: {error.strerror}: free disk space and rerun the same command"
        ) from error


def called(function: Callable[..., Any], *arguments: Any) -> Any:
    """Call the function of a task; drop the causes of our errors: those of GDAL cannot be sent from a worker."""
    try:
        return function(*arguments)
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
