"""Finish strips of a run on workers: final bands, as parts of the files."""

from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np

from sat_intervals.config import HeightCalibration
from sat_intervals.kernels.conformal import AROUND, Margins, relief_of
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
from sat_intervals.prepare.pair import Rows
from sat_intervals.products import SURFACE, Bands
from sat_intervals.progress import Progress
from sat_intervals.raster import read_views
from sat_intervals.run.job import Job
from sat_intervals.run.parts import PartKey, Parts, codecs_of, finish_parts
from sat_intervals.run.state import files_of_run
from sat_intervals.run.workers import Workers
from sat_intervals.tiling import Window


def parts_of(job: Job) -> Parts:
    """Return the parts of the files of a run."""
    files, region = files_of_run(job.config), job.store.grid.region
    return Parts(job.store, files, (region.height, region.width), job.name, codecs_of(files), job.config.cluster)


def finish_strips(
    job: Job, parts: Parts, workers: Workers, scale: ConfidenceScale, progress: Progress
) -> dict[PartKey, dict[str, Any]]:
    """Make the parts of a run that are missing, once its tiles are done; return ``meta`` of all parts."""
    return finish_parts(
        parts,
        workers,
        lambda strip: (finish_strip, (job, strip, scale)),
        lambda rows: f"rows {rows.row} to {rows.row_stop - 1} could not be finished",
        "bands",
        progress,
    )


def finish_strip(job: Job, strip: Window, scale: ConfidenceScale) -> Rows:
    """Return the bands and the counts of a strip of the region; runs on a worker."""
    job.check_version()
    region = job.store.grid.region
    search = job.config.disparity
    margin = halo(job.config) + (AROUND if job.swept and job.swept.calibration else 0)
    read = strip.grown(margin, 0).clipped(Window(0, 0, region.height, region.width))
    shape, extra = (strip.height, strip.width), () if job.swept else job.config.extra_bands
    bands = len(SURFACE) if job.swept else 4 + len(extra)
    intervals, validity = np.empty((bands, *shape), np.float32), np.empty((1, *shape), np.uint16)
    given = given_disparities(job.config, Window(region.row + strip.row, region.column, *shape))
    tally, row = Tally(search.count, search.minimum), 0
    counts = list[np.ndarray]()
    finals = postprocess_strips(raw_rows(job, read.row, read.row_stop, counts), scale, job.config)
    if job.swept and job.swept.calibration:
        finals = _widened(finals, job.swept.calibration, job.ground())
    for final in inner_rows(finals, strip.row - read.row, strip.height):
        rows = slice(row, row := row + len(final.validity))
        if given is not None:
            final = with_agreement(final, given[rows])
        intervals[: 4 + len(extra), rows] = [*final[:4], *(getattr(final, name) for name in extra)]
        validity[:, rows] = final.validity
        tally.add(final)
    if job.swept:
        _to_heights(intervals, np.concatenate(counts)[strip.row - read.row :][: strip.height], job.ground())
    return [intervals, validity], {"counts": tally.counts()}


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


def raw_rows(job: Job, first: int, last: int, counts: list[np.ndarray] | None = None) -> Iterator[RawRows]:
    """Yield raw products of the rows ``[first, last)`` of the region, with the pixels that the settings need.

    The images that see the cells of a sweep are appended to ``counts``.
    """
    region, config = job.store.grid.region, job.config
    if config.fits:
        window = Window(region.row + first, region.column, last - first, region.width)
        left, right = pixels_of(read_views((job.left, job.right), pixel_windows(window, config)))
    row = 0
    for piece in job.store.strips(max(1, STRIP_PIXELS // region.width), config.disparity.count, first, last):
        if (count := piece.pop("count", None)) is not None and counts is not None:
            counts.append(count)
        rows = RawRows(
            **{"lower_low": piece["lower"], "upper_low": piece["upper"]} | piece
        )  # both if there is one level
        here = slice(row, row := row + len(rows.winner))
        yield rows._replace(left=left[here], right=right[here]) if config.fits else rows
