"""A whole aggregated volume read at once: winners, and intervals of any level (method: sections 4 to 6 and 10).

A run never stores its volume and reads every curve while it is in the cache (`matching`); here several methods are
compared on one volume that fits in memory, ``(rows, columns, count)`` uint16, IMPOSSIBLE_COST where impossible.
Letters: r row, c column, k disparity index (disparity = minimum + k).
"""

import numpy as np
from numba import njit

from sat_intervals.kernels.compiled import cached
from sat_intervals.kernels.confidence import ambiguity
from sat_intervals.kernels.disparity import vfit
from sat_intervals.products import IMPOSSIBLE_COST, NO_DISPARITY


@njit(nogil=True)
def _least(curve):
    """The first index of the lowest cost."""
    least = 0
    for k in range(1, curve.size):
        if curve[k] < curve[least]:
            least = k
    return least


@cached
def read_winners(volume, minimum, weights, refine):
    """Winner, refined disparity and ambiguity of every curve.

    Returns ``(rows, columns)`` int16 disparities, NO_DISPARITY for none, float32 ones in pixels, NaN for none, and
    uint32 ambiguities; ``weights`` is the table of `ambiguity`, ``refine`` whether V-fit is done.
    """
    rows, columns, count = volume.shape
    winner = np.full((rows, columns), NO_DISPARITY, np.int16)
    disparity = np.full((rows, columns), np.float32(np.nan))
    doubt = np.zeros((rows, columns), np.uint32)
    for r in range(rows):
        for c in range(columns):
            curve = volume[r, c]
            k = _least(curve)
            if curve[k] == IMPOSSIBLE_COST:
                continue
            shift, _ = vfit(curve, k, count) if refine else (0.0, False)
            winner[r, c], disparity[r, c] = minimum + k, minimum + k + shift
            doubt[r, c] = ambiguity(curve, count, curve[k], weights)
    return winner, disparity, doubt


@cached
def read_right_winners(volume, minimum):
    """The right view's winners along the diagonals of the left volume; the largest disparity at ties.

    Returns ``(rows, columns + count - 1)`` int16 as `cross_check` takes it.
    """
    rows, columns, count = volume.shape
    winner = np.full((rows, columns + count - 1), NO_DISPARITY, np.int16)
    for r in range(rows):
        for x in range(columns + count - 1):
            lowest = IMPOSSIBLE_COST
            for k in range(max(0, x - columns + 1), min(count, x + 1)):
                cost = volume[r, x - k, k]
                if cost <= lowest and cost != IMPOSSIBLE_COST:
                    lowest, winner[r, x] = cost, minimum + k
    return winner


@njit(nogil=True)
def _extremes(curve, limit):
    """First and last index whose cost is at most ``limit``, which the lowest cost is."""
    first, last = 0, curve.size - 1
    while curve[first] > limit:
        first += 1
    while curve[last] > limit:
        last -= 1
    return first, last


@cached
def read_alpha_cuts(volume, minimum, cut_level, refine):
    """Bounds of the alpha-cut of every curve (paper eq. 5 to 9), pushed out for refinement.

    Returns ``(lower, upper)``, ``(rows, columns)`` int16 disparities, NO_DISPARITY for none; ``cut_level`` is
    ``floor((1 - alpha) * span)``.
    """
    rows, columns, count = volume.shape
    lower = np.full((rows, columns), NO_DISPARITY, np.int16)
    upper = lower.copy()
    for r in range(rows):
        for c in range(columns):
            curve = volume[r, c]
            lowest = curve[_least(curve)]
            if lowest == IMPOSSIBLE_COST:
                continue
            first, last = _extremes(curve, min(lowest + cut_level, IMPOSSIBLE_COST - 1))
            if refine:
                first -= curve[first] == lowest and first > 0
                last += curve[last] == lowest and last < count - 1
            lower[r, c], upper[r, c] = minimum + first, minimum + last
    return lower, upper


@cached
def read_baseline(volume, minimum, part, whole):
    """The paper's baseline (its section 4.1): each curve normalised by its own minimum and maximum.

    The bounds are the extreme disparities whose similarity, 1 at the lowest and 0 at the highest possible cost, is at
    least ``1 - part / whole``, integers. Returns as `read_alpha_cuts`, nothing pushed out.
    """
    rows, columns, count = volume.shape
    lower = np.full((rows, columns), NO_DISPARITY, np.int16)
    upper = lower.copy()
    for r in range(rows):
        for c in range(columns):
            curve = volume[r, c]
            lowest = np.int64(curve[_least(curve)])
            if lowest == IMPOSSIBLE_COST:
                continue
            highest = lowest
            for k in range(count):
                if curve[k] != IMPOSSIBLE_COST:
                    highest = max(highest, np.int64(curve[k]))
            first, last = _extremes(curve, lowest + (highest - lowest) * part // whole)
            lower[r, c], upper[r, c] = minimum + first, minimum + last
    return lower, upper
