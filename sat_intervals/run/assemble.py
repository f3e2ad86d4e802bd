"""Assemble the files of a run from its tiles: strips, final bands, report."""

import logging
import platform
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict
from datetime import UTC, datetime
from functools import cache
from importlib.metadata import version
from typing import Any, NamedTuple

from sat_intervals.config import Config, calibration_of
from sat_intervals.errors import RemovedTilesError, RunError
from sat_intervals.match.postprocess import ConfidenceScale
from sat_intervals.products import FLAGS
from sat_intervals.progress import Progress, logged_stage
from sat_intervals.raster import OutputError, OutputWriter, run_files
from sat_intervals.raster.identity import compared
from sat_intervals.run.copying import assemble_files
from sat_intervals.run.inputs import appeared_file
from sat_intervals.run.job import Job
from sat_intervals.run.output import check_still_published
from sat_intervals.run.quality import quality_of, warnings_of
from sat_intervals.run.scale import checked_scale
from sat_intervals.run.seams import seam_report
from sat_intervals.run.statistics import Tally
from sat_intervals.run.strips import finish_strips
from sat_intervals.run.workers import Workers, reason
from sat_intervals.store.manifest import sealed
from sat_intervals.store.marks import replaceable_files
from sat_intervals.store.tiles import Records

# Meanings of some of the counts, for readers of run.json.
_COUNTS_MEANING = {
    "ambiguous": "valid pixels whose interval is the whole search range",
    "range_ends": "valid pixels with the flag range_end and without range_incomplete, counted at the nearer end",
    "low_confidence": "valid pixels with the flag regularized; flags.regularized also counts invalid ones",
    "causes": "invalid pixels, each under its first flag that makes it invalid; with valid they add up to pixels",
    "flags": "pixels with the flag, valid or not; a pixel may have several flags",
}

_LOG = logging.getLogger(__name__)


class Assembled(NamedTuple):
    """The content of ``run.json`` without its checksum, and the `stamps` of the published files."""

    report: dict[str, Any]
    published: dict[str, str]


def assemble(
    job: Job,
    client: Callable[[], Workers],
    seconds: dict[str, float],
    progress: Progress,
    *,
    keep_tiles: bool = False,
) -> Assembled:
    """Write the files of a run whose tiles are done.

    Parameters
    ----------
    job
        The pair.
    client
        Returns the client of the cluster that finishes strips.
    seconds
        Times of earlier stages; those of this one are added.
    progress
        Called after each strip.
    keep_tiles
        Whether the tiles are kept.

    Raises
    ------
    DamagedTilesError
        Tiles must be matched, or strips finished again.
    RunError
        A strip failed, or a file cannot be written.
    SatIntervalsError
        No pixel could be matched.
    """
    region = job.store.grid.region
    place = job.left.georeferencing.shifted(region)
    files = run_files(job.config.products.compression)
    records = job.store.records()
    scale = checked_scale(job, records)
    with (
        _resumable(),
        OutputWriter(job.out, files, region.height, region.width, place, _tags(job.config)) as writer,
        compared(job.files) as differing,  # no step reads images any more
    ):
        with logged_stage(seconds, "bands"):
            parts, workers = finish_strips(job, client, scale, records, progress)
        with logged_stage(seconds, "files"):
            assemble_files(job, writer, parts, workers, progress)
            if keep_tiles:  # strips of a killed run are finished without reading its tiles again
                job.store.keep(records)
            job.check_inputs()
            steps = len(files) * len(parts)
            progress("files", steps, steps)  # a last chance to interrupt the run before it publishes
        with logged_stage(seconds, "inputs"):
            _check_content(job, differing())
        _add_seconds(seconds, records)
        report = _report(job, records, scale, parts.values(), seconds, writer.build())
        for line in report["warnings"]:
            _LOG.warning("%s", line)
        published = _publish(job, writer, report, keep_tiles=keep_tiles)
        progress("files", steps, steps)
    return Assembled(report, published)


def _check_content(job: Job, name: str | None) -> None:
    """Raise if the content of an input has changed or a file beside it has appeared.

    If no time of the input has changed, the tiles are deleted, since they cannot be trusted.
    """
    if name is not None:
        job.check_inputs()
        job.store.remove()
        raise RemovedTilesError(
            f"{name} was changed during the run without a change of its modification time, as through a memory map: "
            "the tiles of the run are deleted: rerun the command when the file is complete"
        )
    if file := appeared_file(job.left, job.right, job.files):
        job.store.remove()
        raise RemovedTilesError(f"{file} appeared during the run, whose tiles are deleted: rerun the command")


def _publish(job: Job, writer: OutputWriter, report: dict[str, Any], *, keep_tiles: bool) -> dict[str, str]:
    def announce(stamps: list[str]) -> None:
        if not keep_tiles:
            job.store.mark_finished(job.name, stamps)

    there = replaceable_files(job.store.home, job.store.run) or {}
    published = writer.publish(("run.json", sealed(report) + "\n"), replaceable=there, announce=announce)
    try:
        job.store.mark_replaced()
        if keep_tiles:  # otherwise the parts are removed with them
            job.parts().drop()
    except OSError as error:  # the run is complete
        _LOG.warning("parts of the files stay in %s: %s", job.store.folder, reason(error))
    return published


