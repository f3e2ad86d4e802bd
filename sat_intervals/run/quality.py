"""Tell what is odd about a pair: search range, no data, rows, noise."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from sat_intervals.config import Disparity, unreached
from sat_intervals.match.rows import Survey
from sat_intervals.raster import Image, read_window
from sat_intervals.run.job import Job
from sat_intervals.tiling import Window

# Disparities up to which refinement alone can widen an interval to all, and up to which usual ones are half of all.
_NARROW_RANGE, _SHORT_RANGE = 3, 8
# Share of valid pixels with the whole search range as interval above which a run warns.
_AMBIGUOUS_SHARE = 0.1
# Share of valid pixels at the ends of the search range above which a run warns, and at one end to search further there.
_AT_ENDS, _AT_END = 0.005, 0.001
# Share of the pixels of an image that make a collar worth a warning, and rows that are looked at.
COLLAR, _ROWS = 0.01, 8
# Rows that make a pair badly resampled, and the distance of matches that makes it noisy.
_ROW_OFFSET, _NOISE = 1.0, 0.55


def is_plain(image: Image) -> bool:
    """Return whether nothing declares pixels of an image as no data."""
    return image.nodata is None and not image.use_mask and image.alpha is None and image.mask is None


def quality_of(job: Job) -> dict[str, Any]:
    """Return the quality of a pair: ``noise``, see `noise_of`, and ``collars``, see `Found`."""
    region, sides = job.store.grid.region, (("left", job.left), ("right", job.right))
    if job.found:
        collars = job.found.collars
    else:
        collars = {side: collar for side, image in sides if (collar := _collar(image, region))}
    return {"noise": job.survey and job.survey.noise, "collars": collars}


def _collar(image: Image, region: Window) -> dict[str, float] | None:
    """Return value and share of the pixels of the smallest value that begin or end rows of a region, None if few do."""
    inside = region.clipped(Window(0, 0, image.height, image.width))
    if not is_plain(image) or inside.width <= 0:
        return None
    rows = np.unique(np.linspace(inside.row, inside.row_stop - 1, _ROWS).astype(int))
    lines = (read_window(image, Window(int(row), inside.column, 1, inside.width)) for row in rows)
    pixels, state = (np.concatenate(parts) for parts in zip(*lines, strict=True))
    smallest = pixels.min(where=state == 0, initial=np.inf)
    has = (pixels == smallest) & (state == 0)
    runs = np.logical_and.accumulate(has, 1) | np.logical_and.accumulate(has[:, ::-1], 1)[:, ::-1]
    return {"value": float(smallest), "share": round(float(runs.mean()), 4)} if runs.mean() > COLLAR else None


def warnings_of(job: Job, counts: dict[str, Any], quality: dict[str, Any]) -> list[str]:
    """Return the warnings about a run, one line each."""
    search, path = job.config.disparity, job.left.path
    lines = []
    if ends := _ends(counts, search):
        lines.append(f"{path}: {ends}" + ("" if job.found else ", or leave it out"))
    width = counts["median_interval_width"] or 0
    ambiguous = counts["ambiguous"] > _AMBIGUOUS_SHARE * counts["valid"] and search.count > _NARROW_RANGE
    if ambiguous or (2 * width > search.count and search.count > _SHORT_RANGE):
        lines.append(
            f"{path}: the interval of {counts['ambiguous']} of {counts['valid']} valid pixels is the whole search "
            f"range {search.minimum} to {search.maximum}, the median width is {width:g} px: check the search range, "
            "and no-data values (--nodata), or the ground has no texture"
        )
    if missed := unreached(job.config):
        lines.append(f"{path}: {missed}")
    is_census = job.config.cost.method == "census" and job.config.preset == "paper"
    doubts = doubts_of(quality["collars"], job.survey, (job.left.path, job.right.path), is_census=is_census)
    return lines + doubts + rows_left(job.survey, job.config.rows, job.right.path)


def doubts_of(
    collars: Mapping[str, Any], survey: Survey | None, paths: tuple[str, str], *, is_census: bool = True
) -> list[str]:
    """Return the warnings about a pair; ``is_census``: it is matched with the penalties for clean images."""
    lines = [
        f"{path}: {100 * collars[side]['share']:.0f} % of the pixels are exactly {collars[side]['value']:.9g}, along "
        f"its borders, and no no-data value is declared: if it is no data, give --nodata {collars[side]['value']:.9g}"
        for side, path in zip(("left", "right"), paths, strict=True)
        if side in collars
    ]
    if survey and (survey.noise or 0) > _NOISE and is_census:
        lines.append(
            f"{paths[0]} and {paths[1]}: matching pixels differ {survey.noise:.2f} times as much as "
            "random pixels, the pair is noisy: try --preset satellite, or find penalties with calibrate --tune"
        )
    return lines


def rows_left(survey: Survey | None, rows: str, path: str) -> list[str]:
    """Return warnings of rows that differ in what is matched."""
    if survey is None or survey.rows is None:
        return []
    found = survey.rows
    if found.contradiction:
        return [f"{path}: {found.contradiction}"]
    if rows == "none" and survey.is_large and found.before[0] > _ROW_OFFSET:
        return [f"{path}: rows differ by {found.before[0]:.1f} px in the median: match with --rows auto"]
    if found.has_jitter:
        return [
            f"{path}: a smooth function leaves {found.after[0]:.2f} px of row offset in the median, "
            f"{found.after[1]:.2f} px in 90 % of the places: jitter or joins of detectors, or too little texture"
        ]
    return []


def _ends(counts: dict[str, Any], search: Disparity) -> str:
    """Return a line that names a wider range if many disparities are at the ends of the range, else nothing."""
    low, high = (counts["range_ends"][end] / max(1, counts["valid"]) for end in ("minimum", "maximum"))
    if low + high <= _AT_ENDS:
        return ""
    more = max(_SHORT_RANGE, search.count // 2)
    wider = search.minimum - more * (low > _AT_END), search.maximum + more * (high > _AT_END)
    return (
        f"{100 * (low + high):.1f} % of the valid disparities are within 1 px of {search.minimum} or {search.maximum}, "
        f"the ends of the search range: try --disparity {wider[0]} {wider[1]}"
    )
