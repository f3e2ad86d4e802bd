"""Tell what is odd about a pair: search range, no data, rows, noise."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from sat_intervals.config import Disparity, unreached
from sat_intervals.match.sampling import Look, summary
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


def quality_of(job: Job, records: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Return the quality of a pair, see `Found`: as the search for the range measured it, else from the tiles."""
    if job.found:
        return job.found.quality
    looks = [Look(**look) for _, record in sorted(records.items()) for look in record["looks"]]
    region = job.store.grid.region
    collars = {side: _collar(image, region) for side, image in (("left", job.left), ("right", job.right))}
    return summary(looks) | {"collars": {side: collar for side, collar in collars.items() if collar}}


def _collar(image: Image, region: Window) -> dict[str, float] | None:
    """Return value and share of the pixels of the smallest value that begin or end rows of a region, None if few do."""
    inside = region.clipped(Window(0, 0, image.height, image.width))
    if not is_plain(image) or inside.width <= 0:
        return None
    rows = np.unique(np.linspace(inside.row, inside.row_stop - 1, _ROWS).astype(int))
    pixels = np.concatenate([read_window(image, Window(int(row), inside.column, 1, inside.width))[0] for row in rows])
    smallest = pixels.min()
    has = pixels == smallest
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
    paths = {"left": job.left.path, "right": job.right.path}
    return lines + doubts(quality, paths, is_census=job.config.cost.method == "census" and job.config.preset == "paper")


def doubts(quality: dict[str, Any], paths: dict[str, str], *, is_census: bool = True) -> list[str]:
    """Return the warnings about a pair; ``is_census``: it is matched with the penalties for clean images."""
    lines = [
        f"{paths[side]}: {100 * collar['share']:.0f} % of the pixels are exactly {collar['value']:g}, along its "
        f"borders, and no no-data value is declared: if they are no data, give --{side}-nodata {collar['value']:g}"
        for side, collar in quality["collars"].items()
    ]
    if abs(quality["row_offset"] or 0) > _ROW_OFFSET:
        lines.append(
            f"{paths['left']} and {paths['right']}: rows differ by {abs(quality['row_offset']):.1f} px in the median: "
            "resample the pair"
        )
    if (quality["noise"] or 0) > _NOISE and is_census:
        lines.append(
            f"{paths['left']} and {paths['right']}: matching pixels differ {quality['noise']:.2f} times as much as "
            "random pixels, the pair is noisy: try --preset satellite, or find penalties with calibrate --tune"
        )
    return lines


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
