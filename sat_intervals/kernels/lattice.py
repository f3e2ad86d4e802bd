"""Trilinear interpolation on a lattice over rows, columns and disparities.

Letters: i, j, k lattice node along rows, columns and disparities; v value.
"""

import numpy as np

from sat_intervals.kernels.compiled import cached


@cached
def interpolate(lattice, spacing, first, disparity):
    """Interpolate the values of a lattice at the disparities of pixels.

    lattice: ``(rows, columns, disparities, values)`` float64 at the nodes, at least two along every axis.
    spacing: pixels between nodes along rows, columns and disparities.
    first: row, column and disparity of the first node; the first pixel is ``0, 0``.
    disparity: ``(rows, columns)`` in pixels, NaN where there is none.
    Returns ``(values, rows, columns)`` float64, NaN where there is no disparity.
    """
    rows, columns = disparity.shape
    values = lattice.shape[3]
    result = np.full((values, rows, columns), np.nan)
    for r in range(rows):
        y = (r - first[0]) / spacing[0]
        i = min(max(int(np.floor(y)), 0), lattice.shape[0] - 2)
        nodes = lattice[i] + (y - i) * (lattice[i + 1] - lattice[i])  # of this row of pixels
        for c in range(columns):
            if np.isnan(disparity[r, c]):
                continue
            x = (c - first[1]) / spacing[1]
            j = min(max(int(np.floor(x)), 0), lattice.shape[1] - 2)
            x -= j
            z = (disparity[r, c] - first[2]) / spacing[2]
            k = min(max(int(np.floor(z)), 0), lattice.shape[2] - 2)
            z -= k
            for v in range(values):
                near = (1 - x) * nodes[j, k, v] + x * nodes[j + 1, k, v]
                far = (1 - x) * nodes[j, k + 1, v] + x * nodes[j + 1, k + 1, v]
                result[v, r, c] = (1 - z) * near + z * far
    return result
