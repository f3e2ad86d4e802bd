"""Local ranges around the disparities of another matcher, and whether intervals agree with them (docs/volumes.md)."""

from collections.abc import Iterable

import numpy as np

from sat_intervals.config import Config
from sat_intervals.config.sections import MOST_PIXELS
from sat_intervals.errors import SatIntervalsError
from sat_intervals.match.local_ranges import LocalRanges
from sat_intervals.products import Bands

# Side in pixels of the cells that share a range.
CELL = 64
# Disparities of a range that no pair of images has.
_WIDEST = 8000


def ranges_around(rows: Iterable[np.ndarray], margin: int) -> LocalRanges:
    """Return the ranges of cells that hold the disparities of their pixels with a margin on both sides.

    ``rows`` are `CELL` rows each, from the top, in pixels, not finite where there is none. A cell without any has none.
    """
    found = []
    for given in rows:
        known, starts = np.isfinite(given), np.arange(0, given.shape[1], CELL)
        least = np.minimum.reduceat(np.where(known, given, np.inf).min(axis=0), starts)
        most = np.maximum.reduceat(np.where(known, given, -np.inf).max(axis=0), starts)
        has_some = np.logical_or.reduceat(known.any(axis=0), starts)
        ends = np.where(has_some, [np.floor(least - margin), np.ceil(most + margin)], [[1], [0]])
        found.append(np.clip(ends, -MOST_PIXELS, MOST_PIXELS).astype(np.int16))
    minimum, maximum = np.stack(found, axis=1)
    return LocalRanges(minimum, maximum, CELL, CELL)


def with_hull(config: Config, ranges: LocalRanges, source: str) -> Config:
    """Return settings with the hull of local ranges as search range; raise if ``source`` has none."""
    known = ranges.minimum <= ranges.maximum
    if not known.any():
        raise SatIntervalsError(f"{source} has no data: give another raster, or the search range")
    least, most = int(ranges.minimum[known].min()), int(ranges.maximum[known].max())
    if most - least > _WIDEST:
        raise SatIntervalsError(
            f"{source} has disparities of {least} to {most} px with the margin: declare its no-data value, or give "
            "the search range"
        )
    ends = {"minimum": least, "maximum": most}
    return config.model_copy(update={"disparity": config.disparity.model_copy(update=ends)})


def with_agreement(final: Bands, given: np.ndarray) -> Bands:
    """Add whether given disparities, NaN for none, are in the intervals."""
    inside = (final.lower <= given) & (given <= final.upper)
    known = np.isfinite(given) & np.isfinite(final.lower)
    return final._replace(agreement=np.where(known, inside, np.float32(np.nan)).astype(np.float32))
