"""Census, SGM and the reading of every finished cost curve, in two sweeps over a patch.

The sweep down keeps the sum of its four paths; the sweep up adds its own to it and reads winner, refinement,
interval, ambiguity and the right view's winner off the finished curve while it is in the cache. No volume but the
first sweep's sum is stored, and neither sweep goes further than the wanted pixels ask.

Letters: r row, c column, k disparity index (disparity = minimum + k).
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from sat_intervals.kernels.confidence import ambiguity
from sat_intervals.kernels.cost import Codes, candidate_costs, padded_to_lanes
from sat_intervals.kernels.disparity import vfit
from sat_intervals.kernels.intervals import alpha_cut
from sat_intervals.kernels.sgm import WALL, advance_pixel, enter_row, path_slots, restart
from sat_intervals.kernels.vector import (
    LANES,
    add,
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
    window
        Side of the census window in pixels.
    p1, p2, regularized
        SGM penalties; without regularisation the aggregated cost is the matching cost itself.
    cut_level
        ``floor((1 - alpha) * span)``; -1: no interval.
    weights
        ``(span + 1,)`` uint16: the number of etas that count a cost so far above the lowest; empty: no ambiguity.
    refine
        Whether winners are refined, and bounds extended for it.
    """

    minimum: int
    count: int
    window: int
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
    """Fill a row's barrier (cost of impossible candidates) and the number of possible candidates of each pixel."""
    columns = left_state.shape[1]
    for x in range(right_state.shape[1]):
        barrier[x] = impossible if right_state[r, x] else 0
    usable = 0
    for x in range(count - 1):
        usable += right_state[r, x] == 0
    for c in range(columns):
        usable += right_state[r, c + count - 1] == 0
        possible[c] = usable
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
def _read_curve(curve, lowest, settings, raw, r, c):
    """Winner, refinement, interval and ambiguity of one pixel."""
    k = _winner(curve, lowest)
    raw.winner[r, c] = settings.minimum + k
    raw.cost[r, c] = lowest
    shift, refined = 0.0, False
    if settings.refine:
        shift, refined = vfit(curve, k, settings.count)
    raw.disparity[r, c] = np.float32(settings.minimum + k + shift)
    if not refined:
        raw.validity[r, c] |= NOT_REFINED
    if settings.cut_level >= 0:
        first, last = alpha_cut(curve, np.uint16(min(lowest + settings.cut_level, IMPOSSIBLE_COST - 1)))
        if settings.refine:  # refinement moves a winner at a bound out of the cut
            if curve[first] == lowest and first > 0:
                first -= 1
            if curve[last] == lowest and last < settings.count - 1:
                last += 1
        raw.lower[r, c] = settings.minimum + first
        raw.upper[r, c] = settings.minimum + last
    if settings.weights.size:
        raw.ambiguity[r, c] = ambiguity(curve, settings.count, lowest, settings.weights)


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


class _Patch(NamedTuple):
    """What both sweeps read and write."""

    left: Codes
    right: Codes  # words padded by whole vectors behind the last column
    barrier: np.ndarray
    possible: np.ndarray
    beyond: np.ndarray
    paths: np.ndarray
    lowest: np.ndarray
    curve: np.ndarray


def _prepare(left: Codes, right: Codes, settings: Settings) -> _Patch:
    rows, columns = left.state.shape
    size = padded_to_lanes(settings.count)
    words = np.zeros((right.words.shape[0], rows, columns + size), right.words.dtype)
    words[:, :, : right.words.shape[2]] = right.words
    beyond = np.zeros(size, np.uint16)
    beyond[settings.count :] = WALL
    slots = 1 + 3 * columns
    return _Patch(
        left=left,
        right=Codes(words, right.state),
        barrier=np.zeros(columns + size, np.uint16),
        possible=np.zeros(columns, np.int64),
        beyond=beyond,
        paths=np.zeros((slots, size), np.uint16),
        lowest=np.zeros(slots, np.uint16),
        curve=np.zeros(size, np.uint16),
    )


@njit(nogil=True, forceinline=True)
def _enter(patch, settings, r, down):
    """Make the row's candidates known and restart the paths that enter the patch in it; returns its diagonals."""
    columns = patch.possible.size
    impossible = settings.window**2 + settings.p2 + 1
    _candidates(patch.left.state, patch.right.state, r, settings.count, impossible, patch.barrier, patch.possible)
    falling, rising = -r % columns, r % columns
    enter_row(patch.paths, patch.lowest, columns, falling, rising, down)
    return falling, rising


@njit(nogil=True, forceinline=True)
def _advance_or_restart(patch, settings, r, c, falling, rising, target, offset):
    """Advance the four paths through a pixel; behind one that has no candidate they restart."""
    slots = path_slots(c, patch.possible.size, falling, rising)
    if patch.left.state[r, c] != 0 or patch.possible[c] == 0:
        for slot in slots:
            restart(patch.paths, patch.lowest, slot)
        return False
    advance_pixel(
        patch.left.words, patch.right.words, patch.barrier, patch.beyond, r, c,
        settings.p1, settings.p2, patch.paths, patch.lowest, slots, target, offset,
    )  # fmt: skip
    return True


@njit(nogil=True, cache=True)
def _sweep_down(patch, settings, row, column, volume):
    """Store the sums of the downward paths of the wanted pixels, which begin at ``row, column``."""
    height, width, size = volume.shape
    for r in range(row + height):
        falling, rising = _enter(patch, settings, r, True)
        for c in range(patch.possible.size):
            if r >= row and column <= c < column + width:
                offset = ((r - row) * width + c - column) * size
                _advance_or_restart(patch, settings, r, c, falling, rising, volume, offset)
            else:
                _advance_or_restart(patch, settings, r, c, falling, rising, patch.curve, 0)


