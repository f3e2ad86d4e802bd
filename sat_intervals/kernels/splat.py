"""Accumulation of ground points in the cells of a grid, and bounds of a cell from those of all its points.

Letters: n point; i, j row and column of a cell; u, v column and row of a point, in cells from the first cell's centre.
"""

import numpy as np

from sat_intervals.kernels.compiled import cached

# Layers of the cells.
WEIGHT, HEIGHT, CONFIDENCE, LOWER, UPPER, LEAST, MOST, COUNT, BOUNDED = range(9)


def empty_cells(rows: int, columns: int) -> np.ndarray:
    """Cells without points: ``(9, rows, columns)`` float64, see `splat`."""
    cells = np.zeros((9, rows, columns))
    cells[LEAST], cells[MOST] = np.inf, -np.inf
    return cells


@cached
def splat(column, row, height, lower, upper, confidence, radius, cells):
    """Add points to the cells they fall in and to all cells whose centre is within ``radius``, in cells.

    The weight of a point at a distance of ``d`` cells is ``exp(-d^2 / 2)``, constant from 30 cells on.

    column, row: ``(n,)`` positions in cells from the upper left corner of the first cell, whose centre is at 0.5, 0.5.
    height, lower, upper, confidence: ``(n,)``; points of NaN height and NaN bounds are ignored.
    cells: ``(9, rows, columns)`` float64, updated: sums of weights and of weighted height, confidence, lower and upper
        bound; the smallest lower and the largest upper bound; the number of points; the sum of the weights of points
        with bounds.
    """
    rows, columns = cells.shape[1:]
    for n in range(height.size):
        if np.isnan(height[n]):
            continue
        u, v = column[n] - 0.5, row[n] - 0.5
        reach = max(radius, 0.5)
        for i in range(max(0, int(np.ceil(v - reach))), min(rows, int(np.floor(v + reach)) + 1)):
            for j in range(max(0, int(np.ceil(u - reach))), min(columns, int(np.floor(u + reach)) + 1)):
                square = (i - v) ** 2 + (j - u) ** 2
                if square > radius**2 and max(abs(i - v), abs(j - u)) > 0.5:
                    continue
                weight = np.exp(-0.5 * min(square, 900.0))
                cells[WEIGHT, i, j] += weight
                cells[HEIGHT, i, j] += weight * height[n]
                cells[CONFIDENCE, i, j] += weight * confidence[n]
                cells[COUNT, i, j] += 1
                if np.isnan(lower[n]) or np.isnan(upper[n]):
                    continue
                cells[BOUNDED, i, j] += weight
                cells[LOWER, i, j] += weight * lower[n]
                cells[UPPER, i, j] += weight * upper[n]
                cells[LEAST, i, j] = min(cells[LEAST, i, j], lower[n])
                cells[MOST, i, j] = max(cells[MOST, i, j], upper[n])


# What `cell_bounds` takes.
MEDIAN, NEAREST, AGREEING = range(3)


@cached
def reaching(column, row, radius, rows, columns):
    """Return which points reach each cell, by the rule of `splat`.

    ``rows`` and ``columns`` are the size of the grid. Returns ``starts (rows * columns + 1,)`` and ``points``: those of
    cell ``i * columns + j`` are ``points[starts[cell] : starts[cell + 1]]``, in their order.
    """
    starts = np.zeros(rows * columns + 1, np.int64)
    points = np.empty(0, np.int32)
    reach = max(radius, 0.5)
    for filling in range(2):
        for n in range(column.size):
            u, v = column[n] - 0.5, row[n] - 0.5
            for i in range(max(0, int(np.ceil(v - reach))), min(rows, int(np.floor(v + reach)) + 1)):
                for j in range(max(0, int(np.ceil(u - reach))), min(columns, int(np.floor(u + reach)) + 1)):
                    if (i - v) ** 2 + (j - u) ** 2 > radius**2 and max(abs(i - v), abs(j - u)) > 0.5:
                        continue
                    cell = i * columns + j
                    if filling:
                        points[starts[cell]] = n
                    starts[cell + (not filling)] += 1
        # Loops: `cumsum` and a copy of slices would take seconds longer to compile.
        if filling:  # each start has moved to the next one
            for cell in range(starts.size - 1, 0, -1):
                starts[cell] = starts[cell - 1]
            starts[0] = 0
        else:
            for cell in range(1, starts.size):
                starts[cell] += starts[cell - 1]
            points = np.empty(starts[-1], np.int32)
    return starts, points


@cached
def cell_bounds(starts, points, height, lower, upper, middle, how):
    """Return bounds of each cell from those of its points, see `reaching`: ``(2, cells)``, NaN without any.

    height, lower, upper: ``(n,)`` of the points, without NaN.
    middle: ``(cells,)``, the height of each cell.
    how: MEDIAN of the bounds; bounds of the point NEAREST to the cell's height, the first of several; AGREEING: the
        intersection of the largest number of intervals that meet, the lowest of several.
    """
    bounds = np.full((2, middle.size), np.nan)
    for cell in range(middle.size):
        first, last = starts[cell], starts[cell + 1]
        if first == last:
            continue
        if how == NEAREST:
            best = points[first]
            for n in points[first + 1 : last]:
                if abs(height[n] - middle[cell]) < abs(height[best] - middle[cell]):
                    best = n
            bounds[0, cell], bounds[1, cell] = lower[best], upper[best]
            continue
        count = last - first
        lows, ups = np.empty(count, lower.dtype), np.empty(count, upper.dtype)
        for n in range(count):
            lows[n], ups[n] = lower[points[first + n]], upper[points[first + n]]
        lows.sort()
        ups.sort()
        if how == MEDIAN:
            bounds[0, cell] = (lows[(count - 1) // 2] + lows[count // 2]) / 2
            bounds[1, cell] = (ups[(count - 1) // 2] + ups[count // 2]) / 2
            continue
        most = ended = 0
        for begun in range(count):
            while ups[ended] < lows[begun]:
                ended += 1
            if begun + 1 - ended > most:
                most = begun + 1 - ended
                bounds[0, cell], bounds[1, cell] = lows[begun], ups[ended]
    return bounds
