"""Measure intervals at the thresholds of a sweep, rows by rows, against a truth; see `measurement`."""

from collections.abc import Iterator
from decimal import Decimal

import numpy as np

from sat_intervals.config import Calibration, Config, Interval, key_of
from sat_intervals.config.calibration import COVERAGES
from sat_intervals.match import postprocess
from sat_intervals.match.measurement import (
    EDGE,
    FIELDS,
    HIGH,
    LOW,
    QUANTILES,
    SCHEMES,
    Measured,
    ThresholdSweep,
    measure,
)
from sat_intervals.match.refinement import bounds_of_both
from sat_intervals.products import INVALID

# In place of a threshold of levels: the cut that factors are of.
OF_FITS = -1
# A single pair is judged in blocks, this many along each side.
_BLOCKS = 4


def pairs_of(thresholds: ThresholdSweep) -> list[tuple[int, int]]:
    """Return the thresholds of levels that are matched together; OF_FITS is the cut that factors are of."""
    numbers = [*([] if thresholds.are_one else [OF_FITS]), *range(thresholds.low.size)]
    return list(zip(numbers[::2], [*numbers[1::2], *numbers[-1:]], strict=False))


def at_levels(config: Config, high: float, low: float, quantile: float | None) -> Config:
    """Return settings whose intervals are cut at two levels, whatever the coverage, and without local ranges."""
    level = {"high": high, "edge": high, "low": low, "quantile": quantile}
    rows = [level | {"coverage": coverage} for coverage in COVERAGES]
    constant = Calibration.model_validate({"name": "constant", "key": key_of(config), "levels": rows})
    interval = Interval(coverage=Decimal(str(COVERAGES[0])), calibration=constant)
    disparity = config.disparity.model_copy(update={"local": False, "grid": None, "around": None})
    return config.model_copy(update={"interval": interval, "disparity": disparity})


def block_numbers(row: int, height: int, shape: tuple[int, int]) -> np.ndarray:
    """Return the number of the block of each pixel of some rows of a single pair of this shape."""
    rows, columns = (np.arange(side) * _BLOCKS // side for side in shape)
    return np.asarray(_BLOCKS * rows[row : row + height, None] + columns)


class Gauge:
    """Measures the intervals of a pair, as a whole, of a group, or in blocks, that of `block_numbers`."""

    def __init__(self, thresholds: ThresholdSweep, group: str, tolerance: float, *, in_blocks: bool) -> None:
        parts = _BLOCKS**2 if in_blocks else 1
        self._names = [f"block {part}" for part in range(parts)] if in_blocks else [group]
        self._thresholds, self._tolerance = thresholds, tolerance
        self._tables = np.zeros((parts, thresholds.low.size, SCHEMES, FIELDS))

    def measured(self) -> list[Measured]:
        """Return the measurement of each part."""
        parts = [Measured(name, 1.0, table) for name, table in zip(self._names, self._tables, strict=True)]
        kept = sum(part.kept for part in parts)
        return [part._replace(weight=1 / max(kept, 1)) for part in parts]

    def add(
        self,
        strip: postprocess.RawRows,
        inner: slice,
        scale: postprocess.ConfidenceScale,
        truth: tuple[np.ndarray, np.ndarray],
        pair: tuple[int, int],
        config: Config,
    ) -> None:
        """Measure the rows ``inner`` of some rows with their halo, whose cuts are a pair of thresholds, see `pairs_of`.

        ``truth``: of these rows, and the number of the part of each pixel.
        """
        cuts = (strip.lower, strip.upper), (strip.lower_low, strip.upper_low)
        for threshold, (lower, upper) in zip(dict.fromkeys(pair), cuts, strict=False):
            one_cut = strip._replace(lower=lower, upper=upper, lower_low=lower, upper_low=upper)
            rows = postprocess.filter_rows(one_cut, scale, config)
            here = postprocess.cut_rows(rows, inner.start, inner.stop)
            valid = (here.validity & INVALID == 0) & np.isfinite(truth[0])
            assert here.low is not None
            classes = np.where(here.low, LOW, here.edge if config.fits else HIGH)
            for number, scheme, bounds in self._bounds(rows, inner, threshold, config):
                chosen = np.flatnonzero(valid & (classes == min(scheme, LOW)))
                middle, low, high, true, part = (band.ravel()[chosen] for band in (here.disparity, *bounds, *truth))
                low, high = postprocess.widened(low, high, middle, config)
                measured = measure(low, high, true, self._tolerance, part, len(self._tables))
                self._tables[:, number, scheme] += measured

    def _bounds(
        self, rows: postprocess.Filtered, inner: slice, threshold: int, config: Config
    ) -> Iterator[tuple[int, int, tuple[np.ndarray, np.ndarray]]]:
        """Yield the thresholds and schemes that the rows ``inner`` are measured for, and their bounds."""
        if threshold == OF_FITS:
            half = postprocess.cut_rows(rows.half, inner.start, inner.stop)
            for number, factor in enumerate(self._thresholds.high):
                bounds = bounds_of_both(rows.disparity[inner], half, factor, config)
                yield from ((number, scheme, bounds) for scheme in (HIGH, EDGE))
            return
        if self._thresholds.are_one:
            yield threshold, HIGH, (rows.lower[inner], rows.upper[inner])
        for scheme, quantile in enumerate(QUANTILES, start=LOW):
            yield threshold, scheme, postprocess.regularized(rows, inner.start, inner.stop, config, quantile)
