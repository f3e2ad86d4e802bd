"""Submit tasks to a dask cluster, a bounded number at a time; dask repeats them and replaces lost workers."""

import asyncio
import itertools
import logging
import time
import uuid
from collections.abc import Iterator
from concurrent.futures import CancelledError, Future
from contextlib import contextmanager
from typing import Any

from distributed import Client
from distributed import Future as DaskFuture
from distributed.client import ClosedClientError

from sat_intervals.errors import RunError, SatIntervalsError
from sat_intervals.run.workers import CHECK_EVERY, Outcome, Task, in_flight

WORKERS_GONE = 300.0  # seconds after the last worker left, at which a run ends
_WARN_EVERY = 60.0  # seconds between warnings while there is no worker

_LOG = logging.getLogger(__name__)


class DaskWorkers:
    """Workers of a dask cluster; see `Workers`."""

    def __init__(self, client: Client) -> None:
        self._client = client
        self._run = uuid.uuid4().hex  # unique, since a scheduler may serve several runs
        self._numbers = itertools.count()
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
        key = f"{task.function.__name__}-{self._run}-{next(self._numbers)}"
        with _scheduler_errors():
            future = self._client.submit(task.function, *task.arguments, key=key, retries=task.retries, pure=False)
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
