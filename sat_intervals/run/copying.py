"""Copy the finished parts of a run into its files, on workers that share its folder, else in this process."""

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

from sat_intervals.errors import RunError, SatIntervalsError
from sat_intervals.progress import Progress
from sat_intervals.raster import OutputWriter, Part, run_files
from sat_intervals.raster.old_publishing import open_own
from sat_intervals.run.job import Job
from sat_intervals.run.parts import codecs_of, rows_of_levels
from sat_intervals.run.strips import on_worker
from sat_intervals.run.workers import Task, Threads, Workers, reason
from sat_intervals.store.parts import PartKey

# Threads of this process that copy parts which workers cannot copy: one reads while another writes.
_THREADS = 2


def assemble_files(
    job: Job,
    writer: OutputWriter,
    records: Mapping[PartKey, Mapping[str, Any]],
    workers: Workers | None,
    progress: Progress,
) -> None:
    """Make the files of a run from its finished parts.

    Parameters
    ----------
    job
        The pair.
    writer
        Writes the files.
    records
        Records of all parts.
    workers
        Workers that are there, None without.
    progress
        Called after each part.

    Raises
    ------
    DamagedTilesError
        Names all damaged parts; they must be made again.
    OutputError, RunError
        A file cannot be written, or a part not be read.
    """
    files = run_files(job.config.products.compression)
    total = len(files) * len(records)
    copied: list[str | None] = []  # of each copied part None, or its name if it is damaged
    with _copiers(job, workers) as copiers:

        def copy_parts(path: Path, parts: Sequence[tuple[int, Part]]) -> None:
            for outcome in copiers.outcomes(_tasks(job, path, parts)):
                if outcome is not None and outcome.error is not None:
                    if isinstance(outcome.error, (OSError, SatIntervalsError)):
                        raise outcome.error
                    raise RunError(
                        f"a part of {path} could not be copied: {reason(outcome.error)}; rerun the same command: it "
                        "resumes"
                    ) from outcome.error
                if outcome is not None:
                    copied.append(outcome.result)
                progress("files", len(copied), total)

        progress("files", 0, total)
        for file in files:
            levels = [
                [_part(file.kind, (level, row), records[level, row]) for row in range(count)]
                for level, count in enumerate(rows_of_levels(job.store.grid.region))
            ]
            writer.assemble(file.name, levels, copy_parts)
    if damaged := [name for name in copied if name is not None]:
        raise job.parts().damaged(damaged)


@contextmanager
def _copiers(job: Job, workers: Workers | None) -> Iterator[Workers]:
    """Yield the workers if they reach the folder of the run, else threads of this process."""
    if isinstance(workers, Threads) or (workers is not None and job.store.elsewhere is None):
        yield workers
    else:
        with closing(Threads(_THREADS)) as threads:
            yield threads


def _part(kind: str, key: PartKey, record: Mapping[str, Any]) -> Part:
    return Part(record["blocks"][kind], record["files"][kind][1], (key, kind))


def _tasks(job: Job, path: Path, parts: Sequence[tuple[int, Part]]) -> Iterator[Task]:
    codecs, retries = codecs_of(job.config), job.config.cluster.retries
    for offset, part in parts:
        place = path.absolute(), offset  # workers have other working folders
        yield Task(part.source, copy_part, (job, codecs, *part.source, (part.length, part.checksum), place), retries)


def copy_part(
    job: Job,
    codecs: Mapping[str, Any],
    key: PartKey,
    kind: str,
    file: tuple[int, int],
    place: tuple[Path, int],
) -> str | None:
    """Write a part with a size and checksum into a file at an offset; return its name if it is damaged or missing."""
    path, offset = place
    with on_worker(job, codecs) as parts:
        content = parts.read(key, kind, file)
        if content is None:
            return parts.label(key, kind)
        # not for reading: NFS would write whole pages, over bytes of the neighbours
        with open(open_own(path, os.O_WRONLY), "wb") as stream:
            stream.seek(offset)
            stream.write(content)
            stream.flush()
            os.fsync(stream.fileno())
    return None