@njit(nogil=True, forceinline=True)
def _finish_curve(patch, settings, r, c, volume, offset):
    """The aggregated curve of a pixel, its paths or its costs summed up; returns its lowest cost."""
    for k in range(0, patch.curve.size, LANES):
        if settings.regularized:
            costs = add(load(patch.curve, k), load(volume, offset + k))
        else:
            costs = candidate_costs(patch.left.words, patch.right.words, patch.barrier, patch.beyond, r, c, k)
        store(patch.curve, k, costs)
    return _wall_off(patch.curve, patch.barrier, patch.beyond, c)


@njit(nogil=True)
def _explain(patch, settings, r, c):
    """Validity flags of what could be searched at a pixel."""
    flags = 0
    left_closed = patch.left.state[r, c] != 0
    if left_closed:
        flags |= LEFT_WINDOW
    if patch.possible[c] == 0:
        masked = False
        for x in range(c, c + settings.count):
            masked |= patch.right.state[r, x] & MASKED != 0
        flags |= RIGHT_MASKED if masked else NO_CANDIDATE
    elif patch.possible[c] < settings.count and not left_closed:
        flags |= RANGE_INCOMPLETE
    return flags


@njit(nogil=True, cache=True)
def _sweep_up(patch, settings, row, column, volume, keep, raw, core, index, right_cost, right_best):
    """Finish the curves of the wanted pixels and read them; ``core`` is what the right view is made of."""
    height, width, size = volume.shape
    core_row, core_column, core_height, core_width = core
    for r in range(patch.left.state.shape[0] - 1, row - 1, -1):
        falling, rising = _enter(patch, settings, r, False)
        wanted_row = r < row + height
        shared_row = core_row <= r < core_row + core_height
        for c in range(patch.possible.size - 1, -1, -1):
            candidates = _advance_or_restart(patch, settings, r, c, falling, rising, patch.curve, 0)
            if not (wanted_row and column <= c < column + width):
                continue
            raw.validity[r - row, c - column] = _explain(patch, settings, r, c)
            offset = ((r - row) * width + c - column) * size
            if not candidates:
                if keep:
                    volume[r - row, c - column] = IMPOSSIBLE_COST
                continue
            lowest = _finish_curve(patch, settings, r, c, volume, offset)
            _read_curve(patch.curve, lowest, settings, raw, r - row, c - column)
            if shared_row and core_column <= c < core_column + core_width:
                start = (r - core_row) * right_cost.shape[1] + c - core_column
                _see_from_right(patch.curve, index, right_cost, right_best, start)
            if keep:
                volume[r - row, c - column] = patch.curve


def _volume(output: Window, size: int, buffer: np.ndarray | None) -> np.ndarray:
    shape = output.height, output.width, size
    if buffer is None:
        return np.empty(shape, np.uint16)
    return buffer[: output.height * output.width * size].reshape(shape)


def _sweep(left, right, settings, output, core, buffer, keep):
    """Both sweeps; returns the raw products, the right view and the volume (whole curves only with ``keep``)."""
    patch = _prepare(left, right, settings)
    size = patch.curve.size
    volume = _volume(output, size, buffer)
    shape = output.height, output.width
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
        _sweep_down(patch, settings, output.row, output.column, volume)
        patch.paths[:] = 0
        patch.lowest[:] = 0
    bounds = core.row, core.column, core.height, core.width
    _sweep_up(
        patch, settings, output.row, output.column, volume, keep, raw, bounds, index, right_cost, right_best
    )
    cost = right_cost[:, : core.width + settings.count - 1]
    winner = right_best[:, : cost.shape[1]].astype(np.int16) + np.int16(settings.minimum)
    winner[cost == IMPOSSIBLE_COST] = NO_DISPARITY
    return raw, RightView(cost, winner), volume


def match(
    left: Codes,
    right: Codes,
    settings: Settings,
    output: Window,
    core: Window | None = None,
    buffer: np.ndarray | None = None,
) -> tuple[Raw, RightView]:
    """Match a patch: census codes in, raw products and the right view's winners out.

    Parameters
    ----------
    left
        Codes of ``(rows, columns)`` pixels.
    right
        Codes of ``(rows, columns + count - 1)`` pixels: ``right[r, c + k]`` faces ``left[r, c]``.
    settings
        See `Settings`; ``8 * (window**2 - 1 + p2) < IMPOSSIBLE_COST``.
    output
        The pixels of the patch whose products are wanted; the others only support them.
    core
        The pixels that make the right view; by default those of ``output``.
    buffer
        uint16 memory for the volume, at least ``output.height * output.width * padded_to_lanes(count)``: fresh pages
        cost as much as the sweep that fills them.

    Returns
    -------
    Raw
        of the shape of ``output``.
    RightView
        of ``core.height`` rows and ``core.width + count - 1`` columns.
    """
    raw, right_view, _ = _sweep(left, right, settings, output, core or output, buffer, False)
    return raw, right_view


def cost_volume(left: Codes, right: Codes, settings: Settings) -> np.ndarray:
    """Aggregated costs S (the matching cost itself without regularisation) of a whole patch.

    Parameters as in `match`. Returns ``(rows, columns, count)`` uint16, IMPOSSIBLE_COST at impossible candidates.
    """
    whole = Window(0, 0, *left.state.shape)
    return _sweep(left, right, settings, whole, whole, None, True)[2][:, :, : settings.count]
