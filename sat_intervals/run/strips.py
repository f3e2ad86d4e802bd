"""Finish strips of a run on workers: final bands, compressed as parts of the files, and overviews, as a binary tree."""

import zlib
from collections.abc import Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from sat_intervals.config import Config, HeightCalibration
from sat_intervals.errors import RunError, SatIntervalsError
from sat_intervals.kernels.conformal import AROUND, Margins, relief_of
from sat_intervals.match import postprocess, refinement
from sat_intervals.match.around import with_agreement
from sat_intervals.match.ground import GroundViews
from sat_intervals.match.memory import STRIP_PIXELS
from sat_intervals.match.postprocess import (
    ConfidenceScale,
    RawRows,
    cut_rows,
    halo,
    inner_rows,
    postprocess_strips,
    with_halo,
)
from sat_intervals.match.refinement import pixel_windows, pixels_of
from sat_intervals.match.statistics import Tally
from sat_intervals.prepare.local import given_disparities
from sat_intervals.products import SURFACE, Bands
from sat_intervals.progress import Progress
from sat_intervals.raster import BLOCK, codec_versions, compressed, factors, halved, read_views
from sat_intervals.run.job import Job
from sat_intervals.run.state import files_of_run
from sat_intervals.run.workers import Task, Workers, check_not_full, computing, picklable_errors, reason, results
from sat_intervals.store.arrays import DamagedFileError
from sat_intervals.store.manifest import digest
from sat_intervals.store.tiles import PARTS, DamagedTilesError
from sat_intervals.tiling import Window

PartKey = tuple[int, int]
"""Level of a file, 0 for its pixels, and row of blocks from the top."""

# What finishes rows decides their bytes, too. The number increases when parts change.
_CODE = *(zlib.crc32(Path(str(module.__file__)).read_bytes()) for module in (postprocess, refinement)), 2
_HALF = "half of {}"


