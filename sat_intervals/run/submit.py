"""Submit tasks to a dask cluster with a bounded number in flight, and handle lost workers."""

import asyncio
import logging
import time
import uuid
from collections.abc import Iterator
from concurrent import futures
from contextlib import contextmanager
from dataclasses import dataclass, field
from queue import Empty, SimpleQueue
from typing import Any

from distributed import Client, Future, KilledWorker
from distributed.client import ClosedClientError

from sat_intervals.errors import RunError
from sat_intervals.run.batch_system import current_workers
from sat_intervals.run.workers import CHECK_EVERY, Outcome, Task

# Seconds without a heartbeat, normally sent every few seconds, after which a warning names a worker.
SILENT = 30.0
# Seconds without a heartbeat of any worker, after the first one, at which a run ends.
DEAD = 600.0

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class DaskWorkers:
    """Workers of a dask cluster, and the addresses of those that were logged; see `Workers`."""

    client: Client
    known: set[str] = field(default_factory=set)

    def outcomes(self, tasks: Iterator[Task | None]) -> Iterator[Outcome | None]:
        """See `Workers` and `Submission`."""
        return iter(Submission(self.client, tasks, self.known))


class Submission:
    """Tasks with two in flight per core; iterates over their outcomes, and None every few seconds without one.

    dask blames the death of a worker on every task that it held. Tasks that are blamed too often are tried again at the
    end, one at a time, so that no task fails because of another.

    Raises
    ------
    RunError
        The scheduler is gone, or all workers of a batch system.
    """

    def __init__(self, client: Client, tasks: Iterator[Task | None], known: set[str] | None = None) -> None:
        """``known``: workers that were logged before, kept up to date."""
        self._client, self._tasks = client, tasks
        self._name = uuid.uuid4().hex  # unique, since a scheduler may serve several runs
        self._submitted = 0
        self._ended: SimpleQueue[Future[Any]] = SimpleQueue()
        self._in_flight: dict[str, tuple[Task, bool, Future[Any]]] = {}
        self._reading: dict[str, futures.Future[tuple[Any, BaseException | None]]] = {}
        self._suspects: list[Task] = []
        self._limit, self._checked = 2, float("-inf")
        self._workers: set[str] = set() if known is None else known
        self._heartbeats = _Heartbeats()

    def __iter__(self) -> Iterator[Outcome | None]:
        self._fill()
        while self._in_flight:
            ended = self._next()
            if ended is None:
                self._fill()
                yield None
                continue
            key, result, error = ended
            task, is_alone, future = self._in_flight.pop(key)
            future.release()
            is_blamed = isinstance(error, KilledWorker) and not is_alone
            if is_blamed:
                _LOG.info("%s of %s: its workers died; it is tried again, alone", task.function.__name__, task.label)
                self._suspects.append(task)
            else:
                yield Outcome(task.label, result, error)  # first, since it may make other tasks ready
            self._fill()
            if not self._in_flight and self._suspects:
                self._submit(self._suspects.pop(), is_alone=True)

    def _next(self) -> tuple[str, Any, BaseException | None] | None:
        """Return key, result and error of a task that has ended; None after a few seconds without one.

        Its worker may have left with both: then they are computed again, if there is another worker.
        """
        try:
            future = self._ended.get(timeout=CHECK_EVERY)
        except Empty:
            return None
        key = str(future.key)
        if key not in self._reading:
            loop: Any = self._client.loop
            self._reading[key] = asyncio.run_coroutine_threadsafe(_end_of(self._client, future), loop.asyncio_loop)
        if not futures.wait([self._reading[key]], timeout=CHECK_EVERY).done:
            self._ended.put(future)
            return None
        with _scheduler_errors():
            return key, *self._reading.pop(key).result()

    def _fill(self) -> None:
        """Submit tasks until two per current core are in flight."""
        if time.monotonic() - self._checked > CHECK_EVERY:
            with _scheduler_errors():
                cores = current_workers(self._client)
                self._heartbeats.check(self._client)
            self._limit = 2 * max(1, sum(cores.values()))
            self._log_workers(set(cores))
            self._checked = time.monotonic()
        while len(self._in_flight) < self._limit:
            following = next(self._tasks, None)
            if following is None:
                return
            self._submit(following)

    def _log_workers(self, workers: set[str]) -> None:
        for worker in sorted(workers ^ self._workers):
            _LOG.info("worker %s %s", worker, "joined" if worker in workers else "left")
        self._workers.clear()
        self._workers.update(workers)

    def _submit(self, task: Task, *, is_alone: bool = False) -> None:
        self._submitted += 1
        key = f"{task.function.__name__}-{self._name}-{self._submitted}"
        with _scheduler_errors():
            future = self._client.submit(task.function, *task.arguments, key=key, retries=task.retries, pure=False)
        self._in_flight[key] = task, is_alone, future
        future.add_done_callback(self._ended.put)


class _Heartbeats:
    """Times of the workers' last heartbeats: a stopped worker keeps its tasks without an error."""

    def __init__(self) -> None:
        self._last: dict[str, tuple[float, float]] = {}  # by worker: time of the scheduler's clock, and of ours
        self._heard = self._warned = self._checked = time.monotonic()

    def check(self, client: Client) -> None:
        """Warn of silent workers.

        Raises
        ------
        RunError
            All workers have been silent for DEAD seconds.
        """
        now = time.monotonic()
        if now - self._checked > DEAD:  # this process itself was stopped, maybe with its workers
            self._heard = now
        self._checked = now
        workers = client.scheduler_info(n_workers=-1)["workers"]  # the default of some dask releases is five
        for address, worker in workers.items():
            if self._last.get(address, (None,))[0] != worker["last_seen"]:
                self._last[address] = worker["last_seen"], now
                self._heard = now
        silent = sorted(address for address in workers if now - self._last[address][1] > SILENT)
        is_batch_system = hasattr(client.cluster, "refusals")  # `current_workers` warns
        if not workers and now - self._heard > SILENT and not is_batch_system:
            silent = ["any worker"]
        if self._last and now - self._heard > DEAD:
            raise RunError(
                f"no worker has answered for {DEAD:.0f} s: they were stopped, or their machine hangs; rerun the same "
                "command: it resumes"
            )
        if silent and now - self._warned > SILENT:
            self._warned = now
            _LOG.warning("waiting for %s, silent for %.0f s", ", ".join(silent), SILENT)


async def _end_of(client: Client, future: Future[Any]) -> tuple[Any, BaseException | None]:
    """Return result and error of a future; one of them is None.

    It may take for ever. Nobody cancels it, since dask then complains on stderr of what was not retrieved.
    """
    error: BaseException | None = await future.exception(asynchronous=True)
    if future.cancelled():
        raise ClosedClientError(f"{future.key} is lost")
    return (await client.gather(future, asynchronous=True), None) if error is None else (None, error)


@contextmanager
def _scheduler_errors() -> Iterator[None]:
    """Turn the loss of the scheduler into a RunError."""
    try:
        yield
    except (OSError, ClosedClientError, futures.CancelledError) as error:
        raise RunError("the dask scheduler is gone; rerun the same command: it resumes") from error
