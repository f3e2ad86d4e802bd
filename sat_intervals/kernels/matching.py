"""SGM and the reading of every finished cost curve, in two sweeps over a patch.

The sweep down keeps the sum of its four paths; the sweep up adds its own to it and reads winner, refinement,
interval, ambiguity and the right view's winner off the finished curve while it is in the cache. No volume but the
first sweep's sum is stored, and neither sweep goes further than the wanted pixels ask.

Letters: r row, c column, k disparity index (disparity = minimum + k).
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from sat_intervals.kernels.compiled import cached
from sat_intervals.kernels.confidence import ambiguity
from sat_intervals.kernels.cost import Costs, cost_curve, padded_to_lanes
from sat_intervals.kernels.disparity import vfit
from sat_intervals.kernels.intervals import alpha_cut
from sat_intervals.kernels.penalties import Gradients, fill_row, row_penalties
from sat_intervals.kernels.sgm import WALL, add_curve, advance_pixel, enter_row, path_slots, restart_all
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
    """What the kernels need to know of a configuration.

    Attributes
    ----------
    minimum, count
        First disparity of the search range and number of disparities.
    impossible
        Matching cost of an impossible candidate inside SGM, above all others.
    p1, p2, regularized
        SGM penalties where they are constant; without regularisation the aggregated cost is the matching cost itself.
    cut_level
        ``floor((1 - alpha) * span)``; -1: no interval.
    weights
        uint16: the number of etas that count a cost so far above the lowest, for all that there can be; empty: no
        ambiguity.
    refine
        Whether winners are refined, and bounds extended for it.
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
    """Products of single curves, all ``(rows, columns)``.

    Attributes
    ----------
    winner, lower, upper
        int16 disparities in pixels, NO_DISPARITY where there are none.
    disparity
        float32 refined disparity in pixels, NaN where there is none.
    cost
        uint16 aggregated cost of the winner, IMPOSSIBLE_COST where there is none.
    ambiguity
        uint32, 0 where there is no candidate.
    validity
        uint16 flags, but for the left image's own mask, cross-checking and regularisation.
    """

    winner: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    disparity: np.ndarray
    cost: np.ndarray
    ambiguity: np.ndarray
    validity: np.ndarray


class RightView(NamedTuple):
    """The right view's winners as far as some left pixels see them; ``[r, c + k]`` faces left ``(r, c)`` at k.

    Attributes
    ----------
    cost
        ``(rows, columns + count - 1)`` uint16: the smallest aggregated cost, IMPOSSIBLE_COST where there is none.
    winner
        int16 of the same shape: its disparity as seen from the left, the largest at ties; NO_DISPARITY for none.
    """

    cost: np.ndarray
    winner: np.ndarray


@njit(nogil=True)
def _candidates(left_state, right_state, r, count, impossible, barrier, possible):
    """Fill a row's barrier, the cost of impossible candidates or 0, and each pixel's number of possible candidates."""
    columns = left_state.shape[1]
    for x in range(right_state.shape[1]):
        barrier[x] = impossible if right_state[r, x] else 0
    usable = 0
    for x in range(count - 1):
        usable += right_state[r, x] == 0
    for c in range(columns):
        usable += right_state[r, c + count - 1] == 0
        possible[c] = usable if left_state[r, c] == 0 else 0
        usable -= right_state[r, c] == 0


@njit(nogil=True, forceinline=True)
def _wall_off(curve, barrier, beyond, c):
    """Put IMPOSSIBLE_COST where a candidate is impossible or beyond the range; returns the lowest cost."""
    lowest = splat(np.uint16(IMPOSSIBLE_COST))
    for k in range(0, curve.size, LANES):
        closed = fill_where_nonzero(larger(load(barrier, c + k), load(beyond, k)))
        costs = larger(load(curve, k), closed)
        store(curve, k, costs)
        lowest = smaller(lowest, costs)
    return smallest(lowest)


@njit(nogil=True, forceinline=True)
def _winner(curve, lowest):
    """The first index that has the lowest cost."""
    k = 0
    mask = lanes_at_most(load(curve, k), lowest)
    while mask == 0:
        k += LANES
        mask = lanes_at_most(load(curve, k), lowest)
    return k + first_lane(mask)


