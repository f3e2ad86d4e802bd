"""Matching costs for SGM: Census (Zabih and Woodfill 1994; METHOD.md, section 1), or a precomputed volume.

Letters: w word of a code.
"""

from typing import NamedTuple

import numpy as np

from sat_intervals.kernels import vector
from sat_intervals.kernels.compiled import cached, inlined, part
from sat_intervals.kernels.vector import LANES
from sat_intervals.tiling import Window


class Codes(NamedTuple):
    """Census codes of a patch.

    words: ``(words, rows, columns)``, uint32 (one word up to window 5, two for 7), or two of uint64 above.
    state: ``(rows, columns)`` uint8: the union of the states of the window's pixels, 0 = usable.
    """

    words: np.ndarray
    state: np.ndarray


class Costs(NamedTuple):
    """Matching costs of a patch: Census codes to compare, or precomputed costs.

    left, right: words of Census codes, ``(words, rows, columns)`` and ``(words, rows, width)``, padded after the last
        column by whole vectors; or ``left`` holds the costs, ``(rows, columns, size)`` uint8 or uint16, and ``right``
        is None. ``size`` is the count padded to a multiple of 32 lanes, `padded_to_lanes`; lanes beyond the count may
        hold anything. Kernels are compiled for each form.
    left_state: ``(rows, columns)`` uint8, 0 = usable window.
    right_state: ``(rows, columns + count - 1)`` uint8: ``right_state[r, c + k]`` faces left ``(r, c)`` at index k.
    possible: ``(rows, columns)`` int64: number of possible candidates of each pixel, where the costs themselves mark
        the impossible ones, by ``Settings.impossible``; None where the states do.
    """

    left: np.ndarray
    right: np.ndarray | None
    left_state: np.ndarray
    right_state: np.ndarray
    possible: np.ndarray | None = None


def between(left: Codes, right: Codes) -> Costs:
    """Make `Costs` from the Census codes of a patch: Hamming distances.

    ``right`` has ``columns + count - 1`` columns: ``right[r, c + k]`` faces ``left[r, c]``.
    """
    rows, columns = left.state.shape
    size = padded_to_lanes(right.state.shape[1] - columns + 1)
    words = np.zeros((right.words.shape[0], rows, columns + size), right.words.dtype)
    words[:, :, : right.words.shape[2]] = right.words
    return Costs(left.words, words, left.state, right.state)


@cached
def _census_words(pixels, arm, words):
    """Shift the bits of each row of a window into its word: above the centre into the first, below it the last."""
    # ``arm`` is a tuple of as many items as the window's radius: the compiler knows how many, and unrolls the loops
    # over a row of the window. 5x5 takes 2.8 ms at 1024 x 1024, 5.1 ms with one neighbour at a time.
    radius, side, one = len(arm), 2 * len(arm) + 1, np.uint32(1)
    rows, columns = words.shape[1:]
    for r in range(rows):
        centre = pixels[r + radius, radius : radius + columns]  # slices: columns vectorise, 3.6 times faster
        for dr in range(side):
            line, word = pixels[r + dr], words[0 if dr < radius else -1, r]
            if dr != radius:
                for c in range(columns):
                    bits = np.uint32(0)
                    for dc in range(side):
                        bits = (bits << one) | np.uint32(line[c + dc] > centre[c])
                    word[c] = (word[c] << side) | bits
                continue
            before = words[0, r]
            for c in range(columns):
                bits = np.uint32(0)
                for dc in range(radius):
                    bits = (bits << one) | np.uint32(line[c + dc] > centre[c])
                before[c] = (before[c] << radius) | bits
            for c in range(columns):
                bits = np.uint32(0)
                for dc in range(radius + 1, side):
                    bits = (bits << one) | np.uint32(line[c + dc] > centre[c])
                word[c] = (word[c] << radius) | bits


@cached
def window_state(state, radius):
    """Union of the states of windows: uint8, ``(rows + 2 radius, columns + 2 radius)`` to ``(rows, columns)``."""
    # First along rows, then along columns: 5x5 takes 0.25 ms at 600 x 600, 13 ms with one window at a time.
    rows, columns = state.shape[0] - 2 * radius, state.shape[1] - 2 * radius
    union = np.zeros((rows, columns), np.uint8)
    across = np.zeros((state.shape[0], columns), np.uint8)
    for r in range(state.shape[0]):
        row = across[r]
        for dc in range(2 * radius + 1):
            other = state[r, dc : dc + columns]
            for c in range(columns):
                row[c] |= other[c]
    for r in range(rows):
        row = union[r]
        for dr in range(2 * radius + 1):
            other = across[r + dr]
            for c in range(columns):
                row[c] |= other[c]
    return union


