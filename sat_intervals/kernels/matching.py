"""SGM and the reading of every finished cost curve, in two sweeps over a patch.

The sweep down stores the sum of its four paths. The sweep up adds its own four, and reads winner, refinement, interval,
ambiguity and the right view's winner from the finished curve while it is in the cache. No other volume is stored, and
each sweep ends at the last row of the wanted pixels.

Letters: r row, c column, k disparity index (disparity = minimum + k).
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from sat_intervals.kernels.compiled import cached
from sat_intervals.kernels.confidence import ambiguity
from sat_intervals.kernels.cost import Candidates, Costs, cost_curve, padded_to_lanes
from sat_intervals.kernels.disparity import vfit
from sat_intervals.kernels.intervals import alpha_cut
from sat_intervals.kernels.penalties import Gradients, Penalties, fill_row, make_penalties
from sat_intervals.kernels.sgm import WALL, Paths, add_curve, advance_pixel, enter_row, path_slots, restart
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
    NOT_REFINED,
    RANGE_INCOMPLETE,
    RIGHT_MASKED,
)
from sat_intervals.tiling import Window


class Settings(NamedTuple):
    """Settings in the form that the kernels take.

    Attributes
    ----------
    minimum, count
        First disparity of the search range and number of disparities.
    impossible
        Matching cost of an impossible candidate inside SGM, above all possible ones.
    p1, p2, regularized
        Constant SGM penalties, and whether SGM runs; without it the aggregated cost is the matching cost.
    cut_level
        ``floor((1 - alpha) * span)``; -1: no interval.
    weights
        uint16: the table of `ambiguity`, for every cost above the lowest; empty: no ambiguity.
    refine
        Whether winners are refined, and bounds extended by one for it.
    """

    minimum: int
    count: int  # type: ignore[assignment]
    impossible: int
    p1: int
    p2: int
    regularized: bool
    cut_level: int
    weights: np.ndarray
    refine: bool


class Raw(NamedTuple):
    """Products read from single curves, all ``(rows, columns)``.

    Attributes
    ----------
    winner, lower, upper
        int16 disparities in pixels, NO_DISPARITY for none.
    disparity
        float32 refined disparity in pixels, NaN for none.
    cost
        uint16 aggregated cost of the winner, IMPOSSIBLE_COST for none.
    ambiguity
        uint32, 0 where there is no candidate.
    validity
        uint16 flags, without those of the left image's mask, cross-checking and regularisation.
    """

    winner: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    disparity: np.ndarray
    cost: np.ndarray
    ambiguity: np.ndarray
    validity: np.ndarray


class RightView(NamedTuple):
    """Winners of right pixels among the left pixels of a core; ``[r, c + k]`` faces left ``(r, c)`` at k.

    Attributes
    ----------
    cost
        ``(rows, columns + count - 1)`` uint16: the smallest aggregated cost, IMPOSSIBLE_COST for none.
    winner
        int16 of the same shape: its left disparity in pixels, the largest at ties; NO_DISPARITY for none.
    """

    cost: np.ndarray
    winner: np.ndarray


class _Rectangle(NamedTuple):
    """Window in the form that the kernels take."""

    row: int
    column: int
    row_stop: int
    column_stop: int


@njit(nogil=True, forceinline=True)
def _contains(rectangle, r, c):
    return rectangle.row <= r < rectangle.row_stop and rectangle.column <= c < rectangle.column_stop


class _Buffers(NamedTuple):
    """Inputs of both sweeps, and buffers for the current row, paths and curve.

    Attributes
    ----------
    possible
        ``(columns,)`` int64: number of possible candidates of each pixel of the row.
    curve
        ``(size,)`` uint16: buffer of one curve.
    """

    candidates: Candidates
    possible: np.ndarray
    penalties: Penalties
    paths: Paths
    curve: np.ndarray


def _prepare(costs: Costs, gradients: Gradients | None, settings: Settings) -> _Buffers:
    columns, size = costs.left_state.shape[1], padded_to_lanes(settings.count)
    beyond = np.zeros(size, np.uint16)
    beyond[settings.count :] = WALL
    slots = 1 + 3 * columns
    return _Buffers(
        Candidates(costs, np.zeros(columns + size, np.uint16), beyond),
        np.zeros(columns, np.int64),
        make_penalties(gradients, settings.p1, settings.p2, columns, size),
        Paths(np.zeros((slots, size), np.uint16), np.zeros(slots, np.uint16)),
        np.zeros(size, np.uint16),
    )


@njit(nogil=True)
def _enter_row(buffers, gradients, settings, r, down):
    """Fill a row's barrier, numbers of possible candidates and penalties, and start the paths that enter it.

    Returns ``falling`` and ``rising``, the row's arguments of `path_slots`.
    """
    (costs, barrier, _), possible, penalties, paths, _ = buffers
    for x in range(costs.right_state.shape[1]):
        barrier[x] = settings.impossible if costs.right_state[r, x] else 0
    usable = 0
    for x in range(settings.count - 1):
        usable += costs.right_state[r, x] == 0
    for c in range(possible.size):
        usable += costs.right_state[r, c + settings.count - 1] == 0
        possible[c] = usable if costs.left_state[r, c] == 0 else 0
        usable -= costs.right_state[r, c] == 0
    falling, rising = -r % possible.size, r % possible.size
    enter_row(paths, possible.size, falling, rising, down)
    fill_row(gradients, r, down, penalties.row)
    return falling, rising


@njit(nogil=True, forceinline=True)
def _close_impossible(curve, candidates, c):
    """Set impossible candidates and lanes behind the range to IMPOSSIBLE_COST; return the lowest cost."""
    lowest = splat(np.uint16(IMPOSSIBLE_COST))
    for k in range(0, curve.size, LANES):
        closed = fill_where_nonzero(larger(load(candidates.barrier, c + k), load(candidates.beyond, k)))
        costs = larger(load(curve, k), closed)
        store(curve, k, costs)
        lowest = smaller(lowest, costs)
    return smallest(lowest)


@njit(nogil=True, forceinline=True)
def _winner(curve, lowest):
    """First index with the lowest cost: 14 ns for 64 disparities by vectors, 36 ns by single costs."""
    k = 0
    mask = lanes_at_most(load(curve, k), lowest)
    while mask == 0:
        k += LANES
        mask = lanes_at_most(load(curve, k), lowest)
    return k + first_lane(mask)


@njit(nogil=True, forceinline=True)
def _interval(curve, lowest, count, cut_level, refine):
    """First and last index of the alpha-cut, extended by one where refinement may move a winner at a bound outside."""
    first, last = alpha_cut(curve, np.uint16(min(lowest + cut_level, IMPOSSIBLE_COST - 1)))
    first -= refine & (first > 0) & (curve[first] == lowest)
    last += refine & (last < count - 1) & (curve[last] == lowest)
    return first, last


class _RightPixels(NamedTuple):
    """Best candidates so far of the right pixels that face the left pixels of ``core``.

    Attributes
    ----------
    indices
        ``(size,)`` uint16: 0, 1, ...
    cost, best
        ``(rows, columns + size)`` uint16: the smallest cost so far, and its index k.
    """

    core: _Rectangle
    indices: np.ndarray
    cost: np.ndarray
    best: np.ndarray


@njit(nogil=True, forceinline=True)
def _update_right(curve, right, r, c):
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


@njit(nogil=True)
def _search_flags(costs, r, c, count, possible):
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


@njit(nogil=True, forceinline=True)
def _read_curve(curve, lowest, settings):
    """Winner, sub-pixel shift, whether it was refined, both bounds and ambiguity of a finished curve."""
    k = _winner(curve, lowest)
    shift, refined = vfit(curve, k, settings.count) if settings.refine else (0.0, False)
    lower = upper = NO_DISPARITY
    if settings.cut_level >= 0:
        first, last = _interval(curve, lowest, settings.count, settings.cut_level, settings.refine)
        lower, upper = settings.minimum + first, settings.minimum + last
    # An empty table counts nothing. In a branch, numba would count references at every pixel: 4 to 7 % slower.
    count = settings.count if settings.weights.size else 0
    return settings.minimum + k, shift, refined, lower, upper, ambiguity(curve, count, lowest, settings.weights)


@cached
def _sweep_down(buffers, gradients, settings, output, volume):
    """Store the sums of the four downward paths at the pixels of ``output``."""
    candidates, possible, penalties, paths, curve = buffers
    for r in range(output.row_stop):
        falling, rising = _enter_row(buffers, gradients, settings, r, True)
        for c in range(possible.size):
            slots = path_slots(c, possible.size, falling, rising)
            if possible[c] == 0:
                restart(paths, slots)
            elif _contains(output, r, c):
                offset = ((r - output.row) * volume.shape[1] + c - output.column) * curve.size
                advance_pixel(candidates, penalties, paths, slots, r, c, volume, offset)
            else:
                advance_pixel(candidates, penalties, paths, slots, r, c, curve, 0)


@cached
def _sweep_up(buffers, gradients, settings, output, volume, raw, right, keep):
    """Finish and read the curves of the pixels of ``output``, and update the right view."""
    candidates, possible, penalties, paths, curve = buffers
    winner, lower, upper, disparity, cost, ambiguity, validity = raw
    costs = candidates.costs
    for r in range(costs.left_state.shape[0] - 1, output.row - 1, -1):
        falling, rising = _enter_row(buffers, gradients, settings, r, False)
        for c in range(possible.size - 1, -1, -1):
            slots = path_slots(c, possible.size, falling, rising)
            if possible[c] == 0:
                restart(paths, slots)
            elif settings.regularized:
                advance_pixel(candidates, penalties, paths, slots, r, c, curve, 0)
            if not _contains(output, r, c):
                continue
            i, j = r - output.row, c - output.column
            if possible[c] < settings.count:
                validity[i, j] = _search_flags(costs, r, c, settings.count, possible[c])
            if possible[c] == 0:
                if keep:
                    volume[i, j] = IMPOSSIBLE_COST
                continue
            if settings.regularized:
                add_curve(curve, volume, (i * volume.shape[1] + j) * curve.size)
            else:
                cost_curve(candidates, r, c, curve)
            lowest = _close_impossible(curve, candidates, c)
            winner[i, j], shift, refined, lower[i, j], upper[i, j], ambiguity[i, j] = _read_curve(
                curve, lowest, settings
            )
            disparity[i, j], cost[i, j] = winner[i, j] + shift, lowest
            if not refined:
                validity[i, j] |= NOT_REFINED
            if _contains(right.core, r, c):
                _update_right(curve, right, r, c)
            if keep:
                volume[i, j] = curve


def _sweep(costs, gradients, settings, output, core, keep):
    """Run both sweeps; return the raw products, the right view and the volume (finished curves only with ``keep``)."""
    buffers = _prepare(costs, gradients, settings)
    size = buffers.curve.size
    shape = output.height, output.width
    # Allocated for each tile: a buffer kept between tiles (4 % faster) can pause a dask worker above its memory limit.
    volume = np.empty((*shape, size), np.uint16)
    raw = Raw(
        winner=np.full(shape, NO_DISPARITY, np.int16),
        lower=np.full(shape, NO_DISPARITY, np.int16),
        upper=np.full(shape, NO_DISPARITY, np.int16),
        disparity=np.full(shape, np.nan, np.float32),
        cost=np.full(shape, IMPOSSIBLE_COST, np.uint16),
        ambiguity=np.zeros(shape, np.uint32),
        validity=np.zeros(shape, np.uint16),
    )
    wanted, cores = (_Rectangle(w.row, w.column, w.row_stop, w.column_stop) for w in (output, core))
    cost = np.full((core.height, core.width + size), IMPOSSIBLE_COST, np.uint16)
    right = _RightPixels(cores, np.arange(size, dtype=np.uint16), cost, np.zeros(cost.shape, np.uint16))
    if settings.regularized:
        _sweep_down(buffers, gradients, settings, wanted, volume)
        for state in buffers.paths:
            state[:] = 0
    _sweep_up(buffers, gradients, settings, wanted, volume, raw, right, keep)
    cost = cost[:, : core.width + settings.count - 1]
    winner = right.best[:, : cost.shape[1]].astype(np.int16) + np.int16(settings.minimum)
    winner[cost == IMPOSSIBLE_COST] = NO_DISPARITY
    return raw, RightView(cost, winner), volume


def match_costs(
    costs: Costs,
    settings: Settings,
    output: Window,
    core: Window | None = None,
    gradients: Gradients | None = None,
) -> tuple[Raw, RightView]:
    """Match a patch: matching costs in, raw products and the right view's winners out.

    Parameters
    ----------
    costs
        Matching costs of ``(rows, columns)`` pixels.
    settings
        See `Settings`; 8 times the sum of the largest cost and the largest P2 is below IMPOSSIBLE_COST.
    output
        Pixels of the patch whose products are returned; the others only support them.
    core
        Left pixels that make the right view; by default those of ``output``.
    gradients
        Gradients that P1 and P2 follow; by default P1 and P2 are those of ``settings``.

    Returns
    -------
    Raw
        Of the shape of ``output``.
    RightView
        Of ``core.height`` rows and ``core.width + count - 1`` columns.
    """
    raw, right_view, _ = _sweep(costs, gradients, settings, output, core or output, False)
    return raw, right_view


def cost_volume(costs: Costs, settings: Settings, gradients: Gradients | None = None) -> np.ndarray:
    """Aggregated costs of a whole patch; without SGM these are the matching costs.

    Parameters as in `match_costs`. Returns ``(rows, columns, count)`` uint16, IMPOSSIBLE_COST at impossible candidates.
    """
    whole = Window(0, 0, *costs.left_state.shape)
    return _sweep(costs, gradients, settings, whole, whole, True)[2][:, :, : settings.count]
