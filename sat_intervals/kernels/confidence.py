"""Confidence from ambiguity (Sarrazin et al. 2021; method: sections 4 and 8).

Letters: r row, c column, k disparity index.
"""

import numpy as np
from numba import njit

from sat_intervals.kernels.compiled import cached
from sat_intervals.products import IMPOSSIBLE_COST


@njit(nogil=True, forceinline=True)
def ambiguity(curve, count, lowest, weights):
    """Ambiguity of one pixel: over the etas, how many disparities cost at most ``lowest + eta * span``.

    ``weights[x]`` is the number of etas that count a cost ``x`` above the lowest; an impossible candidate counts for
    every eta.
    """
    total = 0
    for k in range(count):
        if curve[k] == IMPOSSIBLE_COST:
            total += weights[0]
        else:
            total += weights[curve[k] - lowest]
    return total


def ambiguity_histogram(ambiguity: np.ndarray, searched: np.ndarray, largest: int) -> np.ndarray:
    """How many searched pixels have each ambiguity from 0 to ``largest``: int64 ``(largest + 1,)``."""
    return np.bincount(ambiguity[searched], minlength=largest + 1)


def percentiles(histogram: np.ndarray) -> tuple[float, float]:
    """1st and 99th percentile of the values ``0 .. n - 1`` that a histogram counts.

    Parameters
    ----------
    histogram
        ``(n,)`` integers; ``histogram[a]`` pixels have the value ``a``.

    Returns
    -------
    ``(p1, p99)``, interpolated as ``numpy.percentile`` does on the values themselves; NaN where nothing is counted.
    """
    upto = np.cumsum(histogram)
    if upto.size == 0 or upto[-1] == 0:
        return float("nan"), float("nan")

    def percentile(share: float) -> float:
        rank = share * float(upto[-1] - 1)
        below = int(np.floor(rank))
        first = float(np.searchsorted(upto, below, side="right"))
        second = float(np.searchsorted(upto, min(below + 1, int(upto[-1]) - 1), side="right"))
        part = rank - below
        if part < 0.5:
            return first + (second - first) * part
        return second - (second - first) * (1.0 - part)  # as numpy rounds it

    return percentile(0.01), percentile(0.99)


@cached
def normalize(ambiguity, searched, p1, p99):
    """Confidence in [0, 1] from ambiguity: ``1 - clip((A - p1) / (p99 - p1), 0, 1)``.

    Parameters
    ----------
    ambiguity
        ``(rows, columns)`` uint32.
    searched
        bool of the same shape: pixels with a possible candidate.
    p1, p99
        What becomes confidence 1 and 0. Where they are equal, confidence is 1 for ``A <= p1``, else 0.

    Returns
    -------
    ``(rows, columns)`` float32, NaN where nothing was searched.
    """
    rows, columns = ambiguity.shape
    confidence = np.full((rows, columns), np.float32(np.nan))
    for r in range(rows):
        for c in range(columns):
            if not searched[r, c]:
                continue
            above = ambiguity[r, c] - p1
            if above <= 0.0:
                confidence[r, c] = 1.0
            elif above >= p99 - p1:
                confidence[r, c] = 0.0
            else:
                confidence[r, c] = 1.0 - above / (p99 - p1)
    return confidence


@cached
def low_confidence(confidence, threshold, kernel):
    """Pixels whose smallest confidence over ``1 x kernel`` is at most the threshold (paper eq. 12 and 13).

    Parameters
    ----------
    confidence
        ``(rows, columns)`` float32; NaN counts as 1 and is never low.
    threshold
        Compared as float32.
    kernel
        Length of the minimum filter along the row, in pixels, odd.

    Returns
    -------
    ``(rows, columns)`` bool.
    """
    rows, columns = confidence.shape
    limit = np.float32(threshold)
    radius = kernel // 2
    low = np.zeros((rows, columns), np.bool_)
    doubtful = np.zeros(columns + 2 * radius, np.bool_)
    for r in range(rows):
        for c in range(columns):
            doubtful[c + radius] = confidence[r, c] <= limit
        for j in range(kernel):
            for c in range(columns):
                low[r, c] |= doubtful[c + j]
        for c in range(columns):
            low[r, c] &= not np.isnan(confidence[r, c])
    return low
