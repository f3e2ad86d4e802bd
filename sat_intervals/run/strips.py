"""Finish strips of a run on workers: final bands, compressed as parts of the files, and overviews of finished parts.

A strip is one row of blocks. It is computed in pieces, so memory depends on the width only. A row of blocks of an
overview is made of two rows of the level below it, so the parts form a binary tree.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from io import BytesIO
from typing import Any, NoReturn

import numpy as np

from sat_intervals.errors import RunError, SatIntervalsError
from sat_intervals.match.memory import STRIP_PIXELS
from sat_intervals.match.postprocess import ConfidenceScale, RawRows, halo, postprocess_strip
from sat_intervals.progress import Progress
from sat_intervals.raster import BLOCK, RUN_FILES, compressed, run_files
from sat_intervals.run.job import Job
from sat_intervals.run.parts import codecs_of, rows_of_levels
from sat_intervals.run.statistics import Tally
from sat_intervals.run.workers import Task, Workers, check_not_full, computing, reason
from sat_intervals.store.parts import PartKey, Parts
from sat_intervals.store.tiles import DamagedTilesError, Records

# Pixels for the next level, not compressed: every second row and column of all files.
_HALF = "half"


def finish_strips(
    job: Job, client: Callable[[], Workers], scale: ConfidenceScale, records: Records, progress: Progress
) -> tuple[dict[PartKey, dict[str, Any]], Workers | None]:
    """Make the parts of a run that are missing; return the records of all, and the workers if these were needed.

    Parameters
    ----------
    job
        The pair.
    client
        Returns the client of the cluster; called if parts are missing.
    scale
        See `postprocess_rows`.
    records
        Records of all tiles.
    progress
        Called after each strip.

    Raises
    ------
    DamagedTilesError
        Tiles must be matched again.
    RunError
        A strip failed.
    """
    parts = job.parts()
    region = job.store.grid.region
    counts = rows_of_levels(region)
    height = region.height
    keys = [(level, row) for level in reversed(range(len(counts))) for row in range(counts[level])]
    done = set(parts.done())
    waiting = [key for key in keys if key not in done]
    job.check_space([], len(done))
    parts.begin()
    tiles: list[str] = []  # what is wrong with tiles
    damaged: list[str] = []  # names of parts

    def tasks() -> Iterator[Task | None]:
        while waiting:
            ready = (key for key in waiting if all(below in done for below in _below(key, counts)))
            if (key := next(ready, None)) is None:
                yield None
            else:
                waiting.remove(key)
                yield _task(job, key, counts, scale, records)

    workers = client() if waiting else None
    for outcome in workers.outcomes(tasks()) if workers else ():
        if outcome is not None and outcome.error is not None:
            _fail(job, outcome.label, outcome.error)
        if outcome is not None and outcome.result is not None:
            # the other strips are finished before the tiles are matched again
            (damaged if outcome.label[0] else tiles).append(outcome.result)
        elif outcome is not None:
            done.add(outcome.label)
        progress("bands", min(height, BLOCK * sum(level == 0 for level, _ in done)), height)
    if tiles:
        raise DamagedTilesError(tiles[0])
    finished = parts.done()
    if damaged := damaged or [parts.label(key) for key in sorted(set(keys) - finished.keys())]:
        raise parts.damaged(damaged)
    progress("bands", height, height)
    return finished, workers


def _below(key: PartKey, counts: Sequence[int]) -> list[PartKey]:
    """Return the one or two rows of the level below that a row of an overview is made of."""
    level, row = key
    return [(level - 1, below) for below in (2 * row, 2 * row + 1) if level and below < counts[level - 1]]


def _task(job: Job, key: PartKey, counts: Sequence[int], scale: ConfidenceScale, records: Records) -> Task:
    codecs, retries = codecs_of(job.config), job.config.cluster.retries
    if key[0]:
        return Task(key, reduce_rows, (job, codecs, key, _below(key, counts)), retries)
    top, bottom = _rows(job, key[1], halo(job.config))
    grid = job.store.grid
    needed = range(top // grid.size, -(-bottom // grid.size))
    names = [grid.tile(row, column).name for row in needed for column in range(grid.columns)]
    files = {name: {"files": records[name]["files"]} for name in names}
    return Task(key, finish_strip, (job, codecs, key, files, scale), retries)


def _rows(job: Job, row: int, margin: int = 0) -> tuple[int, int]:
    """Return the first row of a strip, and the one after its last, grown by a margin inside the region."""
    height = job.store.grid.region.height
    return max(0, row * BLOCK - margin), min(height, (row + 1) * BLOCK + margin)


def _fail(job: Job, key: PartKey, error: BaseException) -> NoReturn:
    check_not_full(error, job.store.folder)
    if isinstance(error, SatIntervalsError):  # names files and the way out
        raise error
    level, row = key
    first, last = (min(job.store.grid.region.height, BLOCK * (there << level)) for there in (row, row + 1))
    raise RunError(
        f"rows {first} to {last - 1} could not be finished: {reason(error)}; rerun the same command: it resumes"
    ) from error


def finish_strip(
    job: Job, codecs: Mapping[str, Any], key: PartKey, records: Records, scale: ConfidenceScale
) -> str | None:
    """Make the part of a strip; return what is wrong if tiles are damaged. Runs on a worker.

    ``records`` are those of the tiles of its rows and their halo.
    """
    # also while it reads and writes: more strips at once would need more memory than `check_tiles` allows for
    with on_worker(job, codecs) as parts, computing(job.config.cluster):
        (first, last), (top, bottom) = _rows(job, key[1]), _rows(job, key[1], halo(job.config))
        shape, search = (last - first, job.store.grid.region.width), job.config.disparity
        intervals, validity = np.empty((4, *shape), np.float32), np.empty((1, *shape), np.uint16)
        tally, row = Tally(search.count, search.minimum), 0
        raw = job.store.strips(max(1, STRIP_PIXELS // shape[1]), records, top, bottom)
        try:
            for final in postprocess_strip(
                (RawRows(**piece) for piece in raw), first - top, shape[0], scale, job.config
            ):
                rows = slice(row, row := row + len(final.validity))
                intervals[:, rows], validity[:, rows] = final[:4], final.validity
                tally.add(final)
        except DamagedTilesError as error:
            return str(error)
        _write(job, parts, key, (intervals, validity), {"counts": tally.counts()})
    return None


def reduce_rows(job: Job, codecs: Mapping[str, Any], key: PartKey, below: Sequence[PartKey]) -> str | None:
    """Make a row of blocks of an overview from parts of the level below; return the name of one that is damaged."""
    with on_worker(job, codecs) as parts:
        halves = []
        for part in below:
            record = parts.record(part)
            if record is None:
                return parts.label(part)
            content = parts.read(part, _HALF, record["files"][_HALF])
            if content is None:
                return parts.label(part, _HALF)
            halves.append(_half(content, record["half"]))
        rasters = [np.concatenate(of_file, axis=1) for of_file in zip(*halves, strict=True)]
        _write(job, parts, key, rasters, {})
    return None


def _half(content: bytes, shape: Sequence[int]) -> list[np.ndarray]:
    """Return the rasters of all files from the content of a half of ``shape``."""
    rasters, start = [], 0
    for file in RUN_FILES:
        whole = len(file.bands), *shape
        rasters.append(np.frombuffer(content, file.dtype, int(np.prod(whole)), start).reshape(whole))
        start += rasters[-1].nbytes
    return rasters


def _write(job: Job, parts: Parts, key: PartKey, rasters: Sequence[np.ndarray], record: Mapping[str, Any]) -> None:
    """Write a part, one content after another, so that only one is in memory."""
    blocks, files = {}, {}
    for file, raster in zip(run_files(job.config.products.compression), rasters, strict=True):
        made = compressed(raster, file)
        blocks[file.kind], files[file.kind] = made.sizes, parts.write(key, file.kind, made.content)
        del made
    halves = [raster[:, ::2, ::2] for raster in rasters]
    if key[0] + 1 < len(rows_of_levels(job.store.grid.region)):
        content = BytesIO()
        content.writelines(band.tobytes() for half in halves for band in half)
        files[_HALF] = parts.write(key, _HALF, content.getvalue())
    parts.write_record(key, {**record, "blocks": blocks, "half": halves[0].shape[1:], "files": files})


@contextmanager
def on_worker(job: Job, codecs: Mapping[str, Any]) -> Iterator[Parts]:
    """Check that a worker makes the same bytes as the others; yield the parts of the run."""
    try:
        try:
            job.store.check(job.manifest)
        except OSError as error:
            raise RunError(f"{job.store.folder} cannot be read: {reason(error)}") from error
        here = codecs_of(job.config)
        if here != codecs:
            raise RunError(
                f"this worker compresses with {here}, the command with {dict(codecs)}: install the same "
                "version of rasterio for all"
            )
        yield job.parts(codecs)
    except SatIntervalsError as error:
        error.__cause__ = error.__context__ = None  # errors of GDAL cannot be pickled
        raise