def end_run(job: Job, assembled: Assembled, *, keep_tiles: bool) -> dict[str, Any]:
    """Remove the tiles of a run whose files are published, unless they are kept; return its report.

    Raises
    ------
    RunError
        A file is no longer the published one.
    """
    if not keep_tiles:
        check_still_published(job.out, assembled.published, has_tiles=True)
        remove_tiles(job)
    check_still_published(job.out, assembled.published, has_tiles=False)
    return assembled.report


def remove_tiles(job: Job) -> bool:
    """Remove the tiles of a complete run, if they can be reached; return whether none are left."""
    try:
        if job.store.remove():
            return True
    except OSError as error:
        _LOG.warning("the tiles of the complete run stay: %s", reason(error))
    else:
        _LOG.warning("files in %s stay: they have no sign that they are of this run", job.store.folder)
    return False


def _add_seconds(seconds: dict[str, float], records: Records) -> None:
    """Add the seconds of all tiles by stage, and the total."""
    for stage in ("read", "match", "write"):
        seconds[f"tiles.{stage}"] = sum(record["seconds"][stage] for record in records.values())
    seconds["total"] = sum(value for stage, value in seconds.items() if "." not in stage)


@contextmanager
def _resumable() -> Iterator[None]:
    """Turn an OutputError into a RunError: all tiles are done, so the run can be resumed."""
    try:
        yield
    except OutputError as error:
        raise RunError(f"{error}; rerun the same command: it resumes from the tiles, which are all done") from error


def _tags(config: Config) -> dict[str, str]:
    """Return the tags of the output files."""
    tags = {
        "SOFTWARE": f"sat-intervals {version('sat-intervals')}",
        "SEARCH_RANGE": f"{config.disparity.minimum} {config.disparity.maximum}",
    }
    interval = config.interval
    if interval and interval.coverage is not None:
        calibration = calibration_of(config)
        tags["COVERAGE"] = f"{interval.coverage} (mean over pixels like those of the calibration, not of each pixel)"
        tags["CALIBRATION"] = f"{calibration.name} {calibration.sha256}"
    elif interval:
        tags["ALPHA"] = f"{interval.alpha} (level of possibility, not a probability)"
    return tags


@cache
def _versions() -> dict[str, str]:
    """Return the versions of Python and of the packages that results depend on, read once from their files."""
    packages = ("sat-intervals", "numpy", "numba", "dask", "distributed", "xarray", "zarr", "rasterio", "pyproj")
    return {"python": platform.python_version()} | {name: version(name) for name in packages}


def _calibration(config: Config) -> dict[str, Any] | None:
    """Return what the run took from its calibration, whose content is in the settings."""
    levels = config.cuts
    if levels is None or levels.coverage is None:
        return None
    calibration = calibration_of(config)
    return {"name": calibration.name, "sha256": calibration.sha256, **levels.model_dump()}


def _counts(config: Config, parts: Iterable[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the counts of all pixels from the records of the parts."""
    tally = Tally(config.disparity.count, config.disparity.minimum)
    for part in parts:
        tally.merge(part.get("counts", {}))
    return tally.report()


def _report(
    job: Job,
    records: Records,
    scale: ConfidenceScale,
    parts: Iterable[Mapping[str, Any]],
    seconds: dict[str, float],
    files: dict[str, dict[str, int]],
) -> dict[str, Any]:
    """Return the content of run.json."""
    grid = job.store.grid
    config = job.config
    statistics = job.statistics()
    counts = _counts(config, parts)
    quality = quality_of(job, records)
    return {
        "finished": datetime.now(UTC).isoformat(timespec="microseconds"),  # distinguishes runs
        "settings": config.model_dump(mode="json"),
        "requested": {"disparity": job.requested},
        "search": job.found and job.found.report(),
        "local_ranges": job.local and job.local.report() | {"share": job.local.share},
        "inputs": job.inputs,
        "tiles": {
            "region": asdict(grid.region),
            "rows": grid.rows,
            "columns": grid.columns,
            "size": grid.size,
            "overlap": config.tiles.overlap,
        },
        "cost_span": config.cost_span,
        "calibration": _calibration(config),
        "normalization": statistics and statistics.report(),
        "ambiguity_percentiles": None if config.ambiguity is None else {"p1": scale.p1, "p99": scale.p99},
        "counts": counts,
        "counts_meaning": _COUNTS_MEANING,
        "validity_bits": {
            flag.name: {"bit": flag.bit, "meaning": flag.meaning, "invalid": flag.invalid} for flag in FLAGS
        },
        "overlap_left": seam_report(job.store.seams(records), grid) if job.store.has_seams else None,
        "seconds": {stage: round(value, 3) for stage, value in seconds.items()},
        "versions": dict(_versions()),
        "files": files,
        "quality": quality,
        "warnings": warnings_of(job, counts, quality),
    }
