"""Reading of a finished cost curve: winner, refinement, interval, ambiguity, flags, and the right view's winners.

Letters: r row, c column, k disparity index (disparity = minimum + k).
"""

from typing import NamedTuple

import numpy as np

from sat_intervals.kernels.compiled import inlined, part
from sat_intervals.kernels.confidence import ambiguity
from sat_intervals.kernels.disparity import vfit
from sat_intervals.kernels.intervals import alpha_cut, subpixel_cuts
from sat_intervals.kernels.vector import (
    LANES,
    choose_smaller,
    fill_where_nonzero,
    first_lane,
    lanes_at_most,
    larger,
    load,
    smaller,
    smallest,
    splat,
    store,
)
from sat_intervals.products import (
    IMPOSSIBLE_COST,
    LEFT_WINDOW,
    MASKED,
    NO_CANDIDATE,
    NO_DISPARITY,
    RANGE_INCOMPLETE,
    RIGHT_MASKED,
)


class Rectangle(NamedTuple):
    """Window in the form that the kernels take."""

    row: int
    column: int
    row_stop: int
    column_stop: int


@inlined
def contains(rectangle, r, c):
    """Whether a rectangle contains the pixel ``(r, c)``."""
    return rectangle.row <= r < rectangle.row_stop and rectangle.column <= c < rectangle.column_stop


@inlined
def close_impossible(curve, candidates, c):
    """Set impossible candidates and lanes behind the range to IMPOSSIBLE_COST; return the lowest cost."""
    lowest = splat(np.uint16(IMPOSSIBLE_COST))
    for k in range(0, curve.size, LANES):
        closed = fill_where_nonzero(larger(load(candidates.barrier, c + k), load(candidates.beyond, k)))
        costs = larger(load(curve, k), closed)
        store(curve, k, costs)
        lowest = smaller(lowest, costs)
    return smallest(lowest)


@inlined
def _winner(curve, lowest):
    """First index with the lowest cost: 14 ns for 64 disparities by vectors, 36 ns by single costs."""
    k = 0
    mask = lanes_at_most(load(curve, k), lowest)
    while mask == 0:
        k += LANES
        mask = lanes_at_most(load(curve, k), lowest)
    return k + first_lane(mask)


@inlined
def _interval(curve, lowest, count, cut_level, refine):
    """First and last index of the alpha-cut, extended by one where refinement may move a winner at a bound outside."""
    first, last = alpha_cut(curve, np.uint16(min(lowest + cut_level, IMPOSSIBLE_COST - 1)))
    first -= refine & (first > 0) & (curve[first] == lowest)
    last += refine & (last < count - 1) & (curve[last] == lowest)
    return first, last


class RightPixels(NamedTuple):
    """Best candidates so far of the right pixels that face the left pixels of ``core``.

    Attributes
    ----------
    indices
        ``(size,)`` uint16: 0, 1, ...
    cost, best
        ``(rows, columns + size)`` uint16: the smallest cost so far, and its index k.
    """

    core: Rectangle
    indices: np.ndarray
    cost: np.ndarray
    best: np.ndarray


@inlined
def update_right(curve, right, r, c):
    """Update the right pixels that a left pixel faces with its candidates.

    The sweep up visits the left pixels of a row from right to left, so ``k`` ascends at each right pixel and ties go to
    the largest.
    """
    start = (r - right.core.row) * right.cost.shape[1] + c - right.core.column
    for k in range(0, curve.size, LANES):
        candidate, known = load(curve, k), load(right.cost, start + k)
        best = choose_smaller(candidate, known, load(right.indices, k), load(right.best, start + k))
        store(right.best, start + k, best)
        store(right.cost, start + k, smaller(candidate, known))


@part
def search_flags(costs, r, c, count, possible):
    """Validity flags of a pixel without all candidates; the left and the right image set separate flags."""
    flags = 0
    if costs.left_state[r, c] != 0:
        flags |= LEFT_WINDOW
    usable, masked = 0, False
    for x in range(c, c + count):
        usable += costs.right_state[r, x] == 0
        masked |= costs.right_state[r, x] & MASKED != 0
    if usable == 0:
        flags |= RIGHT_MASKED if masked else NO_CANDIDATE
    elif 0 < possible < count:
        flags |= RANGE_INCOMPLETE
    return flags


@inlined
def read_curve(curve, lowest, settings):
    """Winner, sub-pixel shift, whether it was refined, the bounds of both levels and ambiguity of a finished curve.

    Bounds are disparities, or steps with sub-pixel cuts; NO_DISPARITY for a level that is off.
    """
    k = _winner(curve, lowest)
    shift, refined = vfit(curve, k, settings.count) if settings.refine else (0.0, False)
    high = low = NO_DISPARITY, NO_DISPARITY
    if settings.steps > 0:
        high, low = subpixel_cuts(curve, lowest, k + shift, settings)
    elif settings.cut_level >= 0:
        first, last = _interval(curve, lowest, settings.count, settings.cut_level, settings.refine)
        high = settings.minimum + first, settings.minimum + last
    # An empty table counts nothing. In a branch, numba would count references at every pixel: 4 to 7 % slower.
    count = settings.count if settings.weights.size else 0
    return settings.minimum + k, shift, refined, high, low, ambiguity(curve, count, lowest, settings.weights)
