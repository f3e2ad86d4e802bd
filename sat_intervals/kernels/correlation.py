"""Matching costs from features: 1 minus the cosine of two unit vectors (Zbontar and LeCun 2016).

Letters: x = c + k column of the right features, f feature.
"""

import numpy as np

from sat_intervals.kernels.compiled import cached, inlined, part
from sat_intervals.kernels.vector import LANES, load_floats, multiply_add, splat_float, store_rounded
from sat_intervals.products import COSINE_STEPS


@part
def _copy_row(features, r, factor, row):
    """Copy the features of a row, times a factor, to contiguous memory."""
    # The stride of the volume would make its rows collide in the cache: correlation would take 1.3 to 1.4 times as
    # long.
    for f in range(features.shape[0]):
        for x in range(features.shape[2]):
            row[f, x] = factor * features[f, r, x]


@inlined
def _correlate_four(here, there, c, start, curves):
    """Costs of the pixels ``c .. c + 3``: ``curves[i, x]`` is that of pixel ``c + i`` and right pixel ``c + x``."""
    # A cost is ``start`` plus the sum of products, rounded. Four pixels share each load of right features, and their
    # sums are independent: one pixel at a time takes 1.6 times as long.
    features, width, size = here.shape[0], there.shape[1], curves.shape[1]
    for x in range(0, size, LANES):
        total_1 = total_2 = total_3 = total_4 = splat_float(start)
        for f in range(features):
            facing = load_floats(there, f * width + c + x)
            total_1 = multiply_add(facing, splat_float(here[f, c]), total_1)
            total_2 = multiply_add(facing, splat_float(here[f, c + 1]), total_2)
            total_3 = multiply_add(facing, splat_float(here[f, c + 2]), total_3)
            total_4 = multiply_add(facing, splat_float(here[f, c + 3]), total_4)
        store_rounded(curves, x, total_1)
        store_rounded(curves, size + x, total_2)
        store_rounded(curves, 2 * size + x, total_3)
        store_rounded(curves, 3 * size + x, total_4)


@cached
def correlate(left, right, costs):
    """Fill ``costs`` with ``round(COSINE_STEPS * (1 - cosine))``.

    left: ``(features, rows, columns)`` float32 unit vectors.
    right: ``(features, rows, columns + count - 1)``: ``right[:, r, c + k]`` faces ``left[:, r, c]``.
    costs: ``(rows, columns, size)`` uint8, 0 to 2 COSINE_STEPS; ``size`` is ``count`` padded to whole vectors.
    """
    rows, columns, size = costs.shape
    here = np.zeros((left.shape[0], columns + 3), np.float32)
    there = np.zeros((left.shape[0], columns + 3 + size + LANES), np.float32)
    curves = np.empty((4, size + LANES), np.uint8)
    for r in range(rows):
        _copy_row(left, r, np.float32(-COSINE_STEPS), here)
        _copy_row(right, r, np.float32(1), there)
        for first in range(0, columns, 4):
            _correlate_four(here, there, first, np.float32(COSINE_STEPS), curves)
            for i in range(min(4, columns - first)):
                for k in range(size):
                    costs[r, first + i, k] = curves[i, i + k]
