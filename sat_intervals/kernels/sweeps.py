"""The two sweeps of SGM over a patch, and the tracing of path states alone.

The sweep down stores the sum of its four paths. The sweep up adds its own four, and reads winner, refinement, interval,
ambiguity and the right view's winner from the finished curve while it is in the cache. No other volume is stored, and
each sweep ends at the last row of the wanted pixels.
"""

from typing import NamedTuple

import numpy as np

from sat_intervals.kernels import reading, sgm
from sat_intervals.kernels.compiled import cached, part
from sat_intervals.kernels.cost import (
    Candidates,
    Cells,
    Costs,
    Ranges,
    cost_curve,
    enter_cells,
    padded_to_lanes,
    possible_count,
    span_at,
)
from sat_intervals.kernels.penalties import Gradients, Penalties, fill_row, make_penalties
from sat_intervals.kernels.reading import Rectangle, columns_of, contains, rectangle_of
from sat_intervals.kernels.sgm import LAST_WAVE, WALL, Borders, Edge, Paths
from sat_intervals.products import IMPOSSIBLE_COST, NOT_REFINED
from sat_intervals.tiling import Window


class Settings(NamedTuple):
    """Settings in the form that the kernels take.

    minimum, count: first disparity of the search range and number of disparities.
    impossible: matching cost of an impossible candidate inside SGM, above all possible ones.
    p1, p2, regularized: constant SGM penalties, and whether SGM runs; else the aggregated cost is the matching cost.
    cut_level: ``floor((1 - alpha) * span)`` of bounds in whole pixels; -1: none.
    high, low: levels of sub-pixel cuts above the lowest cost, of high and of low confidence; -1: none.
    steps: of bounds, per pixel; 1 for those in whole pixels.
    weights: uint16: the table of `ambiguity`, for every cost above the lowest; empty: no ambiguity.
    refine: whether winners are refined, and bounds extended by one for it.
    offset, total: first disparity, and number of disparities, of the whole search range that this one is a part of:
        ``minimum - offset`` is the first. 0: this is the whole range.
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
    high: float = -1.0
    low: float = -1.0
    steps: int = 1
    offset: int = 0
    total: int = 0


class Volume(NamedTuple):
    """Sums of L of the wanted pixels, each with the vectors that it searches.

    sums: uint16, one after another by row, column and candidate.
    rows: ``(rows + 1,)`` int64: where each row begins.
    places: ``(columns,)`` int64: where the candidate 0 of each pixel of the row is, or would be if it were searched.
    """

    sums: np.ndarray
    rows: np.ndarray
    places: np.ndarray


class Buffers(NamedTuple):
    """Inputs of both sweeps, and buffers for the current row, paths and curve.

    ranges: of the pixels of the row; None if all search all candidates: kernels are compiled for either form.
    usable: ``(columns + count,)`` int64: number of usable right pixels of the row before each one.
    possible: ``(columns,)`` int64: number of possible candidates of each pixel of the row.
    curve, opened: ``(size,)`` uint16: one curve; ``(2,)`` int64: its vectors that are in use, None if all are.
    inside: pixels whose paths are computed; those of the pixels around them come from ``around``.
    around: those of the two waves of the sweep.
    leaving: states that leave the pixels ``inside``, to fill; empty if nobody takes them over.
    down: direction of the sweep. As a constant argument of `_enter_row` it would be compiled for each direction.
    """

    candidates: Candidates
    cells: Cells
    ranges: Ranges | None
    usable: np.ndarray
    possible: np.ndarray
    penalties: Penalties
    paths: Paths
    curve: np.ndarray
    opened: np.ndarray | None
    inside: Rectangle
    around: tuple[Edge, ...]
    leaving: Edge
    down: bool


def new_buffers(
    costs: Costs,
    gradients: Gradients | None,
    settings: Settings,
    borders: Borders | None,
    cells: Cells | None,
    down: bool,
) -> Buffers:
    """Allocate the buffers of a sweep ``down`` or up; other parameters as in `match_costs`."""
    (rows, columns), size = costs.left_state.shape, padded_to_lanes(settings.count)
    left = borders.inside if borders else Window(0, 0, 0, 0)
    nothing = np.zeros((0, 2, size), np.uint16)
    inside, around = borders or (Window(0, 0, rows, columns), (Edge(nothing, nothing),) * len(sgm.WAVEFRONTS))
    has_cells = cells is not None
    k = np.arange(size)
    cells = cells or Cells(np.zeros((1, 1), np.int64), np.full((1, 1), settings.count - 1), rows, columns, 0, 0)
    walls = ((k < cells.first.reshape(-1, 1)) | (k > cells.last.reshape(-1, 1))) * np.uint16(WALL)
    return Buffers(
        Candidates(costs, np.zeros(columns + size, np.uint16), walls, np.zeros(columns, np.int64)),
        cells,
        Ranges(*np.zeros((4, columns), np.int64)) if has_cells else None,
        np.zeros(columns + settings.count, np.int64),
        np.zeros(columns, np.int64),
        make_penalties(gradients, settings.p1, settings.p2, columns, size),
        sgm.new_paths(columns, size, has_cells),
        np.zeros(size, np.uint16),
        np.array([0, size]) if has_cells else None,
        rectangle_of(inside),
        around[:2] if down else around[2:],
        Edge(np.zeros((left.height, 2, size), np.uint16), np.zeros((left.width, 2, size), np.uint16)),
        down,
    )


@part
def _enter_row(buffers, gradients, settings, r):
    """Fill a row's buffers and start the paths that enter it; return ``falling`` and ``rising`` of `path_slots`."""
    candidates, cells, ranges, usable, possible, penalties, paths, curve, _, inside, around, _, down = buffers
    costs, barrier = candidates.costs, candidates.barrier
    for x in range(costs.right_state.shape[1]):
        barrier[x] = settings.impossible if costs.right_state[r, x] else 0
        usable[x + 1] = usable[x] + (costs.right_state[r, x] == 0)
    enter_cells(candidates, cells, ranges, r)
    for c in range(possible.size):
        span = span_at(ranges, settings.count, curve.size, c)
        inner = usable[c + span.last + 1] - usable[c + span.first]
        possible[c] = possible_count(costs.possible, r, c, inner if costs.left_state[r, c] == 0 else 0)
    falling, rising = -r % possible.size, r % possible.size
    sgm.enter_row(paths, possible.size, falling, rising, down)
    sgm.take_over(paths, around, inside, r, falling, rising, down)
    fill_row(gradients, r, down, penalties.row)
    return falling, rising


