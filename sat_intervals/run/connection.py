"""Workers of the settings: threads, or a cluster of dask, which is imported only if it is needed."""

from collections.abc import Iterator
from contextlib import ExitStack, closing
from pathlib import Path
from threading import Lock

from sat_intervals.config import Cluster
from sat_intervals.run.state import with_store
from sat_intervals.run.workers import Outcome, Task, Threads, Workers, cores_of_process, readers


class Connection(ExitStack):
    """Workers that are started, or connected to, for the first tasks, and closed at the end; see `Workers`.

    What is added to ``at_end`` is done after that.
    """

    def __init__(self, settings: Cluster, out: Path) -> None:
        """``out`` is the folder for logs of jobs."""
        super().__init__()
        self.at_end = self.enter_context(ExitStack())
        self.settings = with_store(settings, out)
        self._out = out
        self._lock = Lock()
        self._workers: Workers | None = None

    def outcomes(self, tasks: Iterator[Task | None]) -> Iterator[Outcome | None]:
        """See `Workers`."""
        with self._lock:
            self._workers = self._workers or self._started()
        return self._workers.outcomes(tasks)

    def _started(self) -> Workers:
        if self.settings.kind == "threads":
            return self.enter_context(closing(Threads(cores_of_process(self.settings), readers(self.settings))))
        from sat_intervals.run.submit import DaskWorkers, connected

        return DaskWorkers(self.enter_context(connected(self.settings, self._out)))
