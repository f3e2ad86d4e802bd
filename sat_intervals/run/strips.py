"""Finish strips of a run on workers: final bands, compressed as parts of the files, and overviews of finished parts.

A strip is one row of blocks. It is computed in pieces, so memory depends on the width only. A row of blocks of an
overview is made of two rows of the level below it, so the parts form a binary tree.
"""

import os
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from sat_intervals.errors import RunError, SatIntervalsError
from sat_intervals.match import postprocess
from sat_intervals.match.postprocess import ConfidenceScale, RawRows, halo, postprocess_strip
from sat_intervals.progress import Progress
from sat_intervals.raster import BLOCK, RUN_FILES, Copy, Part, codec_versions, compressed, factors, run_files
from sat_intervals.run.job import Job
from sat_intervals.run.statistics import Tally
from sat_intervals.run.workers import Task, Workers, check_not_full, reason
from sat_intervals.store.manifest import digest
from sat_intervals.store.parts import Parts, Place
from sat_intervals.store.tiles import DamagedTilesError, Records

# Pixels of a piece, in whole rows; each takes about 100 bytes.
STRIP_PIXELS = 1 << 19
# Bytes of compressed blocks and of the half per pixel.
_COMPRESSED = 12
# Pixels for the next level, not compressed: every second row and column of all files.
_HALF = "half"
# What finishes rows decides their bytes, too.
_CODE = zlib.crc32(Path(postprocess.__file__).read_bytes())
# Increase when parts change.
_LAYOUT = 1


def parts_of(job: Job, codecs: Mapping[str, Any] | None = None) -> Parts:
    """Return the parts of a run; ``codecs`` are the versions of the codecs, by default those of this process."""
    made_by = {"run": job.name, "codecs": codecs or _codecs(job), "layout": _LAYOUT}
    return Parts(job.store.folder, digest(made_by))


def _codecs(job: Job) -> dict[str, Any]:
    return codec_versions(job.config.products.compression) | {"code": _CODE}


def strip_bytes(width: int) -> int:
    """Return the memory of a strip in bytes: its final bands, its compressed blocks and half, and a piece."""
    pixel = sum(len(file.bands) * np.dtype(file.dtype).itemsize for file in RUN_FILES)
    return (pixel + _COMPRESSED) * BLOCK * width + 100 * max(STRIP_PIXELS, 64 * width)