@njit(nogil=True, forceinline=True)
def _interval(curve, lowest, count, cut_level, refine):
    """First and last index of the alpha-cut; refinement moves a winner at a bound by up to half a pixel out of it."""
    first, last = alpha_cut(curve, np.uint16(min(lowest + cut_level, IMPOSSIBLE_COST - 1)))
    if refine:
        if curve[first] == lowest and first > 0:
            first -= 1
        if curve[last] == lowest and last < count - 1:
            last += 1
    return first, last


@njit(nogil=True, forceinline=True)
def _see_from_right(curve, index, cost, best, start):
    """Offer a left pixel's candidates to the right pixels it faces.

    The sweep up visits the left pixels of a row from right to left, so that ``k`` grows at a right pixel and a tie
    goes to the largest.
    """
    for k in range(0, curve.size, LANES):
        candidate, known = load(curve, k), load(cost, start + k)
        store(best, start + k, choose_smaller(candidate, known, load(index, k), load(best, start + k)))
        store(cost, start + k, smaller(candidate, known))


class _Inputs(NamedTuple):
    """What both sweeps read and write. They unpack it once: counting references would cost more than a pixel."""

    left: np.ndarray
    right: np.ndarray
    left_state: np.ndarray
    right_state: np.ndarray
    barrier: np.ndarray
    possible: np.ndarray
    beyond: np.ndarray
    paths: np.ndarray
    lowest: np.ndarray
    curve: np.ndarray


def _prepare(costs: Costs) -> _Inputs:
    columns = costs.left_state.shape[1]
    count = costs.right_state.shape[1] - columns + 1
    size = padded_to_lanes(count)
    beyond = np.zeros(size, np.uint16)
    beyond[count:] = WALL
    slots = 1 + 3 * columns
    return _Inputs(
        *costs,
        barrier=np.zeros(columns + size, np.uint16),
        possible=np.zeros(columns, np.int64),
        beyond=beyond,
        paths=np.zeros((slots, size), np.uint16),
        lowest=np.zeros(slots, np.uint16),
        curve=np.zeros(size, np.uint16),
    )


@cached
def _sweep_down(patch, gradients, settings, row, column, volume):
    """Store the sums of the downward paths of the wanted pixels, which begin at ``row, column``."""
    left, right, left_state, right_state, barrier, possible, beyond, paths, lowest, curve = patch
    count, impossible = settings.count, settings.impossible
    height, width, size = volume.shape
    columns = possible.size
    p1, p2, edges = row_penalties(gradients, settings.p1, settings.p2, columns, size)
    for r in range(row + height):
        _candidates(left_state, right_state, r, count, impossible, barrier, possible)
        falling, rising = -r % columns, r % columns
        enter_row(paths, lowest, columns, falling, rising, True)
        fill_row(gradients, r, True, p1, p2, edges)
        for c in range(columns):
            slots = path_slots(c, columns, falling, rising)
            if possible[c] == 0:
                restart_all(paths, lowest, slots)
            elif r >= row and column <= c < column + width:
                offset = ((r - row) * width + c - column) * size
                advance_pixel(left, right, barrier, beyond, r, c, p1, p2, edges, paths, lowest, slots, volume, offset)
            else:
                advance_pixel(left, right, barrier, beyond, r, c, p1, p2, edges, paths, lowest, slots, curve, 0)


@njit(nogil=True)
def _explain(left_state, right_state, r, c, count, possible):
    """Validity flags of what could be searched at a pixel; the left and the right image are blamed separately."""
    flags = 0
    if left_state[r, c] != 0:
        flags |= LEFT_WINDOW
    usable, masked = 0, False
    for x in range(c, c + count):
        usable += right_state[r, x] == 0
        masked |= right_state[r, x] & MASKED != 0
    if usable == 0:
        flags |= RIGHT_MASKED if masked else NO_CANDIDATE
    elif 0 < possible < count:
        flags |= RANGE_INCOMPLETE
    return flags