def rows_of_levels(region: Window) -> list[int]:
    """Return the number of rows of blocks of each level."""
    return [-(-region.height // (factor * BLOCK)) for factor in factors(region.height, region.width)]


def codecs_of(config: Config) -> dict[str, Any]:
    """Return what decides the bytes of parts in this process, beside the run."""
    return codec_versions(config.products.compression) | {"code": _CODE}


def parts_of(job: Job) -> str:
    """Return what the parts of a run belong to: those of other settings or codecs are made again."""
    return digest({"run": job.name, "codecs": codecs_of(job.config)})


def part_name(key: PartKey) -> str:
    """Return the name of a part's file."""
    return f"{key[0]}_{key[1]}"


def finish_strips(
    job: Job, workers: Workers, scale: ConfidenceScale, progress: Progress
) -> dict[PartKey, dict[str, Any]]:
    """Make the parts of a run that are missing, once its tiles are done; return ``meta`` of all parts."""
    counts, height = rows_of_levels(job.store.grid.region), job.store.grid.region.height
    keys = [(level, row) for level in reversed(range(len(counts))) for row in range(counts[level])]
    of = parts_of(job)
    done = {key for key in keys if job.store.meta(PARTS, part_name(key), of)}
    waiting = [key for key in keys if key not in done]
    damaged: list[str] = []

    def tasks() -> Iterator[Task | None]:
        while waiting:
            ready = (key for key in waiting if all(below in done for below in _below(key, counts)))
            if (key := next(ready, None)) is None:
                yield None
            else:
                waiting.remove(key)
                more = [_below(key, counts)] if key[0] else [scale]
                function = reduce_rows if key[0] else finish_strip
                yield Task(key, function, (job, of, key, *more), job.config.cluster.retries)

    def look(_: int) -> None:
        progress("bands", min(height, BLOCK * sum(level == 0 for level, _ in done)), height)

    for key, damage in results(workers, tasks(), partial(_fail, job), look) if waiting else ():
        if damage is None:
            done.add(key)
        else:
            damaged.append(damage)  # the other strips are finished before tiles are matched again
    if damaged:
        raise DamagedTilesError(damaged[0])
    found = {key: meta for key in keys if (meta := job.store.meta(PARTS, part_name(key), of)) is not None}
    if missing := [part_name(key) for key in keys if key not in found]:
        raise damaged_parts(job, missing)
    progress("bands", height, height)
    return found


def damaged_parts(job: Job, names: Sequence[str]) -> DamagedTilesError:
    """Delete parts; return the error that says that they must be made again."""
    job.store.delete(PARTS, names)
    return DamagedTilesError(
        f"parts {', '.join(names)} in {job.store.folder} are damaged or missing: rerun the same command: it makes "
        "them again"
    )


def _below(key: PartKey, counts: Sequence[int]) -> list[PartKey]:
    """Return the one or two rows of the level below that a row of an overview is made of."""
    level, row = key
    return [(level - 1, below) for below in (2 * row, 2 * row + 1) if level and below < counts[level - 1]]


def _fail(job: Job, key: PartKey, error: BaseException) -> NoReturn:
    check_not_full(error, job.store.folder)
    if isinstance(error, SatIntervalsError):  # names files and the way out
        raise error
    level, row = key
    first, last = (min(job.store.grid.region.height, BLOCK * (there << level)) for there in (row, row + 1))
    raise RunError(
        f"rows {first} to {last - 1} could not be finished: {reason(error)}; rerun the same command: it resumes"
    ) from error


def finish_strip(job: Job, of: str, key: PartKey, scale: ConfidenceScale) -> str | None:
    """Make the part of a strip; return what is wrong if tiles are damaged. Runs on a worker."""
    # also while it reads and writes: more strips at once would need more memory than `check_tiles` allows for
    with picklable_errors(), computing(job.config.cluster):
        check_codecs(job, of)
        region = job.store.grid.region
        search = job.config.disparity
        margin = halo(job.config) + (AROUND if job.swept and job.swept.calibration else 0)
        first, last = key[1] * BLOCK, min(region.height, (key[1] + 1) * BLOCK)
        top, bottom = max(0, first - margin), min(region.height, last + margin)
        shape, extra = (last - first, region.width), () if job.swept else job.config.extra_bands
        bands = len(SURFACE) if job.swept else 4 + len(extra)
        intervals, validity = np.empty((bands, *shape), np.float32), np.empty((1, *shape), np.uint16)
        given = given_disparities(job.config, Window(region.row + first, region.column, *shape))
        tally, row = Tally(search.count, search.minimum), 0
        counts = list[np.ndarray]()
        try:
            finals = postprocess_strips(raw_rows(job, job.config, top, bottom, counts), scale, job.config)
            if job.swept and job.swept.calibration:
                finals = _widened(finals, job.swept.calibration, job.ground())
            for final in inner_rows(finals, first - top, shape[0]):
                rows = slice(row, row := row + len(final.validity))
                if given is not None:
                    final = with_agreement(final, given[rows])
                intervals[: 4 + len(extra), rows] = [*final[:4], *(getattr(final, name) for name in extra)]
                validity[:, rows] = final.validity
                tally.add(final)
        except DamagedTilesError as error:
            return str(error)
        if job.swept:
            _to_heights(intervals, np.concatenate(counts)[first - top :][: shape[0]], job.ground())
        _write(job, of, key, [intervals, validity], counts=tally.counts())
    return None


def _widened(finals: Iterable[Bands], calibration: HeightCalibration, ground: GroundViews | None) -> Iterator[Bands]:
    """Yield the final bands of a sweep with bounds that are moved by the margins of a calibration of heights."""
    assert ground is not None
    margins = Margins(*calibration.table())
    for rows, first, last in with_halo(finals, AROUND):
        final, relief = cut_rows(rows, first, last), relief_of(ground.step * rows.disparity)[first:last]
        middle, low, high = (ground.step * band.astype(np.float64) for band in final[:3])
        lower, upper = (end / ground.step for end in margins.widened(middle, low, high, relief))
        yield final._replace(lower=lower.astype(np.float32), upper=upper.astype(np.float32))


def _to_heights(bands: np.ndarray, count: np.ndarray, ground: GroundViews | None) -> None:
    """Turn disparities, which are steps of height, their bounds and confidence into the bands of SURFACE, in place."""
    assert ground is not None
    unknown = ~np.isfinite(bands[0])
    bands[4], bands[3] = bands[3], count
    bands[3:5, unknown] = np.nan
    bands[5] = np.nan
    for band in bands[:3]:
        band[:] = ground.base + ground.step * band.astype(np.float64)


def raw_rows(
    job: Job, config: Config, first: int, last: int, counts: list[np.ndarray] | None = None
) -> Iterator[RawRows]:
    """Yield raw products of the rows ``[first, last)`` of the region, with the pixels that the settings need.

    The images that see the cells of a sweep are appended to ``counts``.
    """
    region, search = job.store.grid.region, config.disparity
    if config.fits:
        window = Window(region.row + first, region.column, last - first, region.width)
        left, right = pixels_of(read_views((job.left, job.right), pixel_windows(window, config)))
    row = 0
    for piece in job.store.strips(max(1, STRIP_PIXELS // region.width), search.count, first, last):
        if (count := piece.pop("count", None)) is not None and counts is not None:
            counts.append(count)
        rows = RawRows(
            **{"lower_low": piece["lower"], "upper_low": piece["upper"]} | piece
        )  # both if there is one level
        here = slice(row, row := row + len(rows.winner))
        yield rows._replace(left=left[here], right=right[here]) if config.fits else rows


def reduce_rows(job: Job, of: str, key: PartKey, below: Sequence[PartKey]) -> str | None:
    """Make a row of blocks of an overview from parts of the level below; return what is wrong if one is damaged."""
    with picklable_errors():
        check_codecs(job, of)
        halves = []
        for part in map(part_name, below):
            try:
                with job.store.opened(PARTS, part, of) as archive:
                    halves.append([archive[_HALF.format(file.kind)] for file in files_of_run(job.config)])
            except DamagedFileError:
                return str(damaged_parts(job, [part]))
        _write(job, of, key, [np.concatenate(of_file, axis=1) for of_file in zip(*halves, strict=True)])
    return None


def _write(job: Job, of: str, key: PartKey, rasters: list[np.ndarray], **meta: Any) -> None:
    """Write a part; ``rasters`` are emptied on the way, to save memory."""
    blocks: dict[str, list[int]] = {}
    is_top = key[0] + 1 == len(rows_of_levels(job.store.grid.region))

    def arrays() -> Iterator[tuple[str, np.ndarray]]:
        for file in files_of_run(job.config):
            raster = rasters.pop(0)
            made = compressed(raster, file)
            blocks[file.kind] = made.sizes
            yield file.kind, np.frombuffer(made.content, np.uint8)
            del made
            if not is_top:
                yield _HALF.format(file.kind), halved(raster)

    job.store.write(PARTS, part_name(key), arrays(), of=of, blocks=blocks, **meta)


def check_codecs(job: Job, of: str) -> None:
    """Raise if this process, a worker, makes other bytes than the command."""
    job.check_version()
    if of != parts_of(job):
        raise RunError(
            f"this worker compresses with {codecs_of(job.config)}, the command with other versions: install the same "
            "version of rasterio for all"
        )