def census(pixels: np.ndarray, state: np.ndarray, window: int) -> Codes:
    """Census codes: one bit per neighbour, set where the neighbour is greater than the centre.

    pixels: ``(rows + 2 R, columns + 2 R)`` float32 or float64 with ``R = window // 2``, finite everywhere.
    state: uint8 of the same shape; 0 = usable.
    window: side of the square window in pixels, odd, 3 to 11.
    Returns the codes of ``(rows, columns)`` pixels.
    """
    radius = window // 2
    dtype = np.uint32 if window <= 7 else np.uint64
    count = -(-(window**2 - 1) // (8 * np.dtype(dtype).itemsize))
    states = window_state(state, radius)
    words = np.zeros((count, *states.shape), dtype)
    _census_words(pixels, (0,) * radius, words)
    return Codes(words, states)


@inlined
def _matching_costs(left, right, r, c, k):
    """Costs of the candidates ``k .. k + 31`` of the left pixel ``(r, c)``; arrays as in `Costs`."""
    if right is None:
        return vector.load_costs(left, (r * left.shape[1] + c) * left.shape[2] + k)
    rows, width = right.shape[1:]
    costs = vector.hamming(right, r * width + c + k, left[0, r, c])
    for w in range(1, left.shape[0]):
        costs = vector.add(costs, vector.hamming(right, (w * rows + r) * width + c + k, left[w, r, c]))
    return costs


class Candidates(NamedTuple):
    """Candidates of a row of pixels.

    costs: those of all candidates, as if all were possible.
    barrier: ``(columns + size,)`` uint16: ``barrier[c + k]`` is the cost of an impossible candidate, or 0.
    beyond: ``(cells, size)`` uint16: 0 in the search range of a cell, above every cost before and after it.
    walls: ``(columns,)`` int64: where the row of ``beyond`` that applies to each pixel begins in ``beyond.ravel()``.
    """

    costs: Costs
    barrier: np.ndarray
    beyond: np.ndarray
    walls: np.ndarray


class Cells(NamedTuple):
    """Search ranges of the cells of a patch.

    first, last: ``(rows, columns)`` int64: first and last candidate k of each cell.
    height, width: pixels of a cell.
    row, column: first pixel of the patch, counted from the first pixel of the first cell.
    """

    first: np.ndarray
    last: np.ndarray
    height: int
    width: int
    row: int
    column: int


class Ranges(NamedTuple):
    """Search range of each pixel of a row, all ``(columns,)`` int64.

    first, last: first and last candidate.
    start, stop: the whole vectors ``[start, stop)`` that contain them; others are walls and never computed.
    """

    first: np.ndarray
    last: np.ndarray
    start: np.ndarray
    stop: np.ndarray


class Span(NamedTuple):
    """Search range of a pixel: candidates ``first .. last``, in the whole vectors ``[start, stop)``."""

    first: int
    last: int
    start: int
    stop: int


@inlined
def span_at(ranges, count, size, c):
    """Search range of the pixel in column ``c``; without ranges all ``count`` candidates, in ``size`` lanes."""
    if ranges is None:  # kernels are compiled for either form
        return Span(0, count - 1, 0, size)
    return Span(ranges.first[c], ranges.last[c], ranges.start[c], ranges.stop[c])


def volume_starts(cells: Cells, output: Window) -> np.ndarray:
    """Where each row begins in a volume of the vectors ``[start, stop)`` of every pixel: ``(rows + 1,)`` int64."""
    # The last is the size of the volume. Vectors are those of `enter_cells`: kernels write there without a check.
    row, column = cells.row + output.row, cells.column + output.column
    vectors = cells.last // LANES + 1 - cells.first // LANES
    of_rows = vectors[:, np.arange(column, column + output.width) // cells.width].sum(axis=1)
    sizes = LANES * of_rows[np.arange(row, row + output.height) // cells.height]
    return np.concatenate([[0], np.cumsum(sizes)])


@part
def enter_cells(candidates, cells, ranges, r):
    """Set the search ranges of the pixels of a row, if they have some, and where their walls are."""
    if ranges is None:
        return
    i, number = (r + cells.row) // cells.height, cells.first.shape[1]
    for j in range(number):
        first, last = cells.first[i, j], cells.last[i, j]
        begin = j * cells.width - cells.column
        for c in range(max(0, begin), min(ranges.first.size, begin + cells.width)):
            ranges.first[c], ranges.last[c] = first, last
            ranges.start[c], ranges.stop[c] = first // LANES * LANES, (last // LANES + 1) * LANES
            candidates.walls[c] = (i * number + j) * candidates.beyond.shape[1]


@inlined
def candidate_costs(candidates, r, c, k):
    """Costs of the candidates ``k .. k + 31`` of a pixel, raised where they are impossible or not searched."""
    costs = _matching_costs(candidates.costs.left, candidates.costs.right, r, c, k)
    barrier, beyond = vector.load(candidates.barrier, c + k), vector.load(candidates.beyond, candidates.walls[c] + k)
    return vector.larger(vector.larger(costs, barrier), beyond)


@inlined
def possible_count(possible, r, c, of_states):
    """Return the number of possible candidates of a pixel, by the states or as the costs mark them."""
    return of_states if possible is None else possible[r, c]


@inlined
def closed_by_costs(possible, left, r, c, k, impossible):
    """65535 where the costs of a volume mark the candidates ``k .. k + 31`` as impossible; zeros without marks."""
    if possible is None:
        return vector.splat(np.uint16(0))
    below = vector.splat(np.uint16(impossible - 1))
    costs = vector.load_costs(left, (r * left.shape[1] + c) * left.shape[2] + k)
    return vector.fill_where_nonzero(vector.subtract(vector.larger(costs, below), below))


@inlined
def cost_curve(candidates, span, r, c, curve):
    """Write the costs of the candidates of a pixel to ``curve``."""
    for k in range(span.start, span.stop, LANES):
        vector.store(curve, k, candidate_costs(candidates, r, c, k))


def padded_to_lanes(count: int) -> int:
    """Round a number of disparities up to a multiple of LANES."""
    return -(-count // LANES) * LANES
