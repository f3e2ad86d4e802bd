"""Heights of the cells of a void from its rim: the first known cells in 16 directions, and cells twice as far.

Letters: i, j row and column of a cell; k one of its rim; x, y columns and rows from the cell to it.
"""

import numpy as np

from sat_intervals.kernels.compiled import cached, part

# Rows and columns of a step in each direction.
_T = np.sqrt(2.0) - 1.0
_QUARTER = [(0.0, 1.0), (_T, 1.0), (1.0, 1.0), (1.0, _T)]
_STEPS = np.array([(c * y - s * x, s * y + c * x) for c, s in ((1, 0), (0, 1), (-1, 0), (0, -1)) for y, x in _QUARTER])
# Directions with a rim that a void inside a surface has: a straight border has 7 to 9 of 16.
_LEAST = 10
# Share of the way to the highest of the rim that the upper bound is above a cell between roof and ground.
_SHARE = 0.95


@part
def _rim(height, i, j, reach, found):
    """Find the rim of a cell, and known cells twice as far behind it; return both numbers, 0 for a rim of too few.

    found: ``(32, 2)`` rows and columns, of the rim from the first one on, of those behind from the last one back.
    """
    count = behind = 0
    for n in range(_STEPS.shape[0]):
        length = np.sqrt(_STEPS[n, 0] ** 2 + _STEPS[n, 1] ** 2)
        step, row, column = 1, i, j
        while step * length <= reach:
            row, column = _at(i, j, n, step)
            if not _inside(height, row, column) or not np.isnan(height[row, column]):
                break
            step += 1
        if step * length <= reach and _inside(height, row, column):
            found[count] = row, column
            count += 1
            row, column = _at(i, j, n, 2 * step)
            if _inside(height, row, column) and not np.isnan(height[row, column]):
                behind += 1
                found[-behind] = row, column
        if n - count >= _STEPS.shape[0] - _LEAST:
            return 0, 0
    return count, behind


@part
def _at(i, j, n, step):
    """Return row and column of the cell that is some steps away."""
    return i + int(np.floor(step * _STEPS[n, 0] + 0.5)), j + int(np.floor(step * _STEPS[n, 1] + 0.5))


@part
def _inside(height, row, column):
    return 0 <= row < height.shape[0] and 0 <= column < height.shape[1]


@part
def _plane(z, x, y):
    """Return height at 0, 0 of the plane by least squares with weights of 1 / distance^2, and its largest residual."""
    weight = 1 / (x**2 + y**2)
    total = weight.sum()
    mean_x, mean_y, mean_z = (weight * x).sum() / total, (weight * y).sum() / total, (weight * z).sum() / total
    a, b, c = x - mean_x, y - mean_y, z - mean_z
    xx, xy, yy = (weight * a * a).sum(), (weight * a * b).sum(), (weight * b * b).sum()
    xz, yz = (weight * a * c).sum(), (weight * b * c).sum()
    determinant = xx * yy - xy * xy  # of directions all around it is not 0
    east, south = (yy * xz - xy * yz) / determinant, (xx * yz - xy * xz) / determinant
    return mean_z - east * mean_x - south * mean_y, np.abs(c - east * a - south * b).max()


@part
def _larger(mean, of_lowest):
    """Return the larger of two numbers, NaN if the first is."""
    return of_lowest if of_lowest > mean else mean


@cached
def filled(height, lower, upper, voids, reach, apart):
    """Fill cells of a surface from their rims; return height, lower and upper bound, ``(3, rows, columns)`` float64.

    NaN are all other cells, and those that have a rim in fewer than 10 of 16 directions.
    height, lower, upper: ``(rows, columns)`` metres, NaN where unknown; ``voids``: bool, what is to be filled.
    reach: cells to the rim at most; ``apart``: metres from a plane from which a rim is of roof and ground.
    """
    result, found = np.full((3, *height.shape), np.nan), np.empty((32, 2), np.int64)
    z, x, y, down, up = np.empty((5, 32))
    for i in range(height.shape[0]):
        for j in range(height.shape[1]):
            count, behind = _rim(height, i, j, reach, found) if voids[i, j] else (0, 0)
            if not count:
                continue
            for k in range(count + behind):
                row, column = found[k if k < count else count - k - 1]
                z[k], x[k], y[k] = height[row, column], column - j, row - i
                down[k], up[k] = z[k] - lower[row, column], upper[row, column] - z[k]
            low, other = np.argsort(z[:count], kind="mergesort")[:2]
            known = count + behind
            middle, away = _plane(z[:known], x[:known], y[:known])
            value = middle if away <= apart else z[other]
            top = value if away <= apart else value + _SHARE * (z[:count].max() - value)
            above = value + _larger(up[:count].mean(), (up[low] + up[other]) / 2)
            result[0, i, j] = value
            result[1, i, j] = value - _larger(down[:count].mean(), (down[low] + down[other]) / 2)
            result[2, i, j] = _larger(above, top)
    return result
