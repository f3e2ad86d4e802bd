"""Ground points gathered in the cells of a grid: sums over the points that reach a cell, quantiles of their bounds.

Letters: n point; i, j row and column of a cell; u, v column and row of a point, in cells from the first cell's centre.
"""

import numpy as np

from sat_intervals.kernels.compiled import cached, inlined
from sat_intervals.kernels.disparity import insert

# Layers of the cells.
WEIGHT, HEIGHT, CONFIDENCE, COUNT, BOUNDED, LOWER, UPPER = range(7)


def empty_cells(rows: int, columns: int) -> np.ndarray:
    """Cells without points: ``(7, rows, columns)`` float64, see `splat`."""
    cells = np.zeros((7, rows, columns))
    cells[LOWER], cells[UPPER] = np.inf, -np.inf
    return cells


def mean_heights(cells: np.ndarray) -> np.ndarray:
    """Weighted mean of the heights of the points that reach each cell: ``(rows, columns)``, NaN without points."""
    nothing = np.full(cells.shape[1:], np.nan)
    return np.divide(cells[HEIGHT], cells[WEIGHT], out=nothing, where=cells[COUNT] > 0)


@inlined
def _around(place, radius, size):
    """First cell along an axis whose centre a point may reach, and the one after the last."""
    reach = max(radius, 0.5)
    return max(0, int(np.ceil(place - reach))), min(size, int(np.floor(place + reach)) + 1)


@inlined
def _reaches(down, across, radius):
    """Whether a point reaches a cell from whose centre it is so far: the one it falls in, those within ``radius``."""
    return down**2 + across**2 <= radius**2 or max(abs(down), abs(across)) <= 0.5


@cached
def splat(column, row, height, lower, upper, confidence, radius, cells):
    """Add points to the cells they fall in and to all cells whose centre is within ``radius``, in cells.

    The weight of a point at a distance of ``d`` cells is ``exp(-d^2 / 2)``, constant from 30 cells on.

    column, row: ``(n,)`` positions in cells from the upper left corner of the first cell, whose centre is at 0.5, 0.5.
    height, lower, upper, confidence: ``(n,)``; points of NaN height and NaN bounds are ignored.
    cells: ``(7, rows, columns)`` float64, updated: sums of weights, of weighted heights and of weighted confidences;
        numbers of points and of points with bounds; the smallest lower and the largest upper bound.
    """
    rows, columns = cells.shape[1:]
    for n in range(height.size):
        if np.isnan(height[n]):
            continue
        has_bounds = not (np.isnan(lower[n]) or np.isnan(upper[n]))
        u, v = column[n] - 0.5, row[n] - 0.5
        for i in range(*_around(v, radius, rows)):
            for j in range(*_around(u, radius, columns)):
                if not _reaches(i - v, j - u, radius):
                    continue
                weight = np.exp(-0.5 * min((i - v) ** 2 + (j - u) ** 2, 900.0))
                cells[WEIGHT, i, j] += weight
                cells[HEIGHT, i, j] += weight * height[n]
                cells[CONFIDENCE, i, j] += weight * confidence[n]
                cells[COUNT, i, j] += 1
                if has_bounds:
                    cells[BOUNDED, i, j] += 1
                    cells[LOWER, i, j] = min(cells[LOWER, i, j], lower[n])
                    cells[UPPER, i, j] = max(cells[UPPER, i, j], upper[n])


@inlined
def _sort(values):
    """Sort in place: by insertion where they are few, which takes half the time."""
    if values.size > 64:
        values.sort()
        return
    for n in range(1, values.size):
        insert(values, n, values[n])


@cached
def gather(column, row, bound, radius, ends, bounds):
    """Append the bounds of points to those of each cell that they reach, by the rule of `splat`.

    column, row, bound: ``(n,)`` of points with bounds.
    ends: ``(rows, columns)`` int64, updated: the place in ``bounds`` after the last of each cell.
    bounds: ``(total,)``, updated: the bounds of the first cell, of the second, and so on.
    """
    rows, columns = ends.shape
    for n in range(bound.size):
        u, v = column[n] - 0.5, row[n] - 0.5
        for i in range(*_around(v, radius, rows)):
            for j in range(*_around(u, radius, columns)):
                if _reaches(i - v, j - u, radius):
                    bounds[ends[i, j]] = bound[n]
                    ends[i, j] += 1


@cached
def quantiles(counts, bounds, share):
    """Quantile of the bounds of each cell, which are sorted in place: ``(rows, columns)``, NaN without any.

    counts: ``(rows, columns)``, the number of bounds of each cell, the layer BOUNDED.
    bounds: ``(total,)``, see `gather`.
    share: of the bounds that are smaller; between two ranks it is linear.
    """
    rows, columns = counts.shape
    result = np.full((rows, columns), np.nan)
    first = 0
    for i in range(rows):
        for j in range(columns):
            count = int(counts[i, j])
            if count:
                own = bounds[first : first + count]
                _sort(own)
                rank = share * (count - 1)
                below = int(rank)
                step = own[min(below + 1, count - 1)] - own[below]
                result[i, j] = own[below] + step * (rank - below)
                first += count
    return result
