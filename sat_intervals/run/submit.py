"""Tasks on their way through a cluster, a bounded number of them at a time, whatever becomes of its workers."""

import logging
import time
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from queue import Empty, SimpleQueue
from typing import Any, NamedTuple

from distributed import Client, Future, KilledWorker
from distributed.client import ClosedClientError

from sat_intervals.errors import RunError
from sat_intervals.run.batch_system import workers_there

# Seconds after which the size of a cluster, which may grow and shrink, is asked for again.
_LOOK_AGAIN = 2.0
# Seconds without a heartbeat, of which workers send one every few seconds, after which a worker is named.
SILENT = 30.0
# Seconds without a heartbeat of any worker, after there was one, at which a run ends.
DEAD = 600.0

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class Task:
    """A call that any worker may make, any number of times.

    Attributes
    ----------
    label
        What whoever waits for it knows it by.
    function, arguments
        The call.
    retries
        How often it is tried again where it raises.
    """

    label: Any
    function: Callable[..., Any]
    arguments: tuple[Any, ...]
    retries: int


class Outcome(NamedTuple):
    """How a task ended: with a result, or with an error."""

    label: Any
    result: Any
    error: BaseException | None


class Submission:
    """Tasks, two of them in flight for every core; iterates over their landings, and None where none lands for a while.

    dask blames a worker's death on every task that it held. Those blamed too often are tried again at the end, one at a
    time, so that no task fails for another.

    Raises
    ------
    RunError
        When the scheduler is gone, or all workers of a batch system.
    """

    def __init__(self, client: Client, tasks: Iterator[Task]) -> None:
        self._client, self._tasks = client, tasks
        self._name = uuid.uuid4().hex  # a scheduler may serve several runs, and takes equal keys for one task
        self._submitted = 0
        self._ended: SimpleQueue[Future[Any]] = SimpleQueue()
        self._in_flight: dict[str, tuple[Task, bool, Future[Any]]] = {}
        self._suspects: list[Task] = []
        self._width, self._looked = 2, float("-inf")
        self._workers: set[str] = set()
        self._heartbeats = _Heartbeats()

    def __iter__(self) -> Iterator[Outcome | None]:
        self._fill()
        while self._in_flight:
            future = self._next()
            if future is None:
                self._fill()
                yield None
                continue
            result, error = _end_of(future)
            task, is_alone, _ = self._in_flight.pop(str(future.key))
            future.release()
            is_blamed = isinstance(error, KilledWorker) and not is_alone
            if is_blamed:
                _LOG.info("%s of %s: its workers died; it is tried again, alone", task.function.__name__, task.label)
                self._suspects.append(task)
            self._fill()
            if not self._in_flight and self._suspects:
                self._submit(self._suspects.pop(), is_alone=True)
            if not is_blamed:
                yield Outcome(task.label, result, error)

    def _next(self) -> Future[Any] | None:
        """The next future that ends; None where none does for a while, so that whoever waits can look around."""
        try:
            return self._ended.get(timeout=_LOOK_AGAIN)
        except Empty:
            return None

    def _fill(self) -> None:
        """Submit tasks until two are in flight for every core that there is now."""
        if time.monotonic() - self._looked > _LOOK_AGAIN:
            with _scheduler_needed():
                cores = workers_there(self._client)
                self._heartbeats.check(self._client)
            self._width = 2 * max(1, sum(cores.values()))
            self._note_workers(set(cores))
            self._looked = time.monotonic()
        while len(self._in_flight) < self._width:
            following = next(self._tasks, None)
            if following is None:
                return
            self._submit(following)

    def _note_workers(self, workers: set[str]) -> None:
        for worker in sorted(workers ^ self._workers):
            _LOG.info("worker %s %s", worker, "joined" if worker in workers else "left")
        self._workers = workers

    def _submit(self, task: Task, *, is_alone: bool = False) -> None:
        self._submitted += 1
        key = f"{task.function.__name__}-{self._name}-{self._submitted}"
        with _scheduler_needed():
            future = self._client.submit(task.function, *task.arguments, key=key, retries=task.retries, pure=False)
        self._in_flight[key] = task, is_alone, future
        future.add_done_callback(self._ended.put)


class _Heartbeats:
    """When the workers were last heard of: one that was stopped holds its tasks for ever, and says nothing."""

    def __init__(self) -> None:
        self._last: dict[str, tuple[float, float]] = {}  # by worker: the scheduler's time of it, and ours
        self._heard = self._told = self._checked = time.monotonic()

    def check(self, client: Client) -> None:
        """Name workers that are silent.

        Raises
        ------
        RunError
            When all are, for DEAD seconds.
        """
        now = time.monotonic()
        if now - self._checked > DEAD:  # this process was stopped itself, and its workers maybe with it
            self._heard = now
        self._checked = now
        workers = client.scheduler_info(n_workers=-1)["workers"]  # some releases of dask give five by default
        for address, worker in workers.items():
            if self._last.get(address, (None,))[0] != worker["last_seen"]:
                self._last[address] = worker["last_seen"], now
                self._heard = now
        silent = sorted(address for address in workers if now - self._last[address][1] > SILENT)
        is_told_of = hasattr(client.cluster, "refusals")  # see `workers_there`
        if not workers and now - self._heard > SILENT and not is_told_of:
            silent = ["any worker"]
        if self._last and now - self._heard > DEAD:
            raise RunError(
                f"no worker has answered for {DEAD:.0f} s: they were stopped, or their machine hangs; the same command "
                "goes on from the tiles that are done"
            )
        if silent and now - self._told > SILENT:
            self._told = now
            _LOG.warning("waiting for %s, not heard of for %.0f s", ", ".join(silent), SILENT)


def _end_of(future: Future[Any]) -> tuple[Any, BaseException | None]:
    """Result and error of a future, one of which is None."""
    with _scheduler_needed():
        error: BaseException | None = future.exception()
        if future.cancelled():
            raise ClosedClientError(f"{future.key} is lost")
        return (future.result(), None) if error is None else (None, error)


@contextmanager
def _scheduler_needed() -> Iterator[None]:
    try:
        yield
    except (OSError, ClosedClientError) as error:
        raise RunError("the dask scheduler is gone; the same command goes on from the tiles that are done") from error


def reason(error: BaseException) -> str:
    """Why a task failed, in one line."""
    if isinstance(error, KilledWorker):
        return (
            f"every worker that matched it died, the last at {error.last_worker.address}, as they do out of memory: "
            "give workers more, or choose smaller tiles"
        )
    if isinstance(error, OSError) and error.filename and error.strerror:
        return f"{error.filename2 or error.filename}: {error.strerror}"
    return " ".join(str(error).split()) or type(error).__name__