@cached
def _sweep_up(patch, gradients, settings, row, column, volume, keep, raw, core, index, right_cost, right_best):
    """Finish the curves of the wanted pixels and read them; ``core`` is what the right view is made of."""
    left, right, left_state, right_state, barrier, possible, beyond, paths, lowest, curve = patch
    winner, lower, upper, disparity, cost, doubt, validity = raw
    minimum, count, impossible, _, _, regularized, cut_level, weights, refine = settings
    height, width, size = volume.shape
    columns = possible.size
    p1, p2, edges = row_penalties(gradients, settings.p1, settings.p2, columns, size)
    for r in range(left_state.shape[0] - 1, row - 1, -1):
        _candidates(left_state, right_state, r, count, impossible, barrier, possible)
        falling, rising = -r % columns, r % columns
        enter_row(paths, lowest, columns, falling, rising, False)
        if regularized:
            fill_row(gradients, r, False, p1, p2, edges)
        wanted_row = r < row + height
        seen_row = core[0] <= r < core[0] + core[2]
        for c in range(columns - 1, -1, -1):
            slots = path_slots(c, columns, falling, rising)
            if possible[c] == 0:
                restart_all(paths, lowest, slots)
            elif regularized:
                advance_pixel(left, right, barrier, beyond, r, c, p1, p2, edges, paths, lowest, slots, curve, 0)
            if not (wanted_row and column <= c < column + width):
                continue
            i, j = r - row, c - column
            if possible[c] < count:
                validity[i, j] = _explain(left_state, right_state, r, c, count, possible[c])
            if possible[c] == 0:
                if keep:
                    volume[i, j] = IMPOSSIBLE_COST
                continue
            if regularized:
                add_curve(curve, volume, (i * width + j) * size)
            else:
                cost_curve(left, right, barrier, beyond, r, c, curve)
            least = _wall_off(curve, barrier, beyond, c)
            k = _winner(curve, least)
            shift, refined = vfit(curve, k, count) if refine else (0.0, False)
            winner[i, j], cost[i, j] = minimum + k, least
            disparity[i, j] = minimum + k + shift
            if not refined:
                validity[i, j] |= NOT_REFINED
            if cut_level >= 0:
                first, last = _interval(curve, least, count, cut_level, refine)
                lower[i, j], upper[i, j] = minimum + first, minimum + last
            if weights.size:
                doubt[i, j] = ambiguity(curve, count, least, weights)
            if seen_row and core[1] <= c < core[1] + core[3]:
                start = (r - core[0]) * right_cost.shape[1] + c - core[1]
                _see_from_right(curve, index, right_cost, right_best, start)
            if keep:
                volume[i, j] = curve


def _sweep(costs, gradients, settings, output, core, keep):
    """Both sweeps; returns the raw products, the right view and the volume (whole curves only with ``keep``)."""
    patch = _prepare(costs)
    size = patch.curve.size
    shape = output.height, output.width
    # fresh for each tile: room kept between tiles (4 % faster) would leave a worker of dask paused, above its memory
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
    right_cost = np.full((core.height, core.width + size), IMPOSSIBLE_COST, np.uint16)
    right_best = np.zeros(right_cost.shape, np.uint16)
    index = np.arange(size, dtype=np.uint16)
    if settings.regularized:
        _sweep_down(patch, gradients, settings, output.row, output.column, volume)
        patch.paths[:] = 0
        patch.lowest[:] = 0
    bounds = core.row, core.column, core.height, core.width
    wanted = output.row, output.column
    _sweep_up(patch, gradients, settings, *wanted, volume, keep, raw, bounds, index, right_cost, right_best)
    cost = right_cost[:, : core.width + settings.count - 1]
    winner = right_best[:, : cost.shape[1]].astype(np.int16) + np.int16(settings.minimum)
    winner[cost == IMPOSSIBLE_COST] = NO_DISPARITY
    return raw, RightView(cost, winner), volume


def match(
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
        Of ``(rows, columns)`` pixels.
    settings
        See `Settings`; 8 times the largest cost and the largest P2 stay below IMPOSSIBLE_COST.
    output
        The pixels of the patch whose products are wanted; the others only support them.
    core
        The pixels that make the right view; by default those of ``output``.
    gradients
        What P1 and P2 follow; by default they are those of ``settings`` everywhere.

    Returns
    -------
    Raw
        of the shape of ``output``.
    RightView
        of ``core.height`` rows and ``core.width + count - 1`` columns.
    """
    raw, right_view, _ = _sweep(costs, gradients, settings, output, core or output, False)
    return raw, right_view


def cost_volume(costs: Costs, settings: Settings, gradients: Gradients | None = None) -> np.ndarray:
    """Aggregated costs S (the matching cost itself without regularisation) of a whole patch.

    Parameters as in `match`. Returns ``(rows, columns, count)`` uint16, IMPOSSIBLE_COST at impossible candidates.
    """
    whole = Window(0, 0, *costs.left_state.shape)
    return _sweep(costs, gradients, settings, whole, whole, True)[2][:, :, : settings.count]
