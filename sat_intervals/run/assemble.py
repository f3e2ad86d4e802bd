"""Put the files of a run together from finished parts, compare its inputs, and publish."""

import logging
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from hashlib import file_digest
from pathlib import Path
from typing import Any

import numpy as np

from sat_intervals.errors import REPORT, ChangedInputError, RunError, SatIntervalsError
from sat_intervals.match.postprocess import ConfidenceScale, confidence_scale
from sat_intervals.products import as_json
from sat_intervals.progress import Progress, logged_stage
from sat_intervals.raster import OutputError, OutputWriter
from sat_intervals.raster.completion import complete
from sat_intervals.raster.identity import absolute_in
from sat_intervals.raster.publishing import new_file
from sat_intervals.run.inputs import check_unchanged
from sat_intervals.run.job import Job, remove_tiles
from sat_intervals.run.parts import copy_parts
from sat_intervals.run.report import report_of, tags_of
from sat_intervals.run.state import RUN_REPORT
from sat_intervals.run.strips import finish_strips, parts_of
from sat_intervals.run.workers import Workers, reason
from sat_intervals.store.tiles import COSTS, FAILURES, PARTS, PIXELS, Tables, home_of

_LOG = logging.getLogger(__name__)
_WARNINGS = logging.getLogger(REPORT)


def assemble(job: Job, workers: Workers, seconds: dict[str, float], progress: Progress) -> dict[str, Any]:
    """Write and publish the files of a run whose tiles are done; return the content of ``run.json``."""
    region, tables = job.store.grid.region, job.store.tables()
    scale = scale_of(job, tables)
    with logged_stage(seconds, "bands"):
        parts = parts_of(job)
        made_of = finish_strips(job, parts, workers, scale, progress)
    files, place = parts.files, job.left.georeferencing.shifted(region)
    with (
        _resumable(job),
        OutputWriter(job.out, files, region.height, region.width, place, tags_of(job)) as writer,
    ):
        with logged_stage(seconds, "files"):
            copy_parts(parts, made_of, writer, workers if job.is_home else None, progress)
            made, completed = writer.build(), None
            if job.swept and job.swept.completion:
                surface = made[files[0].name]
                completed = complete(surface, surface, files[0], job.swept.completion, progress)
        with logged_stage(seconds, "inputs"):
            check_unchanged(absolute_in(job.out, job.inputs), job.images, job.config)
        report = report_of(job, tables, scale, made_of.values(), seconds)
        if completed:
            report["sweep"]["completed"] = completed
        for line in report["warnings"]:
            _WARNINGS.warning("%s", line)
        _publish(job, writer, made, report)
    return report | {"inputs": absolute_in(job.out, job.inputs)}


def _publish(job: Job, writer: OutputWriter, made: Mapping[str, Path], report: dict[str, Any]) -> None:
    """Give the files their names, ``run.json`` last; files that are there must be the same, or may be replaced."""
    for name, new in made.items():
        there = job.out / name
        if not job.overwrite and there.exists() and not _is_same(there, new):
            raise SatIntervalsError(f"{there} is not of this run: move it away or give --overwrite; the tiles are kept")
    with new_file(job.out / RUN_REPORT) as new:  # gets its name last
        new.write_bytes((as_json(report) + "\n").encode())
        (job.out / RUN_REPORT).unlink(missing_ok=True)  # never beside files of another run
        writer.publish()


def _is_same(one: Path, other: Path) -> bool:
    with one.open("rb") as there, other.open("rb") as new:
        return file_digest(there, "sha256").digest() == file_digest(new, "sha256").digest()


def end_tiles(job: Job, *, keep_tiles: bool) -> None:
    """Remove the tiles of a complete run, or what is beside them if they are kept."""
    try:
        if not keep_tiles:
            remove_tiles(job.out)
        elif home_of(job.out).exists():
            job.store.remove([PIXELS, COSTS, PARTS, FAILURES])
    except OSError as error:  # the run is complete
        _LOG.warning("tiles of the complete run stay: %s", reason(error))


@contextmanager
def _resumable(job: Job) -> Iterator[None]:
    """Turn an OutputError into a RunError, since the run can be resumed; delete tiles of inputs that have changed."""
    try:
        yield
    except ChangedInputError:
        remove_tiles(job.out)
        raise
    except OutputError as error:
        raise RunError(f"{error}; rerun the same command: it resumes from the tiles, which are all done") from error


# ---- Scale of confidence -----------------------------------------------------------------------------------
def scale_of(job: Job, tables: Tables) -> ConfidenceScale:
    """Return the scale of confidence of a run; NaN without confidence. Raise if no pixel could be matched."""
    if not tables.histogram.any():
        raise _nothing_matched(job, tables)
    nothing = ConfidenceScale(np.nan, np.nan)
    if not job.config.ambiguity:
        return nothing
    return confidence_scale(job.config.ambiguity, tables.histogram, job.config.cost.rejected)


def _nothing_matched(job: Job, tables: Tables) -> SatIntervalsError:
    records = tables.records.values()
    empty = [
        image.path
        for side, image in job.images.items()
        if not any(one["usable_pixels"].get(side, 1) for one in records)
    ]
    search, window = job.config.disparity, job.config.cost.window
    reason = (
        f"all pixels of {' and '.join(empty)} are no data or masked"
        if empty
        else f"nowhere do both images have {window} x {window} usable pixels"
    )
    return SatIntervalsError(
        f"no pixel of {job.left.path} can be matched in {job.right.path} over disparities {search.minimum} to "
        f"{search.maximum}, {reason}: check no-data values, masks, window and search range"
    )
