"""Measure intervals that were made at a sweep of thresholds against a truth (docs/coverage.md).

Every pair is matched at each threshold of the levels, through the whole chain; factors are tried on one cut. Classes
are `HIGH` confidence, with least squares without `EDGE`, and `LOW`. Low-confidence pixels are measured once for each
quantile of the regularisation, and once without it.

Letters of shapes: thresholds (levels of the sweep), schemes (high, edge, then low with each of QUANTILES), fields.
"""

from math import ceil
from typing import NamedTuple

import numpy as np

from sat_intervals.config import Config

# Quantiles of the regularisation that are tried; None: no regularisation.
QUANTILES = (None, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95)
HIGH, EDGE, LOW = 0, 1, 2
SCHEMES = LOW + len(QUANTILES)

# Thresholds: level 0, and from a fraction of the span to the level that holds every candidate, each 1.26 times the
# one before.
_LOWEST, _THRESHOLDS = 1 / 256, 25
# Factors of the same number of thresholds, and the last one.
_FACTORS, _ALL = (1 / 16, 64), 6e4
# Widths are counted in steps of 1/64 px up to 8 px, and of 1 % above.
_STEPS = 64
_FINE = 8
_RATIO = 1.01
_COARSE = ceil(np.log(32000 / _FINE) / np.log(_RATIO)) + 1
WIDTHS = np.concatenate([np.arange(_FINE * _STEPS) / _STEPS, _FINE * _RATIO ** (np.arange(_COARSE) + 0.5)])
# Place of a width among them, by its number of steps.
_UPTO = np.arange(32000 * _STEPS + 1)
_ABOVE = _FINE * _STEPS + np.log(np.maximum(_UPTO, _FINE * _STEPS) / (_FINE * _STEPS)) / np.log(_RATIO)
_PLACES = np.where(_UPTO < _FINE * _STEPS, _UPTO, _ABOVE).astype(np.int16)
# Fields of a measurement: pixels that hold the truth, sum of widths, sum of distances that miss, counts by width.
INSIDE = 0
WIDTH = 1
MISSED = 2
COUNTS = 3
FIELDS = COUNTS + WIDTHS.size


class Measured(NamedTuple):
    """Measurements of a pair, or of a block of one.

    group: parts of one group are left out together.
    weight: of a pixel: one over the pixels of the pair, so that every pair weighs the same.
    table: ``(thresholds, schemes, fields)`` float64 sums over kept pixels with truth.
    """

    group: str
    weight: float
    table: np.ndarray

    @property
    def kept(self) -> int:
        """Return the number of kept pixels with truth."""
        return int(self.table[0, : LOW + 1, COUNTS:].sum())


class ThresholdSweep(NamedTuple):
    """Thresholds of both classes, ascending float64 ``(thresholds,)``: the last ones hold every possible candidate.

    low: levels at which pairs are matched.
    high: the same; with least squares factors of intervals, see `refinement.bounds_of_both`.
    """

    high: np.ndarray
    low: np.ndarray

    @property
    def are_one(self) -> bool:
        """Return whether a threshold of one class has a meaning for the other."""
        return self.high is self.low


def threshold_sweep(config: Config) -> ThresholdSweep:
    """Return the thresholds that intervals of some settings are measured at."""
    levels = np.concatenate([[0.0], np.geomspace(config.cost_span * _LOWEST, config.largest_sum, _THRESHOLDS)])
    if not config.fits:
        return ThresholdSweep(levels, levels)
    factors = np.geomspace(_FACTORS[0], _FACTORS[1], _THRESHOLDS - 1)
    return ThresholdSweep(np.concatenate([[0.0], factors, [_ALL]]), levels)


def measure(
    lower: np.ndarray, upper: np.ndarray, truth: np.ndarray, tolerance: float, part: np.ndarray, parts: int
) -> np.ndarray:
    """Measure some intervals: ``(parts, fields)``.

    lower, upper, truth: ``(pixels,)`` finite numbers of pixels.
    tolerance: distance up to which a truth outside an interval counts as inside.
    part, parts: part of each pixel, and number of parts.
    """
    width = upper.astype(np.float64) - lower
    missed = np.maximum(np.maximum(lower - truth, truth - upper) - tolerance, 0)
    place = _PLACES[np.rint(width * _STEPS).astype(np.int64)]
    fields = np.zeros((parts, FIELDS))
    for field, weights in ((INSIDE, missed == 0), (WIDTH, width), (MISSED, missed)):
        fields[:, field] = np.bincount(part, weights, parts)
    counts = np.bincount(part * WIDTHS.size + place, minlength=parts * WIDTHS.size)
    fields[:, COUNTS:] = counts.reshape(parts, -1)
    return fields
