"""Winner's refinement, cross-checking and median (method: sections 6 and 7).

Letters: r row, c column, k disparity index (disparity = minimum + k), x column of the right image, from the one that
faces the first left column at the minimum: ``x = c + k``.
"""

import numpy as np
from numba import njit

from sat_intervals.products import IMPOSSIBLE_COST, MISMATCH, NO_DISPARITY, OCCLUSION


@njit(nogil=True, forceinline=True)
def vfit(curve, k, count):
    """Sub-pixel shift of the winner ``k`` by V-fit (Haller et al. 2010), within half a pixel.

    Returns ``(shift, refined)``: 0 and False at the range's ends and beside an impossible candidate. The winner is the
    first of its ties, so the cost before it is larger and the three are never equal.
    """
    if k == 0 or k == count - 1:
        return 0.0, False
    here, before, after = np.int64(curve[k]), np.int64(curve[k - 1]), np.int64(curve[k + 1])
    steepest = max(before, after)
    if steepest == IMPOSSIBLE_COST:
        return 0.0, False
    return (before - after) / (2 * (steepest - here)), True


@njit(nogil=True, cache=True)
def cross_check(winner, right_winner, minimum, tolerance):
    """Rejected pixels: a left winner that the winner of the right pixel it points to does not confirm.

    Parameters
    ----------
    winner
        ``(rows, columns)`` int16 disparities, NO_DISPARITY where there is none.
    right_winner
        ``(rows, columns + count - 1)`` int16: ``right_winner[r, c + k]`` is the disparity, seen from the left, of the
        right pixel that faces ``(r, c)`` at index ``k``; NO_DISPARITY where there is none.
    minimum, tolerance
        First disparity of the search range; largest difference in pixels that is kept.

    Returns
    -------
    ``(rows, columns)`` uint16: 0, OCCLUSION or MISMATCH (some right pixel of the range points back).
    """
    rows, columns = winner.shape
    count = right_winner.shape[1] - columns + 1
    flags = np.zeros((rows, columns), np.uint16)
    for r in range(rows):
        for c in range(columns):
            d = np.int64(winner[r, c])
            if d == NO_DISPARITY:
                continue
            back = np.int64(right_winner[r, c + d - minimum])
            if back != NO_DISPARITY and abs(d - back) <= tolerance:
                continue
            flags[r, c] = OCCLUSION
            for k in range(count):
                if right_winner[r, c + k] == minimum + k:
                    flags[r, c] = MISMATCH
                    break
    return flags


@njit(nogil=True, forceinline=True)
def _insert(values, count, value):
    """Insert into the first ``count`` values, which are sorted."""
    i = count
    while i > 0 and values[i - 1] > value:
        values[i] = values[i - 1]
        i -= 1
    values[i] = value


@njit(nogil=True, forceinline=True)
def _median_around(values, kept, r, c, radius, window):
    """Median of the kept pixels within ``radius`` of one that is kept itself."""
    rows, columns = values.shape
    count = 0
    for i in range(max(0, r - radius), min(rows, r + radius + 1)):
        for j in range(max(0, c - radius), min(columns, c + radius + 1)):
            if kept[i, j]:
                _insert(window, count, values[i, j])
                count += 1
    middle = window[count // 2]
    if count % 2 == 0:
        middle = (window[count // 2 - 1] + middle) / np.float32(2)
    return middle


@njit(nogil=True, forceinline=True)
def _ordered(a, b, c):
    """Three values in ascending order; comparisons and selections only, which vectorise."""
    a, b = (a, b) if a < b else (b, a)
    b, c = (b, c) if b < c else (c, b)
    a, b = (a, b) if a < b else (b, a)
    return a, b, c


@njit(nogil=True)
def _median_of_nine(values, r, result):
    """Medians of whole 3 x 3 windows along the inside of a row (Devillard 1998)."""
    above, here, below = values[r - 1], values[r], values[r + 1]
    for c in range(1, here.size - 1):
        low_1, middle_1, high_1 = _ordered(above[c - 1], here[c - 1], below[c - 1])
        low_2, middle_2, high_2 = _ordered(above[c], here[c], below[c])
        low_3, middle_3, high_3 = _ordered(above[c + 1], here[c + 1], below[c + 1])
        low = _ordered(low_1, low_2, low_3)[2]
        middle = _ordered(middle_1, middle_2, middle_3)[1]
        high = _ordered(high_1, high_2, high_3)[0]
        result[c] = _ordered(low, middle, high)[1]


@njit(nogil=True)
def _whole_windows(kept, r, whole):
    """Which 3 x 3 windows along the inside of a row are kept as a whole."""
    above, here, below = kept[r - 1], kept[r], kept[r + 1]
    for c in range(1, here.size - 1):
        left = above[c - 1] & here[c - 1] & below[c - 1]
        right = above[c + 1] & here[c + 1] & below[c + 1]
        whole[c] = left & above[c] & here[c] & below[c] & right


@njit(nogil=True, cache=True)
def median(values, kept, size):
    """Median of the kept pixels of each kept pixel's window; the other pixels keep their value.

    Applied to disparity and bounds alike it keeps their order (paper eq. 10 and 11).

    Parameters
    ----------
    values
        ``(rows, columns)`` float32.
    kept
        bool of the same shape.
    size
        Side of the square window in pixels, odd. Outside the array nothing is kept.

    Returns
    -------
    ``(rows, columns)`` float32; of an even number of pixels the mean of the two in the middle.
    """
    rows, columns = values.shape
    radius = size // 2
    result = values.copy()
    window = np.empty(size * size, np.float32)
    nine, whole = np.empty(columns, np.float32), np.zeros(columns, np.bool_)
    for r in range(rows):
        if size == 3 and 0 < r < rows - 1:
            _median_of_nine(values, r, nine)
            _whole_windows(kept, r, whole)
        else:
            whole[:] = False
        for c in range(columns):
            if whole[c]:
                result[r, c] = nine[c]
            elif kept[r, c]:
                result[r, c] = _median_around(values, kept, r, c, radius, window)
    return result
