"""Sub-pixel refinement, cross-checking and median (METHOD.md, sections 6 and 7).

Letters: d disparity, x column of the right image, counted from the one that faces the first left column at the minimum
(``x = c + k``).
"""

import numpy as np

from sat_intervals.kernels.compiled import cached, inlined, inlined_unchecked, part
from sat_intervals.products import IMPOSSIBLE_COST, MISMATCH, NO_DISPARITY, OCCLUSION


@inlined_unchecked
def vfit(curve, k, count):
    """Sub-pixel shift of the winner ``k`` by V-fit (Haller and Nedevschi 2012), at most half a pixel.

    Returns ``(shift, refined)``: 0 and False at the ends of the range and beside an impossible candidate. The winner is
    the first of its ties, so the cost before it is larger and the three costs are never equal.
    Python's check for divisions by zero would make sweeps 2 to 6 % slower.
    """
    if k == 0 or k == count - 1:
        return 0.0, False
    here, before, after = np.int64(curve[k]), np.int64(curve[k - 1]), np.int64(curve[k + 1])
    steepest = max(before, after)
    if steepest == IMPOSSIBLE_COST:
        return 0.0, False
    return (before - after) / (2 * (steepest - here)), True


@cached
def cross_check(winner, right_winner, minimum, tolerance):
    """Reject left winners that the winner of the right pixel they point to does not confirm.

    winner: ``(rows, columns)`` int16 disparities, NO_DISPARITY where there is none.
    right_winner: ``(rows, columns + count - 1)`` int16: ``right_winner[r, c + k]`` is the winner, as a left disparity,
        of the right pixel that faces ``(r, c)`` at index ``k``; NO_DISPARITY where there is none.
    minimum, tolerance: first disparity of the search range; largest accepted difference in pixels.
    Returns ``(rows, columns)`` uint16: 0, OCCLUSION, or MISMATCH where some right pixel of the range points back.
    """
    rows, columns = winner.shape
    flags = np.zeros((rows, columns), np.uint16)
    pointed_at = np.empty(columns, np.bool_)
    for r in range(rows):
        pointed_at[:] = False
        for x in range(right_winner.shape[1]):
            d = np.int64(right_winner[r, x])
            c = x - (d - minimum)
            if d != NO_DISPARITY and 0 <= c < columns:
                pointed_at[c] = True
        for c in range(columns):
            d = np.int64(winner[r, c])
            if d == NO_DISPARITY:
                continue
            back = np.int64(right_winner[r, c + d - minimum])
            if back == NO_DISPARITY or abs(d - back) > tolerance:
                flags[r, c] = MISMATCH if pointed_at[c] else OCCLUSION
    return flags


@inlined
def insert(values, count, value):
    """Insert a value into the first ``count`` values, which are sorted."""
    i = count
    while i > 0 and values[i - 1] > value:
        values[i] = values[i - 1]
        i -= 1
    values[i] = value


@inlined
def _median_around(values, kept, r, c, radius, window):
    """Median of the kept pixels in the window around the kept pixel ``(r, c)``."""
    rows, columns = values.shape
    count = 0
    for i in range(max(0, r - radius), min(rows, r + radius + 1)):
        for j in range(max(0, c - radius), min(columns, c + radius + 1)):
            if kept[i, j]:
                insert(window, count, values[i, j])
                count += 1
    middle = window[count // 2]
    if count % 2 == 0:
        middle = (window[count // 2 - 1] + middle) / np.float32(2)
    return middle


@inlined
def _ordered(a, b, c):
    """Sort three values by comparisons and selections, which vectorise."""
    a, b = (a, b) if a < b else (b, a)
    b, c = (b, c) if b < c else (c, b)
    a, b = (a, b) if a < b else (b, a)
    return a, b, c


@inlined
def _column(values, kept, c, infinity):
    """Sort three values, rejected ones as infinities of alternating sign; return them and the next infinity."""
    a, infinity = (values[0][c], infinity) if kept[0][c] else (infinity, -infinity)
    b, infinity = (values[1][c], infinity) if kept[1][c] else (infinity, -infinity)
    d, infinity = (values[2][c], infinity) if kept[2][c] else (infinity, -infinity)
    return _ordered(a, b, d), infinity


@inlined
def _middle_of_nine(values, kept, c, infinity):
    """Middle of the 3 x 3 window from column c on (Devillard 1998), with infinities in place of rejected values."""
    # For an odd number of kept values it is their median. For an even number it is the lower of the middle two if the
    # first infinity is positive, and the upper if it is negative.
    (low_1, middle_1, high_1), infinity = _column(values, kept, c, infinity)
    (low_2, middle_2, high_2), infinity = _column(values, kept, c + 1, infinity)
    (low_3, middle_3, high_3), infinity = _column(values, kept, c + 2, infinity)
    low = _ordered(low_1, low_2, low_3)[2]
    middle = _ordered(middle_1, middle_2, middle_3)[1]
    high = _ordered(high_1, high_2, high_3)[0]
    return _ordered(low, middle, high)[1]


@part
def _medians_of_nine(values, kept, result):
    """Medians of the 3 x 3 windows along a row, from three rows with one more pixel at both ends."""
    infinity = np.float32(np.inf)
    for c in range(result.size):
        lower, upper = _middle_of_nine(values, kept, c, infinity), _middle_of_nine(values, kept, c, -infinity)
        result[c] = (lower + upper) / np.float32(2) if kept[1][c + 1] else values[1][c + 1]


@part
def _median_3(values, kept):
    """Medians of 3 x 3 windows: the same operations on every pixel, kept or not, so that they vectorise."""
    # 1.9 ms at 600 x 600, 135 ms by `_median_around`.
    rows, columns = values.shape
    result = np.empty((rows, columns), np.float32)
    # The current row and its neighbours, with a border of pixels that are not kept.
    near, near_kept = np.zeros((3, columns + 2), np.float32), np.zeros((3, columns + 2), np.bool_)
    for r in range(-1, rows):
        entering = (r + 1) % 3
        if r + 1 < rows:
            for c in range(columns):  # a copy of slices would take seconds longer to compile
                near[entering, c + 1], near_kept[entering, c + 1] = values[r + 1, c], kept[r + 1, c]
        else:
            near_kept[entering] = False
        if r >= 0:
            above, here = (r - 1) % 3, r % 3
            of_kept = near_kept[above], near_kept[here], near_kept[entering]
            _medians_of_nine((near[above], near[here], near[entering]), of_kept, result[r])
    return result


@cached
def median(values, kept, size):
    """Median of the kept pixels in each kept pixel's window; the other pixels keep their value.

    Applied separately to disparity and bounds, it keeps their order (paper eq. 10 and 11).

    values: ``(rows, columns)``, float32, or integers that float32 represents exactly; not NaN where kept.
    kept: bool of the same shape.
    size: side of the square window in pixels, odd. Outside the array nothing is kept.
    Returns ``(rows, columns)`` float32; for an even number of pixels the mean of the middle two.
    """
    if size == 3:
        return _median_3(values, kept)
    rows, columns = values.shape
    result = values.astype(np.float32)
    window = np.empty(size * size, np.float32)
    for r in range(rows):
        for c in range(columns):
            if kept[r, c]:
                result[r, c] = _median_around(values, kept, r, c, size // 2, window)
    return result
