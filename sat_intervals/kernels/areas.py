"""Maxima over low-confidence areas (METHOD.md, section 10).

Letters: s and t segments (runs of low-confidence pixels in a row).
"""

import numpy as np

from sat_intervals.kernels.compiled import cached
from sat_intervals.kernels.intervals import find_segments


@cached
def area_maximum(values, low, depth):
    """Maximum over the low-confidence area around each low-confidence pixel (paper eq. 16).

    values: ``(rows, columns)`` float64; NaN is ignored.
    low: bool of the same shape: low-confidence pixels.
    depth: largest number of steps between touching segments of an area, as in `regularize`.
    Returns ``(rows, columns)`` float64, NaN outside low-confidence pixels and where the area has no value.
    """
    start, stop, row_start, above, below = find_segments(low)
    largest = np.full(start.size, -np.inf)
    for r in range(values.shape[0]):
        for s in range(row_start[r], row_start[r + 1]):
            for c in range(start[s], stop[s]):
                if values[r, c] > largest[s]:
                    largest[s] = values[r, c]
    for _ in range(depth):
        reached = largest.copy()
        for s in range(start.size):
            for neighbours in (above[s], below[s]):
                for t in range(neighbours[0], neighbours[1]):
                    reached[s] = max(reached[s], largest[t])
        largest = reached
    result = np.full(values.shape, np.nan)
    for r in range(values.shape[0]):
        for s in range(row_start[r], row_start[r + 1]):
            if largest[s] > -np.inf:
                result[r, start[s] : stop[s]] = largest[s]
    return result
