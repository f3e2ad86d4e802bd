"""The report of a run, ``run.json``, and the tags of its files."""

import platform
from collections.abc import Iterable, Mapping
from dataclasses import asdict
from datetime import UTC, datetime
from functools import cache
from importlib.metadata import version
from typing import Any

from sat_intervals.config import Config, calibration_of
from sat_intervals.match.postprocess import ConfidenceScale
from sat_intervals.match.statistics import Tally
from sat_intervals.products import FLAGS, FLAGS_OF_SWEEP
from sat_intervals.run.job import Job, Swept, origin_of
from sat_intervals.run.quality import quality_of, verdict_of, warnings_of
from sat_intervals.store.tiles import Tables

# Meanings of some of the counts, for readers of run.json.
_COUNTS_MEANING = {
    "ambiguous": "valid pixels whose interval is the whole search range",
    "range_ends": "valid pixels with the flag range_end and without range_incomplete, counted at the nearer end",
    "low_confidence": "valid pixels with the flag regularized; flags.regularized also counts invalid ones",
    "causes": "invalid pixels, each under its first flag that makes it invalid; with valid they add up to pixels",
    "flags": "pixels with the flag, valid or not; a pixel may have several flags",
}


def tags_of(job: Job) -> dict[str, str]:
    """Return the tags of the output files."""
    config = job.config
    tags = {"SOFTWARE": f"sat-intervals {version('sat-intervals')}"}
    if swept := job.swept:  # see `surface_tags`; the size of tiles is not in them
        of = {"RUNS": swept.asked, "HEIGHTS": f"above {swept.level}"} | tags_of_sweep(config, len(job.images))
        return tags | (swept.calibration.tagged(of, job.left.georeferencing.affine.a) if swept.calibration else of)
    tags["SEARCH_RANGE"] = f"{config.disparity.minimum} {config.disparity.maximum}"
    interval = config.interval
    if interval and interval.coverage is not None:
        calibration = calibration_of(config)
        tags["COVERAGE"] = f"{interval.coverage} (mean over pixels like those of the calibration, not of each pixel)"
        tags["CALIBRATION"] = f"{calibration.name} {calibration.sha256}"
    elif interval:
        tags["ALPHA"] = f"{interval.alpha} (level of possibility, not a probability)"
    return tags


def _margins(swept: Swept) -> dict[str, Any] | None:
    """Return what identifies the calibration of heights that moved the bounds, and its coverage."""
    if (found := swept.calibration) is None:
        return None
    return {"name": found.name, "sha256": found.sha256, "coverage": found.coverage}


def tags_of_sweep(config: Config, images: int) -> dict[str, str]:
    """Return the tags of the intervals of a sweep, see `surface_key`."""
    interval, tags = config.interval, {"IMAGES": f"{images}", "INTERVAL": "cost curve of many images"}
    if interval and interval.coverage is not None:
        calibration = calibration_of(config)
        name = f"{calibration.name} {calibration.sha256}"
        return tags | {"COVERAGE": str(interval.coverage), "DISPARITY_CALIBRATION": name}
    return tags | ({"ALPHA": str(interval.alpha)} if interval else {})


@cache
def _versions() -> dict[str, str]:
    """Return the versions of Python and of the packages that results depend on, read once from their files."""
    packages = ("sat-intervals", "numpy", "numba", "dask", "distributed", "xarray", "rasterio", "pyproj")
    return {"python": platform.python_version()} | {name: version(name) for name in packages}


def _calibration(config: Config) -> dict[str, Any] | None:
    """Return what the run took from its calibration, whose content is in the settings."""
    levels = config.cuts
    if levels is None or levels.coverage is None:
        return None
    calibration = calibration_of(config)
    return {"name": calibration.name, "sha256": calibration.sha256, **levels.model_dump()}


def report_of(
    job: Job, tables: Tables, scale: ConfidenceScale, parts: Iterable[Mapping[str, Any]], seconds: dict[str, float]
) -> dict[str, Any]:
    """Return the content of run.json."""
    grid = job.store.grid
    config, prepared = job.config, job.prepared
    tally = Tally(config.disparity.count, config.disparity.minimum)
    for part in parts:
        tally.merge(part.get("counts", {}))
    flags = FLAGS_OF_SWEEP if job.swept else FLAGS
    counts, quality = tally.report(), quality_of(job, tables)
    of_tiles = [record["seconds"] for record in tables.records.values()]
    seconds |= {f"tiles.{stage}": sum(each[stage] for each in of_tiles) for stage in ("read", "match", "write")}
    seconds["total"] = sum(value for stage, value in seconds.items() if "." not in stage)
    return {
        "run": job.name,
        "finished": datetime.now(UTC).isoformat(timespec="microseconds"),  # distinguishes runs
        "settings": config.model_dump(mode="json"),
        "requested": {"disparity": job.requested},
        "search": prepared.search and prepared.search.report(),
        "survey": prepared.survey and prepared.survey.report(),
        "rows": prepared.rows and asdict(prepared.rows),
        "origin": origin_of(job.inputs),
        "local_ranges": prepared.ranges and prepared.ranges.report() | {"share": prepared.ranges.share},
        "inputs": job.inputs,
        **({"sweep": job.swept.report | {"margins": _margins(job.swept)}} if job.swept else {}),
        "tiles": {
            "region": asdict(grid.region),
            "rows": grid.rows,
            "columns": grid.columns,
            "size": grid.size,
            "overlap": config.tiles.overlap,
        },
        "cost_span": config.cost_span,
        "calibration": _calibration(config),
        "normalization": prepared.statistics and prepared.statistics.report(),
        "ambiguity_percentiles": None if config.ambiguity is None else {"p1": scale.p1, "p99": scale.p99},
        "counts": counts,
        "counts_meaning": _COUNTS_MEANING,
        "validity_bits": {one.name: {"bit": one.bit, "meaning": one.meaning, "invalid": one.invalid} for one in flags},
        "seconds": {stage: round(value, 3) for stage, value in seconds.items()},
        "versions": dict(_versions()),
        "quality": quality,
        "warnings": (warnings := warnings_of(job, counts, quality)),
        "verdict": verdict_of(counts, config, warnings),
    }
