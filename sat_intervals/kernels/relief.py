"""Heights and slopes of surfaces of blocks at points.

A surface is ``(blocks, rows, columns)``, NaN where unknown; points are ``(n,)`` block, column x and row y there, where
centres of cells are integers.

Letters: n a point; i, j row and column of a cell.
"""

import numpy as np

from sat_intervals.kernels.compiled import cached, part


@cached
def slopes(surface, block, x, y, reach):
    """Return ``(n, 2)`` slopes of the nearest cells, down the rows and along the columns; NaN where unknown.

    They are means of three lines, over ``reach`` cells to each side.
    """
    result = np.full((x.size, 2), np.nan)
    _, rows, columns = surface.shape
    for n in range(x.size):
        i, j = int(np.floor(y[n] + 0.5)), int(np.floor(x[n] + 0.5))
        if reach <= i < rows - reach and reach <= j < columns - reach:
            here = surface[block[n]]
            down = across = 0.0
            for k in range(-1, 2):
                down += here[i + reach, j + k] - here[i - reach, j + k]
                across += here[i + k, j + reach] - here[i + k, j - reach]
            result[n] = down / (6 * reach), across / (6 * reach)
    return result


@part
def bend(here, i, j, down, across):
    """Return how far a cell is from the middle between two opposite neighbours, twice."""
    return abs(here[i - down, j - across] + here[i + down, j + across] - 2 * here[i, j])


@cached
def interpolated(surface, block, x, y):
    """Return ``(n, 4)`` heights between cells (bilinear), lowest and highest of the nine cells around, and their bend.

    Between lowest and highest, a point may be a wall that is moved by a cell; beyond them something has changed. Bends
    are twice the largest distance from a plane. NaN where unknown.
    """
    result = np.full((x.size, 4), np.nan)
    _, rows, columns = surface.shape
    for n in range(x.size):
        i, j = int(np.floor(y[n] + 0.5)), int(np.floor(x[n] + 0.5))
        if 1 <= i < rows - 1 and 1 <= j < columns - 1:
            here = surface[block[n]]
            down, across = y[n] - i, x[n] - j
            below, beside = i + (1 if down > 0 else -1), j + (1 if across > 0 else -1)
            down, across = abs(down), abs(across)
            result[n, 0] = (1 - down) * ((1 - across) * here[i, j] + across * here[i, beside])
            result[n, 0] += down * ((1 - across) * here[below, j] + across * here[below, beside])
            around = here[i - 1 : i + 2, j - 1 : j + 2]
            result[n, 1], result[n, 2] = around.min(), around.max()
            bends = bend(here, i, j, 0, 1), bend(here, i, j, 1, 0), bend(here, i, j, 1, 1), bend(here, i, j, 1, -1)
            result[n, 3] = max(bends)
    return result


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
    """Return ``(n,)`` heights of the nearest cell and its slope, NaN where unknown.

    Interpolation between cells averages their noise: halfway, differences would be smaller than at the true shift.
    """
    result = np.full(x.size, np.nan)
    _, rows, columns = surface.shape
    for n in range(x.size):
        i, j = int(np.floor(y[n] + 0.5)), int(np.floor(x[n] + 0.5))
        if 3 <= i < rows - 3 and 3 <= j < columns - 3:
            here = surface[block[n]]
            result[n] = here[i, j] + slope_of(here, i, j) * (y[n] - i) + slope_of(here.T, j, i) * (x[n] - j)
    return result
