"""Reading of a finished cost curve: winner, refinement, interval, ambiguity, flags, and the right view's winners."""

from typing import NamedTuple

import numpy as np

from sat_intervals.kernels import vector
from sat_intervals.kernels.compiled import inlined, part
from sat_intervals.kernels.confidence import ambiguity
from sat_intervals.kernels.cost import closed_by_costs
from sat_intervals.kernels.disparity import vfit
from sat_intervals.kernels.intervals import alpha_cut, first_at_most, subpixel_cuts
from sat_intervals.kernels.vector import LANES
from sat_intervals.products import (
    IMPOSSIBLE_COST,
    LEFT_WINDOW,
    MASKED,
    NO_BOUND,
    NO_CANDIDATE,
    RANGE_INCOMPLETE,
    RIGHT_MASKED,
)
from sat_intervals.tiling import Window


class Rectangle(NamedTuple):
    """Window in the form that the kernels take."""

    row: int
    column: int
    row_stop: int
    column_stop: int


def rectangle_of(window: Window) -> Rectangle:
    """Convert a window."""
    return Rectangle(window.row, window.column, window.row_stop, window.column_stop)


@inlined
def contains(rectangle, r, c):
    """Whether a rectangle contains the pixel ``(r, c)``."""
    return rectangle.row <= r < rectangle.row_stop and rectangle.column <= c < rectangle.column_stop


@inlined
def columns_of(inside, r, down):
    """Columns of row ``r`` that lie inside, in the order of the sweep."""
    if not inside.row <= r < inside.row_stop:
        return range(0, 0, 1)
    return range(inside.column, inside.column_stop, 1) if down else range(inside.column_stop - 1, inside.column - 1, -1)


@inlined
def open_curve(curve, opened, span):
    """Prepare a curve for a pixel: IMPOSSIBLE_COST outside its vectors; ``opened``: those before it, None: all."""
    if opened is None:
        return
    if opened[0] != span.start or opened[1] != span.stop:
        for k in range(0, curve.size, LANES):
            vector.store(curve, k, vector.splat(np.uint16(IMPOSSIBLE_COST)))
        opened[0], opened[1] = span.start, span.stop


@inlined
def close_impossible(curve, candidates, span, r, c, impossible):
    """Set impossible candidates and those that are not searched to IMPOSSIBLE_COST; return the lowest cost."""
    lowest = vector.splat(np.uint16(IMPOSSIBLE_COST))
    for k in range(span.start, span.stop, LANES):
        wall = vector.load(candidates.beyond, candidates.walls[c] + k)
        closed = vector.fill_where_nonzero(vector.larger(vector.load(candidates.barrier, c + k), wall))
        own = closed_by_costs(candidates.costs.possible, candidates.costs.left, r, c, k, impossible)
        closed = vector.larger(closed, own)
        costs = vector.larger(vector.load(curve, k), closed)
        vector.store(curve, k, costs)
        lowest = vector.smaller(lowest, costs)
    return vector.smallest(lowest)


@inlined
def _interval(curve, span, lowest, cut_level, refine):
    """First and last index of the alpha-cut, extended by one where refinement may move a winner at a bound outside."""
    first, last = alpha_cut(curve, span, np.uint16(min(lowest + cut_level, IMPOSSIBLE_COST - 1)))
    first -= refine & (first > span.first) & (curve[first] == lowest)
    last += refine & (last < span.last) & (curve[last] == lowest)
    return first, last


class RightPixels(NamedTuple):
    """Best candidates so far of the right pixels that face the left pixels of ``core``.

    indices: ``(size,)`` uint16: 0, 1, ...
    cost, best: ``(rows, columns + size)`` uint16: the smallest cost so far, and its index k.
    """

    core: Rectangle
    indices: np.ndarray
    cost: np.ndarray
    best: np.ndarray


@inlined
def update_right(curve, span, right, r, c):
    """Update the right pixels that a left pixel faces with its candidates."""
    # The sweep up visits the left pixels of a row from right to left, so ``k`` ascends at each right pixel and ties go
    # to the largest.
    start = (r - right.core.row) * right.cost.shape[1] + c - right.core.column
    for k in range(span.start, span.stop, LANES):
        candidate, known = vector.load(curve, k), vector.load(right.cost, start + k)
        index, best = vector.load(right.indices, k), vector.load(right.best, start + k)
        vector.store(right.best, start + k, vector.choose_smaller(candidate, known, index, best))
        vector.store(right.cost, start + k, vector.smaller(candidate, known))


@part
def search_flags(costs, r, c, span, possible):
    """Validity flags of a pixel without all candidates; the left and the right image set separate flags."""
    flags = LEFT_WINDOW if costs.left_state[r, c] != 0 else 0
    usable, masked = 0, False
    for x in range(c + span.first, c + span.last + 1):
        usable += costs.right_state[r, x] == 0
        masked |= costs.right_state[r, x] & MASKED != 0
    if usable == 0:
        flags |= RIGHT_MASKED if masked else NO_CANDIDATE
    elif possible < span.last + 1 - span.first and costs.left_state[r, c] == 0:
        flags |= RANGE_INCOMPLETE if possible > 0 else NO_CANDIDATE
    return flags


@inlined
def read_curve(curve, span, lowest, settings):
    """Winner, sub-pixel shift, whether it was refined, the bounds of both levels and ambiguity of a finished curve.

    Bounds are steps above the first disparity of the whole search range; NO_BOUND if they are off.
    """
    k = first_at_most(curve, span, lowest)
    shift, refined = vfit(curve, k, settings.count) if settings.refine else (0.0, False)
    high = low = NO_BOUND, NO_BOUND
    if settings.steps > 1:  # a test of the level, a float, makes the whole sweep 30 % slower
        high, low = subpixel_cuts(curve, span, lowest, k + shift, settings)
    elif settings.cut_level >= 0:
        first, last = _interval(curve, span, lowest, settings.cut_level, settings.refine)
        high = low = (settings.offset + first) * settings.steps, (settings.offset + last) * settings.steps
    # An empty table counts nothing. In a branch, numba would count references at every pixel: 4 to 7 % slower.
    stop = span.last + 1 if settings.weights.size else span.first
    amount = ambiguity(curve, span.first, stop, lowest, settings.weights)
    count = stop - span.first
    if 0 < count < settings.total:
        if _distrusts(k, span, settings):
            amount += settings.weights[0] * (settings.total - count)
        else:
            amount += amount * (settings.total - count) // count
    return settings.minimum + k, shift, refined, high, low, amount


@inlined
def _distrusts(k, span, settings):
    """Whether a winner is at or next to an end of its cell's range where the whole range goes on."""
    # The true disparity may then be among the candidates of the whole range that were not searched: they are ambiguous.
    first, last = settings.offset + span.first, settings.offset + span.last
    return (k <= span.first + 1 and first > 0) or (k >= span.last - 1 and last < settings.total - 1)
