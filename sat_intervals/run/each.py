"""Calls of many blocks, and files of many rows, on workers."""

import logging
import platform
import uuid
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sat_intervals.config import Cluster
from sat_intervals.prepare.pair import RowArguments, Rows
from sat_intervals.progress import Progress
from sat_intervals.raster import OutputWriter, RemotePath
from sat_intervals.raster.publishing import check_space, file_bytes, part_bytes
from sat_intervals.run.connection import Connection
from sat_intervals.run.parts import Parts, codecs_of, copy_parts, finish_parts
from sat_intervals.run.state import with_store
from sat_intervals.run.workers import Task, is_remote, reason, results
from sat_intervals.store.folder import folder_at
from sat_intervals.store.manifest import digest
from sat_intervals.store.tiles import NO_TILES, PARTS, Store

_RETRIES = 2

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class EachOnWorkers:
    """Calls functions on workers, a bounded number at a time; a `prepare.pair.Each`, and a `Pool`."""

    workers: Connection
    progress: Progress

    def __call__(
        self, function: Callable[..., Any], arguments: Sequence[tuple[Any, ...]], stage: str
    ) -> Iterator[tuple[int, Any]]:
        """Yield results with the number of their arguments, as they come."""
        tasks = (Task(i, function, each, _RETRIES) for i, each in enumerate(arguments))
        failed = f"{_FOUND[stage]} could not be found"
        self.progress(stage, 0, len(arguments))
        return results(self.workers, tasks, lambda _: failed, lambda done: self.progress(stage, done, len(arguments)))

    def write_rows(
        self, writer: OutputWriter, function: Callable[..., Rows], arguments: RowArguments, stage: str
    ) -> list[dict[str, Any]]:
        """Write files of parts that workers make, see `Pool`; the parts are beside the files, or in the store."""
        files, shape = writer.files, writer.shape
        connection, first = self.workers, writer.folder / files[0].name
        cluster = with_store(connection.settings, writer.folder)
        store = cluster.store
        # others may have a folder of this name, and the same store
        name = str(first) if isinstance(first, RemotePath) else f"{platform.node()} {first.absolute()}"
        place = f"{store}/{digest(name)}" if store else first.with_name(f".{first.name}.parts")
        run = uuid.uuid4().hex  # parts of a command that died are not used again
        parts = Parts(Store(folder_at(place), NO_TILES, run), files, shape, run, codecs_of(files), cluster)
        if not store:
            check_space(writer.folder, part_bytes(files, *shape) + file_bytes(files, *shape), "files and their parts")
        failed = f"{first} could not be written"
        _remove(parts)
        try:
            noted = finish_parts(
                parts, connection, lambda rows: (function, arguments(rows)), lambda _: failed, stage, self.progress
            )
            copy_parts(parts, noted, writer, None if store else connection, self.progress)
        except BaseException:
            connection.at_end.callback(_remove, parts)  # once no worker writes any more
            raise
        _remove(parts)
        return [noted[0, number] for number in range(parts.rows[0])]


def pool_of(connection: Connection, out: Path, progress: Progress) -> EachOnWorkers:
    """Return the workers of a connection; threads of this process if those do not share the folder ``out``."""
    cluster = connection.settings
    is_shared = cluster.kind in ("threads", "processes") or isinstance(out, RemotePath) or not is_remote(cluster)
    return EachOnWorkers(connection if is_shared else connection.enter_context(Connection(Cluster(), out)), progress)


def _remove(parts: Parts) -> None:
    try:
        parts.store.remove([PARTS])
    except OSError as error:  # the files are whole, or another error is on its way
        _LOG.warning("parts of files stay in %s: %s", parts.store.folder, reason(error))


_FOUND = {
    "range": "the search range",
    "rows": "row offsets",
    "images": "mean and deviation of the images",
    "heights": "the heights of the ground",
    "shifts": "the shifts of the images",
    "extent": "the extent of the surface",
    "alignment": "the shifts of the runs",
}
