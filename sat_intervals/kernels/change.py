"""Height change between two surfaces: cells drawn to another grid.

Letters: n a place; i, j row and column of a cell.
"""

import numpy as np

from sat_intervals.kernels.compiled import cached


@cached
def drawn(bands, x, y, reach):
    """Heights and bounds between cells: means of heights, and the worst bounds of the cells that have a weight.

    bands: ``(3, rows, columns)``: height, lower, upper; NaN where unknown.
    x, y: ``(n,)`` columns and rows of places; centres of cells are integers.
    reach: cells, at least 1: weights fall linearly from 1 to 0 there, bilinear interpolation at 1.
    Returns ``(3, n)``; NaN where a cell with a weight is unknown, or outside.
    """
    _, rows, columns = bands.shape
    result = np.full((3, x.size), np.nan)
    for n in range(x.size):
        top, left = int(np.floor(y[n] - reach)) + 1, int(np.floor(x[n] - reach)) + 1
        bottom, right = int(np.ceil(y[n] + reach)), int(np.ceil(x[n] + reach))
        if not (top >= 0 and left >= 0 and bottom <= rows and right <= columns):
            continue
        total, height, lower, upper = 0.0, 0.0, np.inf, -np.inf
        for i in range(top, bottom):
            for j in range(left, right):
                weight = (reach - abs(y[n] - i)) * (reach - abs(x[n] - j))
                total += weight
                height += weight * bands[0, i, j]
                # a comparison with NaN is false: NaN replaces a bound, and stays
                lower = lower if lower <= bands[1, i, j] or np.isnan(lower) else bands[1, i, j]
                upper = upper if upper >= bands[2, i, j] or np.isnan(upper) else bands[2, i, j]
        result[0, n], result[1, n], result[2, n] = height / total, lower, upper
    return result
