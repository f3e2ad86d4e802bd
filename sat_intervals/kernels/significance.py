"""How likely differences of heights are without a change, and how their errors are correlated (METHOD.md, section 21).

Ratios are differences in standard deviations, as intervals state them. Without a change they follow Student's
distribution with 4 degrees of freedom, times a scale: tails are heavier than normal ones, and intervals wide.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

SCALE = 0.45
"""Scale, larger where half of the ratios exceed its median: ten comparisons of five WorldView-3 pairs on unchanged
ground have .35 to .47 (.90 quantiles), two surfaces of five images .33 (`make change-bench`, 2026-11-30)."""
MEDIAN = 0.7407
"""Median of absolute values of Student's distribution."""
_LAGS = np.unique(np.geomspace(1, 128, 16).astype(int))  # cells


def probability(ratio: np.ndarray, scale: float) -> np.ndarray:
    """Return how often a ratio is as large, or larger, without a change."""
    size, hypotenuse = np.abs(ratio), np.hypot(ratio, 2 * scale)
    rest = 4 * scale**2 / (hypotenuse * (hypotenuse + size))  # 1 - y, exact of large ratios
    return np.asarray(rest**2 * (1.5 - 0.5 * rest))


def ratio_of(rate: float, scale: float) -> float:
    """Return what a share ``rate`` of the ratios exceeds without a change."""
    sine = 2 * np.sin(np.arcsin(1 - rate) / 3)
    return float(2 * scale * sine / np.sqrt(1 - sine**2))


class Correlation(NamedTuple):
    """Variance of ratios without a change, and their correlation at rising distances in metres; 0 beyond."""

    variance: float
    distances: list[float]
    values: list[float]

    def within(self, area: float) -> float:
        """Return the mean correlation of two places in a disk of an area in square metres."""
        share = (np.arange(200) + 0.5) / 200  # of the diameter; density of the distance of two places in a disk
        density = share * (np.arccos(share) - share * np.sqrt(1 - share**2))
        distance = share * 2 * np.sqrt(area / np.pi)
        return float(np.average(np.interp(distance, self.distances, self.values, right=0.0), weights=density))


def correlation_of(blocks: Sequence[np.ndarray], cell: float) -> Correlation:
    """Measure the correlation of ratios in blocks, ``(rows, columns)``, NaN where unknown; cells of so many metres."""
    variance = float(np.mean(np.concatenate([block[np.isfinite(block)] for block in blocks]) ** 2))
    distances, values = [0.0], [1.0]
    for lag in _LAGS:
        products = [part.ravel() for one in blocks for part in (one[lag:] * one[:-lag], one[:, lag:] * one[:, :-lag])]
        known = np.concatenate(products)
        if np.isfinite(known).any() and (value := float(np.nanmean(known)) / (variance or 1.0)) > 0:
            distances.append(float(lag * cell))
            values.append(value)
    return Correlation(variance, distances, values)
