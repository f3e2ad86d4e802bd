"""Points on the ground to the cells of a grid.

Letters: i, j row and column of a cell, u, v position of a point in cells from the grid's upper left corner.
"""

import numpy as np

from sat_intervals.kernels.compiled import cached

# What is gathered of a cell.
WEIGHT, HEIGHT, CONFIDENCE, LOWER, UPPER, LEAST, MOST, COUNT, BOUNDED = range(9)


def empty_cells(rows: int, columns: int) -> np.ndarray:
    """Cells that no point has reached: ``(9, rows, columns)`` float64, see `splat`."""
    cells = np.zeros((9, rows, columns))
    cells[LEAST], cells[MOST] = np.inf, -np.inf
    return cells


@cached
def splat(column, row, height, lower, upper, confidence, radius, cells):
    """Let points reach the cell they fall in and all cells whose centre lies within a radius.

    A point weighs ``exp(-d^2 / 2)`` at a distance of ``d`` cells, and next to nothing from 30 cells on.

    Parameters
    ----------
    column, row
        ``(n,)`` positions in cells from the upper left corner of the first cell; those of centres end in one half.
    height, lower, upper, confidence
        ``(n,)``; a point of NaN height reaches nothing, NaN bounds count for nothing.
    radius
        In cells.
    cells
        ``(9, rows, columns)`` float64, updated: sums of weights and of weighted height, confidence, lower and upper
        bound, the least lower bound, the largest upper bound, the number of points, the sum of weights of those with
        bounds.
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
