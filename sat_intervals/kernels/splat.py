"""Accumulation of ground points in the cells of a grid.

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
    """Add points to the cells they fall in and to all cells whose centre is within a radius.

    The weight of a point at a distance of ``d`` cells is ``exp(-d^2 / 2)``, constant from 30 cells on.

    Parameters
    ----------
    column, row
        ``(n,)`` positions in cells from the upper left corner of the first cell, whose centre is at 0.5, 0.5.
    height, lower, upper, confidence
        ``(n,)``; points of NaN height and NaN bounds are ignored.
    radius
        Radius in cells.
    cells
        ``(9, rows, columns)`` float64, updated: sums of weights and of weighted height, confidence, lower and upper
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
