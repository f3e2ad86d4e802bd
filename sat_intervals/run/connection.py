"""Connect to the workers of the settings: threads, or a cluster of dask, which is imported only if it is needed."""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, Self

from sat_intervals.config import Cluster
from sat_intervals.run.workers import Threads, Workers, cores_of_process, readers


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
