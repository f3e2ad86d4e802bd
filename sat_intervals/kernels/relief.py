"""Heights of surfaces of blocks at points, and how well they fit.

A surface is ``(blocks, rows, columns)``, NaN where unknown; points are ``(n,)`` block, column x and row y there, where
centres of cells are integers.

Letters: n a point; i, j row and column of a cell; a, b a shift.
"""

import numpy as np

from sat_intervals.kernels.compiled import cached, part


@part
def between(here, i, j, down, across):
    """Return the height between a cell and the next ones (bilinear), without those that have no part in it."""
    upper, lower = here[i, j], 0.0
    if across > 0:
        upper += across * (here[i, j + 1] - upper)
    if down > 0:
        lower = here[i + 1, j]
        if across > 0:
            lower += across * (here[i + 1, j + 1] - lower)
        upper += down * (lower - upper)
    return upper


@cached
def losses(surface, block, x, y, height, east, north, cap):
    """Return ``(blocks, east, north)`` sums over points of ``min((d - median d)^2, cap^2)``, and numbers of points.

    ``d`` are differences of height to the surface moved by whole cells, to each of ``east`` and of ``north``: of a
    point, weights of cells are the same for all shifts, and so is the noise of the surface.
    """
    blocks, rows, columns = surface.shape
    sums, counts = np.zeros((2, blocks, east.size, north.size))
    differences, known = np.empty(x.size), np.empty(x.size, np.int64)
    for a in range(east.size):
        for b in range(north.size):
            count = 0
            for n in range(x.size):
                row, column = int(np.floor(y[n])), int(np.floor(x[n]))
                i, j = row + north[b], column - east[a]
                if 0 <= i < rows - 1 and 0 <= j < columns - 1:
                    difference = height[n] - between(surface[block[n]], i, j, y[n] - row, x[n] - column)
                    if not np.isnan(difference):
                        differences[count], known[count] = difference, block[n]
                        count += 1
            middle = np.median(differences[:count]) if count else 0.0
            for n in range(count):
                sums[known[n], a, b] += min((differences[n] - middle) ** 2, cap**2)
                counts[known[n], a, b] += 1
    return sums, counts


@part
def rise(here, i, j, near, far):
    """Return the rise per row between two rows beside a cell, over three columns."""
    total = 0.0
    for k in range(j - 1, j + 2):
        total += here[i + far, k] - here[i + near, k]
    return total / (3 * (far - near))


@part
def slope_of(here, i, j):
    """Return the slope down the rows: the median of that at a cell and those of both sides, where they are known."""
    between, above, below = rise(here, i, j, -1, 1), rise(here, i, j, -3, -1), rise(here, i, j, 1, 3)
    above = between if np.isnan(above) else above
    below = between if np.isnan(below) else below
    if np.isnan(between):
        return between
    return max(min(above, between), min(max(above, between), below))


@cached
def sampled(surface, block, x, y):
    """Return ``(n,)`` heights of the nearest cell and its slope, NaN where unknown."""
    # Interpolation between cells averages their noise: halfway, differences would be smaller than at the true shift.
    result = np.full(x.size, np.nan)
    _, rows, columns = surface.shape
    for n in range(x.size):
        i, j = int(np.floor(y[n] + 0.5)), int(np.floor(x[n] + 0.5))
        if 3 <= i < rows - 3 and 3 <= j < columns - 3:
            here = surface[block[n]]
            result[n] = here[i, j] + slope_of(here, i, j) * (y[n] - i) + slope_of(here.T, j, i) * (x[n] - j)
    return result