@cached
def trace_wave(buffers, gradients, settings, wave):
    """Advance the paths of one wave through a patch and copy the states that leave it."""
    candidates, _, ranges, _, possible, penalties, paths, curve, _, inside, _, leaving, down = buffers
    rows = candidates.costs.left_state.shape[0]
    for step in range(inside.row_stop if down else rows - inside.row):
        r = step if down else rows - 1 - step
        falling, rising = _enter_row(buffers, gradients, settings, r)
        for c in columns_of(inside, r, down):
            slots = sgm.path_slots(c, possible.size, falling, rising)
            if possible[c] == 0:
                sgm.restart(paths, (slots[2 * wave], slots[2 * wave + 1]))
            else:
                span = span_at(ranges, settings.count, curve.size, c)
                sgm.advance_wave(candidates, span, penalties, paths, slots, wave, r, c)
        if inside.row <= r < inside.row_stop:
            sgm.hand_on(paths, inside, r, falling, rising, wave, down, leaving)


@part
def _enter_output(volume, ranges, size, output, r):
    """Set the places of the pixels of a row in the volume."""
    begin = volume.rows[r - output.row]
    for c in range(output.column, output.column_stop):
        span = span_at(ranges, size, size, c)
        volume.places[c] = begin - span.start
        begin += span.stop - span.start


@cached
def sweep_down(buffers, gradients, settings, output, volume):
    """Store the sums of the four downward paths at the pixels of ``output``."""
    candidates, _, ranges, _, possible, penalties, paths, curve, _, inside, _, _, _ = buffers
    for r in range(output.row_stop):
        falling, rising = _enter_row(buffers, gradients, settings, r)
        if r >= output.row:
            _enter_output(volume, ranges, curve.size, output, r)
        for c in columns_of(inside, r, True):
            slots = sgm.path_slots(c, possible.size, falling, rising)
            span = span_at(ranges, settings.count, curve.size, c)
            if possible[c] == 0:
                sgm.restart(paths, slots)
                continue
            target = (volume.sums, volume.places[c]) if contains(output, r, c) else (curve, 0)
            sgm.advance_pixel(candidates, span, penalties, paths, slots, r, c, target)


@cached
def sweep_up(buffers, gradients, settings, output, volume, raw, right, keep):
    """Finish and read the curves of the pixels of ``output``, update the right view, copy states of the last wave."""
    candidates, _, ranges, _, possible, penalties, paths, curve, opened, inside, _, leaving, _ = buffers
    winner, lower, upper, disparity, cost, ambiguity, validity, lower_low, upper_low = raw
    costs = candidates.costs
    for r in range(costs.left_state.shape[0] - 1, output.row - 1, -1):
        falling, rising = _enter_row(buffers, gradients, settings, r)
        if r < output.row_stop:
            _enter_output(volume, ranges, curve.size, output, r)
        for c in columns_of(inside, r, False):
            slots = sgm.path_slots(c, possible.size, falling, rising)
            span = span_at(ranges, settings.count, curve.size, c)
            reading.open_curve(curve, opened, span)
            if possible[c] == 0:
                sgm.restart(paths, slots)
            elif settings.regularized:
                sgm.advance_pixel(candidates, span, penalties, paths, slots, r, c, (curve, 0))
            if not contains(output, r, c):
                continue
            i, j, place = r - output.row, c - output.column, volume.places[c]
            if possible[c] < span.last + 1 - span.first:
                validity[i, j] = reading.search_flags(costs, r, c, span, possible[c])
            if possible[c] == 0:
                if keep:
                    volume.sums[place + span.start : place + span.stop] = IMPOSSIBLE_COST
                continue
            if settings.regularized:
                sgm.add_curve(curve, span, volume.sums, place)
            else:
                cost_curve(candidates, span, r, c, curve)
            lowest = reading.close_impossible(curve, candidates, span, r, c, settings.impossible)
            winner[i, j], shift, refined, high, low, ambiguity[i, j] = reading.read_curve(curve, span, lowest, settings)
            lower[i, j], upper[i, j] = high
            lower_low[i, j], upper_low[i, j] = low
            disparity[i, j], cost[i, j] = winner[i, j] + shift, lowest
            if not refined:
                validity[i, j] |= NOT_REFINED
            if contains(right.core, r, c):
                reading.update_right(curve, span, right, r, c)
            if keep:
                sgm.keep_curve(curve, span, volume.sums, place)
        if leaving.row.shape[0] and inside.row <= r < inside.row_stop:
            sgm.hand_on(paths, inside, r, falling, rising, LAST_WAVE, False, leaving)
