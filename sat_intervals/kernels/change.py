"""Height change between two surfaces: cells drawn to another grid, and connected areas of change.

Letters: n a place; i, j row and column of a cell; s and t segments (runs of changed cells in a row).
"""

import numpy as np

from sat_intervals.kernels.compiled import cached
from sat_intervals.kernels.intervals import find_segments


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


@cached
def connected(change, sign, smallest):
    """Find areas of cells of one sign that touch along rows or columns.

    change: ``(rows, columns)`` int8: ``sign`` where cells belong to an area, twice that where they make one.
    smallest: number of the latter that an area has at least.
    Returns of the runs of changed cells in rows first column, column after the last, and area, counted from 1, 0 if it
    has fewer; and the first run of each row, ``(rows + 1,)``.
    """
    start, stop, row_start, above, _ = find_segments(sign * change > 0)
    root, size, area = np.arange(start.size), np.zeros(start.size, np.int64), np.zeros(start.size, np.int32)
    for s in range(start.size):
        for t in range(above[s, 0], above[s, 1]):
            one, other = s, t
            while root[one] != one:
                root[one] = root[root[one]]
                one = root[one]
            while root[other] != other:
                root[other] = root[root[other]]
                other = root[other]
            root[max(one, other)] = min(one, other)
    for r in range(change.shape[0]):
        for s in range(row_start[r], row_start[r + 1]):  # the root of an area is its first segment
            root[s] = root[root[s]]
            size[root[s]] += np.sum(change[r, start[s] : stop[s]] == 2 * sign)
    count = 0
    for s in range(start.size):
        if size[root[s]] >= smallest:
            count += root[s] == s
            area[s] = count if root[s] == s else area[root[s]]
    return start, stop, area, row_start


@cached
def painted(start, stop, area, row_start, window):
    """Areas of `connected` in a window ``(first row, first column, rows, columns)``: int32, 0 elsewhere."""
    first, left, rows, columns = window
    result = np.zeros((rows, columns), np.int32)
    for i in range(rows):
        for s in range(row_start[first + i], row_start[first + i + 1]):
            result[i, max(start[s] - left, 0) : max(min(stop[s] - left, columns), 0)] = area[s]
    return result