def _levels(job: Job) -> list[int]:
    """Return the number of rows of blocks of each level."""
    region = job.store.grid.region
    return [-(-region.height // (factor * BLOCK)) for factor in factors(region.height, region.width)]


def check_done(job: Job, records: Records) -> None:
    """Raise if tiles are missing; a retry restores them."""
    missing = [tile.name for tile in job.store.grid if tile.name not in records]
    if missing:
        raise DamagedTilesError(
            f"tiles {', '.join(missing)} are missing in {job.store.folder}: rerun the same command: it resumes"
        )


def check_matched(job: Job, records: Records, searched: int) -> None:
    """Raise if no pixel could be matched, with the likely reason."""
    if searched:
        return
    usable = {side: sum(record["usable_pixels"][side] for record in records.values()) for side in ("left", "right")}
    empty = [image.path for image, side in ((job.left, "left"), (job.right, "right")) if not usable[side]]
    search, window = job.config.disparity, job.config.cost.window
    reason = (
        f"all pixels of {' and '.join(empty)} are no data or masked"
        if empty
        else f"nowhere do both images have {window} x {window} usable pixels"
    )
    raise SatIntervalsError(
        f"no pixel of {job.left.path} can be matched in {job.right.path} over disparities {search.minimum} to "
        f"{search.maximum}, {reason}: check no-data values, masks, window and search range"
    )


def finish_strips(
    job: Job, client: Callable[[], Workers], scale: ConfidenceScale, records: Records, progress: Progress
) -> tuple[dict[Place, dict[str, Any]], Copy | None]:
    """Make the parts of a run that are missing; return the records of all, and how workers copy them into a file.

    Workers copy if they are there and share the folder of the run with this process.

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
    parts, counts, height = parts_of(job), _levels(job), job.store.grid.region.height
    places = [(level, row) for level in reversed(range(len(counts))) for row in range(counts[level])]
    done = set(parts.done())
    waiting = [place for place in places if place not in done]
    damage: list[str] = []

    def tasks() -> Iterator[Task | None]:
        while waiting:
            ready = (place for place in waiting if all(below in done for below in _below(place, counts)))
            if (place := next(ready, None)) is None:
                yield None
            else:
                waiting.remove(place)
                yield _task(job, place, counts, scale, records)

    workers = client() if waiting else None
    for outcome in workers.outcomes(tasks()) if workers else ():
        if outcome is not None and outcome.error is not None:
            _raise(job, outcome.label, outcome.error)
        elif outcome is not None and outcome.result is not None:
            damage.append(outcome.result)  # the other strips are finished before the tiles are matched again
        elif outcome is not None:
            done.add(outcome.label)
        progress("bands", min(height, BLOCK * sum(level == 0 for level, _ in done)), height)
    if not damage:
        progress("bands", height, height)
        finished = parts.done()
        damage = [f"part {level}_{row} is missing in {parts.folder}" for level, row in set(places) - finished.keys()]
    if damage:
        raise DamagedTilesError(damage[0])
    return finished, partial(copy_parts, job, workers) if workers and job.store.elsewhere is None else None


def _below(place: Place, counts: Sequence[int]) -> list[Place]:
    """Return the one or two rows of the level below that a row of an overview is made of."""
    level, row = place
    return [(level - 1, below) for below in (2 * row, 2 * row + 1) if level and below < counts[level - 1]]


def _task(job: Job, place: Place, counts: Sequence[int], scale: ConfidenceScale, records: Records) -> Task:
    codecs, retries = _codecs(job), job.config.cluster.retries
    if place[0]:
        return Task(place, reduce_rows, (job, codecs, place, _below(place, counts)), retries)
    top, bottom = _rows(job, place[1], halo(job.config))
    grid = job.store.grid
    needed = range(top // grid.size, -(-bottom // grid.size))
    names = [grid.tile(row, column).name for row in needed for column in range(grid.columns)]
    files = {name: {"files": records[name]["files"]} for name in names}
    return Task(place, finish_strip, (job, codecs, place, files, scale), retries)


def _rows(job: Job, row: int, margin: int = 0) -> tuple[int, int]:
    """Return the first row of a strip, and the one after its last, grown by a margin inside the region."""
    height = job.store.grid.region.height
    return max(0, row * BLOCK - margin), min(height, (row + 1) * BLOCK + margin)


def _raise(job: Job, place: Place, error: BaseException) -> None:
    check_not_full(error, job.store.folder)
    if isinstance(error, (DamagedTilesError, SatIntervalsError)) and not isinstance(error, RunError):
        raise error
    first, last = _rows(job, place[1] << place[0])
    raise RunError(
        f"rows {first} to {last - 1} could not be finished: {reason(error)}; rerun the same command: it resumes"
    ) from error


def finish_strip(
    job: Job, codecs: Mapping[str, Any], place: Place, records: Records, scale: ConfidenceScale
) -> str | None:
    """Make the part of a strip; return what is wrong if tiles are damaged. Runs on a worker.

    ``records`` are those of the tiles of its rows and their halo.
    """
    with _on_worker(job, codecs) as parts:
        (first, last), (top, bottom) = _rows(job, place[1]), _rows(job, place[1], halo(job.config))
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
        _write(job, parts, place, (intervals, validity), {"counts": tally.counts()})
    return None


def reduce_rows(job: Job, codecs: Mapping[str, Any], place: Place, below: Sequence[Place]) -> str | None:
    """Make a row of blocks of an overview from parts of the level below; see `finish_strip`."""
    with _on_worker(job, codecs) as parts:
        halves = []
        for part in below:
            record = parts.record(part)
            if record is None:
                return f"part {part[0]}_{part[1]} is missing in {parts.folder}"
            try:
                halves.append(_half(parts.read(part, _HALF, record), record["half"]))
            except DamagedTilesError as error:
                return str(error)
        rasters = [np.concatenate(of_file, axis=1) for of_file in zip(*halves, strict=True)]
        _write(job, parts, place, rasters, {})
    return None


def _half(content: bytes, shape: Sequence[int]) -> list[np.ndarray]:
    """Return the rasters of all files from the content of a half of ``shape``."""
    rasters, start = [], 0
    for file in RUN_FILES:
        whole = len(file.bands), *shape
        rasters.append(np.frombuffer(content, file.dtype, int(np.prod(whole)), start).reshape(whole))
        start += rasters[-1].nbytes
    return rasters


def _write(job: Job, parts: Parts, place: Place, rasters: Sequence[np.ndarray], record: Mapping[str, Any]) -> None:
    contents, blocks = {}, {}
    for file, raster in zip(run_files(job.config.products.compression), rasters, strict=True):
        kind = file.name.partition(".")[0]
        blocks[kind], contents[kind] = compressed(raster, file)
    halves = [raster[:, ::2, ::2] for raster in rasters]
    if place[0] + 1 < len(_levels(job)):
        contents[_HALF] = b"".join(half.tobytes() for half in halves)
    parts.write(place, contents, {**record, "blocks": blocks, "half": halves[0].shape[1:]})


def copy_parts(job: Job, workers: Workers, path: Path, parts: Sequence[tuple[int, Part]]) -> None:
    """Write parts into a file at their offsets, on workers.

    Raises
    ------
    DamagedTilesError
        Parts must be made again.
    OSError
        The file cannot be written.
    """
    codecs, retries = _codecs(job), job.config.cluster.retries
    tasks = (Task(part.label, copy_part, (job, codecs, *part.label, path, at), retries) for at, part in parts)
    for outcome in workers.outcomes(tasks):
        if outcome is not None and outcome.error is not None:
            if isinstance(outcome.error, (OSError, DamagedTilesError)):
                raise outcome.error
            raise RunError(f"{path} cannot be written: {reason(outcome.error)}") from outcome.error
        if outcome is not None and outcome.result is not None:
            raise DamagedTilesError(outcome.result)


def copy_part(job: Job, codecs: Mapping[str, Any], place: Place, kind: str, path: Path, offset: int) -> str | None:
    """Write a part into a file; see `finish_strip`."""
    with _on_worker(job, codecs) as parts:
        record = parts.record(place)
        try:
            content = parts.read(place, kind, record or {"files": {kind: ()}})
        except DamagedTilesError as error:
            return str(error)
        # not for reading: NFS would write whole pages, over bytes of the neighbours
        with open(os.open(path, os.O_WRONLY), "wb") as stream:
            stream.seek(offset)
            stream.write(content)
            stream.flush()
            os.fsync(stream.fileno())
    return None


@contextmanager
def _on_worker(job: Job, codecs: Mapping[str, Any]) -> Iterator[Parts]:
    """Check that a worker makes the same bytes as the others; yield the parts of the run."""
    try:
        job.store.check(job.manifest)
        if _codecs(job) != codecs:
            raise RunError(
                f"this worker compresses with {_codecs(job)}, the command with {dict(codecs)}: install the same "
                "version of rasterio for all"
            )
        yield parts_of(job, codecs)
    except SatIntervalsError as error:
        error.__cause__ = error.__context__ = None  # errors of GDAL cannot be pickled
        raise


def levels_of(job: Job, name: str, records: Mapping[Place, Mapping[str, Any]]) -> list[list[Part]]:
    """Return the parts of a file, for `OutputWriter.put_together`; they are read when they are needed."""
    parts, kind = parts_of(job), name.partition(".")[0]

    def part(place: Place) -> Part:
        record = records[place]
        _, crc = record["files"][kind]
        return Part(record["blocks"][kind], crc, lambda: parts.read(place, kind, record), (place, kind))

    return [[part((level, row)) for row in range(count)] for level, count in enumerate(_levels(job))]
